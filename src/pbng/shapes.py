"""Meshes of simple shapes: those of the paper, of tests, examples and benchmarks."""

from collections.abc import Sequence

import numpy as np

from pbng.checks import checked_vector
from pbng.errors import InputError
from pbng.mesh import TetMesh, TriMesh

# Five tets of a cube whose corner (i, j, k) is number i + 2 j + 4 k, and their mirror image: cubes that alternate
# between the two agree on the diagonals of their common faces.
_FIVE = np.array([[0, 1, 2, 4], [3, 2, 1, 7], [5, 4, 7, 1], [6, 7, 4, 2], [1, 2, 4, 7]])
_FIVE_MIRRORED = np.array([[1, 0, 5, 3], [2, 3, 6, 0], [4, 5, 0, 6], [7, 6, 3, 5], [0, 3, 6, 5]])


def box(
    size: Sequence[float] = (1.0, 1.0, 1.0),
    vertices: Sequence[int] | int = 16,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> TetMesh:
    """A box on the paper's grid of 5 alternating tets a cell.

    Args:
        size: Edge lengths [m].
        vertices: Vertices along each axis, at least 2; n = 16, 32, 64, 128 along all give the paper's blocks of
            4,096 / 16,875, 32,768 / 148,955, 262,144 / 1,250,235 and 2,097,152 / 10,241,915 vertices / tets.
        origin: The lowest corner [m].

    Raises:
        InputError: A size is not positive or a count is below 2.
    """
    n = _counts("box", vertices, 3)
    axes = [o + np.linspace(0, s, m) for o, s, m in zip(checked_vector("origin", origin, 3), _sizes("box", size, 3), n)]
    X = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return TetMesh(X, _five_tets(n))


def _five_tets(n: tuple[int, ...]) -> np.ndarray:
    i, j, k = (a.ravel() for a in np.meshgrid(*(np.arange(m - 1, dtype=np.int32) for m in n), indexing="ij"))
    corner = np.stack(
        [((i + a) * n[1] + j + b) * n[2] + k + c for c in (0, 1) for b in (0, 1) for a in (0, 1)], axis=1
    ).astype(np.int32)
    even = (i + j + k) % 2 == 0
    cells = np.empty((len(i), 5, 4), np.int32)
    cells[even] = corner[even][:, _FIVE]
    cells[~even] = corner[~even][:, _FIVE_MIRRORED]
    return cells.reshape(-1, 4)


def beam(length: float = 4.0, width: float = 1.0, vertices: int = 8) -> TetMesh:
    """A slender box along x [m], ``vertices`` x ``vertices`` in section, its cells as near to cubes as can be."""
    length, width = _sizes("beam", (length, width), 2)
    (m,) = _counts("beam", vertices, 1)
    along = max(2, round(length / width * (m - 1)) + 1)
    return box((length, width, width), (along, m, m))


def sphere(radius: float = 1.0, vertices: int = 16, center: Sequence[float] = (0.0, 0.0, 0.0)) -> TetMesh:
    """A ball [m], a box grid of ``vertices`` along a diameter mapped onto it (its cells stay well shaped)."""
    (radius,) = _sizes("sphere", (radius,), 1)
    cube = box((2.0, 2.0, 2.0), vertices, (-1.0, -1.0, -1.0))
    X = _rounded(cube.X)
    return TetMesh(radius * X + checked_vector("center", center, 3), cube.cells)


def cylinder(radius: float = 0.5, length: float = 2.0, vertices: Sequence[int] | int = 12) -> TetMesh:
    """A solid cylinder along x [m]; ``vertices`` across a diameter, or (along, across)."""
    radius, length = _sizes("cylinder", (radius, length), 2)
    if isinstance(vertices, Sequence):
        along, across = _counts("cylinder", vertices, 2)
    else:
        (across,) = _counts("cylinder", vertices, 1)
        along = max(2, round(length / (2 * radius) * (across - 1)) + 1)
    grid = box((length, 2.0, 2.0), (along, across, across), (0.0, -1.0, -1.0))
    X = grid.X.copy()
    X[:, 1:] = radius * _rounded(X[:, 1:])
    return TetMesh(X, grid.cells)


def _rounded(X: np.ndarray) -> np.ndarray:
    """Map the cube [-1, 1]^d onto the unit ball: layers |X|_max = s go to radius s, corners drawn in gradually."""
    reach = np.abs(X).max(1, keepdims=True)
    norm = np.linalg.norm(X, axis=1, keepdims=True)
    ball = X * (reach / np.maximum(norm, 1e-300))
    return (1 - reach) * X / np.sqrt(X.shape[1]) + reach * ball


def rectangle(
    size: Sequence[float] = (1.0, 1.0), vertices: Sequence[int] | int = 16, origin: Sequence[float] = (0.0, 0.0)
) -> TriMesh:
    """A plane rectangle in z = 0 [m], two triangles a cell, their diagonals alternating."""
    return TriMesh(*_two_triangles("rectangle", size, vertices, origin))


def sheet(
    size: Sequence[float] = (1.0, 1.0),
    vertices: Sequence[int] | int = 16,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> TriMesh:
    """A level sheet, for cloth: a rectangle along x and z, its normal up, two triangles a cell, diagonals alternating.

    Args:
        size: Edge lengths along x and z [m].
        vertices: Vertices along each, at least 2.
        origin: The corner of least x and z [m].
    """
    flat, cells = _two_triangles("sheet", size, vertices, (0.0, 0.0))
    X = np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]]) + checked_vector("origin", origin, 3)
    return TriMesh(X, cells[:, [0, 2, 1]])


def _two_triangles(
    what: str, size: Sequence[float], vertices: Sequence[int] | int, origin: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 2) and triangles (m, 3) of a grid, counter-clockwise."""
    n = _counts(what, vertices, 2)
    axes = [o + np.linspace(0, s, m) for o, s, m in zip(checked_vector("origin", origin, 2), _sizes(what, size, 2), n)]
    X = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = (a.ravel() for a in np.meshgrid(*(np.arange(m - 1, dtype=np.int32) for m in n), indexing="ij"))
    a, b, c, d = i * n[1] + j, (i + 1) * n[1] + j, (i + 1) * n[1] + j + 1, i * n[1] + j + 1
    even = ((i + j) % 2 == 0)[:, None, None]
    one = np.stack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)], 1)
    other = np.stack([np.stack([a, b, d], 1), np.stack([b, c, d], 1)], 1)
    return X, np.where(even, one, other).reshape(-1, 3)


def _sizes(what: str, sizes: Sequence[float], n: int) -> tuple[float, ...]:
    sizes = checked_vector(f"{what}: size", sizes, n)
    if not all(s > 0 for s in sizes):
        raise InputError(f"{what}: sizes must be positive, not {sizes}")
    return sizes


def _counts(what: str, vertices: Sequence[int] | int, n: int) -> tuple[int, ...]:
    counts = tuple(vertices) if isinstance(vertices, Sequence) else (vertices,) * n
    if len(counts) != n or not all(isinstance(c, int | np.integer) and c >= 2 for c in counts):
        raise InputError(f"{what}: vertices must be {n} whole number(s) of at least 2, not {vertices}")
    return tuple(int(c) for c in counts)
