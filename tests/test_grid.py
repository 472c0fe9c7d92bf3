"""Grids over the rest shape: what they interpolate, and which parts of a mesh share nodes."""

import numpy as np
import oracle
import pytest
from conftest import held_box
from grids import SOFT, coarse_space, element_pieces, grid_over, nodes_of, part, u_shape
from models import polar
from scipy.sparse.csgraph import connected_components

import pbng
from pbng.coarse.grid import CORNERS, coarser, make_grid
from pbng.coarse.linear import interpolation
from pbng.coarse.stiffness import SAMPLES
from pbng.elements.simplex import PLANE_TRIANGLE, TET


@pytest.mark.parametrize("n", [3, 4])
def test_gradients_and_volumes_of_elements(n, rng):
    """Those of the oracle, for either orientation; the gradients of a triangle lie in its plane."""
    X = rng.standard_normal((50, n, 3))
    if n == 3:
        X[..., 2] = 0.7
    kind = PLANE_TRIANGLE if n == 3 else TET
    G, V = oracle.shape_gradients(X)
    np.testing.assert_allclose(kind.gradients(X), G, atol=1e-9 * np.abs(G).max())
    np.testing.assert_allclose(kind.volume(X), V, rtol=1e-12)


def turned_problem():
    """A box with its cells askew to the axes, some of them missing."""
    box = part(pbng.shapes.box((2.0, 1.0, 1.0), (19, 10, 10)), lambda c: (np.abs(c - [1, 0.5, 0.5]) > 0.2).any(1))
    turn = polar(np.random.default_rng(0).standard_normal((1, 3, 3)))[0]
    scene = pbng.Scene()
    body = scene.add(pbng.TetMesh(box.X @ turn.T, box.cells), SOFT)
    scene.pin(body.where(box.X[:, 0] == 0))
    return scene.compile()


@pytest.fixture(params=["several bodies", "turned"])
def gridded(request, mixed, small_bottom):
    problem = mixed if request.param == "several bodies" else turned_problem()
    return problem, coarse_space(problem)[0]


def test_weights_reproduce_linear_functions(gridded):
    """At every vertex: weights sum to one, their mean of the nodes' positions is the vertex, all nodes of its body."""
    problem, coarse = gridded
    grid = coarse.grids[0]
    np.testing.assert_allclose(grid.weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum("vk,vki->vi", grid.weights, grid.position[grid.parents]), problem.X, atol=1e-12
    )
    body = np.repeat(np.arange(len(problem.bodies)), [b.stop - b.start for b in problem.bodies])
    np.testing.assert_array_equal(grid.body[grid.parents], np.broadcast_to(body[:, None], grid.parents.shape))
    np.testing.assert_array_equal(np.unique(grid.node), np.arange(grid.n_node))


def test_vertices_follow_the_nearest_piece(gridded):
    """Of the pieces that its elements are in, a vertex follows that whose cell holds it, or is nearest, in cells."""
    problem, coarse = gridded
    grid = coarse.grids[0]
    nearest, at = np.full(problem.n_vert, np.inf), 0
    for g in problem.groups:
        piece = grid.piece[at : at + len(g.cells), None]
        u = (problem.X[g.cells] - grid.origin[piece]) / grid.size[piece]
        np.minimum.at(nearest, g.cells, np.abs(u - u.clip(0, 1)).max(2))
        at += len(g.cells)
    u = grid.weights @ CORNERS
    np.testing.assert_allclose(np.abs(u - u.clip(0, 1)).max(1), nearest, atol=1e-12)
    assert ((nearest > 0.01).any()) == (len(problem.bodies) == 1)  # where cells of the mesh are not those of the grid


def test_corners_are_one_node_where_pieces_touch(gridded):
    """Nodes by brute force: corners at one place of pieces that have a vertex in common, and chains of such."""
    problem, coarse = gridded
    grid, at = coarse.grids[0], 0
    touching = np.zeros((len(grid.node), problem.n_vert), bool)
    for g in problem.groups:
        touching[grid.piece[at : at + len(g.cells), None], g.cells] = True
        at += len(g.cells)
    corner = (grid.origin[:, None] / grid.size[:, None] + CORNERS).reshape(-1, 3)  # of one body, whole numbers apart
    piece = np.repeat(np.arange(len(grid.node)), 8)
    same = ((touching.astype(int) @ touching.T) > 0)[piece[:, None], piece]
    for k in range(3):
        same &= np.abs(corner[:, None, k] - corner[None, :, k]) < 0.5
    n_node, node = connected_components(same)
    assert n_node == grid.n_node
    assert len(np.unique(np.stack([node, grid.node.ravel()]), axis=1).T) == n_node


def test_grids_nest(gridded):
    """Cells of the next grid are twice as large and hold those of the last; their nodes interpolate its nodes."""
    _, coarse = gridded
    for fine, wide in zip(coarse.grids, coarse.grids[1:]):
        np.testing.assert_allclose(interpolation(wide) @ wide.position, fine.position, atol=1e-12)
        np.testing.assert_allclose(wide.size[wide.piece], 2 * fine.size, rtol=1e-12)
        inside = (fine.origin - wide.origin[wide.piece]) / fine.size
        assert np.minimum(np.abs(inside), np.abs(inside - 1)).max() < 1e-6
        np.testing.assert_array_equal(wide.body[wide.parents], np.broadcast_to(fine.body[:, None], wide.parents.shape))
    if len(coarse.problem.bodies) == 1:
        assert len(coarse.grids) >= 3


def test_grids_of_a_box(small_bottom):
    """A box has one node at each corner of its cells: (6 + 1)³ for 24³ vertices, then (3 + 1)³, (2 + 1)³ and 2³."""
    coarse, _ = coarse_space(held_box(SOFT, (24, 24, 24), (1.0, 1.0, 1.0)))
    assert [g.n_node for g in coarse.grids] == [343, 64, 27, 8]
    assert [len(g.node) for g in coarse.grids] == [216, 27, 8, 1]
    for grid in coarse.grids:
        assert len(np.unique(grid.position.round(9), axis=0)) == grid.n_node


@pytest.mark.parametrize(("width", "n_node"), [(2.0, 16), (1.0, 16), (0.5, 24)])
def test_parts_that_only_touch_share_no_node(width, n_node):
    """Two boxes of one mesh with a common side but no common vertex: both in one cell, in two, in two each."""
    box = pbng.shapes.box((1.0, 1.0, 1.0), 3)
    moved = box.X + np.array([1.0, 0.0, 0.0])
    mesh = pbng.TetMesh(np.concatenate([box.X, moved]), np.concatenate([box.cells, box.cells + box.n_vert]))
    grid = grid_over(mesh, (width, 1.0, 1.0))
    assert not nodes_of(grid, mesh.component == 0) & nodes_of(grid, mesh.component == 1)
    assert grid.n_node == n_node


def test_bodies_share_no_node(rng):
    """Many bodies, more than a few bits can number, all at one place and with the same cells."""
    n, X = 40, rng.random((40, 4, 3))
    grid = make_grid(
        X.reshape(-1, 3), np.arange(4 * n).reshape(n, 4), np.repeat(np.arange(n), 4), np.zeros((n, 3)), np.ones((n, 3))
    )
    assert grid.node.shape == (n, 8)
    assert grid.n_node == 8 * n
    np.testing.assert_array_equal(grid.body[grid.parents].reshape(n, -1), np.repeat(np.arange(n), 32).reshape(n, 32))


@pytest.mark.parametrize(("size", "n_node"), [((6, 4, 2), 16), ((3, 4, 2), 20)], ids=["one cell", "two cells"])
def test_legs_share_nodes_only_where_they_are_joined(size, n_node):
    """The gap of a U is narrower than a cell: tips of the legs follow different nodes, the joint the same."""
    mesh = u_shape()
    grid = grid_over(mesh, size)
    left, right = mesh.where(x=(0, 2), y=8.0), mesh.where(x=(4, 6), y=8.0)
    assert len(left) == len(right) == 9
    assert not nodes_of(grid, left) & nodes_of(grid, right)
    low_left, low_right = mesh.where(x=(0, 2), y=4.0), mesh.where(x=(4, 6), y=4.0)
    assert nodes_of(grid, low_left) & nodes_of(grid, low_right)
    assert nodes_of(grid, left) & nodes_of(grid, mesh.where(x=(0, 2), y=7.0))
    assert grid.n_node == n_node


def test_legs_stay_apart_on_coarser_grids():
    """The coarser grid of a U is the grid of its cells, cut likewise, until legs and joint lie in one cell."""
    mesh = u_shape()
    fine = grid_over(mesh, (3, 2, 2))
    wide = coarser(fine, np.zeros((1, 3)), np.array([[3.0, 2, 2]]))
    assert (len(wide.node), wide.n_node) == (3, 16)
    left, right = nodes_of(fine, mesh.where(x=(0, 2), y=8.0)), nodes_of(fine, mesh.where(x=(4, 6), y=8.0))
    assert not nodes_of(wide, list(left)) & nodes_of(wide, list(right))
    widest = coarser(wide, np.zeros((1, 3)), np.array([[6.0, 4, 4]]))
    assert (len(widest.node), widest.n_node) == (1, 8)


def test_samples_stand_for_the_volume_of_each_piece(gridded):
    """In each piece, for each stiffness, weights sum to the volume of the elements that can move; few are drawn."""
    problem, coarse = gridded
    groups, cubature, n_piece = problem.groups, coarse.cubature, [len(g.node) for g in coarse.grids]
    volume = np.concatenate([oracle.shape_gradients(problem.X[g.cells])[1] for g in groups])
    volume *= np.concatenate([~problem.fixed[g.cells].all(1) for g in groups])
    stiff, level = np.unique(
        np.repeat([g.material.mu for g in groups], [len(g.cells) for g in groups]), return_inverse=True
    )
    expected = np.zeros((sum(n_piece), len(stiff)))
    for first, piece in zip(np.cumsum([0, *n_piece]), element_pieces(coarse)):
        np.add.at(expected, (first + piece, level), volume)
    _, sampled = np.unique(cubature.floor, return_inverse=True)  # a share of μ
    where = np.repeat(np.arange(sum(n_piece)), np.diff(cubature.start))
    found, count = np.zeros_like(expected), np.zeros(expected.shape, int)
    np.add.at(found, (where, sampled), cubature.weight)
    np.add.at(count, (where, sampled), 1)
    np.testing.assert_allclose(found, expected, atol=1e-12 * volume.sum())
    assert SAMPLES <= count.max() <= 2 * SAMPLES  # away from constraints and next to them
