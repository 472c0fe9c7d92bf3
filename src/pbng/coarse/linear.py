"""Linear systems on the grids: block matrices in compressed rows, and conjugate gradients with a V-cycle.

Smoothing is block Gauss-Seidel, forwards before the coarser grid and backwards after it, so that the V-cycle is
symmetric; the coarsest grid is solved by a factorisation.
"""

import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from threadpoolctl import ThreadpoolController

from pbng.coarse.grid import Grid
from pbng.jit import serial
from pbng.linalg import adjugate, scale
from pbng.parallel import array, body, each, rows

# On few cores threads of BLAS only get in the way of Numba's, and their number would show in the last bits.
_blas = ThreadpoolController()
SHIFT = 1e-6  # of each diagonal block: few elements may leave directions of a piece free, or a whole body loose
DENSE = 400  # unknowns up to which the coarsest matrix is factorised as a dense one


class BlockMatrix:
    """A symmetric matrix of 3x3 blocks, one row of blocks a node, summed from the stiffness of pieces.

    Args:
        node: Nodes of the pieces, (n_piece, 8).
        n_node: Number of nodes.
    """

    def __init__(self, node: np.ndarray, n_node: int) -> None:
        self.n_node = n_node
        key = (node[:, :, None].astype(np.int64) * n_node + node[:, None, :]).ravel()
        order = np.argsort(key, kind="stable")
        self.key = key[order]
        self.own = self.key[np.flatnonzero(np.concatenate([[True], self.key[1:] != self.key[:-1]]))]
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
        self.column = (present % n).astype(np.int32)
        self.start = np.searchsorted(present // n, np.arange(n + 1))
        self.diagonal = np.flatnonzero(present // n == self.column)
        self.value = np.empty((len(present), 9))
        self.constant = None
        if constant is not None:
            self.constant = np.zeros((len(present), 9))
            self.constant[np.searchsorted(present, more)] = constant.data.reshape(-1, 9)

    def assemble(self, stiffness: np.ndarray, least: np.ndarray) -> None:
        """Sum stiffness (n_piece, 3, 8, 3, 8), with diagonal blocks no weaker than ``least`` (n_node,) [N/m]."""
        each(_gather, (self.source_start, self.source, stiffness, self.value), len(self.value), grain=1024)
        _raise_diagonal(self.diagonal, self.value, least)
        if self.constant is not None:
            self.value += self.constant
        _invert_diagonal(self.diagonal, self.value, self.inverse)

    def __matmul__(self, x: np.ndarray) -> np.ndarray:
        y = np.empty_like(x)
        each(_multiply, (self.start, self.column, self.value, x, y), len(x), grain=256)
        return y

    def sparse(self) -> scipy.sparse.bsr_matrix:
        n = len(self.start) - 1
        return scipy.sparse.bsr_matrix((self.value.reshape(-1, 3, 3), self.column, self.start), shape=(3 * n, 3 * n))


class GridSolver:
    """Solves with the matrix of the finest of some grids.

    Args:
        grids: From fine to coarse, at least one.
    """

    def __init__(self, grids: list[Grid]) -> None:
        self.up = [interpolation(coarse) for coarse in grids[1:]]
        self.matrices = [BlockMatrix(g.node, g.n_node) for g in grids]
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
    def factorise(self, stiffness: np.ndarray, least: list[np.ndarray]) -> None:
        """Take the stiffness (n_piece, 3, 8, 3, 8) of the pieces of all grids, numbered through."""
        for matrix, part, low in zip(self.matrices, np.split(stiffness, self.split), least):
            matrix.assemble(part, low)
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

    @_blas.wrap(limits=1, user_api="blas")
    def solve(self, b: np.ndarray, tolerance: float, most: int = 30) -> np.ndarray:
        """Conjugate gradients until the residual, measured by the V-cycle, has fallen by ``tolerance``."""
        if not self.up:
            return self.cycle(b)
        x, r = np.zeros_like(b), b.copy()
        z = self.cycle(r)
        p, rz = z.copy(), float(np.vdot(r, z))
        first = rz
        for _ in range(most):
            if not rz > 0:
                break
            q = self.matrices[0] @ p
            alpha = rz / float(np.vdot(p, q))
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


@body
def _multiply(arguments, low, high):
    """Body of the product of a matrix and a vector, for rows low .. high."""
    start, column = array(arguments, 0, np.int64), array(arguments, 1, np.int32)
    value, x, y = (
        rows(arguments, 2, 9, np.float64),
        rows(arguments, 3, 3, np.float64),
        rows(arguments, 4, 3, np.float64),
    )
    for r in range(low, high):
        y0, y1, y2 = 0.0, 0.0, 0.0
        for k in range(start[r], start[r + 1]):
            a, u = value[k], x[column[k]]
            y0 += a[0] * u[0] + a[1] * u[1] + a[2] * u[2]
            y1 += a[3] * u[0] + a[4] * u[1] + a[5] * u[2]
            y2 += a[6] * u[0] + a[7] * u[1] + a[8] * u[2]
        y[r, 0], y[r, 1], y[r, 2] = y0, y1, y2


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
