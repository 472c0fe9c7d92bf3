"""Measures of meshes against shapes whose angles and volumes are known."""

import numpy as np
import pytest

from pbng.mesh import TetMesh, TriMesh
from pbng.mesh_quality import corner_angles, dihedral_angles, mean_ratio, quality
from pbng.shapes import box

REGULAR = TetMesh(np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]]), np.array([[0, 1, 2, 3]]))
SHAPES = {
    "regular tet": (REGULAR, np.degrees(np.arccos(1 / 3)), np.degrees(np.arccos(1 / 3)), 1.0),
    "corner tet": (
        TetMesh(np.concatenate([np.zeros((1, 3)), np.eye(3)]), np.array([[0, 1, 2, 3]])),
        np.degrees(np.arctan(np.sqrt(2))),
        90.0,
        12 * 0.5 ** (2 / 3) / 9,
    ),
    "regular triangle": (TriMesh(np.eye(3), np.array([[0, 1, 2]])), 60.0, 60.0, 1.0),
    "half square": (TriMesh(np.array([[0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]])), 45.0, 90.0, np.sqrt(3) / 2),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_known_shapes(name, scale):
    mesh, smallest, largest, shape = SHAPES[name]
    found = quality(type(mesh)(mesh.X * scale, mesh.cells))
    assert found.angle[0] == pytest.approx(smallest)
    assert found.angle[2] == pytest.approx(largest)
    assert found.shape == pytest.approx((shape,) * 3)


def test_angles_add_up():
    rng = np.random.default_rng(0)
    X = rng.normal(size=(40, 3))
    triangles = np.arange(39).reshape(13, 3)
    assert np.allclose(corner_angles(X, triangles).sum(1), 180)
    tets = np.arange(40).reshape(10, 4)
    angles = dihedral_angles(X, tets)
    assert ((angles > 0) & (angles < 180)).all()
    cosines = np.cos(np.radians(angles))
    gram = np.tile(np.eye(4), (10, 1, 1))
    for k, (i, j) in enumerate([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
        gram[:, i, j] = gram[:, j, i] = -cosines[:, k]
    assert np.allclose(np.linalg.det(gram), 0, atol=1e-12)  # four face normals in space are dependent


def test_mean_ratio_of_a_flat_cell_is_zero():
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1e-9], [2, 0, 0]])
    assert mean_ratio(X, np.array([[0, 1, 2, 3]]))[0] < 1e-5
    assert mean_ratio(X, np.array([[0, 1, 4]]))[0] == 0


def test_a_block():
    found = quality(box(size=(2, 1, 1), vertices=(5, 4, 3)))
    assert (found.kind, found.n_vert, found.n_elem, found.components) == ("tet", 60, 5 * 24, 1)
    assert found.volume == pytest.approx(2)
    assert found.area == pytest.approx(10)
    assert found.size == pytest.approx((2, 1, 1))
    assert found.edge[0] == pytest.approx(1 / 3)
    assert found.edge[2] == pytest.approx(np.hypot(0.5, 0.5))
    assert found.watertight
    assert found.open_edges == found.nonmanifold_edges == 0


def test_boundaries_of_surfaces():
    X, surface = box(vertices=3).X, box(vertices=3).surface
    used, cells = np.unique(surface, return_inverse=True)
    X, cells = X[used], cells.reshape(-1, 3)
    closed = quality(TriMesh(X, cells))
    assert closed.watertight
    assert closed.volume == pytest.approx(1)
    assert quality(TriMesh(X, cells[:, ::-1])).volume == pytest.approx(-1)
    hole = quality(TriMesh(X, cells[1:]))
    assert (hole.watertight, hole.open_edges, hole.volume) == (False, 3, None)
    turned = quality(TriMesh(X, np.concatenate([cells[:1, ::-1], cells[1:]])))
    assert (turned.watertight, turned.open_edges, turned.volume) == (False, 0, None)
    assert "not consistently oriented" in str(turned)
    fan = TriMesh(
        np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, 0, 0.0]]), [[0, 1, 2], [0, 1, 3], [0, 1, 4]]
    )
    assert quality(fan).nonmanifold_edges == 1


def test_two_parts_are_counted():
    two = TetMesh(np.concatenate([REGULAR.X, REGULAR.X + 5]), np.array([[0, 1, 2, 3], [4, 5, 6, 7]]))
    assert quality(two).components == 2


def test_it_reads_well():
    lines = str(quality(box(vertices=3))).splitlines()
    assert len(lines) == len(quality(box(vertices=3)).rows())
    assert lines[0].split() == ["vertices", "27"]
    assert any("watertight" in line for line in lines)
