"""Grids and coarse spaces for tests, and plain ways to look at them."""

from dataclasses import replace

import numpy as np

import pbng
from pbng.coarse.grid import make_grid
from pbng.coarse.space import CoarseSpace
from pbng.packing import pack_problem

SOFT = pbng.Corotated(E=1e5, nu=0.3)


def coarse_space(problem, dtype=np.float64):
    packed = pack_problem(problem, dtype)
    return CoarseSpace(problem, packed), packed


def shaken(problem, stretch, amount):
    """Positions stretched evenly, and then each vertex moved by about ``amount`` [m]."""
    return stretch * problem.X + amount * np.random.default_rng(3).standard_normal(problem.X.shape)


def free(problem):
    """The problem without constraints, which no scene would make."""
    return replace(problem, fixed=np.zeros(problem.n_vert, bool))


def part(mesh, keep):
    """The mesh of the cells for which keep(centroid) holds."""
    cells = mesh.cells[keep(mesh.X[mesh.cells].mean(1))]
    used, number = np.unique(cells, return_inverse=True)
    return type(mesh)(mesh.X[used], number.reshape(cells.shape))


def u_shape():
    """Two legs along y at x < 2 and x > 4, joined below y = 2."""
    return part(pbng.shapes.box((6.0, 8.0, 2.0), (7, 9, 3)), lambda c: (abs(c[:, 0] - 3) > 1) | (c[:, 1] < 2))


def grid_over(mesh, size):
    """A grid over one mesh, its cells of the given size [m]."""
    return make_grid(mesh.X, mesh.cells, np.zeros(mesh.n_vert, int), np.zeros((1, 3)), np.array([size], float))


def nodes_of(grid, vertices):
    """Nodes that the vertices follow."""
    return set(grid.parents[vertices][np.abs(grid.weights[vertices]) > 1e-9].tolist())


def element_pieces(coarse):
    """For each grid the piece of each element."""
    pieces = [coarse.grids[0].piece]
    for grid in coarse.grids[1:]:
        pieces.append(grid.piece[pieces[-1]])
    return pieces


def dense(pieces, node, n_node):
    """Matrix (3 n_node, 3 n_node) of the stiffness (n, 3, 8, 3, 8) of pieces with nodes (n, 8)."""
    K = np.zeros((n_node, 3, n_node, 3))
    for k, n in zip(pieces, node):
        for i in range(3):
            for j in range(3):
                np.add.at(K, (n[:, None], i, n[None], j), k[i, :, j])
    return K.reshape(3 * n_node, 3 * n_node)
