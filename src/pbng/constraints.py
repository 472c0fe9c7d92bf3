"""Weak constraints: springs of no length between interpolated points, Eqs. (18)-(19), and their energy and forces.

With C = Σ_j w0_j x_j - Σ_j w1_j x_j the energy is ½ Cᵀ K C. Both sides' weights are kept as one list with signs; a side
that is a point in space, fixed or moving, is a *target*. Backward Euler's inertia has the same form: each vertex is
bound to where it would fly, with K = m/Δt² I.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from pbng.errors import InputError

ROUNDING = 1e-9  # what weights may sum to that should sum to zero


@dataclass(frozen=True, eq=False)
class WeakConstraints:
    """Weak constraints with stencils of one size.

    Args:
        vertices: Vertices of each stencil, (m, s) int32, none twice in a row.
        weights: Their weights w0 - w1, (m, s).
        K: Stiffness matrices [N/m], symmetric and positive semidefinite, (m, 3, 3).
        targets: ``t -> (m, 3)`` [m]: points that take the place of the second side; None if that has vertices too.

    Raises:
        InputError: Shapes do not fit, a number is not finite, weights do not sum to zero (to one with targets), a
            vertex stands twice in a stencil, or a K is not symmetric or has a negative eigenvalue.
    """

    vertices: np.ndarray
    weights: np.ndarray
    K: np.ndarray
    targets: Callable[[float], np.ndarray] | None = None

    def __post_init__(self) -> None:
        m = len(self.vertices)
        if self.vertices.ndim != 2 or m == 0 or self.weights.shape != self.vertices.shape:
            raise InputError(
                f"weak constraints: vertices and weights must have one shape (m, s), not {self.vertices.shape} and"
                f" {self.weights.shape}"
            )
        if self.K.shape != (m, 3, 3):
            raise InputError(f"weak constraints: K must have shape {(m, 3, 3)}, not {self.K.shape}")
        for name in ("weights", "K"):
            bad = np.flatnonzero(~np.isfinite(getattr(self, name).reshape(m, -1)).all(1))
            if len(bad):
                raise InputError(f"weak constraint {bad[0]}: {name} is not finite")
        wanted = 1.0 if self.targets else 0.0
        bad = np.flatnonzero(np.abs(self.weights.sum(1) - wanted) > ROUNDING)
        if len(bad):
            side = "to a point" if self.targets else "between two sides"
            raise InputError(
                f"weak constraint {bad[0]} {side}: weights sum to {self.weights[bad[0]].sum():.9g}, not {wanted:g}"
            )
        ordered = np.sort(self.vertices, axis=1)
        bad = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(1))
        if len(bad):
            raise InputError(f"weak constraint {bad[0]}: a vertex stands twice in {self.vertices[bad[0]].tolist()}")
        scale = np.abs(self.K).max(axis=(1, 2))
        bad = np.flatnonzero(
            (np.abs(self.K - self.K.transpose(0, 2, 1)).max(axis=(1, 2)) > ROUNDING * scale)
            | (np.linalg.eigvalsh(self.K)[:, 0] < -ROUNDING * scale)
        )
        if len(bad):
            raise InputError(f"weak constraint {bad[0]}: K must be symmetric without negative eigenvalues")

    @property
    def corners(self) -> int:
        """Vertices of each stencil."""
        return self.vertices.shape[1]

    @property
    def anchored(self) -> bool:
        """Whether the second side is a point in space."""
        return self.targets is not None


class WeakEnergy:
    """Energy, forces and Hessian of weak constraints in float64, for any numbering of the vertices.

    Args:
        constraints: The constraints; at least one.
        n: Length of the position arrays.
        slot: Number in them of each vertex; by default its own.
    """

    def __init__(self, constraints: Sequence[WeakConstraints], n: int, slot: np.ndarray | None = None) -> None:
        row, column, weight, first = [], [], [], 0
        self.anchored: list[slice] = []  # which have targets, in the order of these
        for c in constraints:
            m, s = c.vertices.shape
            row.append(np.repeat(np.arange(first, first + m), s))
            column.append((c.vertices if slot is None else slot[c.vertices]).ravel())
            weight.append(c.weights.ravel())
            if c.anchored:
                self.anchored.append(slice(first, first + m))
            first += m
        entries = np.concatenate(weight), (np.concatenate(row), np.concatenate(column))
        self.weights = scipy.sparse.csr_matrix(entries, (first, n))
        self.K = np.concatenate([c.K for c in constraints])
        self.k = self.K[:, 0, 0].copy()
        same = (self.k[:, None, None] * np.eye(3) == self.K).all((1, 2))  # in all directions: a number will do
        self.directed = np.flatnonzero(~same)

    def gaps(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """C (m, 3) [m] at x (n, 3), with targets (n_target, 3)."""
        C = self.weights @ x
        used = 0
        for which in self.anchored:
            m = which.stop - which.start
            C[which] -= targets[used : used + m]
            used += m
        return C

    def ends(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """The two points (m, 2, 3) [m] that each constraint ties together."""
        first = self.weights.maximum(0) @ x
        return np.stack([first, first - self.gaps(x, targets)], axis=1)

    def energy(self, x: np.ndarray, targets: np.ndarray) -> float:
        """½ Σ Cᵀ K C [J]."""
        C = self.gaps(x, targets)
        return 0.5 * float((C * self._pull(C)).sum())  # not by BLAS, whose threads show in the last bits

    def forces(self, x: np.ndarray, targets: np.ndarray) -> tuple[np.ndarray, float]:
        """Forces (n, 3) [N], Eq. (31), and the sum of the norms of all constraints' forces [N]."""
        pull = self._pull(self.gaps(x, targets))
        return -(self._spread @ pull), float((np.linalg.norm(pull, axis=1) * self._reach).sum())

    def _pull(self, C: np.ndarray) -> np.ndarray:
        """K C (m, 3) [N]."""
        pull = self.k[:, None] * C
        if len(self.directed):
            pull[self.directed] = np.einsum("mij,mj->mi", self.K[self.directed], C[self.directed])
        return pull

    @cached_property
    def _spread(self) -> scipy.sparse.csr_matrix:
        return self.weights.T.tocsr()

    @cached_property
    def _reach(self) -> np.ndarray:
        """Norm (m,) of each constraint's weights."""
        return np.sqrt(np.asarray(self.weights.multiply(self.weights).sum(1)).ravel())

    def hessian(self, U: scipy.sparse.csr_matrix | None = None) -> scipy.sparse.bsr_matrix:
        """Hessian [N/m] in blocks of 3x3, (3 n, 3 n), or U'HU for interpolation weights U (n, k): it is constant."""
        W = (self.weights if U is None else self.weights @ U).tocsr()
        k = self.k.copy()
        k[self.directed] = 0
        total = _blocks(W.T @ scipy.sparse.diags(k) @ W, np.eye(3))
        if len(self.directed):
            total = total + stencil_hessian(W[self.directed], self.K[self.directed])
        return total.tobsr((3, 3))


def stencil_hessian(W: scipy.sparse.csr_matrix, K: np.ndarray) -> scipy.sparse.bsr_matrix:
    """Σ (w ⊗ I) K (w ⊗ I)ᵀ over stencils with weights W (m, n) and matrices K (m, 3, 3), in blocks of 3x3."""
    m = len(K)
    B = _blocks(W, np.eye(3))
    stiffness = scipy.sparse.bsr_matrix((K, np.arange(m), np.arange(m + 1)), shape=(3 * m, 3 * m))
    return (B.T.tobsr((3, 3)) @ (stiffness @ B)).tobsr((3, 3))


def _blocks(matrix: scipy.sparse.csr_matrix, block: np.ndarray) -> scipy.sparse.bsr_matrix:
    """A matrix whose entries are each multiplied with a block (3, 3)."""
    matrix = matrix.tocsr()
    shape = 3 * matrix.shape[0], 3 * matrix.shape[1]
    return scipy.sparse.bsr_matrix((matrix.data[:, None, None] * block, matrix.indices, matrix.indptr), shape=shape)
