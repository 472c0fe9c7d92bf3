"""Budgets, statuses, results; the drivers ``solve`` and ``simulate``."""

import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import hard_start, held_box, twisted_bar

import pbng
from pbng.problem import ElementGroup
from pbng.solvers.base import ITERATION_CAP
from pbng.solvers.loop import run

DOUBLE = pbng.PBNG(dtype="float64")
PLAIN = pbng.PBNG(acceleration=None, dtype="float64")


@pytest.fixture(scope="module")
def bar():
    return twisted_bar().compile()


def start_of(problem):
    return problem.constrain(problem.X, problem.end)


def test_converges_to_an_equilibrium(bar):
    """The residual of the state itself, evaluated anew, is what the result says; nothing is inverted."""
    result = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-8))
    assert result.status is pbng.Status.CONVERGED
    assert result.status.ok
    assert result.reduction <= 1e-8
    assert bar.residual(result.x) == pytest.approx(result.residual, rel=1e-6)
    assert bar.energy(result.x) == pytest.approx(result.energy, rel=1e-12)
    np.testing.assert_array_equal(result.x[bar.fixed], bar.prescribed(bar.end))
    assert result.inverted == bar.inverted(result.x) == 0


def test_residual_ratio_is_to_the_first(bar):
    """residuals[0] is that of the start with prescribed vertices in place; rtol is the ratio to it (Conventions)."""
    x = start_of(bar)
    result = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-2, every=1))
    assert result.residuals[0] == pytest.approx(bar.residual(x), rel=1e-12)
    assert result.energies[0] == pytest.approx(bar.energy(x), rel=1e-12)
    assert result.residuals[-1] <= 1e-2 * result.residuals[0]
    assert (result.residuals[:-1] > 1e-2 * result.residuals[0]).all()
    assert result.reduction == result.residuals[-1] / result.residuals[0]


def test_force_scale_is_the_sum_of_element_forces(bar):
    """The second ratio's denominator: Σ |(f_0, ..., f_3)| over elements, in float64."""
    result = pbng.solve(bar, DOUBLE, pbng.Budget(iterations=5))
    (group,) = bar.groups
    total = 0.0
    for cell in group.cells:
        x = bar.X.copy()
        x[cell] = result.x[cell]
        only = ElementGroup(group.kind, group.material, cell[None])
        single = pbng.Problem("one", bar.X, (only,), bar.bodies, bar.fixed, bar.prescribed, 0 * bar.f_ext, bar.mass)
        total += np.linalg.norm(single.forces(x))
    assert result.force_scale == pytest.approx(total, rel=1e-12)
    assert result.relative_residual == pytest.approx(result.residual / total)


def test_iterations_are_counted_and_monitored(bar):
    """Exactly as many as asked; the residual every ``every`` and at the end; 0 iterations report the start."""
    result = pbng.solve(bar, PLAIN, pbng.Budget(iterations=25, every=10))
    assert result.status is pbng.Status.ITERATIONS
    assert result.iterations == 25
    np.testing.assert_array_equal(result.monitored, [0, 10, 20, 25])
    assert len(result.residuals) == len(result.energies) == 4
    for solver in (PLAIN, pbng.MultigridPBNG()):  # which would else begin at a state of its own
        none = pbng.solve(bar, solver, pbng.Budget(iterations=0))
        assert none.status is pbng.Status.ITERATIONS
        assert none.iterations == 0
        assert none.correction == 0
        np.testing.assert_array_equal(none.x, start_of(bar).astype(none.x.dtype))


def test_iterations_do_not_depend_on_monitoring(bar):
    states = [pbng.solve(bar, DOUBLE, pbng.Budget(iterations=12, every=k)).x for k in (1, 5, 100)]
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(states[0], states[2])


def test_atol(bar):
    """An absolute tolerance [N] stops where the residual is below it, the larger of both tolerances counts."""
    result = pbng.solve(bar, DOUBLE, pbng.Budget(atol=10.0, every=1))
    assert result.status is pbng.Status.CONVERGED
    assert result.residuals[-1] <= 10.0 < result.residuals[-2]
    both = pbng.solve(bar, DOUBLE, pbng.Budget(atol=10.0, rtol=1e-12, every=1))
    assert both.iterations == result.iterations


def test_seconds(bar):
    """Time is up after the first iteration that ends later; what was computed is kept."""
    result = pbng.solve(bar, PLAIN, pbng.Budget(seconds=0.02, every=1000))
    assert result.status is pbng.Status.SECONDS
    assert 0.02 <= result.seconds < 2.0
    assert result.iterations >= 1
    assert result.monitored[-1] == result.iterations
    assert result.energies[-1] < result.energies[0]
    none = pbng.solve(bar, PLAIN, pbng.Budget(seconds=0.0))
    assert none.status is pbng.Status.SECONDS
    assert none.iterations == 0


def test_tolerance_met_at_the_end_of_the_budget_counts(bar):
    """A state that meets the tolerance is converged even where the budget ran out first."""
    enough = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-2, every=1)).iterations
    result = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-2, iterations=enough, every=1000))
    assert result.status is pbng.Status.CONVERGED


def test_default_budget(bar):
    """``Budget()`` is rtol = 1e-3, and the defaults of ``solve`` are PBNG() with it; a cap stands behind tolerances."""
    assert pbng.Budget() == pbng.Budget(rtol=1e-3)
    assert pbng.Budget().cap == ITERATION_CAP
    assert pbng.Budget(iterations=7).rtol is None
    result = pbng.solve(bar)
    assert result.status is pbng.Status.CONVERGED
    assert 1e-6 < result.reduction <= 1e-3
    assert result.x.dtype == np.float32


@pytest.mark.parametrize(
    ("limits", "word"),
    [
        ({"iterations": -1}, "iterations must be finite and at least 0, not -1"),
        ({"iterations": 2.5}, r"iterations must be a whole number, not 2\.5"),
        ({"seconds": np.inf}, "seconds must be finite and at least 0, not inf"),
        ({"rtol": -1e-3}, r"rtol must be finite and at least 0, not -0\.001"),
        ({"rtol": np.nan}, "rtol must be finite"),
        ({"atol": np.nan}, "atol must be finite"),
        ({"every": 0}, "every must be finite and at least 1, not 0"),
    ],
)
def test_bad_budgets_are_named(limits, word):
    with pytest.raises(pbng.InputError, match=f"Budget: {word}"):
        pbng.Budget(**limits)


def test_float32_ends_at_its_floor(bar):
    """Asked for more than float32 can give, the solve says so instead of going on; float64 and "auto" get there."""
    budget = pbng.Budget(rtol=1e-12, iterations=2000)
    result = pbng.solve(bar, pbng.PBNG(dtype="float32"), budget)
    assert result.status is pbng.Status.PRECISION
    assert result.status.ok
    assert result.iterations < 1000
    assert result.reduction < 1e-4
    for solver in (DOUBLE, pbng.PBNG()):
        assert pbng.solve(bar, solver, budget).status is pbng.Status.CONVERGED


def test_float32_and_float64_agree(bar):
    """Both precisions reach the same equilibrium; residuals are float64 in both."""
    single = pbng.solve(bar, pbng.PBNG(dtype="float32"), pbng.Budget(rtol=1e-4))
    double = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-8))
    assert np.abs(single.x - double.x).max() < 1e-3
    assert single.residuals.dtype == np.float64
    assert bar.residual(single.x) == pytest.approx(single.residual, rel=1e-3)


def test_divergence_is_reported():
    """A method that blows up ends with DIVERGED, not with an exception or NaN called a result."""
    problem = held_box(pbng.NeoHookean(E=1e5, nu=0.3))
    solver = pbng.PBNG(pbng.NodeSOR(1.95), block="paper", dtype="float64")
    result = pbng.solve(problem, solver, pbng.Budget(iterations=500), start=hard_start(problem, "scrambled"))
    assert result.status is pbng.Status.DIVERGED
    assert not result.status.ok
    assert result.iterations < 500


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_interrupt_keeps_the_state(bar, dtype):
    """Ctrl-C (here from a monitor) ends the solve with the last state and its certificate."""
    seen = []

    def monitor(progress):
        seen.append(progress)
        if progress.iteration == 6:
            raise KeyboardInterrupt

    solver = pbng.PBNG(dtype=dtype)
    result = pbng.solve(bar, solver, pbng.Budget(rtol=1e-9, every=2), monitor=monitor)
    assert result.status is pbng.Status.INTERRUPTED
    assert not result.status.ok
    assert result.iterations == 6
    np.testing.assert_array_equal(result.monitored, [0, 2, 4, 6])
    whole = pbng.solve(bar, solver, pbng.Budget(iterations=6, every=2))
    np.testing.assert_array_equal(result.x, whole.x)
    assert result.residual == whole.residual


@pytest.mark.parametrize("acceleration", [pbng.Anderson, None])
@pytest.mark.parametrize("swept", [False, True])
def test_interrupt_within_a_step_keeps_the_state(bar, acceleration, swept):
    """Ctrl-C before or after the sweep of a step: the state is finite, and its certificate is its own."""
    method = pbng.PBNG(acceleration, dtype="float64").set_up(bar)
    step, count = method.step, itertools.count()

    def interrupted():
        last = next(count) == 3
        if swept or not last:
            step()
        if last:
            raise KeyboardInterrupt

    method.step = interrupted
    result = run(method, start_of(bar), pbng.Budget(rtol=1e-9, every=1))
    assert result.status is pbng.Status.INTERRUPTED
    assert result.iterations == 3
    assert result.residual == pytest.approx(bar.residual(result.x), rel=1e-9)
    np.testing.assert_array_equal(result.monitored, [0, 1, 2, 3])


def test_monitor_is_told_what_the_result_says(bar):
    seen = []
    result = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-4, every=5), monitor=seen.append)
    np.testing.assert_array_equal([p.iteration for p in seen], result.monitored[1:])
    np.testing.assert_array_equal([p.residual for p in seen], result.residuals[1:])
    np.testing.assert_array_equal([p.energy for p in seen], result.energies[1:])
    assert {p.first for p in seen} == {result.residuals[0]}
    assert {p.tolerance for p in seen} == {1e-4 * result.residuals[0]}
    assert all(a.seconds <= b.seconds for a, b in itertools.pairwise(seen))


def test_rest_converges_at_once():
    """Nothing to do is done in no iteration, whatever the tolerance."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    result = pbng.solve(problem, DOUBLE, pbng.Budget(atol=1e-9))
    assert result.status is pbng.Status.CONVERGED
    assert result.iterations == 0
    np.testing.assert_array_equal(result.x, problem.X)


@pytest.mark.parametrize(("dtype", "status"), [("float32", pbng.Status.PRECISION), ("float64", pbng.Status.CONVERGED)])
def test_rest_ends_at_once_with_the_default_budget(dtype, status):
    """At rest the first residual is rounding; a ratio to it cannot be met, and is not asked for."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    result = pbng.solve(problem, pbng.PBNG(dtype=dtype))
    assert result.status is status
    assert result.iterations == 0


def test_a_load_below_the_rounding_of_float32_is_not_called_converged():
    """Where float32 cannot tell the state from equilibrium it says so; float64, and "auto" in it, solves it."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box(vertices=3), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    scene.force(body.where(x=1.0), (1e-7, 0, 0))
    for single in (pbng.PBNG(dtype="float32"), pbng.MultigridPBNG(dtype="float32")):
        assert pbng.solve(scene, single).status is pbng.Status.PRECISION
    for exact in (pbng.solve(scene), pbng.solve(scene, DOUBLE)):
        assert exact.status is pbng.Status.CONVERGED
        assert exact.reduction <= 1e-3


def test_far_from_the_origin():
    """A scene is as accurate a kilometre away: positions are kept relative to its middle."""
    found = []
    for away in (0.0, 1000.0):
        scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
        body = scene.add(pbng.shapes.box(vertices=4), pbng.Corotated(E=1e4, nu=0.3), at=(away, 0, 0))
        scene.pin(body.where(x=away))
        found.append(pbng.solve(scene).x - (away, 0, 0))
    np.testing.assert_allclose(found[1], found[0], atol=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_units_do_not_matter(dtype):
    """Steel in metres or tissue in micrometres: the same iterations and the same shape, in both precisions."""
    found = []
    for E, size in ((1e5, 1.0), (2e11, 100.0), (1e3, 1e-6), (1.0, 1e-9)):
        scene = pbng.Scene()
        body = scene.add(pbng.shapes.box((1.5 * size, size, size), (6, 4, 4)), pbng.Corotated(E=E, nu=0.3))
        scene.pin(body.where(x=0.0))
        scene.move(body.where(x=1.5 * size), pbng.Rotate("x", 0.25) + pbng.Translate((0.2 * size, 0, 0)))
        result = pbng.solve(scene, pbng.PBNG(dtype=dtype), pbng.Budget(rtol=1e-3, every=1))
        assert result.status is pbng.Status.CONVERGED
        found.append((result.iterations, result.x / size))
    assert len({n for n, _ in found}) == 1
    for _, x in found:
        np.testing.assert_allclose(x, found[0][1], atol=1e-5 if dtype == "float32" else 1e-12)


def test_single_free_node():
    """One free vertex: for Neo-Hookean one sweep is the exact minimum, as the energy it sees is quadratic."""
    mesh = pbng.shapes.box((1.0, 1.0, 1.0), 3)
    scene = pbng.Scene(gravity=(0, -500.0, 0))
    body = scene.add(mesh, pbng.NeoHookean(E=1e5, nu=0.3))
    scene.pin(body.where(np.flatnonzero((mesh.X != 0.5).any(1))))
    problem = scene.compile()
    assert (~problem.fixed).sum() == 1
    result = pbng.solve(problem, PLAIN, pbng.Budget(iterations=1))
    assert result.reduction < 1e-12
    assert result.x[13, 1] < 0.5
    assert pbng.solve(problem, DOUBLE, pbng.Budget(rtol=1e-10)).status is pbng.Status.CONVERGED


def test_no_free_node():
    """Everything prescribed: nothing to solve, converged at once."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box(vertices=3), pbng.Corotated(E=1e5, nu=0.3))
    scene.move(body.where(), pbng.Translate((1.0, 0, 0)))
    result = pbng.solve(scene, DOUBLE)
    assert result.status is pbng.Status.CONVERGED
    assert result.iterations == 0
    np.testing.assert_allclose(result.x, body.mesh.X + np.array([1.0, 0, 0]))


def test_start_is_used_and_constrained(bar):
    """``start`` is where the iteration begins; prescribed vertices go where they belong; it is not written to."""
    x = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-6)).x
    moved = x.copy()
    moved[bar.fixed] += 5.0
    kept = moved.copy()
    again = pbng.solve(bar, DOUBLE, pbng.Budget(iterations=0), start=moved)
    np.testing.assert_array_equal(again.x, x)
    np.testing.assert_array_equal(moved, kept)


@pytest.mark.parametrize(
    ("start", "word"),
    [
        (np.zeros((3, 3)), r"start must have shape \(96, 3\), not \(3, 3\)"),
        (np.full((96, 3), np.nan), "start is not finite at vertex 0"),
    ],
)
def test_bad_starts_are_named(bar, start, word):
    with pytest.raises(pbng.InputError, match=word):
        pbng.solve(bar, DOUBLE, start=start)


def test_at_takes_motions_at_a_time():
    """``at`` poses the prescribed vertices at a time; by default every motion has ended."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.5, 1.0, 1.0), (6, 4, 4)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    right = body.where(x=1.5)
    scene.move(right, pbng.Translate((0.4, 0, 0)), over=2.0)
    for at, moved in ((0.0, 0.0), (1.0, 0.2), (None, 0.4)):
        result = pbng.solve(scene, DOUBLE, pbng.Budget(iterations=3), at=at)
        np.testing.assert_allclose(result.x[right.index, 0], 1.5 + moved)


def test_scene_and_problem_give_the_same():
    scene = twisted_bar()
    budget = pbng.Budget(iterations=8)
    np.testing.assert_array_equal(pbng.solve(scene, DOUBLE, budget).x, pbng.solve(scene.compile(), DOUBLE, budget).x)


def test_method_is_reused(bar):
    """A method set up once serves any number of starts, and forgets the history of the one before."""
    method = DOUBLE.set_up(bar)
    first = run(method, start_of(bar), pbng.Budget(iterations=15))
    run(method, bar.constrain(bar.X * [1, 0.5, 1], bar.end), pbng.Budget(iterations=7))
    np.testing.assert_array_equal(run(method, start_of(bar), pbng.Budget(iterations=15)).x, first.x)


def test_result_fields(bar):
    """Times, the last correction and the rest of the certificate."""
    result = pbng.solve(bar, PLAIN, pbng.Budget(iterations=7, every=7))
    before = pbng.solve(bar, PLAIN, pbng.Budget(iterations=6))
    assert result.correction == pytest.approx(np.linalg.norm(result.x - before.x, axis=1).max(), rel=1e-9)
    assert result.seconds > 0
    assert result.setup_seconds > 0
    assert 0 < result.monitor_seconds < result.seconds
    assert result.seconds_per_iteration == (result.seconds - result.monitor_seconds) / 7
    assert str(result.status) == "The iterations of the budget were used up."
    assert [s.value for s in pbng.Status if not s.value.endswith(".")] == []


def moving_bar():
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.5, 1.0, 1.0), (6, 4, 4)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    scene.move(body.where(x=1.5), pbng.Rotate("x", 0.2), over=0.1)
    return scene


def test_simulate_yields_frames():
    """Frame k at time k / fps, prescribed vertices where they belong then, each converged."""
    scene = moving_bar()
    problem = scene.compile()
    frames = list(pbng.simulate(scene, DOUBLE, pbng.Budget(rtol=1e-3, atol=1e-6), frames=4, fps=30))
    assert [f.index for f in frames] == [0, 1, 2, 3]
    np.testing.assert_allclose([f.t for f in frames], [0, 1 / 30, 2 / 30, 0.1])
    for frame in frames:
        np.testing.assert_allclose(frame.x[problem.fixed], problem.prescribed(frame.t))
        assert frame.result.status is pbng.Status.CONVERGED
        assert frame.problem.n_vert == problem.n_vert
    np.testing.assert_array_equal(frames[0].x, problem.X)
    assert frames[0].result.setup_seconds > 0
    assert frames[1].result.setup_seconds == 0


def test_frames_start_from_the_one_before():
    """Warm starts: a frame's first residual is the last one of the frame before, where nothing moved in between."""
    budget = pbng.Budget(iterations=30)
    frames = list(pbng.simulate(moving_bar(), DOUBLE, budget, frames=6, fps=30))
    assert frames[4].result.residuals[0] == pytest.approx(frames[3].result.residual, rel=1e-9)
    assert frames[5].result.residual < frames[4].result.residual < frames[3].result.residual
    cold = pbng.solve(moving_bar(), DOUBLE, budget, at=0.1)
    assert frames[3].result.residuals[0] < 0.7 * cold.residuals[0]


def test_simulate_is_lazy_and_checks_at_once():
    """Frames are computed as they are asked for; what is wrong with the call is said when it is made."""
    frames = pbng.simulate(moving_bar(), DOUBLE, frames=10**9)
    assert next(frames).index == 0
    for wrong in ({"frames": 0}, {"frames": 3, "fps": 0.0}):
        with pytest.raises(pbng.InputError, match="frames must be at least 1 and fps positive"):
            pbng.simulate(moving_bar(), DOUBLE, **wrong)


def test_interrupted_frames_are_not_handed_over():
    """Ctrl-C within frame 2: frames 0 and 1 were yielded, then KeyboardInterrupt."""
    done = []

    def monitor(progress):
        if len(done) == 2:
            raise KeyboardInterrupt

    def collect():
        for frame in pbng.simulate(moving_bar(), DOUBLE, pbng.Budget(iterations=20), frames=5, monitor=monitor):
            done.append(frame.index)

    with pytest.raises(KeyboardInterrupt):
        collect()
    assert done == [0, 1]


def test_public_functions_are_not_shadowed_by_modules():
    """``pbng.solve`` first, ``pbng.simulate`` then: both are functions."""
    script = "import pbng; pbng.solve; assert callable(pbng.simulate), pbng.simulate"
    env = {**os.environ, "PYTHONPATH": str(Path(pbng.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", script], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
