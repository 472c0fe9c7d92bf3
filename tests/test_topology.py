"""Connectivity, against what loops say."""

import numpy as np
import pytest

import pbng
from pbng.topology import TRIANGLE_EDGES, edge_sides, entries, hinges, unique_edges

CLOSED = pbng.shapes.sphere(1.0, 5).surface
SHEET = pbng.shapes.rectangle((1, 1), 4).cells
FAN = np.array([[0, 1, 2], [1, 0, 3], [4, 0, 1]], np.int32)


@pytest.mark.parametrize("triangles", [CLOSED, SHEET, FAN, FAN[:0]])
def test_edge_sides(triangles):
    edges, start, sides = edge_sides(triangles)
    assert np.array_equal(edges, unique_edges(triangles, TRIANGLE_EDGES))
    assert start[0] == 0
    assert sorted(sides) == list(range(3 * len(triangles)))
    for e, edge in enumerate(edges):
        at = sides[start[e] : start[e + 1]]
        assert (np.diff(at) > 0).all()
        for side in at:
            assert sorted(triangles[side // 3][TRIANGLE_EDGES[side % 3]]) == edge.tolist()


@pytest.mark.parametrize(("triangles", "boundary"), [(CLOSED, 0), (SHEET, 12)])
def test_hinges(triangles, boundary):
    """One at each edge that is not of the boundary; its triangles are there, oriented alike."""
    found, code, bad = hinges(triangles)
    assert (code, len(bad)) == (0, 0)
    assert len(found) == len(unique_edges(triangles, TRIANGLE_EDGES)) - boundary
    turned = {tuple(t[order]) for t in triangles for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1])}
    assert all({(a, b, c), (b, a, d)} <= turned for a, b, c, d in found.tolist())


def test_bad_hinges():
    assert hinges(FAN)[1] == 1
    assert hinges(FAN)[2].tolist() == [0, 1, 2]
    assert hinges(FAN[[0, 2]])[1] == 2
    assert hinges(FAN[[0, 2]])[2].tolist() == [0, 1]


def test_entries():
    start, rows = np.array([0, 2, 2, 5, 6]), np.array([2, 0, 1, 2, 3])
    of, at = entries(start, rows)
    assert of.tolist() == [0, 0, 0, 1, 1, 3, 3, 3, 4]
    assert at.tolist() == [2, 3, 4, 0, 1, 2, 3, 4, 5]
    assert [len(a) for a in entries(start, rows[:0])] == [0, 0]
    assert [len(a) for a in entries(start, rows[2:3])] == [0, 0]
