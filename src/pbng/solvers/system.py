"""A matrix in 3x3 blocks with what solvers of linear systems do to it: diagonal blocks, sweeps, triangles."""

import numpy as np
from numba import uint64

from pbng.blocks import BlockMatrix
from pbng.jit import inline
from pbng.linalg import adjugate, scale
from pbng.parallel import array, body, each, rows, run

SINGULAR = 1e-12  # determinant of a block, relative to the cube of its largest diagonal entry, that counts as zero
_1, _2, _3, _4, _5, _6, _7, _8, _9 = (uint64(n) for n in range(1, 10))


class System:
    """A matrix with what solvers ask of it.

    Args:
        matrix: The matrix; n rows of blocks.
        color_start: Where the rows of each colour start, (n_color + 1,): rows of one colour have no block in common.
        X: Rest positions of the vertices of the rows [m], (n, 3).
    """

    def __init__(self, matrix: BlockMatrix, color_start: np.ndarray, X: np.ndarray) -> None:
        self.matrix, self.X, self.color_start = matrix, X, color_start
        self.colors = np.arange(len(color_start) - 1)
        self.diagonal = matrix.diagonal
        self.inverse, self.definite = np.empty((len(matrix), 9)), np.empty(len(matrix), np.bool_)

    def invert_diagonal(self, positive: bool) -> bool:
        """Invert the diagonal blocks, and tell whether all are positive definite.

        What is singular is replaced by a multiple of the unit matrix; where positive is asked for, all that is not
        positive definite.
        """
        arrays = self.diagonal, self.matrix.value, np.array([positive]), self.inverse, self.definite
        each(_invert, arrays, len(self.matrix), grain=256)
        return bool(self.definite.all())

    def jacobi(self, r: np.ndarray) -> np.ndarray:
        """The inverted diagonal blocks times r (n, 3)."""
        z = np.empty_like(r)
        each(_scale, (self.inverse, r, z), len(r), grain=512)
        return z

    def sweep(self, b: np.ndarray, x: np.ndarray, omega: float) -> None:
        """One coloured sweep of block Gauss-Seidel with over-relaxation, in place."""
        m = self.matrix
        arrays = m.start, m.column, m.value, self.inverse, b, x, np.array([omega])
        run(_gauss_seidel, arrays, self.colors, self.color_start, grain=64)

    def forward(self, b: np.ndarray, v: np.ndarray, t: np.ndarray, p: np.ndarray, w: np.ndarray, g: np.ndarray) -> None:
        """Solve (L + D) v = b for the lower triangle L and the diagonal D; and w = t + v, g = p - L v. All (n, 3)."""
        m = self.matrix
        arrays = m.start, self.diagonal, m.column, m.value, self.inverse, b, v, t, p, w, g
        run(_forward, arrays, self.colors, self.color_start, grain=64)

    def backward(self, p: np.ndarray, t: np.ndarray, e: np.ndarray) -> None:
        """Solve (D + U) t = p for the upper triangle U; and e = U t. All (n, 3)."""
        m = self.matrix
        arrays = m.start, self.diagonal, m.column, m.value, self.inverse, p, t, e
        run(_backward, arrays, self.colors[::-1].copy(), self.color_start, grain=64)


@body
def _invert(arguments, low, high):
    """Body that inverts diagonal blocks low .. high."""
    diagonal, value = array(arguments, 0, np.int64), rows(arguments, 1, 9, np.float64)
    positive, inverse = array(arguments, 2, np.bool_)[0], rows(arguments, 3, 9, np.float64)
    definite = array(arguments, 4, np.bool_)
    for r in range(low, high):
        a, i = value[diagonal[r]], inverse[r]
        adj, det = adjugate(a)
        size = max(abs(a[0]), abs(a[4]), abs(a[8]))
        least = SINGULAR * size * size * size
        definite[r] = a[0] > 0 and a[0] * a[4] - a[1] * a[3] > 0 and det > least
        if definite[r] or (not positive and abs(det) > least):
            d = 1 / det
            for k in range(3):
                row = scale(d, adj[k])
                i[3 * k], i[3 * k + 1], i[3 * k + 2] = row
        else:
            i[:] = 0.0
            i[0] = i[4] = i[8] = 1 / size if size > 0 else 0.0


@body
def _scale(arguments, low, high):
    """Body of the product of blocks and vectors low .. high."""
    inverse = rows(arguments, 0, 9, np.float64)
    r, z = rows(arguments, 1, 3, np.float64), rows(arguments, 2, 3, np.float64)
    for n in range(low, high):
        a, u = inverse[n], r[n]
        z[n, 0] = a[0] * u[0] + a[1] * u[1] + a[2] * u[2]
        z[n, 1] = a[3] * u[0] + a[4] * u[1] + a[5] * u[2]
        z[n, 2] = a[6] * u[0] + a[7] * u[1] + a[8] * u[2]


@body
def _gauss_seidel(arguments, low, high):
    """Body of a sweep over rows low .. high."""
    start, column = array(arguments, 0, np.int64), array(arguments, 1, np.int32)
    value, inverse = rows(arguments, 2, 9, np.float64), rows(arguments, 3, 9, np.float64)
    b, x = rows(arguments, 4, 3, np.float64), rows(arguments, 5, 3, np.float64)
    omega = array(arguments, 6, np.float64)[0]
    for r in range(low, high):
        r0, r1, r2 = b[r, 0], b[r, 1], b[r, 2]
        for k in range(start[r], start[r + 1]):
            a, u = value[k], x[column[k]]
            r0 -= a[0] * u[0] + a[1] * u[1] + a[2] * u[2]
            r1 -= a[3] * u[0] + a[4] * u[1] + a[5] * u[2]
            r2 -= a[6] * u[0] + a[7] * u[1] + a[8] * u[2]
        i = inverse[r]
        x[r, 0] += omega * (i[0] * r0 + i[1] * r1 + i[2] * r2)
        x[r, 1] += omega * (i[3] * r0 + i[4] * r1 + i[5] * r2)
        x[r, 2] += omega * (i[6] * r0 + i[7] * r1 + i[8] * r2)


@body
def _forward(arguments, low, high):
    """Body of :meth:`System.forward` for rows low .. high."""
    start, diagonal = array(arguments, 0, np.int64), array(arguments, 1, np.int64)
    column, value = array(arguments, 2, np.int32), array(arguments, 3, np.float64)
    inverse, b, v = array(arguments, 4, np.float64), array(arguments, 5, np.float64), array(arguments, 6, np.float64)
    t, p = array(arguments, 7, np.float64), array(arguments, 8, np.float64)
    w, g = array(arguments, 9, np.float64), array(arguments, 10, np.float64)
    for r in range(low, high):
        y0, y1, y2 = _row(start[r], diagonal[r], column, value, v)
        o = _3 * uint64(r)
        g[o], g[o + _1], g[o + _2] = p[o] - y0, p[o + _1] - y1, p[o + _2] - y2
        v0, v1, v2 = _block(inverse, _9 * uint64(r), b[o] - y0, b[o + _1] - y1, b[o + _2] - y2)
        v[o], v[o + _1], v[o + _2] = v0, v1, v2
        w[o], w[o + _1], w[o + _2] = t[o] + v0, t[o + _1] + v1, t[o + _2] + v2


@body
def _backward(arguments, low, high):
    """Body of :meth:`System.backward` for rows low .. high."""
    start, diagonal = array(arguments, 0, np.int64), array(arguments, 1, np.int64)
    column, value = array(arguments, 2, np.int32), array(arguments, 3, np.float64)
    inverse, p = array(arguments, 4, np.float64), array(arguments, 5, np.float64)
    t, e = array(arguments, 6, np.float64), array(arguments, 7, np.float64)
    for r in range(low, high):
        y0, y1, y2 = _row(diagonal[r] + 1, start[r + 1], column, value, t)
        o = _3 * uint64(r)
        e[o], e[o + _1], e[o + _2] = y0, y1, y2
        t0, t1, t2 = _block(inverse, _9 * uint64(r), p[o] - y0, p[o + _1] - y1, p[o + _2] - y2)
        t[o], t[o + _1], t[o + _2] = t0, t1, t2


@inline
def _row(first, last, column, value, x):
    """The product of blocks first .. last with x."""
    y0, y1, y2 = 0.0, 0.0, 0.0
    for k in range(first, last):
        c = _3 * uint64(column[k])
        a = _block(value, _9 * uint64(k), x[c], x[c + _1], x[c + _2])
        y0, y1, y2 = y0 + a[0], y1 + a[1], y2 + a[2]
    return y0, y1, y2


@inline
def _block(value, v, x0, x1, x2):
    """The product of the block at v with a vector."""
    return (
        value[v] * x0 + value[v + _1] * x1 + value[v + _2] * x2,
        value[v + _3] * x0 + value[v + _4] * x1 + value[v + _5] * x2,
        value[v + _6] * x0 + value[v + _7] * x1 + value[v + _8] * x2,
    )
