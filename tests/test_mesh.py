"""Meshes: what is wrong is named; surfaces, selections, shapes and connectivity."""

import logging

import numpy as np
import pytest

import pbng
from pbng.topology import TET_FACES, components, incidence, tet_faces, unique_edges

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]])
TWO = [[0, 1, 2, 3], [1, 2, 3, 4]]


@pytest.mark.parametrize(
    ("X", "cells", "word"),
    [
        (CORNERS[:4], [[0, 1, 2]], r"cells must have shape \(n, 4\) with n > 0, not \(1, 3\)"),
        (CORNERS[:4], np.zeros((0, 4), int), r"not \(0, 4\)"),
        (CORNERS[:4], [[0, 1, 2, 3.0]], "cells must be integers, not float64"),
        (CORNERS[:4], [[0, 1, 2, 4]], r"tet 0 = \[0, 1, 2, 4\] names a vertex outside 0 \.\. 3 \(1 such tets\)"),
        (CORNERS[:4], [[0, 1, 2, -1]], r"names a vertex outside 0 \.\. 3"),
        (CORNERS, [[0, 1, 2, 3]], "vertex 4 belongs to no tet; remove it"),
        (CORNERS[:, :1], TWO, r"X must have shape \(n_vert, 3\), not \(5, 1\)"),
        (CORNERS * [1, 1, np.nan], TWO, r"vertices 0, 1, 2, 3, 4 are not finite: X\[0\] = \[0\.0, 0\.0, nan\]"),
        (CORNERS * [1, 1, 0], TWO, "tets 0, 1 have zero volume"),
        (CORNERS, [[0, 1, 2, 3], [1, 2, 4, 4]], "tet 1 has zero volume"),
        (CORNERS, [[0, 1, 2, 3], [1, 2, 3, 4], [4, 3, 2, 1]], r"tets 1 and 2 have the same vertices \[1, 2, 3, 4\]"),
    ],
)
def test_bad_tets_are_named(X, cells, word):
    with pytest.raises(pbng.InputError, match=word):
        pbng.TetMesh(X, cells)


def test_overlapping_tets_are_named():
    """An inverted cell of a mesh lies on the same side of a face as its neighbour: volumes alone do not show it."""
    X = np.concatenate([CORNERS[:4], [[0.2, 0.2, 0.2]]])
    with pytest.raises(pbng.InputError, match=r"tets 0 and 1 lie on the same side of their common face \[1, 2, 3\]"):
        pbng.TetMesh(X, [[0, 1, 2, 3], [1, 2, 3, 4]])


def test_face_of_three_tets_is_named():
    X = np.concatenate([CORNERS, [[2, 2, 2.0]]])
    cells = [[0, 1, 2, 3], [1, 2, 3, 4], [1, 2, 3, 5]]
    with pytest.raises(pbng.InputError, match=r"face \[1, 2, 3\] of tets|same side of their common face \[1, 2, 3\]"):
        pbng.TetMesh(X, cells)


def test_flipped_tets_are_corrected_and_reported(caplog):
    """Cells of negative volume are turned, listed in ``flipped``, and mentioned in the log."""
    mesh = pbng.shapes.box(vertices=3)
    cells = mesh.cells.copy()
    cells[[3, 17]] = cells[[3, 17]][:, [1, 0, 2, 3]]
    with caplog.at_level(logging.INFO, "pbng"):
        turned = pbng.TetMesh(mesh.X, cells)
    np.testing.assert_array_equal(turned.flipped, [3, 17])
    np.testing.assert_allclose(turned.volume, mesh.volume)
    assert "corrected the orientation of 2 of 40 tets" in caplog.text
    assert len(mesh.flipped) == 0


@pytest.mark.parametrize(
    ("X", "cells", "word"),
    [
        (CORNERS[:3], [[0, 1, 3]], r"triangle 0 = \[0, 1, 3\] names a vertex outside"),
        (CORNERS[:3], [[0, 1, 1]], "vertex 2 belongs to no triangle"),
        (CORNERS[[0, 1, 1]] * [1, 2, 3], [[0, 1, 2]], "triangle 0 has zero area"),
        (CORNERS[:3], [[0, 1, 2], [2, 0, 1]], "triangles 0 and 1 have the same vertices"),
    ],
)
def test_bad_triangles_are_named(X, cells, word):
    with pytest.raises(pbng.InputError, match=word):
        pbng.TriMesh(X, cells)


def test_plane_meshes():
    """Two columns are a plane at z = 0; triangles are turned counter-clockwise; areas and boundary follow."""
    mesh = pbng.TriMesh([[0, 0], [2, 0], [0, 1], [2, 1]], [[0, 2, 1], [1, 3, 2]])
    assert mesh.X.shape == (4, 3)
    assert mesh.is_plane
    np.testing.assert_array_equal(mesh.flipped, [0])
    np.testing.assert_allclose(mesh.volume, [1.0, 1.0])
    assert {tuple(e) for e in np.sort(mesh.boundary_edges, axis=1).tolist()} == {(0, 1), (0, 2), (1, 3), (2, 3)}
    assert len(mesh.edges) == 5
    bent = pbng.TriMesh([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 1, 1]], [[0, 2, 1], [1, 3, 2]])
    assert not bent.is_plane
    assert len(bent.flipped) == 0  # a surface keeps the orientation it has


def test_meshes_are_frozen_copies():
    X, cells = CORNERS[:4].copy(), np.array([[0, 1, 2, 3]])
    mesh = pbng.TetMesh(X, cells)
    X[0], cells[0] = 9, 0
    assert mesh.X.max() == 1
    assert mesh.cells.tolist() == [[0, 1, 2, 3]]
    for array in (mesh.X, mesh.cells, mesh.surface):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(AttributeError):
        mesh.X = X


@pytest.mark.parametrize("kind", ["tets", "surface"])
def test_moved_meshes(kind):
    """Cells, groups and skin stay; measures and orientation are those of the new positions."""
    named = {"groups": {"a": [0, 2]}, "cell_groups": {"b": [1]}}
    if kind == "tets":
        skin = pbng.Embedding(np.array([[0, 1, 2]]), np.array([[0, 1, 2, 3]] * 3), np.full((3, 4), 0.25))
        mesh = pbng.TetMesh(CORNERS, TWO, skin=skin, **named)
    else:
        mesh = pbng.TriMesh(CORNERS, [[0, 1, 2], [1, 2, 3], [2, 3, 4]], **named)
    before = mesh.volume.copy()
    moved = mesh.moved(2 * mesh.X[:, [1, 2, 0]] + 1)  # turned, twice as large
    np.testing.assert_array_equal(moved.X[1], [1, 1, 3])
    np.testing.assert_array_equal(moved.cells, mesh.cells)
    np.testing.assert_allclose(moved.volume, (8 if kind == "tets" else 4) * before, rtol=1e-14)
    np.testing.assert_array_equal(moved.groups["a"], [0, 2])
    np.testing.assert_array_equal(moved.cell_groups["b"], [1])
    assert type(moved) is type(mesh)
    np.testing.assert_array_equal(mesh.X, CORNERS)
    np.testing.assert_array_equal(mesh.volume, before)
    if kind == "tets":
        assert moved.skin is mesh.skin
        np.testing.assert_array_equal(mesh.moved(-mesh.X).flipped, [0, 1])
    with pytest.raises(pbng.InputError, match="names a vertex outside"):
        mesh.moved(mesh.X[:-1])


def test_groups():
    """Masks and indices become sorted indices; what lies outside is named."""
    mesh = pbng.TetMesh(CORNERS, TWO, groups={"a": [4, 1, 1]}, cell_groups={"b": np.array([False, True])})
    np.testing.assert_array_equal(mesh.groups["a"], [1, 4])
    np.testing.assert_array_equal(mesh.cell_groups["b"], [1])
    with pytest.raises(pbng.InputError, match=r"group 'a' names a vertex outside 0 \.\. 4"):
        pbng.TetMesh(CORNERS, TWO, groups={"a": [5]})
    with pytest.raises(pbng.InputError, match=r"group 'b' names a tet outside 0 \.\. 1"):
        pbng.TetMesh(CORNERS, TWO, cell_groups={"b": [-1]})


def test_group_masks_of_the_wrong_length_are_named():
    with pytest.raises(pbng.InputError, match="group 'a'"):
        pbng.TetMesh(CORNERS, TWO, groups={"a": np.array([True, False])})


def test_where():
    """Conditions combine; a coordinate, an interval, a named group, a mask, indices, a function."""
    box = pbng.shapes.box((2.0, 1.0, 1.0), (5, 3, 3))
    mesh = pbng.TetMesh(box.X, box.cells, groups={"end": box.X[:, 0] == 2.0})
    assert len(mesh.where()) == mesh.n_vert
    np.testing.assert_array_equal(mesh.where(x=2.0), mesh.where("end"))
    np.testing.assert_array_equal(mesh.where("end", y=0.0), mesh.where(x=2.0, y=0.0))
    assert len(mesh.where(x=(0.4, 1.6), y=1.0, z=(0.5, 9.0))) == 3 * 2
    np.testing.assert_array_equal(mesh.where(mesh.X[:, 0] < 0.6), mesh.where(x=(0, 0.6)))
    np.testing.assert_array_equal(mesh.where(lambda X: X[:, 2] == 1.0), mesh.where(z=1.0))
    np.testing.assert_array_equal(mesh.where(np.array([7, 3, 7])), [3, 7])
    assert len(mesh.where(x=2.0 + 1e-6)) == 9  # within the tolerance of 1e-6 of the size
    assert len(mesh.where(x=2.001)) == 0
    assert len(mesh.where(x=2.001, tol=0.01)) == 9


@pytest.mark.parametrize(
    ("which", "word"),
    [
        ("left", r"no vertex group 'left'; this mesh has none"),
        (np.ones(3, bool), r"a vertex mask must have shape \(8,\), not \(3,\)"),
        (np.array([8]), r"a selection names a vertex outside 0 \.\. 7"),
        (np.array([0.5]), "must be a mask or integer indices, not float64"),
    ],
)
def test_bad_selections_are_named(which, word):
    with pytest.raises(pbng.InputError, match=word):
        pbng.shapes.box(vertices=2).where(which)


def enclosed(mesh):
    """Volume inside the surface by the divergence theorem."""
    a, b, c = (mesh.X[mesh.surface[:, k]] for k in range(3))
    return np.einsum("ni,ni->", np.cross(a, b), c) / 6


def is_closed(surface):
    """Whether every directed edge is met by its opposite."""
    edges = surface[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there = {tuple(e) for e in edges.tolist()}
    return len(there) == len(edges) and there == {(b, a) for a, b in there}


MESHES = {
    "box": pbng.shapes.box((2.0, 1.0, 0.5), (5, 4, 3)),
    "beam": pbng.shapes.beam(4.0, 1.0, 3),
    "sphere": pbng.shapes.sphere(1.0, 7),
    "cylinder": pbng.shapes.cylinder(0.5, 2.0, 6),
    "one tet": pbng.TetMesh(CORNERS[:4], [[0, 1, 2, 3]]),
}


@pytest.mark.parametrize("name", MESHES)
def test_surface_is_closed_and_outward(name):
    """Every edge of the surface is shared by two opposite triangles, and the volume inside is that of the tets."""
    mesh = MESHES[name]
    assert (mesh.volume > 0).all()
    assert is_closed(mesh.surface)
    assert enclosed(mesh) == pytest.approx(mesh.volume.sum())
    assert mesh.surface.dtype == np.int32


def test_surface_after_flips():
    mesh = MESHES["box"]
    turned = pbng.TetMesh(mesh.X, mesh.cells[:, [0, 2, 1, 3]])
    assert len(turned.flipped) == mesh.n_elem
    assert enclosed(turned) == pytest.approx(1.0)


def test_volumes_of_shapes():
    """Boxes exactly; round shapes from below, with an error that falls as h²."""
    assert MESHES["box"].volume.sum() == pytest.approx(1.0)
    assert MESHES["beam"].volume.sum() == pytest.approx(4.0)
    for make, volume in (
        (lambda n: pbng.shapes.sphere(1.5, n), 4 / 3 * np.pi * 1.5**3),
        (lambda n: pbng.shapes.cylinder(0.5, 2.0, n), np.pi * 0.5),
    ):
        missing = [1 - make(n).volume.sum() / volume for n in (5, 9, 17)]
        assert (np.array(missing) > 0).all()
        assert np.log2(missing[1] / missing[2]) == pytest.approx(2, abs=0.3)
    assert pbng.shapes.rectangle((2.0, 0.5), (5, 4)).volume.sum() == pytest.approx(1.0)


def test_round_shapes_are_round():
    sphere = pbng.shapes.sphere(1.5, 7, center=(1, 2, 3))
    radius = np.linalg.norm(sphere.X - np.array([1, 2, 3]), axis=1)
    np.testing.assert_allclose(radius[np.unique(sphere.surface)], 1.5)
    cylinder = pbng.shapes.cylinder(0.5, 2.0, (7, 6))
    assert np.linalg.norm(cylinder.X[:, 1:], axis=1).max() == pytest.approx(0.5)
    assert cylinder.n_vert == 7 * 36


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: pbng.shapes.box((1.0, 0.0, 1.0)), "box: sizes must be positive"),
        (lambda: pbng.shapes.box((1.0, 1.0)), "expected 3 finite numbers"),
        (lambda: pbng.shapes.box(vertices=1), "vertices must be 3 whole number"),
        (lambda: pbng.shapes.box(vertices=(3, 3, 2.5)), "vertices must be 3 whole number"),
        (lambda: pbng.shapes.rectangle((np.nan, 1.0)), "expected 2 finite numbers"),
        (lambda: pbng.shapes.sphere(-1.0), "sphere: sizes must be positive"),
    ],
)
def test_bad_shapes_are_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()


def test_incidence_lists_every_corner_once():
    mesh = MESHES["box"]
    start, incident = incidence(mesh.cells, mesh.n_vert)
    for v in range(mesh.n_vert):
        expected = np.flatnonzero(mesh.cells.ravel() == v)
        np.testing.assert_array_equal(incident[start[v] : start[v + 1]], expected)


def test_faces_point_outward():
    """TET_FACES of a positive tet: normals away from the opposite vertex."""
    X = CORNERS[:4]
    for k, face in enumerate(TET_FACES):
        a, b, c = X[face]
        assert np.cross(b - a, c - a) @ (X[k] - a) < 0
    boundary, bad = tet_faces(np.array([[0, 1, 2, 3]], np.int32), 4)
    assert len(boundary) == 4
    assert bad[0] == 0


def test_edges_are_unique_and_ordered():
    """Euler's formula for a ball: V - E + F - C = 1, with the inner faces counted from the tets."""
    mesh = MESHES["box"]
    assert (mesh.edges[:, 0] < mesh.edges[:, 1]).all()
    assert len(np.unique(mesh.edges, axis=0)) == len(mesh.edges)
    faces = (4 * mesh.n_elem + len(mesh.surface)) // 2
    assert mesh.n_vert - len(mesh.edges) + faces - mesh.n_elem == 1
    np.testing.assert_array_equal(unique_edges(np.array([[2, 0], [0, 2]]), np.array([[0, 1]])), [[0, 2]])


def test_components_are_numbered_by_their_smallest_vertex():
    cells = np.array([[5, 1], [0, 4], [4, 2]], np.int32)
    np.testing.assert_array_equal(components(cells, 6), [0, 1, 0, 2, 0, 1])
    assert MESHES["sphere"].component.max() == 0


def test_drawn_is_the_surface_or_the_skin():
    """What stands for a mesh in pictures; an embedded skin moves with the tets affinely."""
    mesh = MESHES["box"]
    points, triangles = mesh.drawn(mesh.X)
    assert points is mesh.X
    assert triangles is mesh.surface
    weights = np.array([[0.25, 0.25, 0.25, 0.25], [1, 0, 0, 0.0], [0.5, 0.5, 0, 0]])
    skin = pbng.Embedding(np.array([[0, 1, 2]]), mesh.cells[[0, 1, 2]], weights)
    clothed = pbng.TetMesh(mesh.X, mesh.cells, skin=skin)
    A = np.array([[1, 0.2, 0], [0, 2, 0], [0.1, 0, 1.0]])
    rest, triangles = clothed.drawn(mesh.X)
    np.testing.assert_allclose(clothed.drawn(mesh.X @ A.T)[0], rest @ A.T)
    assert len(triangles) == 1
