"""Linear systems on the grids: block matrices in compressed rows, and conjugate gradients with a V-cycle.

Smoothing is block Gauss-Seidel, forwards before the coarser grid and backwards after it, so that the V-cycle is
symmetric; the coarsest grid is solved by a factorisation.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from threadpoolctl import ThreadpoolController

from pbng.blocks import BlockMatrix
from pbng.coarse.cloth import Restriction
from pbng.coarse.grid import Grid
from pbng.jit import serial
from pbng.linalg import adjugate, scale
from pbng.parallel import array, body, each, rows

# On few cores threads of BLAS only get in the way of Numba's, and their number would show in the last bits.
_blas = ThreadpoolController()
SHIFT = 1e-6  # of each diagonal block: few elements may leave directions of a piece free, or a whole body loose
MOST, MOST_CLOTH = 30, 100  # iterations of conjugate gradients
DENSE = 400  # unknowns up to which the coarsest matrix is factorised as a dense one


class GridMatrix(BlockMatrix):
    """A symmetric matrix, one row of blocks a node, summed from the stiffness of pieces.

    Args:
        node: Nodes of the pieces, (n_piece, 8).
        n_node: Number of nodes.
        loose: n_node * row + column of blocks that are given each time, as those of cloth are; rising.
    """

    def __init__(self, node: np.ndarray, n_node: int, loose: np.ndarray | None = None) -> None:
        self.n_node = n_node
        self.loose = np.empty(0, np.int64) if loose is None else loose
        key = (node[:, :, None].astype(np.int64) * n_node + node[:, None, :]).ravel()
        order = np.argsort(key, kind="stable")
        self.key = key[order]
        self.own = (
            self.key[np.flatnonzero(np.concatenate([[True], self.key[1:] != self.key[:-1]]))] if order.size else key
        )
        if len(self.loose):
            self.own = np.unique(np.concatenate([self.own, self.loose, np.arange(n_node) * (n_node + 1)]))
        piece, a, b = order // 64, order // 8 % 8, order % 8
        self.source = 576 * piece + 24 * a + b  # where a block's first entry is in the stiffness
        self.inverse = np.empty((n_node, 9))
        self.add(None)

    def add(self, constant: scipy.sparse.bsr_matrix | None) -> None:
        """What is added to the stiffness from now on, in blocks of 3x3, (3 n_node, 3 n_node)."""
        n, present = self.n_node, self.own
        if constant is not None:
            more = np.repeat(np.arange(n), np.diff(constant.indptr)) * n + constant.indices
            present = np.union1d(present, more)
        self.source_start = np.append(np.searchsorted(self.key, present), len(self.key))
        self.loose_at = np.searchsorted(present, self.loose)
        super().__init__(np.searchsorted(present // n, np.arange(n + 1)), (present % n).astype(np.int32))
        self.diagonal = np.flatnonzero(present // n == self.column)
        self.constant = None
        if constant is not None:
            self.constant = np.zeros((len(present), 9))
            self.constant[np.searchsorted(present, more)] = constant.data.reshape(-1, 9)

    def assemble(self, stiffness: np.ndarray, least: np.ndarray, loose: np.ndarray | None = None) -> None:
        """Sum stiffness (n_piece, 3, 8, 3, 8) and loose blocks (n_loose, 9), with diagonal blocks no weaker than
        ``least`` (n_node,) [N/m]."""
        each(_gather, (self.source_start, self.source, stiffness, self.value), len(self.value), grain=1024)
        if loose is not None:
            self.value[self.loose_at] += loose
        _raise_diagonal(self.diagonal, self.value, least)
        if self.constant is not None:
            self.value += self.constant
        _invert_diagonal(self.diagonal, self.value, self.inverse)


@dataclass(frozen=True, eq=False)
class Level:
    """A level finer than all grids, of nodes of the finest grid and of vertices.

    Attributes:
        up: Weights (n, n_node) of the nodes of the finest grid at its nodes.
        piece: Which of that grid's pieces it has, (k,).
        node: Its nodes of these, (k, 8).
        keys: n * row + column of the blocks of cloth, rising.
    """

    up: scipy.sparse.csr_matrix
    piece: np.ndarray
    node: np.ndarray
    keys: np.ndarray


class GridSolver:
    """Solves with the matrix of the finest of some grids, or of a level above them.

    Args:
        grids: From fine to coarse, at least one.
        top: The level above, if there is one.
    """

    def __init__(self, grids: list[Grid], top: Level | None = None) -> None:
        self.up = [interpolation(coarse) for coarse in grids[1:]]
        self.top, self.restrictions = top, []
        if top is None:
            self.matrices = [GridMatrix(g.node, g.n_node) for g in grids]
        else:
            self.up.insert(0, top.up)
            self.matrices, keys = [GridMatrix(top.node, top.up.shape[0], top.keys)], top.keys
            for grid, up in zip(grids, self.up):
                self.restrictions.append(Restriction(keys, up))
                keys = self.restrictions[-1].keys
                self.matrices.append(GridMatrix(grid.node, grid.n_node, keys))
        self.down = [u.T.tocsr() for u in self.up]
        self.split = np.cumsum([len(g.node) for g in grids])[:-1]

    def add(self, hessian: scipy.sparse.bsr_matrix | None) -> None:
        """What is added on the finest grid from now on, in blocks of 3x3; restricted to the others."""
        for level, matrix in enumerate(self.matrices):
            matrix.add(hessian)
            if hessian is not None and level < len(self.up):
                up = scipy.sparse.kron(self.up[level], np.eye(3), format="bsr")
                hessian = (up.T @ hessian @ up).tobsr((3, 3))

    @_blas.wrap(limits=1, user_api="blas")
    def factorise(
        self,
        stiffness: np.ndarray,
        least: list[np.ndarray],
        cloth: np.ndarray | None = None,
        exact: np.ndarray | None = None,
    ) -> None:
        """Take the stiffness (n_piece, 3, 8, 3, 8) of the pieces of all grids, numbered through, and blocks of cloth,
        made positive definite and exact."""
        parts = np.split(stiffness, self.split)
        if self.top is not None:
            parts.insert(0, parts[0][self.top.piece])
        definite = cloth
        for level, (matrix, part, low) in enumerate(zip(self.matrices, parts, least)):
            matrix.assemble(part, low, cloth)
            if cloth is not None and level < len(self.restrictions):
                cloth = self.restrictions[level](cloth)
        if exact is not None:
            m = self.matrices[0]
            self.exact = BlockMatrix(m.start, m.column, m.value.copy())
            self.exact.value[m.loose_at] += exact - definite
        coarsest = self.matrices[-1].sparse()
        if coarsest.shape[0] <= DENSE:
            factor = scipy.linalg.cho_factor(coarsest.toarray(), lower=True, overwrite_a=True, check_finite=False)
            self._bottom = lambda b: scipy.linalg.cho_solve(factor, b, check_finite=False)
        else:  # many small bodies: nothing is left to coarsen, and little to fill in
            self._bottom = scipy.sparse.linalg.splu(coarsest.tocsc()).solve

    def cycle(self, b: np.ndarray, level: int = 0) -> np.ndarray:
        """One symmetric V-cycle for b (n_node, 3) from zero."""
        if level == len(self.up):
            return self._bottom(b.ravel()).reshape(b.shape)
        m, x = self.matrices[level], np.zeros_like(b)
        _gauss_seidel(m.start, m.column, m.value, m.inverse, b, x, False)
        x += self.up[level] @ self.cycle(self.down[level] @ (b - m @ x), level + 1)
        _gauss_seidel(m.start, m.column, m.value, m.inverse, b, x, True)
        return x

    def solve(self, b: np.ndarray, tolerance: float, most: int | None = None) -> np.ndarray:
        """Conjugate gradients until the residual, measured by the V-cycle, has fallen by ``tolerance``."""
        x = self._solve(b, tolerance, most, self.matrices[0])
        assert x is not None
        return x

    def solve_exact(self, b: np.ndarray, tolerance: float, most: int | None = None) -> np.ndarray | None:
        """The same with cloth's exact Hessian; None if it is found not to be positive definite."""
        return self._solve(b, tolerance, most, self.exact, True)

    @_blas.wrap(limits=1, user_api="blas")
    def _solve(
        self, b: np.ndarray, tolerance: float, most: int | None, A: BlockMatrix, may_fail: bool = False
    ) -> np.ndarray | None:
        if not self.up:
            return self.cycle(b)
        x, r = np.zeros_like(b), b.copy()
        z = self.cycle(r)
        p, rz = z.copy(), float(np.vdot(r, z))
        first = rz
        for _ in range(most or (MOST_CLOTH if self.top else MOST)):
            if not rz > 0:
                break
            q = A @ p
            curvature = float(np.vdot(p, q))
            if may_fail and not curvature > 0:
                return None
            alpha = rz / curvature
            x += alpha * p
            r -= alpha * q
            z = self.cycle(r)
            rz, before = float(np.vdot(r, z)), rz
            if rz <= tolerance**2 * first:
                break
            p = z + (rz / before) * p
        return x


def interpolation(grid: Grid) -> scipy.sparse.csr_matrix:
    """Weights (n, n_node) of a grid's nodes at the vertices of what it was made for."""
    return weight_matrix(grid.parents, grid.weights, grid.n_node)


def weight_matrix(parents: np.ndarray, weights: np.ndarray, n_node: int) -> scipy.sparse.csr_matrix:
    """The matrix (n, n_node) of parents and weights (n, 8), without zeros."""
    row = np.repeat(np.arange(len(parents)), 8)
    matrix = scipy.sparse.csr_matrix((weights.ravel(), (row, parents.ravel())), (len(parents), n_node))
    matrix.eliminate_zeros()
    return matrix


@body
def _gather(arguments, low, high):
    """Body that sums blocks low .. high."""
    start, source = array(arguments, 0, np.int64), array(arguments, 1, np.int64)
    stiffness, value = array(arguments, 2, np.float64), rows(arguments, 3, 9, np.float64)
    for k in range(low, high):
        value[k] = 0.0
        for s in range(start[k], start[k + 1]):
            for i in range(3):
                for j in range(3):
                    value[k, 3 * i + j] += stiffness[source[s] + 192 * i + 8 * j]


@serial
def _raise_diagonal(diagonal, value, least):
    """Raise diagonal blocks, those weaker than ``least`` to it."""
    for r in range(diagonal.size):
        a = value[diagonal[r]]
        mean = (a[0] + a[4] + a[8]) / 3
        lift = max(SHIFT * mean, least[r] - mean)
        a[0] += lift
        a[4] += lift
        a[8] += lift


@serial
def _invert_diagonal(diagonal, value, inverse):
    for r in range(diagonal.size):
        a = value[diagonal[r]]
        adj, det = adjugate(a)
        d = 1 / det
        i = inverse[r]
        for k in range(3):
            row = scale(d, adj[k])
            i[3 * k], i[3 * k + 1], i[3 * k + 2] = row


@serial
def _gauss_seidel(start, column, value, inverse, b, x, backwards):
    n = start.size - 1
    for turn in range(n):
        r = n - 1 - turn if backwards else turn
        r0, r1, r2 = b[r, 0], b[r, 1], b[r, 2]
        for k in range(start[r], start[r + 1]):
            c = column[k]
            if c != r:
                a, u = value[k], x[c]
                r0 -= a[0] * u[0] + a[1] * u[1] + a[2] * u[2]
                r1 -= a[3] * u[0] + a[4] * u[1] + a[5] * u[2]
                r2 -= a[6] * u[0] + a[7] * u[1] + a[8] * u[2]
        i = inverse[r]
        x[r, 0] = i[0] * r0 + i[1] * r1 + i[2] * r2
        x[r, 1] = i[3] * r0 + i[4] * r1 + i[5] * r2
        x[r, 2] = i[6] * r0 + i[7] * r1 + i[8] * r2
