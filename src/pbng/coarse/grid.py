"""Grids over the rest shape, for trilinear interpolation inside whatever hangs together.

A cell of the grid is split into *pieces*, one for each connected set of elements whose centroids lie in it, and each
piece has its own eight corners. Corners of neighbouring pieces are one node only if the pieces share a vertex of the
mesh. So parts that touch in space but not in the mesh, such as a hand near a thigh, never share a node.
"""

from dataclasses import dataclass

import numpy as np

from pbng.topology import components

CORNERS = np.array(list(np.ndindex(2, 2, 2)))  # of a cell, in units of its size


@dataclass(frozen=True, eq=False)
class Grid:
    """Pieces of cells and their nodes.

    Attributes:
        node: Nodes at the corners of each piece, (n_piece, 8).
        position: Rest positions of the nodes [m], (n_node, 3).
        body: Body of each node, (n_node,).
        piece: The piece that each element lies in, (n_elem,).
        origin, size: Low corner [m] of each piece's cell and its edge lengths [m], (n_piece, 3).
        parents, weights: Interpolation: the nodes of each vertex and their weights, (n_vert, 8); they sum to one.
    """

    node: np.ndarray
    position: np.ndarray
    body: np.ndarray
    piece: np.ndarray
    origin: np.ndarray
    size: np.ndarray
    parents: np.ndarray
    weights: np.ndarray

    @property
    def n_node(self) -> int:
        return len(self.position)


def trilinear(u: np.ndarray) -> np.ndarray:
    """Weights (..., 8) of the corners of the unit cell at u (..., 3)."""
    factors = np.where(CORNERS == 1, u[..., None, :], 1 - u[..., None, :])
    return factors[..., 0] * factors[..., 1] * factors[..., 2]


def make_grid(X: np.ndarray, cells: np.ndarray, body: np.ndarray, low: np.ndarray, size: np.ndarray) -> Grid:
    """The grid over a mesh; the mesh may itself be a grid, of which this is a coarser one.

    Args:
        X: Rest positions [m], (n, 3).
        cells: Vertices of the elements, (m, k).
        body: Body of each vertex, (n,).
        low, size: Low corner and cell size [m] for each body, (n_body, 3).
    """
    owner = body[cells[:, 0]]
    place = np.maximum(np.floor((X[cells].mean(1) - low[owner]) / size[owner]), 0).astype(np.int64)
    _, cell = np.unique(((owner << 20 | place[:, 0]) << 20 | place[:, 1]) << 20 | place[:, 2], return_inverse=True)
    # What hangs together inside a cell: elements are joined by the vertices they share there.
    seen, number = np.unique(cell[:, None] * len(X) + cells, return_inverse=True)
    number = number.reshape(cells.shape).astype(np.int32)
    label = components(number, len(seen))
    piece, vertex = label[number[:, 0]], seen % len(X)
    first = np.unique(piece, return_index=True)[1]
    place, owner = place[first], owner[first]
    node = _merged(place, *_touching(vertex, label))
    n_node = int(node.max()) + 1
    position, of_body = np.empty((n_node, 3)), np.empty(n_node, np.int64)
    position[node] = low[owner][:, None] + (place[:, None] + CORNERS) * size[owner][:, None]
    of_body[node] = owner[:, None]
    origin, edges = low[owner] + place * size[owner], size[owner]
    best = _nearest(vertex, label, (X[vertex] - origin[label]) / edges[label], len(X))
    weights = trilinear((X - origin[best]) / edges[best])
    return Grid(node, position, of_body, piece, origin, edges, node[best], weights)


def coarser(grid: Grid, low: np.ndarray, size: np.ndarray) -> Grid:
    """The grid of cells twice as large; ``low`` and ``size`` are those of the given grid, for each body."""
    return make_grid(grid.position, grid.node, grid.body, low, 2 * size)


def _touching(vertex: np.ndarray, piece: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of pieces that share a vertex."""
    order = np.argsort(vertex, kind="stable")
    v, p = vertex[order], piece[order].astype(np.int64)
    found, step = [np.empty(0, np.int64)], 1
    while (same := v[step:] == v[:-step]).any():
        found.append(np.unique(p[:-step][same] << 32 | p[step:][same]))
        step += 1
    pairs = np.unique(np.concatenate(found))
    return pairs >> 32, pairs & 0xFFFFFFFF


def _merged(place: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Node numbers (n_piece, 8): corners at one place are one node if their pieces touch."""
    at = place[:, None] + CORNERS
    pair, i, j = np.nonzero((at[a][:, :, None] == at[b][:, None]).all(-1))
    same = np.stack([8 * a[pair] + i, 8 * b[pair] + j], axis=1).astype(np.int32)
    return components(same, 8 * len(place)).reshape(-1, 8)


def _nearest(vertex: np.ndarray, piece: np.ndarray, u: np.ndarray, n_vert: int) -> np.ndarray:
    """For each vertex the piece in whose cell it lies, or which it is nearest to, of those that it belongs to."""
    outside = np.maximum(np.maximum(-u, u - 1).max(1), 0)
    order = np.lexsort((piece, outside, vertex))
    best = np.zeros(n_vert, np.int64)
    best[vertex[order[::-1]]] = piece[order[::-1]]
    return best
