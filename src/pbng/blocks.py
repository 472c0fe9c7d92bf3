"""Square matrices of 3x3 blocks in compressed rows."""

from functools import cached_property

import numpy as np
import scipy.sparse

from pbng.parallel import array, body, each, rows


class BlockMatrix:
    """A square matrix of 3x3 blocks in compressed rows.

    Attributes:
        start: Where each row's blocks start, (n + 1,) int64.
        column: Columns of the blocks, rising in each row, (n_block,) int32.
        value: The blocks [N/m], each row by row, (n_block, 9) float64.
    """

    def __init__(self, start: np.ndarray, column: np.ndarray, value: np.ndarray | None = None) -> None:
        self.start, self.column = start, column
        self.value = np.zeros((len(column), 9)) if value is None else value

    def __len__(self) -> int:
        """Number of rows of blocks."""
        return len(self.start) - 1

    def __matmul__(self, x: np.ndarray) -> np.ndarray:
        """The product with x (n, 3), or flat (3 n,)."""
        x = np.ascontiguousarray(x, float)
        y = np.empty_like(x)
        each(_multiply, (self.start, self.column, self.value, x, y), len(self), grain=256)
        return y

    @cached_property
    def diagonal(self) -> np.ndarray:
        """Numbers of the diagonal blocks, (n,)."""
        row = np.repeat(np.arange(len(self)), np.diff(self.start))
        return np.flatnonzero(row == self.column)

    def sparse(self) -> scipy.sparse.bsr_matrix:
        """As SciPy's matrix (3 n, 3 n), which shares the values."""
        n = 3 * len(self)
        return scipy.sparse.bsr_matrix((self.value.reshape(-1, 3, 3), self.column, self.start), shape=(n, n))


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
