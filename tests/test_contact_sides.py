"""On which side of a closed surface points lie, at edges and vertices too, against the tets that it bounds."""

import numpy as np
import pytest

import pbng
from pbng.contact.bvh import BoxTree
from pbng.contact.normals import SmoothNormals
from pbng.contact.queries import closest_triangles, containing_tets
from pbng.contact.sides import Sides
from pbng.topology import edge_sides


def carved(rng, away):
    """A box of 3³ cells without some of them, its vertices moved a little: tets and surface."""
    box = pbng.shapes.box((1.0, 1.0, 1.0), 4)
    cell = np.floor(3 * box.X[box.cells].mean(1)).astype(int)
    cells = box.cells[~np.array([tuple(c) in away for c in cell])]
    used, cells = np.unique(cells, return_inverse=True)
    mesh = pbng.TetMesh(box.X[used], cells.reshape(-1, 4))
    return mesh.X + 0.05 * rng.uniform(-1, 1, mesh.X.shape), mesh.cells, mesh.surface


def sides_of(x, triangles):
    _, start, sides = edge_sides(triangles)
    return Sides(SmoothNormals(x, triangles), start, sides)


corner = {(0, 0, 0)}
apart = {(i, j, k) for i in range(3) for j in range(3) for k in range(3)} - {(1, 1, 1), (0, 0, 1), (2, 2, 1), (0, 2, 0)}


@pytest.mark.parametrize("away", [corner, corner | {(2, 1, 1), (1, 1, 1)}, apart], ids=["corner", "tunnel", "touching"])
def test_sides_are_those_of_the_tets(rng, away):
    """Of cells that touch along an edge, or in a corner, too; points close to edges and vertices are the hard ones."""
    x, cells, triangles = carved(rng, away)
    p = np.concatenate([rng.uniform(-0.3, 1.3, (4000, 3)), x[rng.choice(triangles.ravel(), 4000)]])
    p[4000:] += 0.03 * rng.normal(size=(4000, 3))
    triangle, weights, _ = closest_triangles(BoxTree(x, triangles), x, p)
    behind, sure, below = sides_of(x, triangles).behind(x, p, triangle, weights)
    inside = containing_tets(BoxTree(x, cells), x, p)[0] >= 0
    np.testing.assert_array_equal(behind, inside)
    corners = (weights > 0).sum(1)
    for k in (1, 2, 3):
        at = corners == k
        assert at.sum() > 300
        assert not inside[at].all()
        assert inside[at].any() or away is apart  # inside of a convex cell, faces are closest
    assert (below == inside)[corners == 3].all()
    for k in (1, 2):  # the triangle's own normal does not tell
        assert (below != inside)[corners == k].any()
    assert sure[corners == 3].all()


def test_a_spike_is_not_sure():
    """What is closest to its tip; not what is closest to its blunt end, or to the corner of a box."""
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 9]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    p = np.array([[0.3, 0.3, 10], [0.3, 0.3, -1], [0.3, 0.3, 1]])
    triangle, weights, _ = closest_triangles(BoxTree(x, triangles), x, p)
    behind, sure, _ = sides_of(x, triangles).behind(x, p, triangle, weights)
    np.testing.assert_array_equal(behind, [False, False, True])
    np.testing.assert_array_equal(sure, [False, True, True])
    box = pbng.shapes.box((1.0, 1.0, 1.0), 2)
    p = np.array([[-1.0, -1, -1], [2, 2, 0.5]])
    triangle, weights, _ = closest_triangles(BoxTree(box.X, box.surface), box.X, p)
    behind, sure, _ = sides_of(box.X, box.surface).behind(box.X, p, triangle, weights)
    assert not behind.any()
    assert sure.all()
