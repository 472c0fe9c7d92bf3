"""scikit-fem with MKL's Pardiso: Newton's method on Neo-Hookean (8) as one would write it, float64.

Newton's method without a projected Hessian or a line search does not converge from the hard start. So the load is
applied in steps, each begun by a linear prediction (the tangent's answer to the movement of the ends), grown by half
after a success and halved after a failure. States at partial loads are not looked at, but their time counts.
"""

import warnings

import numpy as np
import pypardiso
import skfem
from record import arguments
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, LinearForm, MeshTet

FIRST = 0.25  # load step
NEWTON = 25  # iterations a load step
PARTIAL = 1e-2  # to which, of its own first residual, a partial load is solved
WORSE = 1e2  # than it was first: the residual at which a load step is given up


def cross(a, b):
    """Cross product of fields of vectors (3, ...)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def mixed(A, B):
    """Derivative of cof F along B where F = A; twice the cofactor of A if B is A. Fields (3, 3, ...)."""
    pairs = ((1, 2), (2, 0), (0, 1))
    return np.stack([cross(A[:, i], B[:, j]) + cross(B[:, i], A[:, j]) for i, j in pairs], 1)


def double(A, B):
    """A : B, field by field."""
    return np.einsum("ij...,ij...", A, B)


@LinearForm
def internal_force(v, w):
    return double(w["P"], v.grad)


@BilinearForm
def tangent(u, v, w):
    volume = w["k"] * double(w["C"], u.grad) * double(w["C"], v.grad)
    return w["m"] * double(u.grad, v.grad) + volume + w["s"] * double(mixed(w["F"], u.grad), v.grad)


def main() -> None:
    problem, record = arguments()
    warnings.simplefilter("ignore")
    mu = problem.E / (2 * (1 + problem.nu))
    lam_hat = mu + problem.E * problem.nu / ((1 + problem.nu) * (1 - 2 * problem.nu))
    loads = len(problem.poses) - 1
    with record.phase("set-up"):
        mesh = MeshTet(problem.X.T.copy(), problem.cells.T.astype(np.int64))
        basis = Basis(mesh, ElementVector(ElementTetP1()), intorder=1)
        dofs = basis.nodal_dofs  # (3, n)
        held = dofs[:, problem.fixed]
        free = np.setdiff1d(np.arange(basis.N), held)

    def system(u):
        """Tangent, and internal force, at displacements u."""
        F = basis.interpolate(u).grad + np.eye(3)[:, :, None, None]
        C = mixed(F, F) / 2
        s = lam_hat * (double(F, C) / 3 - 1) - mu
        one = np.ones_like(s)
        K = tangent.assemble(basis, F=F, C=C, s=s, m=mu * one, k=lam_hat * one)
        return K, internal_force.assemble(basis, P=mu * F + s * C)

    def solve(K, b):
        return pypardiso.spsolve(K[free][:, free].tocsr(), b[free])

    iterations = 0
    u, done, step = np.zeros(basis.N), 0, int(FIRST * loads)
    while done < loads and step and not record.over:
        target = min(done + step, loads)
        w, first, good = u.copy(), None, False
        for k in range(NEWTON + 1):  # the first is the prediction
            with record:
                K, R = system(w)
                if k == 0:
                    d = np.zeros(basis.N)
                    d[held] = (problem.poses[target] - problem.X[problem.fixed]).T - w[held]
                    d[free] = solve(K, -(K @ d))
                else:
                    norm = np.linalg.norm(R[free])
                    first = norm if first is None else first
                    good = target < loads and norm <= PARTIAL * first
                    if good or not np.isfinite(norm) or norm > WORSE * first:
                        break
                    d = np.zeros(basis.N)
                    d[free] = solve(K, -R)
                w = w + d
            iterations += 1
            if target == loads:
                record.add(iterations, lambda w=w: problem.X + w[dofs].T, always=True)
            if record.over:
                break
        if good:
            u, done, step = w, target, step + step // 2
        else:
            step //= 2
    versions = {"scikit-fem": skfem.__version__, "pypardiso": pypardiso.__version__}
    record.close(versions, unit="Newton step", load=done / loads if not record.stopped else 1.0)


if __name__ == "__main__":
    main()
