"""Surfaces become conforming, well-shaped tets that carry them."""

import logging
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from pbng.errors import InputError
from pbng.mesh import TetMesh, TriMesh
from pbng.mesh_quality import cone_volumes, dihedral_angles, quality
from pbng.meshing import creature, embed, stuff, tetrahedralize
from pbng.shapes import box

igl_needed = pytest.mark.skipif(find_spec("igl") is None, reason="needs libigl")


def ball(centre, radius):
    return lambda P: np.linalg.norm(P - centre, axis=1) < radius


def solids():
    rng = np.random.default_rng(1)
    yield "ball", ball((0.03, 0.01, -0.02), 0.9)
    yield "plate thinner than a cell", lambda P: np.abs(P @ (0.6, 0.64, 0.48)) < 0.04
    yield "torus", lambda P: np.hypot(np.hypot(P[:, 0], P[:, 1]) - 0.6, P[:, 2]) < 0.17
    yield "box along the lattice", lambda P: (np.abs(P) < (0.8, 0.5, 0.3)).all(1)
    for k in range(4):
        waves, phase = rng.normal(0, 5, (6, 3)), rng.uniform(0, 6, 6)
        yield (
            f"random {k}",
            lambda P, w=waves, p=phase: (np.sin(P @ w.T + p).sum(1) > 0.3) & (np.linalg.norm(P, axis=1) < 0.95),
        )


@pytest.mark.parametrize(("name", "inside"), list(solids()), ids=lambda s: s if isinstance(s, str) else "")
def test_stuffing_is_conforming_and_keeps_the_papers_angles(name, inside):
    X, cells = stuff(inside, (-1, -1, -1), (1, 1, 1), 0.11)
    mesh = TetMesh(X, cells)  # refuses overlaps and faces of more than two tets
    assert len(mesh.flipped) == 0
    found = quality(mesh)
    assert found.watertight
    assert found.volume == pytest.approx(mesh.volume.sum(), rel=1e-12)  # no gaps inside
    angles = dihedral_angles(mesh.X, mesh.cells)
    assert angles.min() > 10.7
    assert angles.max() < 164.8


def test_stuffing_converges_to_the_solid():
    exact = 4 / 3 * np.pi * 0.8**3
    error = []
    for cell in (0.2, 0.1, 0.05):
        X, cells = stuff(ball((0, 0, 0), 0.8), (-0.8,) * 3, (0.8,) * 3, cell)
        mesh = TetMesh(X, cells)
        error.append(exact - mesh.volume.sum())
        surface = np.unique(mesh.surface)
        assert np.abs(np.linalg.norm(mesh.X[surface], axis=1) - 0.8).max() < 1e-3 * cell
    assert np.log2(error[0] / error[1]) == pytest.approx(2, abs=0.3)
    assert np.log2(error[1] / error[2]) == pytest.approx(2, abs=0.3)


def test_stuffing_finds_nothing_in_nothing():
    X, cells = stuff(lambda P: np.zeros(len(P), bool), (0, 0, 0), (1, 1, 1), 0.3)
    assert X.shape == (0, 3)
    assert cells.shape == (0, 4)


def test_crumbs_are_dropped_but_parts_are_kept(caplog):
    large, crumb, other = ball((0.35, 0.35, 0.35), 0.3), ball((0.1, 0.9, 0.1), 0.05), ball((0.8, 0.8, 0.8), 0.15)
    with caplog.at_level(logging.WARNING, "pbng"):
        mesh = TetMesh(*stuff(lambda P: large(P) | crumb(P) | other(P), (0, 0, 0), (1, 1, 1), 0.05))
    assert quality(mesh).components == 2
    assert "1 crumbs" in caplog.text
    assert "2 parts that share no face" in caplog.text


def test_the_creature_is_a_closed_symmetric_surface():
    surface = creature()
    found = quality(surface)
    assert found.watertight
    assert found.nonmanifold_edges == 0
    assert found.components == 1
    assert surface.n_vert - len(surface.edges) + surface.n_elem == 2  # genus 0
    assert found.volume > 0  # normals outward
    assert found.size[0] == pytest.approx(1, abs=1e-6)
    assert surface.X[:, 1].min() == 0
    mirrored = surface.X * [1, 1, -1]
    assert {tuple(p) for p in mirrored + 0.0} == {tuple(p) for p in surface.X + 0.0}


@igl_needed
@pytest.mark.parametrize("cells_across", [20, 32])
def test_tetrahedralized_creature(cells_across):
    surface = creature()
    mesh = tetrahedralize(surface, surface.size / cells_across)
    whole = cone_volumes(surface.X, surface.cells).sum()
    assert mesh.volume.sum() == pytest.approx(whole, rel=0.15 if cells_across == 20 else 0.05)
    found = quality(mesh)
    assert found.watertight
    assert found.components == 1
    assert found.angle[0] > 8
    assert np.abs(mesh.skin.points(mesh.X) - surface.X).max() < 1e-12
    assert np.array_equal(mesh.skin.triangles, surface.cells)
    assert mesh.skin.weights.min() > -4.001
    assert np.allclose(mesh.skin.weights.sum(1), 1, atol=1e-12)
    rng = np.random.default_rng(0)
    A, t = rng.normal(size=(3, 3)), rng.normal(size=3)
    assert np.abs(mesh.skin.points(mesh.X @ A.T + t) - (surface.X @ A.T + t)).max() < 1e-10
    points, triangles = mesh.drawn(mesh.X)
    assert np.allclose(points, surface.X)
    assert triangles is mesh.skin.triangles


@igl_needed
def test_tetrahedralize_is_deterministic():
    one, two = (tetrahedralize(creature(), 0.08) for _ in range(2))
    assert np.array_equal(one.X, two.X)
    assert np.array_equal(one.cells, two.cells)
    assert np.array_equal(one.skin.weights, two.skin.weights)


def cube(turn=()):
    """A closed surface of 12 triangles; those named are turned inward."""
    block = box(vertices=2)
    cells = block.surface.copy()
    cells[list(turn)] = cells[list(turn)][:, ::-1]
    return TriMesh(block.X, cells)


@igl_needed
@pytest.mark.parametrize("turn", [(), range(12), (3,), (0, 5, 11)])
def test_orientation_of_the_surface_does_not_matter(turn):
    mesh = tetrahedralize(cube(turn), 0.1)
    assert mesh.volume.sum() == pytest.approx(1, rel=0.02)
    assert cone_volumes(mesh.skin.points(mesh.X), mesh.skin.triangles).sum() == pytest.approx(1)  # turned outward


@igl_needed
def test_an_open_surface_is_filled_with_a_warning(caplog):
    whole = cube()
    with caplog.at_level(logging.WARNING, "pbng"):
        mesh = tetrahedralize(TriMesh(whole.X, whole.cells[:-1]), 0.1)
    assert "3 open edges" in caplog.text
    assert 0.6 < mesh.volume.sum() < 1


@igl_needed
def test_points_far_outside_are_drawn_nearer(caplog):
    mesh = box(vertices=3)
    far = TriMesh(np.array([[0.5, 0.5, 0.5], [0.5, 0.5, 1.2], [0.5, 0.6, 20.0]]), np.array([[0, 1, 2]]))
    with caplog.at_level(logging.WARNING, "pbng"):
        skin = embed(far, mesh)
    assert "1 of the surface's 3 points" in caplog.text
    assert skin.weights.min() == pytest.approx(-4)
    reached = skin.points(mesh.X)
    assert np.allclose(reached[:2], far.X[:2], atol=1e-12)
    assert 1.5 < reached[2, 2] < 20
    assert np.allclose(reached[2, :2], (0.5, 0.6))  # straight towards the closest point


@igl_needed
@pytest.mark.parametrize("cell", [0, -1.0, np.nan, np.inf, "small", [0.1], 1e-6])
def test_bad_cells_are_refused(cell):
    with pytest.raises(InputError, match="cell"):
        tetrahedralize(cube(), cell)


@igl_needed
def test_bad_surfaces_are_refused():
    thin = TriMesh(cube().X * [1, 1, 0.01], cube().cells)
    with pytest.raises(InputError, match=r"cell 0\.1 m finds nothing inside .* 0\.0098 m thick"):
        tetrahedralize(thin, 0.1)
    with pytest.raises(InputError, match="flat"):
        tetrahedralize(TriMesh(np.array([[0, 0], [1, 0], [0, 1]]), np.array([[0, 1, 2]])))
    with pytest.raises(InputError, match="open edges"):
        tetrahedralize(TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1.0]]), np.array([[0, 1, 2]])))
    with pytest.raises(InputError, match="TetMesh"):
        tetrahedralize(box(vertices=2))
    with pytest.raises(InputError, match="method 'magic'"):
        tetrahedralize(cube(), method="magic")


def test_missing_libraries_say_how_to_install_them(monkeypatch):
    monkeypatch.setitem(sys.modules, "igl", None)
    with pytest.raises(InputError, match=r"pip install 'pbng\[mesh\]'"):
        tetrahedralize(cube())


@igl_needed
def test_tetwild_follows_the_surface(tmp_path, monkeypatch):
    pytest.importorskip("pytetwild")
    monkeypatch.chdir(tmp_path)
    mesh = tetrahedralize(cube(), 0.5, method="tetwild")
    assert mesh.volume.sum() == pytest.approx(1, rel=0.01)
    assert quality(mesh).watertight
    assert np.abs(mesh.skin.points(mesh.X) - cube().X).max() < 1e-6
    assert not list(tmp_path.iterdir())  # it likes to leave a file behind
