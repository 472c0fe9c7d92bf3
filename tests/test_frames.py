"""What was written comes back bit for bit, whatever stops the writer, and bad folders are refused by name."""

import errno
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from fake_runs import Body, Problem, Status, box, frames, sheet

import pbng
from pbng.errors import InputError
from pbng.io import store
from pbng.io.frames import FrameWriter, Run, StoredContact, read_run
from pbng.mesh import Embedding, TetMesh


def write(path, n=3, **options):
    made = list(frames([box()], n))
    with FrameWriter(path, **options) as out:
        for frame in made:
            out.write(frame)
    return made


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_frames_come_back_bit_for_bit(tmp_path, dtype):
    made = list(frames([box(), sheet()], 3, dtype=dtype))
    made[1].result.status = Status.BUDGET
    made[2].x[5] = np.nan, np.inf, -0.0  # a diverged frame is stored as it is
    with FrameWriter(tmp_path / "twist.h5", fps=24) as out:
        for frame in made:
            out.write(frame)
    run = read_run(tmp_path / "twist.h5")
    assert len(run) == 3
    assert run.fps == 24
    for frame, back in zip(made, run, strict=True):
        assert back.x.dtype == dtype
        assert back.x.tobytes() == frame.x.tobytes()
        assert back.residuals.tobytes() == frame.result.residuals.tobytes()
        assert back.monitored.tolist() == frame.result.monitored.tolist()
        assert (back.index, back.t, back.status) == (frame.index, frame.t, frame.result.status.name)
        for name in ("iterations", "energy", "seconds", "inverted"):
            assert getattr(back, name) == getattr(frame.result, name)
            assert type(getattr(back, name)) is type(getattr(frame.result, name))
    assert run[-1].index == 2
    assert [frame.index for frame in run[1:]] == [1, 2]
    with pytest.raises(IndexError):
        run[3]


def test_meshes_come_back_with_groups_and_skin(tmp_path):
    block = box()
    skin = Embedding(np.array([[0, 1, 2]]), block.cells[:3], np.full((3, 4), 0.25))
    block = TetMesh(
        block.X, block.cells, groups={"left/end": block.where(x=0.0)}, cell_groups={"é": np.arange(4)}, skin=skin
    )
    plate = sheet()
    frame = next(frames([block, plate], 1))
    with FrameWriter(tmp_path / "run") as out:
        out.write(frame)
    a, b = Run(tmp_path / "run").bodies
    assert (a.name, a.start, a.stop) == ("body 0", 0, 64)
    assert (b.name, b.start, b.stop) == ("body 1", 64, 64 + 81)
    for mesh, back in ((block, a.mesh), (plate, b.mesh)):
        assert type(back) is type(mesh)
        assert back.X.tobytes() == mesh.X.tobytes()
        assert np.array_equal(back.cells, mesh.cells)
        assert np.array_equal(back.surface, mesh.surface)
    assert np.array_equal(a.mesh.groups["left/end"], block.groups["left/end"])
    assert np.array_equal(a.mesh.cell_groups["é"], np.arange(4))
    assert np.array_equal(a.mesh.skin.points(block.X), skin.points(block.X))
    assert a.mesh.skin.triangles.tolist() == [[0, 1, 2]]


def test_info_is_kept(tmp_path):
    write(tmp_path / "run", info={"solver": "PBNG", "omega": 1.7})
    run = Run(tmp_path / "run")
    assert run.info["omega"] == 1.7
    assert run.info["created"].endswith("+00:00")
    assert run.name == "a run"
    with pytest.raises(InputError, match="info"):
        FrameWriter(tmp_path / "other", info={"x": np.zeros(3)})


CHILD = """
import sys
sys.path[:0] = {paths!r}
from fake_runs import box, frames
from pbng.io.frames import FrameWriter
with FrameWriter({run!r}, overwrite=True) as out:
    for frame in frames([box((12, 12, 12))], 100000):
        out.write(frame)
        print(frame.index, flush=True)
"""


def test_killed_writer_leaves_every_finished_frame(tmp_path):
    path = tmp_path / "run"
    paths = [os.path.dirname(__file__), *sys.path]
    for _ in range(3):  # the later rounds also overwrite what the killed ones left
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD.format(paths=paths, run=str(path))], stdout=subprocess.PIPE, text=True
        )
        said = [child.stdout.readline() for _ in range(20)]
        time.sleep(0.013)
        child.send_signal(signal.SIGKILL)
        said += child.stdout.readlines()
        assert child.wait() == -signal.SIGKILL
        run = Run(path)
        assert len(said) <= len(run) <= len(said) + 1  # the last may have been finished and not yet told
        for k, expected in zip(range(len(run)), frames([box((12, 12, 12))], 100000)):
            assert run[k].index == k
            assert run[k].x.tobytes() == expected.x.tobytes()


def test_leftovers_are_ignored_and_cleaned(tmp_path):
    write(tmp_path / "run")
    half = tmp_path / "run" / ".frame_000003.npz.tmp"
    half.write_bytes(b"half a frame")
    assert len(Run(tmp_path / "run")) == 3
    FrameWriter(tmp_path / "run", append=True)
    assert not half.exists()


def test_a_writer_killed_before_its_first_frame_leaves_a_usable_folder(tmp_path):
    path = tmp_path / "run"
    write(path)
    for file in path.glob("frame_*"):
        file.unlink()
    (path / "body_000.npz").unlink()
    with pytest.raises(InputError, match="no frames"):
        Run(path)
    write(path, 2)
    assert len(Run(path)) == 2


def test_existing_run_is_kept_unless_told(tmp_path):
    path = tmp_path / "run"
    write(path, 3)
    with pytest.raises(InputError, match=r"run already holds a run of 3 frames; overwrite=True"):
        FrameWriter(path)
    (path / "notes.txt").write_text("mine")
    FrameWriter(path, overwrite=True)
    assert len(Run(path)) == 3, "nothing is lost before there is something new"
    write(path, 2, overwrite=True)
    assert len(Run(path)) == 2
    assert (path / "notes.txt").read_text() == "mine"


def test_append_continues_the_same_bodies_only(tmp_path):
    path = tmp_path / "run"
    first, second = write(path, 3), write(path, 2, append=True)
    assert [frame.x.tobytes() for frame in Run(path)] == [frame.x.tobytes() for frame in first + second]
    with pytest.raises(InputError, match="append"), FrameWriter(path, append=True) as out:
        out.write(next(frames([box((2, 2, 2))], 1)))
    assert len(Run(path)) == 5
    with pytest.raises(InputError, match="not both"):
        FrameWriter(path, append=True, overwrite=True)
    write(tmp_path / "new", 1, append=True)
    assert len(Run(tmp_path / "new")) == 1


def test_only_runs_are_overwritten(tmp_path):
    folder = tmp_path / "thesis"
    folder.mkdir()
    (folder / "run.json").write_text('{"format": "something else"}')
    (folder / "body_000.npz").write_text("precious")
    for options in ({}, {"overwrite": True}, {"append": True}):
        with pytest.raises(InputError, match="thesis: it is not empty and not a pbng run"):
            FrameWriter(folder, **options)
    assert (folder / "body_000.npz").read_text() == "precious"
    with pytest.raises(InputError, match=r"run\.json: it is a file"):
        FrameWriter(folder / "run.json")
    with pytest.raises(InputError, match=r"cannot write frames to .*below: "):
        FrameWriter(folder / "run.json" / "below")


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="Permission denied"):
        FrameWriter(tmp_path / "run")


@pytest.mark.parametrize("fails_at", [0, 1, 2, 3, 5])  # the manifest, the mesh, the frames
def test_full_disk_costs_only_the_frame_being_written(tmp_path, monkeypatch, fails_at):
    made = list(frames([box()], 4))
    count = 0

    def full(descriptor):
        nonlocal count
        count += 1
        if count == fails_at + 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(store.os, "fsync", full)
    out = FrameWriter(tmp_path / "run")
    lost = max(fails_at - 2, 0)
    for frame in made[:lost]:
        out.write(frame)
    with pytest.raises(InputError, match=rf"frame {lost} was not written to .*run: No space.*the {lost} frames before"):
        out.write(made[lost])
    assert not list((tmp_path / "run").glob(".*"))
    if lost:
        assert [frame.x.tobytes() for frame in Run(tmp_path / "run")] == [frame.x.tobytes() for frame in made[:lost]]
    for frame in made[lost:]:  # room was made: go on
        out.write(frame)
    assert [frame.x.tobytes() for frame in Run(tmp_path / "run")] == [frame.x.tobytes() for frame in made]


def test_ctrl_c_waits_for_the_frame_that_is_being_written(tmp_path, monkeypatch):
    made = list(frames([box()], 2))
    savez = np.savez

    def interrupted(*arguments, **arrays):
        signal.raise_signal(signal.SIGINT)
        savez(*arguments, **arrays)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with FrameWriter(tmp_path / "run") as out:
            out.write(made[0])
            monkeypatch.setattr(np, "savez", interrupted)
            with pytest.raises(KeyboardInterrupt):
                out.write(made[1])
            assert out.n_written == 2
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)
    assert [frame.x.tobytes() for frame in Run(tmp_path / "run")] == [frame.x.tobytes() for frame in made]


def test_misfit_frames_are_refused(tmp_path):
    frame = next(frames([box()], 1))
    frame.x = frame.x[:-1]
    with pytest.raises(InputError, match=r"frame 0 has positions of shape \(63, 3\), expected \(64, 3\)"):
        FrameWriter(tmp_path / "run").write(frame)
    with pytest.raises(InputError, match="fps"):
        FrameWriter(tmp_path / "run", fps=0)


def test_unreadable_runs_name_the_file(tmp_path):
    with pytest.raises(InputError, match="absent: no such folder"):
        Run(tmp_path / "absent")
    with pytest.raises(InputError, match=r"incomplete run: .*run\.json is missing"):
        Run(tmp_path)
    path = tmp_path / "run"
    write(path, 5)
    manifest = (path / "run.json").read_text()
    for text in ("{", "[]", '{"format": "x"}', '{"format": "pbng run"}'):
        (path / "run.json").write_text(text)
        with pytest.raises(InputError, match=r"cannot read .*run\.json"):
            Run(path)
    (path / "run.json").write_text(json.dumps({**json.loads(manifest), "version": 99}))
    with pytest.raises(InputError, match="newer pbng"):
        Run(path)
    (path / "run.json").write_text(manifest)

    run, file = Run(path), path / "frame_000001.npz"
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 4] ^= 1
    for data in (b"", whole[: len(whole) // 2], bytes(flipped), b"not a frame"):
        file.write_bytes(data)
        with pytest.raises(InputError, match=r"cannot read .*frame_000001\.npz"):
            run[1]
    file.unlink()
    with pytest.raises(InputError, match=r"incomplete run: .*frame_000001\.npz is missing"):
        Run(path)
    write(path, 2, overwrite=True)  # even a run with a hole may be replaced
    (path / "body_000.npz").unlink()
    with pytest.raises(InputError, match=r"incomplete run: .*body_000\.npz is missing"):
        Run(path)


def test_nothing_of_the_problem_but_bodies_is_needed(tmp_path):
    frame = next(frames([box()], 1))
    frame.problem = Problem("", (Body("b", 0, 64, box()),))
    with FrameWriter(tmp_path / "dir.with.dots") as out:
        out.write(frame)
    assert Run(tmp_path / "dir.with.dots").name == "dir.with"


def test_velocities_and_springs_are_kept(tmp_path):
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), pbng.Corotated(E=1e4, nu=0.3))
    scene.bind(body.where(x=0.0), [0.0, 2, 0], k=10.0)
    with pbng.FrameWriter(tmp_path / "run") as out:
        for frame in pbng.simulate(scene, frames=2, fps=10, inertia=True):
            out.write(frame)
    last = pbng.read_run(tmp_path / "run")[-1]
    np.testing.assert_array_equal(last.v, frame.v)
    np.testing.assert_allclose(last.springs[:, 0], frame.x[body.where(x=0.0).index])
    np.testing.assert_allclose(last.springs[:, 1], np.tile([0.0, 2, 0], (9, 1)), atol=1e-12)


def press(moving=True):
    """A ball between a floor and a plane that comes down, beside a mesh that turns."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    scene.add(pbng.shapes.sphere(0.5, 5, (0, 0.5, 0)), pbng.Corotated(E=2e3, nu=0.3, density=10.0), name="ball")
    options = {"motion": pbng.Translate((0, -0.2, 0)), "over": 0.2} if moving else {}
    paddle = pbng.shapes.box((0.2, 0.2, 0.2), 2, (1.0, 0.0, 0.0))
    scene.collide_with(
        [
            pbng.Plane((0, 0, 0), (0, 1, 0)),
            pbng.Plane((0, 1, 0), (0, -1, 0), name="press", **options),
            pbng.Kinematic(paddle, motion=pbng.Rotate("y", 0.1) if moving else None, over=0.2),
        ]
    )
    return list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=20), frames=3, fps=10, inertia=True))


def test_contact_and_colliders_come_back(tmp_path):
    made = press()
    with FrameWriter(tmp_path / "run") as out:
        for frame in made:
            out.write(frame)
    run = Run(tmp_path / "run")
    assert [(c.name, c.kind, c.moves) for c in run.colliders] == [
        ("Plane", "Plane", False),
        ("press", "Plane", True),
        ("Kinematic", "Kinematic", True),
    ]
    colliders = made[0].problem.contact.colliders
    assert len(made[-1].contact.vertices) > 0
    for frame, back in zip(made, run, strict=True):
        for name in StoredContact.__dataclass_fields__:
            assert np.array_equal(getattr(back.contact, name), getattr(frame.contact, name)), name
        for collider, shape, points in zip(colliders, run.colliders, back.colliders, strict=True):
            expected, triangles = collider.surface(frame.t)
            assert np.array_equal(points, expected.astype(points.dtype))
            assert points.dtype == (frame.x.dtype if shape.moves else float)
            assert np.array_equal(shape.mesh.cells, triangles)
    assert np.array_equal(run.colliders[1].mesh.X[:, 1], np.ones(4)), "at rest"
    assert np.allclose(run[-1].colliders[1][:, 1], 0.8)
    assert "collider_000" not in np.load(tmp_path / "run" / "frame_000001.npz"), "what rests is stored once"
    with pytest.raises(InputError, match="its colliders are not those"):
        FrameWriter(tmp_path / "run", append=True).write(press(moving=False)[0])
    FrameWriter(tmp_path / "run", append=True).write(made[-1])
    assert len(Run(tmp_path / "run")) == 4


def test_runs_from_before_there_was_contact_are_read(tmp_path):
    write(tmp_path / "run")
    file = tmp_path / "run" / "run.json"
    manifest = json.loads(file.read_text())
    del manifest["colliders"]
    file.write_text(json.dumps(manifest))
    run = Run(tmp_path / "run")
    assert run.colliders == ()
    assert run[0].contact is None
    assert run[0].colliders == ()


def test_colliders_of_a_run_that_is_replaced_go_with_it(tmp_path):
    with FrameWriter(tmp_path / "run") as out:
        out.write(press(moving=False)[0])
    write(tmp_path / "run", overwrite=True)
    assert not list((tmp_path / "run").glob("collider_*"))
    (tmp_path / "run" / "body_000.npz").unlink()
    with FrameWriter(tmp_path / "run", overwrite=True) as out:
        out.write(press(moving=False)[0])
    (tmp_path / "run" / "collider_001.npz").unlink()
    with pytest.raises(InputError, match=r"incomplete run: .*collider_001\.npz is missing"):
        Run(tmp_path / "run")
