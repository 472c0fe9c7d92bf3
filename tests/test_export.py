"""Other programs get the bits of the run, in files that other readers read."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from fake_runs import box, frames, sheet

import pbng
from pbng.errors import InputError
from pbng.io.export import FORMATS, drawn, export
from pbng.io.frames import FrameWriter, Run
from pbng.mesh import Embedding, TetMesh


@pytest.fixture(params=[np.float32, np.float64], ids=["float32", "float64"])
def run(request, tmp_path):
    block = box()
    skin = Embedding(np.array([[0, 1, 2], [0, 2, 3]]), block.cells[:4], np.full((4, 4), 0.25))
    with FrameWriter(tmp_path / "run", fps=10) as out:
        for frame in frames(
            [block, sheet(4), TetMesh(block.X, block.cells, skin=skin)], 3, dtype=request.param, fps=10
        ):
            out.write(frame)
    return Run(tmp_path / "run")


def read_obj(path):
    lines = path.read_text().splitlines()
    points = np.array([line.split()[1:] for line in lines if line.startswith("v ")], float)
    return points, np.array([line.split()[1:] for line in lines if line.startswith("f ")], int) - 1


def test_the_drawn_surface_is_all_surfaces_with_skins(run):
    points, triangles, owner = drawn(run.bodies, run[2].x)
    block, plate, fleshy = (body.mesh for body in run.bodies)
    assert len(points) == len(block.X) + len(plate.X) + 4
    assert len(triangles) == len(block.surface) + len(plate.cells) + 2
    assert np.array_equal(owner[triangles[:, 0]], np.repeat([0, 1, 2], [len(block.surface), len(plate.cells), 2]))
    assert np.allclose(points[-4:], run[2].x[run.bodies[2].start :][fleshy.cells[:4]].mean(1))


def test_ply_has_the_bits(run, tmp_path):
    files = export(run, tmp_path / "out", "ply")
    assert [file.name for file in files] == ["out_0000.ply", "out_0001.ply", "out_0002.ply"]
    for frame, file in zip(run, files, strict=True):
        points, triangles, _ = drawn(run.bodies, frame.x)
        data = file.read_bytes()
        start = data.index(b"end_header\n") + len(b"end_header\n")
        assert data[start : start + points.nbytes] == points.tobytes()
        faces = np.frombuffer(data[start + points.nbytes :], [("n", "u1"), ("v", "<i4", 3)])
        assert np.array_equal(faces["v"], triangles)
        meshio = pytest.importorskip("meshio")
        other = meshio.read(file)
        assert np.array_equal(other.points, points)
        assert np.array_equal(other.cells_dict["triangle"], triangles)


def test_obj_has_the_bits(run, tmp_path):
    for frame, file in zip(run, export(run, tmp_path / "twist.obj"), strict=True):
        points, triangles, _ = drawn(run.bodies, frame.x)
        read, faces = read_obj(file)
        assert read.astype(points.dtype).tobytes() == points.tobytes()
        assert np.array_equal(faces, triangles)
        assert re.findall(r"^g (.*)$", file.read_text(), re.M) == ["body_0", "body_1", "body_2"]


def test_point_cache_has_the_bits(run, tmp_path):
    topology, cache = export(run, tmp_path / "out", "pc2")
    assert (topology.name, cache.name) == ("out.obj", "out.pc2")
    data = cache.read_bytes()
    assert data[:12] == b"POINTCACHE2\0"
    _, n_point, _, _, n_frame = np.frombuffer(data[12:32], "<i4")
    assert n_frame == len(run)
    assert np.frombuffer(data[20:28], "<f4").tolist() == [0, 1]
    expected = np.stack([drawn(run.bodies, frame.x)[0] for frame in run]).astype("<f4")
    assert n_point == expected.shape[1]
    assert data[32:] == expected.tobytes()
    points, triangles = read_obj(topology)
    assert len(points) == n_point
    assert np.array_equal(triangles, drawn(run.bodies, run[0].x)[1])
    assert np.array_equal(points[:64], run.bodies[0].mesh.X), "the topology is at rest"


def test_vtu_has_cells_points_and_times(run, tmp_path):
    pv = pytest.importorskip("pyvista")
    *files, index = export(run, tmp_path / "out", "vtu")
    assert index.name == "out.pvd"
    for frame, file in zip(run, files, strict=True):
        grid = pv.read(file)
        assert np.asarray(grid.points).tobytes() == frame.x.tobytes()
        block, plate, fleshy = run.bodies
        tets = np.concatenate([block.mesh.cells, fleshy.mesh.cells + fleshy.start])
        assert np.array_equal(grid.cells_dict[pv.CellType.TETRA], tets)
        assert np.array_equal(grid.cells_dict[pv.CellType.TRIANGLE], plate.mesh.cells + plate.start)
        # Whatever the order of the cells in the file, each carries the body of its vertices.
        assert np.array_equal(
            grid.cell_data["body"], [grid.point_data["body"][cell.point_ids[0]] for cell in grid.cell]
        )
        assert np.allclose(grid.point_data["displacement"][:64], frame.x[:64] - block.mesh.X, atol=1e-6)
    reader = pv.get_reader(index)
    assert reader.time_values == pytest.approx([0.0, 0.1, 0.2])


def test_vtp_has_the_drawn_surface(run, tmp_path):
    pv = pytest.importorskip("pyvista")
    *files, _ = export(run, tmp_path / "out", "vtp")
    for frame, file in zip(run, files, strict=True):
        surface = pv.read(file)
        points, triangles, owner = drawn(run.bodies, frame.x)
        assert np.asarray(surface.points).tobytes() == points.tobytes()
        assert np.array_equal(surface.regular_faces, triangles)
        assert np.array_equal(surface.point_data["body"], owner)


@pytest.mark.parametrize("format", FORMATS)
def test_split_gives_each_body_its_files(tmp_path, format):
    if format.startswith("vt"):
        pytest.importorskip("pyvista")
    with FrameWriter(tmp_path / "run") as out:
        for frame in frames([box((2, 1, 1)), sheet(2)], 2):
            out.write(frame)
    written = export(tmp_path / "run", tmp_path / "out", format, split=True)
    assert sorted((tmp_path / "out").iterdir()) == sorted(written)
    assert sum("body_0" in file.name for file in written) == len(written) / 2
    if format == "obj":
        assert len(read_obj(written[0])[0]) == 12
        assert len(read_obj(written[-1])[0]) == 9


def test_bad_targets_are_named(run, tmp_path):
    with pytest.raises(InputError, match="cannot export 'fbx': expected one of vtu, vtp, obj, ply, pc2"):
        export(run, tmp_path / "out", "fbx")
    with pytest.raises(InputError, match="expected one of"):
        export(run, tmp_path / "out")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot export to .*file"):
        export(run, tmp_path / "file", "obj")
    with pytest.raises(InputError, match="no such folder"):
        export(tmp_path / "absent", tmp_path / "out.obj")


def test_no_half_written_file_is_left(run, tmp_path, monkeypatch):
    (tmp_path / "run" / "frame_000002.npz").write_bytes(b"damaged")
    with pytest.raises(InputError, match="frame_000002"):
        export(run, tmp_path / "out", "pc2")
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["out.obj"]


@pytest.mark.parametrize("format", FORMATS)
def test_colliders_are_further_bodies_if_wanted(tmp_path, format):
    if format.startswith("vt"):
        pytest.importorskip("pyvista")
    ball = pbng.Sphere((0, 0, 0), 0.4, motion=pbng.Translate((0, -1, 0)), over=0.1)
    with FrameWriter(tmp_path / "run") as out:
        for frame in frames([sheet(4, 0.5)], 2, dtype=np.float64, fps=10):
            frame.problem.contact = SimpleNamespace(colliders=(pbng.Plane((0, -2, 0), (0, 1, 0), name="floor"), ball))
            out.write(frame)
    plain = export(tmp_path / "run", tmp_path / "plain", format)
    full = export(tmp_path / "run", tmp_path / "full", format, colliders=True)
    assert len(plain) == len(full)
    split = export(tmp_path / "run", tmp_path / "split", format, split=True, colliders=True)
    assert len(split) == 3 * len(plain)
    if format == "obj":
        (points, faces), alone = read_obj(full[-1]), read_obj(plain[-1])
        assert len(points) == len(alone[0]) + 4 + len(ball.surface()[0])
        assert len(faces) == len(alone[1]) + 2 + len(ball.surface()[1])
        assert np.array_equal(points[-len(ball.surface()[0]) :], ball.surface(0.1)[0])
        assert {file.name for file in split} >= {"split_floor_0000.obj", "split_Sphere_0001.obj"}
