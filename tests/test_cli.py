"""The command line: runs leave readable frames, bad input names itself, and Ctrl-C loses nothing."""

import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import pbng
from pbng.cli import app
from pbng.cli_options import parse_acceleration
from pbng.view.residuals import residual_curves

TINY = "run twisting_block --resolution 4"

SCENE = """
import pbng

def scene(resolution=3):
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), resolution), pbng.Corotated(E=1e5, nu=0.3), name="block")
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Translate((0.1, 0.0, 0.0)), over=0.1)
    return scene
"""


@pytest.fixture
def pbng_(tmp_path, monkeypatch):
    """Runs a command in an empty folder; returns its exit code and everything it said, without line breaks."""
    monkeypatch.chdir(tmp_path)

    def command(text):
        result = CliRunner().invoke(app, text.split())
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, " ".join(result.output.split())

    return command


def test_run_leaves_readable_frames(pbng_):
    code, said = pbng_(f"{TINY} --frames 3")
    assert code == 0, said
    run = pbng.read_run("runs/twisting_block")
    assert len(run) == 3
    assert run.fps == 30
    assert np.isfinite(run[2].x).all()
    for words in ("3 of 3 frames", "64 vertices", "3 converged", "wrote 3 frames to runs/twisting_block"):
        assert words in said


def test_run_does_not_replace_a_run_unless_told_to(pbng_):
    assert pbng_(f"{TINY} --frames 2")[0] == 0
    code, said = pbng_(f"{TINY} --frames 1")
    assert code == 1
    assert "runs/twisting_block already holds a run; --overwrite" in said
    assert len(pbng.read_run("runs/twisting_block")) == 2
    assert pbng_(f"{TINY} --frames 1 --overwrite")[0] == 0
    assert len(pbng.read_run("runs/twisting_block")) == 1


def test_options_reach_the_solver(pbng_):
    solver = "--solver anderson:3 --iterations 4 --dtype float64 --threads 1"
    code, said = pbng_(f"{TINY} {solver} --frames 2 --fps 10 --out here")
    assert code == 0, said
    run = pbng.read_run("here")
    assert run.fps == 10
    assert run[1].iterations == 4
    assert run[1].x.dtype == np.float64
    assert "memory=3" in run.info["solver"]


def test_scene_file_runs_to_the_end_of_its_motions(pbng_, tmp_path):
    (tmp_path / "mine.py").write_text(SCENE)
    code, said = pbng_("run mine.py --resolution 4")
    assert code == 0, said
    run = pbng.read_run("runs/mine")
    assert len(run) == 4
    assert run[3].x.shape == (64, 3)


def test_info_and_export_of_a_run(pbng_):
    pbng_(f"{TINY} --frames 2")
    code, said = pbng_("info runs/twisting_block")
    assert code == 0
    assert "64 vertices" in said
    assert "2 converged" in said
    code, said = pbng_("export runs/twisting_block --format obj --out objs")
    assert code == 0, said
    assert os.path.exists("objs/objs_0001.obj")


def test_info_says_of_a_run_what_the_run_said(pbng_):
    for words in ("--inertia --dt 0.02", "--quasistatic --rtol 1e-2"):
        code, ran = pbng_(f"run hanging_bar --resolution 3 --frames 4 --out here --overwrite {words}")
        assert code == 0, ran
        code, said = pbng_("info here")
        assert code == 0, said
        for row in (r"iterations [\d,]+, \d+ a frame", r"residual, end median \S+ N, worst \S+ N"):
            assert re.search(row, said).group() in ran
        curves, xlabel = residual_curves(pbng.read_run("here"))
        assert xlabel == "time [s]"
        assert len(curves["end of frame"][0]) == (3 if "--inertia" in words else 4), "the start is not solved"


def test_names_in_brackets_are_shown(pbng_):
    pbng_(f"{TINY} --frames 1 --out bar[m]")
    code, said = pbng_("info bar[m]")
    assert code == 0
    assert "bar[m]" in said


def commands(app):
    """Every command of a typer app, by its name."""
    return typer.main.get_command(app).commands


@pytest.mark.parametrize("name", sorted(commands(app)))
def test_help_loses_no_word(name, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    command = commands(app)[name]
    said = CliRunner().invoke(app, [name, "--help"]).output
    said = re.sub(r"\x1b\[[0-9;]*m|[\s│]", "", said)  # colours, which some terminals are given, and the frame
    for text in [p.help for p in command.params if getattr(p, "help", None)]:
        assert re.sub(r"\s", "", text.replace("\\[", "[")) in said, text


def test_help_of_bench_names_its_commands():
    benchmarks = pytest.importorskip("pbng.bench")
    for name in commands(benchmarks.app):
        assert name in commands(app)["bench"].help


def test_list_names_every_scene(pbng_):
    code, said = pbng_("list")
    assert code == 0
    assert all(name in said for name in pbng.gallery.SCENES)


def test_version(pbng_):
    assert pbng_("--version") == (0, f"pbng {pbng.__version__}")


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("run twisting_blok", "did you mean twisting_block"),
        ("run nothing_like_it", "no scene 'nothing_like_it'"),
        ("run none.py", "no scene file none.py"),
        ("run bunny.obj", "bunny.obj is a mesh"),
        ("run bent_surface none.obj", "none.obj"),
        ("run hanging_bar some.obj", "takes no file (some.obj)"),
        ("run twisting_block --resolution 1", "vertices must be"),
        ("run twisting_block --resolution 4 --rtol -1", "rtol must be finite and at least 0, not -1"),
        ("run twisting_block --resolution 4 --atol nan", "atol must be finite"),
        ("run twisting_block --resolution 4 --iterations -2", "iterations must be"),
        ("run twisting_block --resolution 4 --frames 0", "frames must be at least 1"),
        ("run twisting_block --resolution 4 --fps 0", "fps must be positive, not 0"),
        ("run twisting_block --resolution 4 --solver andersen", "known are auto, multigrid, anderson, plain"),
        ("run twisting_block --resolution 4 --solver anderson:x", "memory must be a whole number, not 'x'"),
        ("run twisting_block --resolution 4 --solver plain:1", "plain takes no parameter"),
        ("run twisting_block --resolution 4 --solver node-sor:2.5", "omega must lie strictly between 0 and 2, not 2.5"),
        ("run twisting_block --resolution 4 --dtype float16", "not 'float16'"),
        ("run twisting_block --resolution 4 --threads 0", "threads must lie between 1 and"),
        ("run twisting_block --resolution 4 --out taken/run", "taken/run"),
        ("run twisting_block --resolution 4 --out taken", "taken: it is a file"),
        ("info none.obj", "no file or folder none.obj"),
        ("info taken", "taken: expected a mesh"),
        ("view none", "no run at none"),
        ("export none", "no run at none"),
    ],
)
def test_bad_input_names_itself_and_leaves_nothing(pbng_, tmp_path, words, named):
    (tmp_path / "taken").write_text("")
    code, said = pbng_(words)
    assert code == 1, said
    assert "Error:" in said
    assert named in said
    assert "Traceback" not in said
    assert os.listdir(tmp_path) == ["taken"]


@pytest.mark.parametrize(
    "words", ["run", "run twisting_block --frobnicate", "run twisting_block --resolution x", "dance"]
)
def test_wrong_usage_exits_with_2(pbng_, words):
    code, said = pbng_(words)
    assert code == 2
    assert words.split()[-1] in said or "NAME" in said


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("import nothing_like_it", "mine.py, line 1: ModuleNotFoundError: No module named 'nothing_like_it'"),
        ("x = 1\ny = (", "mine.py, line 2: SyntaxError"),
        (SCENE.replace("nu=0.3", "nu=0.6"), "mine.py, line 6: Corotated: Poisson's ratio"),
        (SCENE.replace("x=1.0", "x=7.0"), "mine.py, line 8: move: block.where(x=7.0) selects no vertex"),
        ("def scene():\n    return 1 / 0", "mine.py, line 2: ZeroDivisionError"),
        ("def scene():\n    raise SystemExit(4)", "mine.py, line 2: SystemExit"),
        ("scenes = 3", "mine.py has no function scene()"),
        ("def scene():\n    return 4", "mine.py: scene() must return a pbng.Scene"),
        (
            SCENE.replace("scene.pin", "0 and scene.pin").replace("scene.move", "0 and scene.move"),
            "no vertex is pinned",
        ),
    ],
)
def test_wrong_scene_files_are_blamed_by_line(pbng_, tmp_path, text, named):
    (tmp_path / "mine.py").write_text(text)
    code, said = pbng_("run mine.py")
    assert code == 1
    assert named in said
    assert "Traceback" not in said
    assert not (tmp_path / "runs").exists()


def test_scene_that_fails_on_the_way_keeps_the_frames_before(pbng_, tmp_path):
    motion = "lambda t, X: X + 0 * (1 // (t < 0.05))"  # fails from the third frame on
    (tmp_path / "mine.py").write_text(SCENE.replace("pbng.Translate((0.1, 0.0, 0.0))", motion))
    code, said = pbng_("run mine.py")
    assert code == 1
    assert "mine.py, line 8: ZeroDivisionError" in said
    assert "the 2 frames before it are intact in runs/mine" in said
    assert len(pbng.read_run("runs/mine")) == 2


def test_debug_shows_the_traceback_wherever_it_stands(pbng_):
    for words in ("--debug run none.py", "run none.py --debug"):
        code, said = pbng_(words)
        assert code == 1
        assert "Traceback" in said
        assert "Error: no scene file none.py" in said


def test_scene_without_resolution_says_so(pbng_, tmp_path):
    (tmp_path / "mine.py").write_text(SCENE.replace("resolution=3", "").replace("resolution", "3"))
    code, said = pbng_("run mine.py --resolution 5")
    assert code == 1
    assert "mine.py: scene() has no parameter 'resolution'" in said


def test_diverged_run_stops_with_an_error(pbng_):
    code, said = pbng_(f"{TINY} --solver sor:40 --iterations 60 --atol 1 --frames 9")
    assert code == 1
    assert re.search(r"Frame \d diverged", said)
    assert "frames are intact in runs/twisting_block" in said
    assert all(np.isfinite(frame.x).all() for frame in pbng.read_run("runs/twisting_block"))


@pytest.mark.parametrize(
    ("text", "made"),
    [
        ("anderson", pbng.Anderson()),
        ("Anderson:5, 1.5", pbng.Anderson(memory=5, omega=1.5)),
        ("plain", None),
        ("node_sor:1.9", pbng.NodeSOR(1.9)),
        ("sor", pbng.SOR()),
        ("chebyshev:0.9,1.2", pbng.Chebyshev(0.9, 1.2)),
    ],
)
def test_solvers_by_name(text, made):
    assert parse_acceleration(text) == made


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_ctrl_c_keeps_the_finished_frames(tmp_path):
    words = f"run twisting_block --resolution 8 --frames 100000 --fps 50000 --threads 1 --out {tmp_path / 'run'}"
    child = subprocess.Popen(
        [sys.executable, "-m", "pbng.cli", *words.split()],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        # A parent that ignores the signal, as one in the background may, would make the child ignore it too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        deadline = time.monotonic() + 300  # kernels may have to be compiled
        while not (tmp_path / "run" / "frame_000002.npz").exists():
            assert child.poll() is None, child.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        child.send_signal(signal.SIGINT)
        _, said = child.communicate(timeout=60)
    finally:
        child.kill()
    assert child.returncode == 130, said
    run = pbng.read_run(tmp_path / "run")
    assert len(run) >= 3
    assert np.isfinite(run[len(run) - 1].x).all()
    assert f"Interrupted. {len(run)} of 100000 frames are intact in {tmp_path / 'run'}." in said


def test_help_needs_nothing_heavy():
    loaded = "import sys, pbng.cli; print(sorted({'numba', 'numpy', 'scipy', 'pyvista'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_inertia_from_the_command_line(pbng_):
    code, said = pbng_("run hanging_bar --resolution 3 --inertia --frames 3 --dt 0.02")
    assert code == 0, said
    assert "kinetic" in said
    assert "momentum" in said
    run = pbng.read_run("runs/hanging_bar")
    assert np.abs(run[2].v).max() > 0
    code, said = pbng_("run hanging_bar --resolution 3 --dt 0.02")
    assert code == 1
    assert "--dt and --substeps are for runs with --inertia" in said
