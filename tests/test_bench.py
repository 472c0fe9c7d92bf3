"""The benchmarks run, and what they say of small problems is true."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import pbng
from pbng.bench import accuracy, app, cloth, cycles, frames, poses
from pbng.cli import app as commands

LEVELS = ("1e-02", "1e-03", "1e-04", "1e-06")


@pytest.fixture(scope="module")
def found():
    # All methods end long before the time is up, at the floor of float32.
    return accuracy.measure(10, "corotated", 0.3, seconds=2.0, threads=1)


def test_accuracy_watches_every_method_to_its_end(found):
    """Time rises; a curve begins at most at the first residual; two-grid comes down to the floor of float32."""
    curves = found.curves
    assert list(curves) == [*accuracy.ACCELERATIONS, "two-grid", "Newton"]
    for c in curves.values():
        assert len(c.seconds) == len(c.ratios) == len(c.errors) <= accuracy.MOMENTS + 2
        assert (np.diff(c.seconds) > 0).all()
        assert c.iterations[-1] >= len(c.seconds) - 1
        assert c.ratios[-1] < 0.1
    two_grid = curves["two-grid"]
    assert two_grid.ratios[-1] < 1e-5
    assert two_grid.errors[-1] < 1e-3
    assert curves["Newton"].errors[-1] < 1e-8
    assert curves["plain"].ratios[0] == pytest.approx(1)
    assert two_grid.errors[0] < curves["plain"].errors[0]  # it begins with the movement extended


def test_accuracy_tells_the_first_moment_below_a_level(found):
    for row in accuracy.rows(found):
        for what in ("ratio", "error"):
            moment = row[f"{what} 1e-02"]
            met = np.array(row[f"{what}s"]) <= 1e-2
            assert moment == (np.array(row["seconds"])[met][0] if met.any() else None)
        assert row["last_error"] == row["errors"][-1]


def test_accuracy_is_drawn(found, tmp_path):
    pytest.importorskip("matplotlib")
    path = accuracy.draw(found, tmp_path / "new" / "a.png", "10³ vertices")
    assert path.stat().st_size > 20_000


def test_a_figure_has_a_panel_for_each_y(tmp_path):
    pytest.importorskip("matplotlib")
    x, y = np.arange(1, 5), 10.0 ** np.arange(4)
    with pytest.raises(pbng.InputError, match="curve 'a' has 1 y for 2 panels"):
        pbng.view.plot_residuals({"a": (x, y)}, tmp_path / "a.png", ylabel=("one", "two"))
    with pytest.raises(pbng.InputError, match="curve 'a' has 4 x and 3 y"):
        pbng.view.plot_residuals({"a": (x, y, y[:3])}, tmp_path / "a.png", ylabel=("one", "two"))
    assert pbng.view.plot_residuals({"a": (x, y, 1 / y)}, tmp_path / "a.png", ylabel=("one", "two"), top=3.0).is_file()


def test_cycles_are_counted_to_each_level():
    row = cycles.measure(7, "corotated", 0.45, "float64", threads=1)
    assert row["status"] == "CONVERGED"
    assert row["inverted"] == 0
    needed = [row[level] for level in LEVELS]
    assert needed == sorted(needed)
    assert needed[0] >= 1
    assert needed[-1] == len(row["ratios"]) - 1 < 30
    for level, k in zip(LEVELS, needed):
        assert row["ratios"][k] <= float(level) < min(row["ratios"][:k])
    assert row["s 1e-06"] == pytest.approx(row["ms"] * needed[-1] / 1e3)


def test_poses_are_certified_rightly():
    rows = poses.measure(3, 7, 1e-4, threads=1)
    total = poses.summary(rows)
    assert total["poses"] == total["certified"] == 3
    assert total["falsely"] == total["unknown"] == 0
    for r in rows:
        assert r["estimate"] <= r["bound"] == pytest.approx(2e-4)
        assert 0 < r["true"] <= r["bound"]


def test_false_certificates_are_counted():
    row = {"certified": True, "bound": 1.0, "estimate": 0.5, "true": 0.4, "cycles": 5, "ms": 1.0, "setup_s": 0.1}
    row |= {"inverted": 0}
    off = {"certified": False, "true": 3.0, "inverted": 2, "cycles": 100}
    total = poses.summary([row, row | {"true": 2.0}, row | off, row | {"true": float("nan")}])
    assert (total["certified"], total["falsely"], total["unknown"], total["inverted"]) == (3, 1, 1, 1)
    assert total["true/estimate"] == pytest.approx(2.4)
    assert total["worst true/estimate"] == 4


def test_a_pose_moves_the_far_end_and_repeats():
    """The pose is a rigid movement of the far end; the same seed gives the same poses."""
    first, again = (poses.random_pose(np.random.default_rng(3)) for _ in range(2))
    problem = poses.bar(3, pbng.Corotated(E=1e5, nu=0.3, density=10.0), [first])
    x = problem.constrain(problem.X, 0)
    near, far = problem.X[:, 0] == 0, problem.X[:, 0] == 2
    np.testing.assert_array_equal(x[near], problem.X[near])
    np.testing.assert_array_equal(problem.fixed, near | far)
    X, y = problem.X[far], x[far]
    np.testing.assert_allclose(
        np.linalg.norm(y[:, None] - y, axis=2), np.linalg.norm(X[:, None] - X, axis=2), atol=1e-12
    )
    assert (np.abs(y.mean(0) - [2.3, 0.5, 0.5]) <= [1.0, 0.3, 0.3]).all()
    np.testing.assert_array_equal(again.at(X, X.mean(0), 1.0, 0.0), y)


def test_commands_print_and_record(tmp_path):
    record = tmp_path / "cycles.json"
    command = f"cycles --n 6 --model neo-hookean --nu 0.3 --threads 1 --record {record}"
    result = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "neo-hookean" in result.output
    written = json.loads(record.read_text())
    assert written["benchmark"] == "cycles"
    assert [r["n"] for r in written["rows"]] == [6]

    record = tmp_path / "poses.json"
    command = f"poses --count 1 --n 5 --error 1e-3 --threads 1 --record {record}"
    result = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    (row,) = json.loads(record.read_text())["rows"]
    assert row["poses"] == len(row["each"]) == 1

    command = f"accuracy --n 5 --seconds 0.02 --threads 1 --record {tmp_path / 'accuracy.json'}"
    result = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert "two-grid" in result.output
    assert len(json.loads((tmp_path / "accuracy.json").read_text())["rows"]) == 7


def test_cloth_is_a_command_like_the_others(tmp_path):
    record = tmp_path / "new" / "cloth.json"
    command = f"bench cloth --n 6 --held rim --seconds 2 --record {record}"
    result = CliRunner().invoke(commands, command.split(), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    written = json.loads(record.read_text())
    assert written["benchmark"] == "cloth"
    assert {r["held"] for r in written["rows"]} == {"rim"}
    for k, _ in enumerate(cloth.CLOTHS):
        rows = {r["method"]: r for r in written["rows"][3 * k : 3 * k + 3]}
        assert list(rows) == ["cycles", "Newton", "sweeps"]
        assert {r["status"] for r in rows.values()} == {"CONVERGED"}
        for r in rows.values():
            needed = [r[level] for level in LEVELS]
            assert needed == sorted(needed)
            assert r["s 1e-06"] > 0
            assert r["last"] <= 1e-6
            assert r["energy"] == pytest.approx(rows["Newton"]["energy"], rel=1e-6)
        assert rows["cycles"]["1e-06"] < rows["sweeps"]["1e-06"]


@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        ("sweep --model foo", 1, "no model 'foo' to measure; there are corotated, neo-hookean"),
        ("convergence --model corotated --model foo", 1, "no model 'foo'"),
        ("accuracy --model foo", 1, "no model 'foo'"),
        ("cycles --model foo", 1, "no model 'foo'"),
        ("poses --model foo", 1, "no model 'foo'"),
        ("cloth --held foo", 1, "no sheet is held by 'foo'"),
        ("sweep --dtype float16", 2, "'float16' is not one of"),
        ("cycles --dtype float16", 2, "'float16' is not one of"),
        ("sweep --rounds 0", 2, "--rounds"),
        ("contact --rounds 0", 2, "--rounds"),
        ("convergence --sweeps 0", 2, "--sweeps"),
        ("convergence --every 0", 2, "--every"),
        ("cycles --n 2", 2, "--n"),
        ("poses --seed -1", 2, "--seed"),
        ("sweep --threads 0", 2, "--threads"),
        ("sweep --threads 4096", 1, "threads must lie between"),
        ("contact --threads 4096", 1, "threads must lie between"),
        ("sweep --n 3 --threads 1 --rounds 1 --delaunay 1", 1, "at least 2 vertices along an edge, not 1"),
        ("cycles --record .", 2, "--record"),
    ],
)
def test_commands_refuse_what_they_cannot_use(command, code, said):
    """In a line, before any work, and without a traceback."""
    result = CliRunner().invoke(commands, ["bench", *command.split()])
    assert isinstance(result.exception, SystemExit)
    assert result.exit_code == code
    assert said in " ".join(result.output.split())


def test_models_are_told_by_name():
    from pbng.bench.scenes import MODELS, model_of

    assert [model_of(name) for name in MODELS] == list(MODELS.values())
    with pytest.raises(pbng.InputError, match="no model 'foo' to measure; there are corotated"):
        poses.measure(1, 3, 1e-3, "foo")


def test_a_cycle_a_frame_beats_sweeps():
    """Frames of the twisting block: one cycle a frame ends nearer to equilibrium than six sweeps, two nearer still."""
    rows = {row["budget"]: row for row in frames.measure(10, 8, threads=1)}
    assert [len(row["errors"]) for row in rows.values()] == [8] * 4
    assert rows["2 cycles"]["last"] < rows["1 cycle"]["last"] < rows["6 sweeps"]["last"]
