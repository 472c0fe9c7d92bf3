"""Meshes survive a round trip through files, and bad files say what is wrong with them."""

import logging
import sys

import numpy as np
import pytest

from pbng.errors import InputError
from pbng.io.meshes import MESHES, SURFACES, WRITTEN, read_mesh, read_surface, save_mesh
from pbng.mesh import Embedding, TetMesh, TriMesh
from pbng.shapes import box

meshio = pytest.importorskip("meshio")
trimesh = pytest.importorskip("trimesh")


def block():
    mesh = box(size=(2, 1, 1), vertices=(4, 3, 3))
    groups = {"left end": mesh.where(x=0.0), "top": mesh.where(y=1.0)}
    centre = mesh.X[mesh.cells].mean(1)
    return TetMesh(mesh.X, mesh.cells, groups=groups, cell_groups={"soft": centre[:, 0] > 1})


def surface():
    mesh = block()
    used, cells = np.unique(mesh.surface, return_inverse=True)
    return TriMesh(mesh.X[used], cells.reshape(-1, 3))


def same(one, two, atol=0.0):
    assert np.allclose(one.X, two.X, rtol=0, atol=atol)
    assert np.array_equal(one.cells, two.cells)
    for a, b in ((one.groups, two.groups), (one.cell_groups, two.cell_groups)):
        assert set(a) == set(b)
        assert all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("suffix", WRITTEN)
def test_tets_round_trip_with_groups(tmp_path, suffix, capfd):
    save_mesh(block(), tmp_path / f"block{suffix}")
    same(read_mesh(tmp_path / f"block{suffix}"), block())
    assert capfd.readouterr() == ("", "")


def test_npz_keeps_the_skin(tmp_path):
    mesh = block()
    skin = Embedding(np.array([[0, 1, 2]]), mesh.cells[:3], np.full((3, 4), 0.25))
    save_mesh(TetMesh(mesh.X, mesh.cells, skin=skin), tmp_path / "block.npz")
    found = read_mesh(str(tmp_path / "block.npz")).skin
    assert np.array_equal(found.points(mesh.X), skin.points(mesh.X))


def test_npz_made_by_hand(tmp_path):
    mesh = block()
    X = np.concatenate([[[9, 9, 9]], mesh.X])  # a vertex that no tet uses comes first
    np.savez(tmp_path / "m.npz", X=X, cells=mesh.cells + 1, **{"groups/all": np.arange(len(X)), "cell_groups/one": [0]})
    found = read_mesh(tmp_path / "m.npz")
    assert np.array_equal(found.X, mesh.X)
    assert np.array_equal(found.cells, mesh.cells)
    assert np.array_equal(found.groups["all"], np.arange(mesh.n_vert))
    assert found.cell_groups["one"].tolist() == [0]


GMSH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
2
2 5 "clamp"
3 7 "bone"
$EndPhysicalNames
$Nodes
6
1 9 9 9
2 0 0 0
3 1 0 0
4 0 1 0
5 0 0 1
6 1 1 1
$EndNodes
$Elements
4
1 15 2 0 1 1
2 2 2 5 1 2 3 4
3 4 2 7 1 2 3 4 5
4 4 2 8 2 3 4 5 6
$EndElements
"""

MEDIT = """MeshVersionFormatted 2
Dimension 3
Vertices
5
0 0 0 0
1 0 0 0
0 1 0 0
0 0 1 0
1 1 1 0
Triangles
1
1 2 3 4
Tetrahedra
2
1 2 3 4 1
2 3 4 5 2
End
"""


def test_gmsh_physical_groups(tmp_path, caplog):
    (tmp_path / "two.msh").write_text(GMSH)
    with caplog.at_level(logging.INFO, "pbng"):
        mesh = read_mesh(tmp_path / "two.msh")
    assert "dropped 1 vertices" in caplog.text
    assert (mesh.n_vert, mesh.n_elem) == (5, 2)
    assert np.array_equal(mesh.X[0], (0, 0, 0))
    assert {k: v.tolist() for k, v in mesh.cell_groups.items()} == {"bone": [0], "physical 8": [1]}
    assert {k: v.tolist() for k, v in mesh.groups.items()} == {"clamp": [0, 1, 2]}


def test_medit_references(tmp_path):
    (tmp_path / "two.mesh").write_text(MEDIT)
    mesh = read_mesh(tmp_path / "two.mesh")
    assert {k: v.tolist() for k, v in mesh.cell_groups.items()} == {"ref 1": [0], "ref 2": [1]}
    assert {k: v.tolist() for k, v in mesh.groups.items()} == {"ref 4": [0, 1, 2]}


def test_curved_tets_become_straight(tmp_path):
    X = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    middles = [(X[i] + X[j]) / 2 for i, j in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
    meshio.Mesh(np.concatenate([X, middles]), [("tetra10", np.arange(10)[None])]).write(tmp_path / "curved.vtu")
    mesh = read_mesh(tmp_path / "curved.vtu")
    assert np.array_equal(mesh.X, X)


@pytest.mark.parametrize("suffix", SURFACES)
def test_surfaces_round_trip(tmp_path, suffix, capfd):
    given = surface()
    trimesh.Trimesh(given.X, given.cells, process=False).export(tmp_path / f"s{suffix}")
    found = read_surface(tmp_path / f"s{suffix}")
    if suffix == ".stl":  # its triangles are separate: merging them gives the same surface in another order
        corners = {tuple(map(tuple, np.round(x, 6))) for x in given.X[given.cells]}
        assert found.n_vert == given.n_vert
        assert corners == {tuple(map(tuple, np.round(x, 6))) for x in found.X[found.cells]}
    else:
        same(found, given, atol=1e-7)
    assert capfd.readouterr() == ("", "")


SQUARE = """# quads, seams of texture, a loose vertex, a repeated triangle, a flat and a collapsed one
mtllib missing.mtl
v 5 5 5
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0.5
v 1 0 -0.0
v 2 0 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl a
f 2/1 3/2 4/3 5/4
usemtl b
f 3/4 4/3 2/2
f 2/1 6/2 7/3
f 3/1 6/2 4/3
f 6/1 7/2 4/4
"""


def test_surfaces_are_cleaned(tmp_path, caplog):
    (tmp_path / "square.obj").write_text(SQUARE)
    with caplog.at_level(logging.INFO, "pbng"):
        mesh = read_surface(tmp_path / "square.obj")
    assert mesh.n_vert == 5
    assert mesh.n_elem == 3
    assert "3 degenerate or repeated triangles" in caplog.text
    assert mesh.volume.sum() == pytest.approx(0.5 + 0.5 * np.linalg.norm(np.cross((1, 1, 0), (0, 1, 0.5))) + 0.5)


@pytest.mark.parametrize("suffix", [*MESHES, *SURFACES])
def test_bad_files_say_what_is_wrong(tmp_path, suffix, capfd):
    read = read_mesh if suffix in MESHES else read_surface
    path = tmp_path / f"bad{suffix}"

    def refuses(what):
        with pytest.raises(InputError, match=what) as raised:
            read(path)
        assert str(raised.value).startswith(f"{path}: ")

    refuses("no such file")
    path.mkdir()
    refuses("folder")
    path.rmdir()
    path.write_bytes(b"")
    refuses("empty")
    path.write_bytes(b"this is no mesh\n" * 20)
    refuses("cannot be read|no triangles|no tets")
    path.write_bytes(bytes(np.random.default_rng(0).integers(0, 256, 5000, np.uint8)))
    refuses("cannot be read|no triangles|no tets")
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("suffix", [".npz", ".msh", ".vtu"])
def test_cut_files_are_refused(tmp_path, suffix):
    path = tmp_path / f"cut{suffix}"
    save_mesh(block(), path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="cannot be read"):
        read_mesh(path)


def written(path, X, cells):
    if path.suffix == ".npz":
        np.savez(path, X=X, cells=next(iter(cells.values())))
    else:
        meshio.Mesh(X, cells).write(path, file_format={".msh": "gmsh"}.get(path.suffix))
    return path


@pytest.mark.parametrize("suffix", MESHES)
def test_bad_meshes_say_what_is_wrong(tmp_path, suffix):
    X = np.concatenate([np.zeros((1, 3)), np.eye(3), np.ones((1, 3))])

    def refuses(what, X, **cells):
        path = written(tmp_path / f"bad{suffix}", X, {k: np.array(v) for k, v in cells.items()})
        with pytest.raises(InputError, match=what) as raised:
            read_mesh(path)
        assert str(raised.value).startswith(f"{path}: ")

    refuses("only triangles.*read_surface.*tetrahedralize", X, triangle=[[0, 1, 2]])
    refuses("tet 0 has zero volume", X * [1, 1, 0], tetra=[[0, 1, 2, 4]])
    refuses("face .* more than two|same side", X, tetra=[[0, 1, 2, 3], [0, 1, 2, 4]])
    if suffix != ".npz":
        refuses("cells other than tets: hexahedron", np.ones((8, 3)), hexahedron=[list(range(8))])
    if suffix != ".mesh":  # which meshio writes, but does not read
        refuses("vertex 2 is not finite", np.where(np.arange(5)[:, None] == 2, np.nan, X), tetra=[[0, 1, 2, 3]])


def test_arrays_that_are_no_mesh(tmp_path):
    X = np.concatenate([np.zeros((1, 3)), np.eye(3)])
    path = tmp_path / "m.npz"
    for arrays, what in (
        ({"X": X}, "'cells' is missing; the file has \\['X'\\]"),
        ({"X": X, "cells": np.array([[0, 1, 2, 9]])}, "outside 0 .. 3"),
        ({"X": X, "cells": np.array([[0, 1, 2, 3.0]])}, "integers"),
        ({"X": X, "cells": np.array([0, 1, 2, 3])}, "shape"),
        ({"X": X[:, :2], "cells": np.array([[0, 1, 2, 3]])}, "zero volume"),
        ({"X": X, "cells": np.array([[0, 1, 2, 3]]), "groups/a": np.array([7])}, "group 'a'"),
        ({"X": X, "cells": np.array([{}])}, "cannot be read"),
    ):
        np.savez(path, **arrays)
        with pytest.raises(InputError, match=what):
            read_mesh(path)


def test_bad_surfaces_say_what_is_wrong(tmp_path):
    path = tmp_path / "s.obj"
    for text, what in (
        ("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "vertex 2 is not finite"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read|outside"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "degenerate"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=what) as raised:
            read_surface(path)
        assert str(raised.value).startswith(f"{path}: ")


def test_extensions(tmp_path):
    for name in ("a.step", "b.obj", "c"):
        (tmp_path / name).write_text("x")
    with pytest.raises(InputError, match=r"unknown extension '.step'; known are .msh .vtu .mesh .npz"):
        read_mesh(tmp_path / "a.step")
    with pytest.raises(InputError, match=r"known are .obj .ply .stl .off"):
        read_surface(tmp_path / "c")
    with pytest.raises(InputError, match="read by read_surface"):
        read_mesh(tmp_path / "b.obj")
    with pytest.raises(InputError, match=r"cannot write .stl; known are .npz .msh .vtu"):
        save_mesh(block(), tmp_path / "a.stl")
    with pytest.raises(InputError, match="folder does not exist"):
        save_mesh(block(), tmp_path / "nowhere" / "a.npz")


@pytest.mark.parametrize(("suffix", "library"), [(".msh", "meshio"), (".vtu", "meshio"), (".stl", "trimesh")])
def test_missing_libraries_say_how_to_install_them(tmp_path, monkeypatch, suffix, library):
    for module in [name for name in sys.modules if name.partition(".")[0] == library]:
        monkeypatch.setitem(sys.modules, module, None)
    path = tmp_path / f"m{suffix}"
    path.write_text("x")
    with pytest.raises(InputError, match=rf"{suffix} files need {library}: pip install 'pbng\[mesh\]'"):
        (read_mesh if suffix in MESHES else read_surface)(path)
