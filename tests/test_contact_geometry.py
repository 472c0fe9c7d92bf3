"""What contact rests on: normals that vary smoothly."""

import numpy as np

import pbng
from pbng.contact.normals import SmoothNormals


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
    normals = SmoothNormals(mesh.X, mesh.cells)
    normals.fit(mesh.X @ turn.T)
    found = normals.at(triangle, rng.dirichlet(np.ones(3), 200))
    np.testing.assert_allclose(found, np.tile(turn @ [0, 1, 0], (200, 1)), atol=1e-12)


def test_normals_are_continuous_over_a_ball_and_nearly_radial(rng):
    mesh = pbng.shapes.sphere(1.0, 9)
    normals = SmoothNormals(mesh.X, mesh.surface)
    beside, edge = sides_of(mesh.surface)
    share = rng.random(len(edge))
    one, other = (normals.at(t, weights_at(mesh.surface[t], edge, share)) for t in beside.T)
    np.testing.assert_allclose(one, other, atol=1e-12)
    triangle = np.arange(len(mesh.surface))
    weights = rng.dirichlet(np.ones(3), len(triangle))
    found = normals.at(triangle, weights)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    point = np.einsum("kj,kji->ki", weights, mesh.X[mesh.surface])
    cosine = (found * point).sum(1) / np.linalg.norm(point, axis=1)
    assert np.rad2deg(np.arccos(cosine.min())) < 3.0  # those of the triangles are 9 degrees off


def test_normals_do_not_mix_over_a_sharp_edge(rng):
    mesh = pbng.shapes.box((1.0, 0.8, 0.6), 4)
    triangle = np.repeat(np.arange(len(mesh.surface)), 4)
    inside = rng.dirichlet(np.ones(3), (len(mesh.surface), 1))
    weights = np.concatenate([np.tile(np.eye(3), (len(mesh.surface), 1, 1)), inside], axis=1).reshape(-1, 3)
    found = SmoothNormals(mesh.X, mesh.surface).at(triangle, weights)
    own = pbng.mesh.triangle_areas(mesh.X, mesh.surface)
    own /= np.linalg.norm(own, axis=1)[:, None]
    np.testing.assert_allclose(found, own[triangle], atol=1e-12)
