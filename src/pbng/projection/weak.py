"""Projection of weak constraints (18)-(19): vectors of three constraints with constant gradients.

Projections along the eigenvectors of K do not disturb each other, so all three are one step: with S = Σ_j w_j c_j², c a
weight and w an inverse mass, ΔΛ = -(A C + B Λ), A = (Δt² K S + I)⁻¹ Δt² K and B = (Δt² K S + I)⁻¹, which is Eq. (26)
along each eigenvector. For PBD A is the projector on the range of K over S, and B = 0.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pbng.coloring import color_constraints
from pbng.constraints import WeakConstraints
from pbng.dispatch import specialised
from pbng.parallel import array, body, rows, run


class WeakPass:
    """All weak constraints but inertia, by colour.

    Args:
        constraints: The weak constraints of the problem, inertia left out.
        place, inverse_mass: New number and inverse mass [1/kg] of each vertex, (n_vert,).
        dt, compliant, dtype: As for :class:`pbng.projection.elastic.ElasticPass`.

    Attributes:
        color: Colour of each constraint, numbered through.
    """

    def __init__(
        self,
        constraints: Sequence[WeakConstraints],
        place: np.ndarray,
        inverse_mass: np.ndarray,
        dt: float,
        compliant: bool,
        dtype: Any,
    ) -> None:
        self.dtype = np.dtype(dtype)
        self.color = color_constraints([w.vertices for w in constraints], len(place))
        parts: list[tuple[np.ndarray, ...]] = []
        n_target = 0
        for w in constraints:
            S = (inverse_mass[w.vertices] * w.weights**2).sum(1)
            targets = n_target + np.arange(len(S)) if w.anchored else np.full(len(S), -1)
            n_target += len(S) * w.anchored
            parts.append((w.vertices, w.weights, _matrices(w.K, S, dt, compliant), targets, S > 0))
        self._lay_out(parts, place)

    def _lay_out(self, parts: list[tuple[np.ndarray, ...]], place: np.ndarray) -> None:
        size = np.concatenate([np.full(len(v), v.shape[1]) for v, *_ in parts])
        first = np.cumsum(size) - size
        vertices = np.concatenate([v.ravel() for v, *_ in parts])
        weights = np.concatenate([p[1].ravel() for p in parts])
        matrices, target, movable = (np.concatenate([p[k] for p in parts]) for k in (2, 3, 4))
        order = np.lexsort((place[vertices[first]], np.where(movable, self.color, -1)))[np.sum(~movable) :]
        entry = np.concatenate([first[n] + np.arange(size[n]) for n in order]) if len(order) else np.empty(0, int)
        self.vertices = (4 * place[vertices[entry]]).astype(np.uint32)
        self.weights = weights[entry].astype(self.dtype)
        self.first = np.concatenate([[0], np.cumsum(size[order])])
        self.target, self.matrices = target[order], matrices[order].astype(self.dtype)
        self.start = np.cumsum(np.bincount(self.color[order] + 1)) if len(order) else np.zeros(1, np.int64)
        self.colors = np.arange(len(self.start) - 1)
        self.targets = np.zeros((1, 3), self.dtype)
        self.multipliers = np.zeros((len(order), 3), self.dtype)

    def aim(self, targets: np.ndarray) -> None:
        """Set the points in space (n_target, 3) that constraints end at."""
        self.targets = np.ascontiguousarray(targets, self.dtype)

    def reset(self) -> None:
        """Set all multipliers to zero: a new time step."""
        self.multipliers[:] = 0

    def run(self, x: np.ndarray) -> None:
        """Project every constraint once, as :meth:`pbng.projection.elastic.ElasticPass.run`."""
        arrays = (x, self.first, self.vertices, self.weights, self.target, self.targets, self.matrices)
        run(specialised(make_pull, (), self.dtype), (*arrays, self.multipliers), self.colors, self.start, 64)


def _matrices(K: np.ndarray, S: np.ndarray, dt: float, compliant: bool) -> np.ndarray:
    """Upper triangles of A and B (m, 12) of weak constraints with K (m, 3, 3)."""
    k, Q = np.linalg.eigh(K)
    k = np.where(k > 1e-12 * np.abs(k).max(axis=1, keepdims=True), k, 0.0)
    S = np.where(S > 0, S, 1.0)[:, None]
    if compliant:
        kappa = k * dt**2
        values = kappa / (kappa * S + 1), 1 / (kappa * S + 1)
    else:
        values = (k > 0) / S, np.zeros_like(k)
    A, B = (np.einsum("mik,mk,mjk->mij", Q, v, Q) for v in values)
    upper = np.triu_indices(3)
    return np.concatenate([A[:, *upper], B[:, *upper]], axis=1)


def make_pull(key: str, dtype: np.dtype) -> Any:
    """Body of :meth:`WeakPass.run` for constraints low .. high of one colour."""
    real = dtype.type

    @body
    def pull(arguments, low, high):
        x, first = array(arguments, 0, real), array(arguments, 1, np.int64)
        vertices, weights = array(arguments, 2, np.uint32), array(arguments, 3, real)
        target, targets = array(arguments, 4, np.int64), rows(arguments, 5, 3, real)
        matrices, multipliers = rows(arguments, 6, 12, real), rows(arguments, 7, 3, real)
        for n in range(low, high):
            # C from differences to one vertex, as weights sum to zero, or to one with a target.
            p = vertices[first[n]]
            ox, oy, oz = x[p], x[p + 1], x[p + 2]
            cx = cy = cz = real(0)
            if target[n] >= 0:
                cx, cy, cz = ox - targets[target[n], 0], oy - targets[target[n], 1], oz - targets[target[n], 2]
            for k in range(first[n] + 1, first[n + 1]):
                p, weight = vertices[k], weights[k]
                cx += weight * (x[p] - ox)
                cy += weight * (x[p + 1] - oy)
                cz += weight * (x[p + 2] - oz)
            A, L = matrices[n], multipliers[n]
            dx = -(A[0] * cx + A[1] * cy + A[2] * cz + A[6] * L[0] + A[7] * L[1] + A[8] * L[2])
            dy = -(A[1] * cx + A[3] * cy + A[4] * cz + A[7] * L[0] + A[9] * L[1] + A[10] * L[2])
            dz = -(A[2] * cx + A[4] * cy + A[5] * cz + A[8] * L[0] + A[10] * L[1] + A[11] * L[2])
            L[0] += dx
            L[1] += dy
            L[2] += dz
            for k in range(first[n], first[n + 1]):
                p = vertices[k]
                step = x[p + 3] * weights[k]
                x[p] += step * dx
                x[p + 1] += step * dy
                x[p + 2] += step * dz

    return pull
