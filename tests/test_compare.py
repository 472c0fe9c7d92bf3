"""The comparison runner: what its clock counts, that its curves are those of solves, and what it says of failures."""

import json
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import held_box, twisted_bar
from typer.testing import CliRunner

import pbng
from pbng.cli import app
from pbng.cli_compare import parse_methods
from pbng.compare import runner
from pbng.compare.contest import contest
from pbng.compare.curve import Curve
from pbng.compare.frames import contest_frames
from pbng.compare.reference import Reference, converged
from pbng.compare.start import Start, scattered
from pbng.solvers.base import Certificate, Status


@pytest.fixture(scope="module")
def problem():
    return twisted_bar().compile()


class Clock:
    """A clock that stands still unless told to run on."""

    def __init__(self):
        self.now = self.compiled = 0.0


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(runner, "time", SimpleNamespace(perf_counter=lambda: clock.now))
    monkeypatch.setattr(runner, "compile_seconds", lambda: clock.compiled)
    return clock


@dataclass(frozen=True, eq=False)
class Fake:
    """A solver that moves every free vertex half the way home, and whose every act takes a time of its own."""

    clock: Clock
    step_seconds: tuple = (1.0,)
    bad_from: int | None = None
    jit_at: int | None = None

    def set_up(self, problem):
        self.clock.now += 7.0
        return FakeMethod(problem, self)


class FakeMethod:
    every, estimates_error, setup_seconds = 1, False, 7.0

    def __init__(self, problem, solver):
        self.problem, self.solver, self.total = problem, solver, 0

    def prepare(self, before, x):
        self.solver.clock.now += 0.25

    def start(self, x, targets=None, contacts=None, resume=False):
        self.solver.clock.now += 0.25
        self.x, self.targets, self.k = x.copy(), targets, 0

    def step(self):
        solver, free = self.solver, ~self.problem.fixed
        self.k, self.total = self.k + 1, self.total + 1
        solver.clock.now += solver.step_seconds[self.total % len(solver.step_seconds)]
        if self.k == solver.jit_at:
            solver.clock.now += 5.0
            solver.clock.compiled += 5.0
        self.x[free] += 0.5 * (self.problem.X[free] - self.x[free])
        if solver.bad_from is not None and self.k >= solver.bad_from:
            self.x[free] = np.nan

    def settle(self):
        self.solver.clock.now += 100.0

    def state(self):
        self.solver.clock.now += 100.0
        return self.x.copy()

    def certify(self):
        p = self.problem
        return Certificate(p.residual(self.x, self.targets), p.energy(self.x, self.targets), 1.0, 0)

    def refine(self):
        return False

    def floor(self, dtype=None):
        return 0.0


def test_the_clock_leaves_out_setting_up_compiling_and_looking(problem, clock):
    found = contest(problem, {"fake": Fake(clock, jit_at=6)}, iterations=8, reference=None)
    curve = found.curves["fake"]
    np.testing.assert_array_equal(curve.iterations, np.arange(9))
    np.testing.assert_allclose(curve.seconds, 0.5 + np.arange(9))  # starting takes half a second
    assert curve.setup_seconds == 7
    assert curve.compile_seconds == 5
    assert curve.ms == pytest.approx(1000)


def test_equal_seconds(problem, clock):
    solvers = {"quick": Fake(clock, (1.0,)), "slow": Fake(clock, (3.0,))}
    found = contest(problem, solvers, seconds=10.0, reference=None)
    assert [c.iterations[-1] for c in found.curves.values()] == [10, 4]  # the iteration under way is finished
    assert all(c.status is Status.SECONDS for c in found.curves.values())
    assert found.curves["slow"].seconds[-1] == 12.5


def test_times_are_medians_over_rounds(problem, clock):
    """Five iterations take turns with three speeds; four steps warm up."""
    found = contest(problem, {"fake": Fake(clock, (1.0, 2.0, 30.0))}, iterations=1, rounds=3, reference=None)
    assert found.curves["fake"].seconds.tolist() == [0.5, 2.5]
    assert found.record()["budget"]["rounds"] == 3


def test_equal_iterations_or_a_number_for_each(problem):
    solvers = {"plain": pbng.PBNG(acceleration=None, threads=1), "mixed": pbng.PBNG(threads=1)}
    found = contest(problem, solvers, iterations=70, looks=10, reference=None)
    for curve in found.curves.values():
        assert curve.iterations[0] == 0
        assert curve.iterations[-1] == 70
        assert len(curve.iterations) <= 11
        assert curve.status is Status.ITERATIONS
    found = contest(problem, solvers, iterations={"plain": 3, "mixed": 5}, reference=None)
    assert [c.iterations[-1] for c in found.curves.values()] == [3, 5]


SOLVERS = {
    "plain": pbng.PBNG(acceleration=None, dtype="float64", threads=1),
    "mixed": pbng.PBNG(threads=1),
    "two-grid": pbng.MultigridPBNG(threads=1),
    "newton": pbng.Newton(threads=1),
    "xpbd": pbng.XPBD(threads=1),
}


@pytest.fixture(scope="module")
def found(problem):
    return contest(problem, SOLVERS, iterations=6)


def test_curves_are_those_of_solves(found, problem):
    for label, solver in SOLVERS.items():
        result = pbng.solve(problem, solver, pbng.Budget(iterations=6, every=1))
        curve = found.curves[label]
        tiny = 1e-9 * result.force_scale
        assert found.first == pytest.approx(result.residuals[0])
        np.testing.assert_allclose(curve.residuals[1:], result.residuals[1:], rtol=1e-6, atol=tiny)
        np.testing.assert_allclose(curve.energies[1:], result.energies[1:], rtol=1e-9)
        np.testing.assert_array_equal(curve.x, np.asarray(result.x, float))


def test_errors_are_distances_from_what_newton_certified(found, problem):
    reference = found.reference
    assert (reference.by, reference.certain) == ("Newton", True)
    assert reference.residual < 1e-9 * found.first
    assert reference.distance < 1e-6 * found.size
    for label, curve in found.curves.items():
        assert curve.errors[-1] == pytest.approx(np.linalg.norm(curve.x - reference.x, axis=1).max())
        assert found.gaps(label)[-1] == pytest.approx(
            (curve.energies[-1] - reference.energy) / (found.energy - reference.energy)
        )
    assert found.curves["two-grid"].errors[-1] < found.curves["plain"].errors[-1]
    given = contest(problem, {"plain": SOLVERS["plain"]}, iterations=2, reference=reference.x)
    assert given.reference.by == "given"
    np.testing.assert_allclose(given.curves["plain"].errors, found.curves["plain"].errors[:3])


def test_without_a_reference_there_are_no_errors(problem):
    found = contest(problem, {"plain": SOLVERS["plain"]}, iterations=3, reference=None)
    assert np.isnan(found.curves["plain"].errors).all()
    assert found.gaps("plain")[-1] == 0  # the lowest that was seen
    doubtful = Reference(problem.X, 1.0, 0.0, 0.5, "MultigridPBNG", certain=False)
    found = contest(problem, {"plain": SOLVERS["plain"]}, iterations=3, reference=doubtful)
    assert np.isnan(found.curves["plain"].errors).all()
    assert "none: MultigridPBNG came to 5e-01" in str(doubtful)


def test_rounding_ends_a_run_and_auto_goes_on_in_float64(problem):
    solvers = {d: pbng.PBNG(dtype=d, threads=1) for d in ("float32", "auto")}
    curves = contest(problem, solvers, iterations=2000, rounds=2).curves
    assert all(c.status is Status.PRECISION and c.iterations[-1] < 2000 for c in curves.values())
    assert curves["auto"].ratios[-1] < 1e-4 * curves["float32"].ratios[-1]
    assert (np.diff(curves["auto"].seconds) > 0).all()


def test_a_method_that_diverges_is_reported(problem, clock):
    found = contest(problem, {"bad": Fake(clock, bad_from=3), "good": Fake(clock)}, iterations=9, reference=None)
    bad = found.curves["bad"]
    assert bad.status is Status.DIVERGED
    assert bad.iterations[-1] == 3
    assert found.curves["good"].status is Status.ITERATIONS
    row, _ = found.rows()
    assert (row["status"], row["ratio"], row["s ratio 1e-06"]) == ("DIVERGED", None, None)


def test_the_record_is_json(found):
    record = found.record(seed=3)
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    assert record["seed"] == 3
    assert set(record["versions"]) >= {"pbng", "numpy", "numba"}
    assert record["machine"]["cores"] >= 1
    assert record["reference"]["by"] == "Newton"
    assert [m["method"] for m in record["methods"]] == list(SOLVERS)
    for m in record["methods"]:
        assert m["curve"]["residuals"] == found.curves[m["method"]].residuals.tolist()
        assert m["solver"] == repr(SOLVERS[m["method"]])


def test_a_curve_tells_when_a_level_was_met():
    four = np.arange(1.0, 5.0)
    curve = Curve(
        "a", np.array([0, 1, 5, 9]), four, np.array([8.0, 2.0, 1.0, np.nan]), four, np.array([4.0, 3.0, 2.0, 1.0]),
        np.zeros(4, int), np.zeros((1, 3)), 10.0, Status.ITERATIONS,
    )  # fmt: skip
    assert curve.to_residual(0.2) == (2.0, 1)
    assert curve.to_residual(0.01) is None
    assert curve.to_error(2.5) == (3.0, 5)
    assert curve.ms == pytest.approx(3000 / 9)


def test_a_comparison_is_drawn(found, tmp_path):
    pytest.importorskip("matplotlib")
    assert [p.name for p in found.draw(tmp_path / "new", states=False)] == ["iterations.png", "seconds.png"]
    pytest.importorskip("pyvista")
    bad = replace(found.curves["xpbd"], x=np.full_like(found.curves["xpbd"].x, np.nan), status=Status.DIVERGED)
    wild = replace(found.curves["plain"], x=1e20 * found.curves["plain"].x)
    odd = replace(found, curves={"bad": bad, "wild": wild}, solvers={})
    assert odd.draw(tmp_path)[-1].stat().st_size > 20_000


def test_scattered_vertices_stay_in_the_box(problem):
    x = scattered(problem, 5)
    assert ((x >= problem.X.min(0)) & (x <= problem.X.max(0))).all()
    np.testing.assert_array_equal(x[problem.fixed], problem.X[problem.fixed])
    np.testing.assert_array_equal(x, scattered(problem, 5))
    assert not np.array_equal(x, scattered(problem, 6))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({}, "give iterations or seconds"),
        ({"iterations": 0}, "at least 1, not 0"),
        ({"seconds": -1.0}, "seconds must be positive"),
        ({"iterations": {"other": 3}}, r"iterations for \['a'\]"),
        ({"iterations": 3, "rounds": 0}, "rounds must be at least 1"),
        ({"iterations": 3, "looks": 1}, "looks must be at least 2"),
        ({"iterations": 3, "reference": "exact"}, "not 'exact'"),
        ({"iterations": 3, "reference": np.zeros((2, 3))}, r"not \(2, 3\)"),
        ({"iterations": 3, "start": np.zeros((2, 3))}, "start must have shape"),
        ({"iterations": 3, "at": float("nan")}, "at must be finite"),
    ],
)
def test_bad_input_names_itself(problem, options, said):
    with pytest.raises(pbng.InputError, match=said):
        contest(problem, {"a": SOLVERS["plain"]}, **options)


def test_a_solver_that_cannot_do_the_scene_is_named_with_those_that_can():
    problem = held_box(pbng.StableNeoHookean(E=1e5, nu=0.3))
    with pytest.raises(pbng.InputError, match=r"xpbd cannot do this scene: .*StableNeoHookean.*; plain, newton can"):
        contest(problem, {k: SOLVERS[k] for k in ("plain", "xpbd", "newton")}, iterations=1)
    with pytest.raises(pbng.InputError, match="backward Euler"):
        Start.of(problem.dynamic(0.1))


def test_newton_finds_the_reference_where_two_grids_do_not(problem, monkeypatch):
    from pbng.compare import reference

    monkeypatch.setattr(reference, "CYCLES", 1)
    found = converged(problem, Start.of(problem))
    assert (found.by, found.certain) == ("Newton", True)
    assert np.isnan(found.distance)
    monkeypatch.setattr(reference, "CHEAP", 0)
    assert not converged(problem, Start.of(problem)).certain


def test_an_interrupt_is_not_taken_for_an_answer(problem, monkeypatch):
    from pbng.solvers.multigrid import TwoGrid

    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr(TwoGrid, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        converged(problem, Start.of(problem))


def test_frames_are_the_same_as_those_of_simulate():
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box((1.5, 1.0, 1.0), (6, 4, 4)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.5), pbng.Rotate("x", 0.2), over=0.2)
    problem = scene.compile()
    budget, seen = pbng.Budget(iterations=4), []
    entries = {"plain": (SOLVERS["plain"], budget), "newton": (SOLVERS["newton"], pbng.Budget(rtol=1e-6))}
    curves = contest_frames(
        problem, entries, frames=5, fps=20, keep=(0, -1), monitor=lambda label, k: seen.append((label, k))
    )
    frames = list(pbng.simulate(problem, SOLVERS["plain"], budget, frames=5, fps=20))
    plain, newton = curves.values()
    np.testing.assert_allclose(plain.residuals, [f.result.residual for f in frames], rtol=1e-9)
    np.testing.assert_allclose(plain.ratios, [f.result.reduction for f in frames], rtol=1e-9)
    np.testing.assert_array_equal(plain.positions[4], frames[4].x)
    assert list(plain.positions) == [0, 4]
    assert plain.iterations.tolist() == [0, 4, 4, 4, 4]  # at time 0 it is at rest
    assert (newton.ratios[1:] <= 1e-6).all()
    assert newton.diverged is None
    assert (plain.seconds > 0).all()
    assert seen == [(label, k) for label in entries for k in range(5)]
    with pytest.raises(pbng.InputError, match=r"there are 5 frames; cannot keep \[7\]"):
        contest_frames(problem, entries, frames=5, fps=20, keep=(7,))


def test_frames_with_inertia_and_a_method_that_diverges(clock):
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    problem = replace(problem, f_ext=problem.mass[:, None] * [0.0, -9.8, 0.0])
    budget = pbng.Budget(iterations=3)
    entries = {"bad": (Fake(clock, bad_from=2), budget), "good": (SOLVERS["plain"], budget)}
    bad, good = contest_frames(problem, entries, frames=4, fps=30, inertia=True, substeps=2, keep=range(4)).values()
    assert bad.diverged == 1
    assert bad.statuses[1:] == (Status.DIVERGED,) * 3
    assert np.isnan(bad.residuals[1:]).all()
    assert list(bad.positions) == [0]
    assert np.isfinite(good.residuals).all()
    assert good.iterations[1:].tolist() == [6, 6, 6]


@pytest.fixture
def compare(tmp_path, monkeypatch):
    """Runs ``pbng compare`` in an empty folder; returns its exit code and everything it said, without line breaks."""
    monkeypatch.chdir(tmp_path)

    def command(text):
        result = CliRunner().invoke(app, ["compare", *text.split()])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, " ".join(result.output.split())

    return command


TINY = "twisting_block --resolution 4 --threads 1"


def test_compare_leaves_a_folder(compare, tmp_path):
    code, said = compare(f"{TINY} --iterations 5 --hard --seed 4 --record all/of.json")
    assert code == 0, said
    for words in ("64 vertices", "5 iterations", "pbng", "multigrid", "newton", "xpbd", "reference: equilibrium by"):
        assert words in said
    folder = tmp_path / "comparisons" / "twisting_block"
    assert {p.name for p in folder.iterdir()} == {"iterations.png", "seconds.png", "states.png", "record.json"}
    record = json.loads((folder / "record.json").read_text())
    assert record == json.loads((tmp_path / "all" / "of.json").read_text())
    assert record["seed"] == 4
    assert [m["iterations"] for m in record["methods"]] == [5, 5, 5, 5]
    code, said = compare(f"{TINY} --iterations 1")
    assert code == 1
    assert "comparisons/twisting_block is not empty; --overwrite" in said
    (folder / "mine.txt").write_text("stays")
    code, said = compare(f"{TINY} --iterations 1 --methods plain,anderson:3,1.2 --no-pictures --overwrite")
    assert code == 0, said
    assert [m["method"] for m in json.loads((folder / "record.json").read_text())["methods"]] == [
        "plain",
        "anderson:3,1.2",
    ]
    assert (folder / "mine.txt").exists()
    assert not list((tmp_path / "comparisons").glob(".*"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--methods pbng,newtn", "unknown solver 'newtn'; did you mean newton? known are auto, multigrid, anderson"),
        ("--methods pbgn", "unknown solver 'pbgn'; did you mean pbng?"),
        ("--methods plain,plain", "plain is named twice"),
        ("--methods ,", "name at least one"),
        ("--seconds -1", "seconds must be positive"),
        ("--at nan", "at must be finite"),
    ],
)
def test_compare_refuses_what_it_cannot_use(compare, tmp_path, options, said):
    code, told = compare(f"{TINY} {options} --no-pictures")
    assert code == 1
    assert said in told
    assert not list(tmp_path.iterdir())


def test_compare_says_who_can_do_a_scene(compare, tmp_path):
    scene = "constitutive_models --resolution 4 --iterations 1 --threads 1 --no-pictures"
    code, said = compare(f"{scene} --methods xpbd,plain")
    assert code == 1
    assert "xpbd cannot do this scene: XPBD: StableNeoHookean has no form as constraints" in said
    assert "; plain can" in said
    assert not list(tmp_path.iterdir())
    code, said = compare(scene)
    assert code == 0, said
    assert "left out xpbd" in said


def test_methods_are_the_words_of_run():
    solvers = parse_methods("pbng, anderson:5,1.1,newton,node-sor:1.5", threads=1)
    assert list(solvers) == ["pbng", "anderson:5,1.1", "newton", "node-sor:1.5"]
    assert solvers["pbng"] == pbng.PBNG(threads=1)
    assert solvers["anderson:5,1.1"].acceleration == pbng.Anderson(5, 1.1)
    assert isinstance(solvers["newton"], pbng.Newton)
