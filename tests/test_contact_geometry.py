"""What contact rests on: the nearest point of several half-spaces, and normals that vary smoothly."""

import numpy as np
import pytest

import pbng
from pbng.contact.contacts import move_in
from pbng.contact.normals import SmoothNormals


def wedge(angle, sides, rng):
    """Normals of half-spaces about an axis that are ``angle`` degrees from one another, turned at random."""
    c, s = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    if sides == 2:
        normals = np.array([[1.0, 0, 0], [c, s, 0]])
    else:
        across = np.sqrt((1 - c) * 2 / 3)  # from the axis
        turn = 2 * np.pi / 3 * np.arange(3)
        normals = np.column_stack([across * np.cos(turn), across * np.sin(turn), np.full(3, np.sqrt(1 - across**2))])
    return normals @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


@pytest.mark.parametrize(
    ("sides", "angle"), [(2, 30), (2, 60), (2, 90), (2, 120), (2, 150), (3, 60), (3, 90), (3, 105)]
)
def test_a_vertex_moves_to_the_nearest_point_of_its_half_spaces(rng, sides, angle):
    """Outside of all, moved only along normals of those that it touches: there is one such point, the nearest."""
    n_vert = 40
    plane = np.concatenate([wedge(angle, sides, rng) for _ in range(n_vert)])
    vertex, level = np.repeat(np.arange(n_vert), sides), rng.normal(size=len(plane))
    order = rng.permutation(len(plane))
    vertex, plane, level = vertex[order], plane[order], level[order]
    x = 2 * rng.normal(size=(n_vert + 1, 3))
    y = x.copy()
    pushed = move_in(y, vertex, plane, level)
    height = (plane * y[vertex]).sum(1) - level
    by = np.zeros_like(x)
    np.add.at(by, vertex, pushed[:, None] * plane)
    np.testing.assert_allclose(y, x + by, atol=1e-12)
    assert height.min() > -1e-6
    assert pushed.min() >= 0
    assert np.abs(height[pushed > 0]).max() < 1e-6
    at = np.bincount(vertex, pushed > 0, n_vert)
    assert all((at == k).any() for k in range(sides))
    # Where it is held by a plane it is on that, whichever side it was on.
    z = x.copy()
    move_in(z, vertex, plane, level, np.ones(len(vertex), bool))
    assert np.abs((plane * z[vertex]).sum(1) - level).max() < 1e-6
    # One edge is in closed form.
    if sides == 2:
        v = int(np.flatnonzero(at == 2)[0])
        n, l = plane[vertex == v], level[vertex == v]
        np.testing.assert_allclose(y[v], x[v] + n.T @ np.linalg.solve(n @ n.T, l - n @ x[v]), atol=1e-6)


def sides_of(triangles):
    """For each edge between two triangles of a closed surface: these (k, 2), and its two vertices (k, 2)."""
    ends = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(ends.T)
    return order.reshape(-1, 2) // 3, ends[order][::2]


def weights_at(triangles, edge, share):
    """Weights of the point that divides an edge, in triangles that have it."""
    return (triangles == edge[:, :1]) * (1 - share)[:, None] + (triangles == edge[:, 1:]) * share[:, None]


def test_normals_of_flat_surfaces_are_those_of_triangles(rng):
    mesh = pbng.shapes.sheet((1.0, 0.7), (6, 5))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    triangle = rng.integers(0, mesh.n_elem, 200)
    found = SmoothNormals(mesh.X, mesh.cells).at(mesh.X @ turn.T, triangle, rng.dirichlet(np.ones(3), 200))
    np.testing.assert_allclose(found, np.tile(turn @ [0, 1, 0], (200, 1)), atol=1e-12)


def test_normals_are_continuous_over_a_ball_and_nearly_radial(rng):
    mesh = pbng.shapes.sphere(1.0, 9)
    normals = SmoothNormals(mesh.X, mesh.surface)
    beside, edge = sides_of(mesh.surface)
    share = rng.random(len(edge))
    one, other = (normals.at(mesh.X, t, weights_at(mesh.surface[t], edge, share)) for t in beside.T)
    np.testing.assert_allclose(one, other, atol=1e-12)
    triangle = np.arange(len(mesh.surface))
    weights = rng.dirichlet(np.ones(3), len(triangle))
    found = normals.at(mesh.X, triangle, weights)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    point = np.einsum("kj,kji->ki", weights, mesh.X[mesh.surface])
    cosine = (found * point).sum(1) / np.linalg.norm(point, axis=1)
    assert np.rad2deg(np.arccos(cosine.min())) < 3.0  # those of the triangles are 9 degrees off


def test_normals_do_not_mix_over_a_sharp_edge(rng):
    mesh = pbng.shapes.box((1.0, 0.8, 0.6), 4)
    triangle = np.repeat(np.arange(len(mesh.surface)), 4)
    inside = rng.dirichlet(np.ones(3), (len(mesh.surface), 1))
    weights = np.concatenate([np.tile(np.eye(3), (len(mesh.surface), 1, 1)), inside], axis=1).reshape(-1, 3)
    found = SmoothNormals(mesh.X, mesh.surface).at(mesh.X, triangle, weights)
    own = pbng.mesh.triangle_areas(mesh.X, mesh.surface)
    own /= np.linalg.norm(own, axis=1)[:, None]
    np.testing.assert_allclose(found, own[triangle], atol=1e-12)
