"""Solvers of linear systems in 3x3 blocks, for Newton's method: direct, Krylov, Gauss-Seidel, algebraic multigrid.

Each is a frozen description whose ``start(system)`` returns what solves again and again with the present values of one
matrix: ``solve(b, forcing) -> Solution``. Matrices may be indefinite; what a solver then does is said in its class.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import scipy.sparse.linalg
from threadpoolctl import ThreadpoolController

from pbng.errors import InputError
from pbng.solvers.system import System

MOST = 5000  # iterations, where no number is given
_blas = ThreadpoolController()  # on one thread: its threads get in the way of Numba's, and show in the last bits


class Solution(NamedTuple):
    """Of a linear system: x (n, 3), the iterations it took, and whether the matrix was seen not to be positive."""

    x: np.ndarray
    iterations: int
    indefinite: bool = False


class LinearMethod(Protocol):
    """Solves with one matrix, whose values may change between solves."""

    def solve(self, b: np.ndarray, forcing: float) -> Solution:
        """Solve for b (n, 3), an iterative method until the residual has fallen to ``forcing`` of it."""


class LinearSolver(Protocol):
    """What a user configures."""

    def start(self, system: System) -> LinearMethod:
        """Everything that does not depend on the values of the matrix."""


@dataclass(frozen=True)
class Direct:
    """A sparse LU factorisation without regard to symmetry in the values, of SciPy (SuperLU).

    It solves with indefinite matrices too, and tells by its pivots that they are.
    """

    def start(self, system: System) -> "_Direct":
        return _Direct(system)


@dataclass(frozen=True)
class CG:
    """Preconditioned conjugate gradients, until the residual, in the norm of the preconditioner, is small enough.

    If a direction of negative curvature turns up it is not used: what was found before it is the solution, or, if it is
    the first, the preconditioned right-hand side. With a diagonal block that is not positive definite, which tells as
    much, the preconditioner is "jacobi", such blocks replaced.

    Args:
        tolerance: Of the residual, relative to the right-hand side; by default what Newton's method asks for.
        iterations: At most so many; by default 5,000.
        preconditioner: "gauss-seidel", a coloured sweep forwards and one backwards, or "jacobi", the diagonal blocks.
            An iteration costs about the same.
    """

    tolerance: float | None = None
    iterations: int | None = None
    preconditioner: str = "gauss-seidel"

    def __post_init__(self) -> None:
        _check_krylov(self)
        if self.preconditioner not in ("jacobi", "gauss-seidel"):
            raise InputError(f"CG: preconditioner must be 'jacobi' or 'gauss-seidel', not {self.preconditioner!r}")

    def start(self, system: System) -> "_CG":
        return _CG(system, self)


@dataclass(frozen=True)
class BiCGSTAB:
    """Stabilised biconjugate gradients, of SciPy, preconditioned by the diagonal blocks; for indefinite matrices.

    Args:
        tolerance: As for :class:`CG`.
        iterations: At most so many, as it may not converge.
    """

    tolerance: float | None = None
    iterations: int | None = 500

    def __post_init__(self) -> None:
        _check_krylov(self)

    def start(self, system: System) -> "_BiCGSTAB":
        return _BiCGSTAB(system, self)


@dataclass(frozen=True)
class GaussSeidel:
    """A number of coloured sweeps of block Gauss-Seidel from zero (section 11.1.3); the same for any matrix.

    Args:
        sweeps: How many.
        omega: Over-relaxation, in (0, 2).
    """

    sweeps: int = 7
    omega: float = 1.3

    def __post_init__(self) -> None:
        if not (isinstance(self.sweeps, int) and self.sweeps >= 1):
            raise InputError(f"GaussSeidel: sweeps must be a whole number of at least 1, not {self.sweeps}")
        if not 0 < self.omega < 2:
            raise InputError(f"GaussSeidel: omega must lie strictly between 0 and 2, not {self.omega}")

    def start(self, system: System) -> "_GaussSeidel":
        return _GaussSeidel(system, self)


@dataclass(frozen=True)
class AMG:
    """Conjugate gradients with smoothed aggregation of PyAMG, which knows the rigid motions; needs ``pbng[amg]``.

    Args:
        tolerance, iterations: As for :class:`CG`.
    """

    tolerance: float | None = None
    iterations: int | None = None

    def __post_init__(self) -> None:
        _check_krylov(self)

    def start(self, system: System) -> "_AMG":
        return _AMG(system, self)


NAMES: dict[str, Any] = {"direct": Direct, "cg": CG, "bicgstab": BiCGSTAB, "gauss-seidel": GaussSeidel, "amg": AMG}


def _check_krylov(solver: Any) -> None:
    who = type(solver).__name__
    if solver.tolerance is not None and not 0 <= solver.tolerance < 1:
        raise InputError(f"{who}: tolerance must lie in [0, 1), not {solver.tolerance}")
    if solver.iterations is not None and not (isinstance(solver.iterations, int) and solver.iterations >= 1):
        raise InputError(f"{who}: iterations must be a whole number of at least 1, not {solver.iterations}")


class _Direct:
    def __init__(self, system: System) -> None:
        self.matrix = system.matrix

    @_blas.wrap(limits=1, user_api="blas")
    def solve(self, b: np.ndarray, forcing: float) -> Solution:
        try:
            factor = scipy.sparse.linalg.splu(
                self.matrix.sparse().tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=1e-3,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # exactly singular, or not finite
            return Solution(np.zeros_like(b), 0, True)
        pivots = factor.U.diagonal()
        indefinite = bool((factor.perm_r != factor.perm_c).any() or not (pivots > 0).all())
        return Solution(factor.solve(b.ravel()).reshape(b.shape), 1, indefinite)


class _CG:
    def __init__(self, system: System, solver: CG) -> None:
        self.system, self.solver = system, solver

    @_blas.wrap(limits=1, user_api="blas")
    def solve(self, b: np.ndarray, forcing: float) -> Solution:
        system, (tolerance, most) = self.system, _limits(self.solver, forcing)
        definite = system.invert_diagonal(True)
        if definite and self.solver.preconditioner == "gauss-seidel":
            return symmetric_gauss_seidel(system, b, tolerance, most)
        solution = conjugate_gradients(system.matrix, b, system.jacobi, tolerance, most)
        return solution._replace(indefinite=not definite or solution.indefinite)


def conjugate_gradients(matrix: Any, b: np.ndarray, precondition: Any, tolerance: float, most: int) -> Solution:
    """Solve until r·M⁻¹r, with r = b - A x, is ``tolerance²`` of b·M⁻¹b, or until a direction of negative curvature."""
    x, r = np.zeros_like(b), b.copy()
    p = precondition(r)
    rz = float(np.vdot(r, p))
    enough = tolerance**2 * rz
    for n in range(most):
        if not (rz > 0 and math.isfinite(rz)):
            return Solution(x, n, not rz >= 0)
        q = matrix @ p
        curvature = float(np.vdot(p, q))
        if not curvature > 0:
            return Solution(p if n == 0 else x, n, True)
        alpha = rz / curvature
        x += alpha * p
        r -= alpha * q
        z = precondition(r)
        rz, before = float(np.vdot(r, z)), rz
        if rz <= enough:
            return Solution(x, n + 1)
        p *= rz / before
        p += z
    return Solution(x, most)


def symmetric_gauss_seidel(system: System, b: np.ndarray, tolerance: float, most: int) -> Solution:
    """The same with M = (L + D) D⁻¹ (D + U), for the price of one product with the matrix (Eisenstat 1981).

    In terms of y = (D + U) x the matrix is (L + D)⁻¹ A (D + U)⁻¹ with A = (L + D) + (D + U) - D. So, with t the
    solution of (D + U) t = p, its product with p is t + (L + D)⁻¹ (p - D t), where p - D t = U t: each triangle is read
    once. The residual s = (L + D)⁻¹ r and q = D s, whose product is r·M⁻¹r, are updated without reading D.
    """
    x, s, p, t, e, v, w, g = (np.zeros_like(b) for _ in range(8))
    system.forward(b, v, t, b, s, p)  # p = b - L s = D s
    q = p.copy()
    rz = float(np.vdot(s, q))
    enough = tolerance**2 * rz
    for n in range(most):
        if not (rz > 0 and math.isfinite(rz)):
            return Solution(x, n, not rz >= 0)
        system.backward(p, t, e)
        system.forward(e, v, t, p, w, g)
        curvature = float(np.vdot(p, w))
        if not curvature > 0:
            return Solution(t if n == 0 else x, n, True)
        alpha = rz / curvature
        x += np.multiply(alpha, t, out=e)
        s -= np.multiply(alpha, w, out=e)
        q -= np.multiply(alpha, g, out=e)
        rz, before = float(np.vdot(s, q)), rz
        if rz <= enough:
            return Solution(x, n + 1)
        p *= rz / before
        p += q
    return Solution(x, most)


def _limits(solver: Any, forcing: float) -> tuple[float, int]:
    tolerance = forcing if solver.tolerance is None else solver.tolerance
    return tolerance, solver.iterations or MOST


class _BiCGSTAB:
    def __init__(self, system: System, solver: BiCGSTAB) -> None:
        self.system, self.solver = system, solver

    @_blas.wrap(limits=1, user_api="blas")
    def solve(self, b: np.ndarray, forcing: float) -> Solution:
        self.system.invert_diagonal(False)
        tolerance, most = _limits(self.solver, forcing)
        n, count = b.size, 0

        def counted(_: np.ndarray) -> None:
            nonlocal count
            count += 1

        def jacobi(r: np.ndarray) -> np.ndarray:
            return self.system.jacobi(r.reshape(-1, 3)).ravel()

        A = scipy.sparse.linalg.LinearOperator((n, n), matvec=lambda v: self.system.matrix @ v.ravel(), dtype=float)
        M = scipy.sparse.linalg.LinearOperator((n, n), matvec=jacobi, dtype=float)
        with np.errstate(all="ignore"):  # what overflows is not finite, and seen
            x, _ = scipy.sparse.linalg.bicgstab(
                A, b.ravel(), rtol=tolerance, atol=0.0, maxiter=most, M=M, callback=counted
            )
        x = x.reshape(b.shape)
        return Solution(x, count, bool(np.vdot(x, b) < 0))


class _GaussSeidel:
    def __init__(self, system: System, solver: GaussSeidel) -> None:
        self.system, self.solver = system, solver

    def solve(self, b: np.ndarray, forcing: float) -> Solution:
        self.system.invert_diagonal(False)
        x = np.zeros_like(b)
        for _ in range(self.solver.sweeps):
            self.system.sweep(b, x, self.solver.omega)
        return Solution(x, self.solver.sweeps, bool(np.vdot(x, b) < 0))


class _AMG:
    def __init__(self, system: System, solver: AMG) -> None:
        try:
            import pyamg
        except ImportError as error:
            raise InputError("AMG: PyAMG is missing; install it with: pip install 'pbng[amg]'") from error
        self.pyamg, self.system, self.solver = pyamg, system, solver
        X = system.X - system.X.mean(0) if len(system.X) else system.X
        modes = np.zeros((len(X), 3, 6))
        modes[:, :, :3] = np.eye(3)
        modes[:, 1, 3], modes[:, 2, 3] = -X[:, 2], X[:, 1]
        modes[:, 2, 4], modes[:, 0, 4] = -X[:, 0], X[:, 2]
        modes[:, 0, 5], modes[:, 1, 5] = -X[:, 1], X[:, 0]
        self.rigid = modes.reshape(-1, 6)

    @_blas.wrap(limits=1, user_api="blas")
    def solve(self, b: np.ndarray, forcing: float) -> Solution:
        matrix = self.system.matrix.sparse()
        if not np.isfinite(self.system.matrix.value).all():
            return Solution(np.full_like(b, math.nan), 0, True)
        hierarchy = self.pyamg.smoothed_aggregation_solver(matrix, B=self.rigid, max_coarse=50)
        cycle = hierarchy.aspreconditioner()

        def precondition(r: np.ndarray) -> np.ndarray:
            return (cycle @ r.ravel()).reshape(r.shape)

        return conjugate_gradients(self.system.matrix, b, precondition, *_limits(self.solver, forcing))
