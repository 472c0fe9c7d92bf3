"""Stiffness matrices of membranes and hinges, exact or made positive semidefinite, for all elements of a group at once.

Cloth has few elements beside solids, so this is plain NumPy but for the change of the stress of a membrane.
"""

import math
from functools import cache
from typing import Any

import numpy as np

from pbng.dispatch import call, specialised
from pbng.elements.base import parameters
from pbng.elements.hinge import Hinge, least_squares, normals
from pbng.elements.membrane import SurfaceTriangle, plane_gradients
from pbng.errors import InputError
from pbng.jit import inline
from pbng.linalg import combine, dot
from pbng.materials.base import Model
from pbng.materials.differentials import STEP
from pbng.parallel import array, body, each, rows


class ClothStiffness:
    """The stiffness of a group of membranes or hinges.

    Args:
        group: The group (:class:`pbng.problem.ElementGroup`).
        X: Rest positions [m], (n_vert, 3).
    """

    def __init__(self, group: Any, X: np.ndarray) -> None:
        self.group, self.cells, self.X = group, group.cells, X[group.cells]
        if not isinstance(group.kind, SurfaceTriangle | Hinge):
            raise InputError(f"Newton: elements of kind {group.kind.name!r} have no Hessian; use PBNG")
        self.angle0 = _angle(self.X, self.X)[0] if isinstance(group.kind, Hinge) and group.kind.curved else 0.0

    def evaluate(self, x: np.ndarray, projection: str, floor: float) -> np.ndarray:
        """∂²E/∂x_a∂x_c [N/m] at x (n_vert, 3) for each pair of corners a, c, (n, corners, corners, 3, 3).

        Projection and floor as for :meth:`pbng.stiffness.StiffnessMatrix.fill`; of hinges what is projected is the
        whole matrix, and its floor is zero.
        """
        now = np.ascontiguousarray(x[self.cells], float)
        if isinstance(self.group.kind, Hinge):
            return _hinges(self.group, now, self.X, self.angle0, projection)
        return _membranes(self.group, now, self.X, projection, floor)


def projected(A: np.ndarray, projection: str, floor: float) -> np.ndarray:
    """Symmetric matrices (n, k, k) with eigenvalues below the floor raised to it, or first reflected ("abs")."""
    if projection == "none":
        return A
    e, Q = np.linalg.eigh((A + A.transpose(0, 2, 1)) / 2)
    e = np.maximum(np.abs(e) if projection == "abs" else e, floor)
    return np.einsum("nik,nk,njk->nij", Q, e, Q)


# ------------------------------------------------------------------------------------------------------- membranes


def _membranes(group: Any, x: np.ndarray, X: np.ndarray, projection: str, floor: float) -> np.ndarray:
    G = plane_gradients(X)
    F = np.ascontiguousarray(np.einsum("nai,nak->nki", x, G)).reshape(-1, 6)
    numbers = np.array(group.material.parameters(), float)
    H = np.empty((len(x), 36))
    each(change_of_stress(group.term.model), (F, numbers, H), len(x), grain=256)
    H = projected(H.reshape(-1, 6, 6), projection, floor * group.block().a).reshape(-1, 2, 3, 2, 3)
    return np.einsum("n,nak,nkimj,ncm->nacij", group.kind.volume(X), G, H, G, optimize=True)


@cache
def change_of_stress(model: Model) -> Any:
    """Body that writes ∂P_ik/∂F_jm of membranes low .. high, (2, 3, 2, 3) as (k, i, m, j)."""
    numbers, change = parameters(model.n_parameters), _differential(model)
    return specialised(make_change, (inline(lambda F, D, par, p: change(F, D, *numbers(par, p))),))


@cache
def _differential(model: Model) -> Any:
    """As :func:`pbng.materials.differentials.differential`, for F of two columns."""
    if model.hessian is not None:
        return model.hessian
    stress = model.stress

    @inline
    def difference(F, D, *numbers):
        h = STEP * (1.0 + math.sqrt(dot(F[0], F[0]) + dot(F[1], F[1])))
        P = stress((combine(1.0, F[0], h, D[0]), combine(1.0, F[1], h, D[1])), *numbers)
        M = stress((combine(1.0, F[0], -h, D[0]), combine(1.0, F[1], -h, D[1])), *numbers)
        d = 0.5 / h
        return combine(d, P[0], -d, M[0]), combine(d, P[1], -d, M[1])

    return difference


def make_change(key: str) -> Any:
    """The body of :func:`change_of_stress`."""

    @body
    def change(arguments, low, high):
        F, par, H = (
            rows(arguments, 0, 6, np.float64),
            array(arguments, 1, np.float64),
            rows(arguments, 2, 36, np.float64),
        )
        for n in range(low, high):
            columns = (F[n, 0], F[n, 1], F[n, 2]), (F[n, 3], F[n, 4], F[n, 5])
            for d in range(6):
                first = 1.0 * (d == 0), 1.0 * (d == 1), 1.0 * (d == 2)
                second = 1.0 * (d == 3), 1.0 * (d == 4), 1.0 * (d == 5)
                P = call(key, 0, (columns, (first, second), par, np.uint64(0)))
                for i in range(3):
                    H[n, 6 * i + d], H[n, 6 * (3 + i) + d] = P[0][i], P[1][i]

    return change


# ---------------------------------------------------------------------------------------------------------- hinges


def _hinges(group: Any, x: np.ndarray, X: np.ndarray, angle0: np.ndarray | float, projection: str) -> np.ndarray:
    """w k (g gᵀ + (θ - θ₀) ∂²θ/∂x∂x)."""
    angle, gradient, hessian = _angle(x, X)
    angle = (np.remainder(angle - angle0 + np.pi, 2 * np.pi) - np.pi)[:, None, None]
    g = gradient.reshape(-1, 12)
    K = projected(g[:, :, None] * g[:, None] + angle * hessian, projection, 0.0)
    K *= group.material.k * group.kind.volume(X)[:, None, None]
    return K.reshape(-1, 4, 3, 4, 3).transpose(0, 1, 3, 2, 4)


def _angle(x: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """θ (n,) and its derivatives (n, 4, 3) and (n, 12, 12) at x (n, 4, 3), by :mod:`pbng.elements.hinge`'s formulae.

    The second are those of the first along twelve directions.
    """
    least = least_squares(X)[:, None]
    n1, n2 = normals(x)
    e, a, b = (x[:, k] - x[:, 0] for k in (1, 2, 3))
    length = np.linalg.norm(e, axis=1, keepdims=True)
    unit = e / np.maximum(length, 1e-18)
    angle = np.arctan2(-length[:, 0] * (n1 * b).sum(1), (n1 * n2).sum(1))
    m1, m2 = (np.maximum((n**2).sum(1, keepdims=True), least) for n in (n1, n2))
    p, q = n1 / m1, n2 / m2
    arms = [(e - a, e - b), (a, b)]  # of the ends of the edge
    gradient = np.stack([*(_dot(u, unit) * p + _dot(v, unit) * q for u, v in arms), -length * p, -length * q], axis=1)

    D = np.eye(12).reshape(1, 12, 4, 3)
    de, da, db = (D[:, :, k] - D[:, :, 0] for k in (1, 2, 3))
    e, a, b, unit, p, q, length, m1, m2 = (v[:, None] for v in (e, a, b, unit, p, q, length, m1, m2))
    dn1, dn2 = np.cross(de, a) + np.cross(e, da), np.cross(db, e) + np.cross(b, de)
    free1, free2 = m1 > least[:, None], m2 > least[:, None]  # not at the least
    dp = dn1 / m1 - 2 * p * _dot(p, dn1) * free1
    dq = dn2 / m2 - 2 * q * _dot(q, dn2) * free2
    dlength = _dot(unit, de)
    dunit = (de - unit * dlength) / np.maximum(length, 1e-18)
    second = []
    for u, v, du, dv in ((e - a, e - b, de - da, de - db), (a, b, da, db)):
        along_p, along_q = _dot(du, unit) + _dot(u, dunit), _dot(dv, unit) + _dot(v, dunit)
        second.append(along_p * p + _dot(u, unit) * dp + along_q * q + _dot(v, unit) * dq)
    second += [-dlength * p - length * dp, -dlength * q - length * dq]
    hessian = np.stack(second, axis=2).reshape(-1, 12, 12)
    return angle, gradient, (hessian + hessian.transpose(0, 2, 1)) / 2


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(-1, keepdims=True)
