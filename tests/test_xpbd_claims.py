"""What the paper says of PBD and XPBD, and what holds of their steps: gravity, order, backward Euler."""

from dataclasses import replace

import numpy as np
import pytest
from oracle import deformation, shape_gradients
from test_xpbd import SOFT, bound_bodies, pair, run

import pbng
from pbng.constraints import WeakConstraints
from pbng.drivers import solve


def sag(problem, x):
    """How far the free end of a bar held at x = 0 has come down [m]."""
    tip = problem.X[:, 0] == problem.X[:, 0].max()
    return float((problem.X[tip, 1] - x[tip, 1]).mean())


@pytest.fixture(scope="module")
def bar():
    """Section 11.4, small, with the sag of its equilibrium."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = scene.add(pbng.shapes.box((1.0, 0.25, 0.25), (9, 3, 3)), SOFT)
    scene.pin(body.where(x=0.0))
    problem = scene.compile()
    result = solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-8, iterations=2000))
    assert result.status is pbng.Status.CONVERGED
    return problem, sag(problem, result.x)


def test_pbd_loses_gravity(bar):
    """Fig. 18: in one step and at rest after many, PBD's sag goes to zero as its iterations grow; PBNG's is 0.8 m."""
    problem, true = bar
    assert 0.6 < true < 0.9
    once = [sag(problem, run(problem, pbng.PBD(dt=1 / 30, dtype="float64"), n)) for n in (1, 100, 1000, 10000)]
    assert once[3] < once[2] < once[1]
    assert once[3] < 0.1 * once[0] < 0.01 * true
    steady = [sag(problem, run(problem, pbng.PBD(dt=0.02, iterations=k), 60 * k)) for k in (1, 10, 100)]
    assert steady[1] < 0.8 * steady[0]
    assert steady[2] < 0.5 * steady[1]


def test_xpbd_qs_tends_to_pbng(bar):
    """Fig. 18: the error of the sag falls with more iterations a pseudo-time step, and with shorter ones."""
    problem, true = bar

    def error(dt, iterations, steps) -> float:
        return abs(sag(problem, run(problem, pbng.XPBD(dt=dt, iterations=iterations), iterations * steps)) - true)

    assert error(0.04, 10, 100) < 0.5 * error(0.04, 1, 100)
    errors = [error(dt, 1, round(8 / dt)) for dt in (0.02, 0.01, 0.005)]
    assert errors[1] < 0.6 * errors[0]
    assert errors[2] < 0.6 * errors[1]
    assert errors[2] < 0.03 * true


@pytest.mark.parametrize("damping", ["kinetic", 0.05])
def test_damping_changes_the_way_not_the_end(bar, damping):
    problem, _ = bar
    x = run(problem, pbng.XPBD(dt=0.01, iterations=1, damping=damping, dtype="float64"), 12000)
    again = run(problem, pbng.XPBD(dt=0.01, iterations=1, damping=0.2, dtype="float64"), 5000)
    assert np.abs(x - again).max() < 1e-4


@pytest.mark.parametrize("material", [pbng.Corotated, pbng.NeoHookean])
def test_default_step(material):
    """It follows the material's own time: the same shape for any stiffness, near the equilibrium's."""
    shapes = []
    for factor in (1.0, 1e4):
        scene = pbng.Scene(gravity=(0, -9.8 * factor, 0))
        body = scene.add(pbng.shapes.box((1.0, 0.25, 0.25), (9, 3, 3)), material(E=2e3 * factor, nu=0.3, density=10.0))
        scene.pin(body.where(x=0.0))
        problem = scene.compile()
        shapes.append(run(problem, pbng.XPBD(dtype="float64"), 2000))
    np.testing.assert_allclose(shapes[1], shapes[0], atol=1e-6)
    true = run(problem, pbng.PBNG(dtype="float64"), 300)
    assert problem.residual(true) < 1e-4 * problem.residual(problem.X)
    assert np.abs(shapes[1] - true).max() < 0.09 * sag(problem, true)


def two_blocks():
    """Section 11.3, small: a block hangs on another by springs of 1e8 N/m, whose ends coincide at rest."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    upper = scene.add(pbng.shapes.box((0.5, 0.5, 0.5), 4), SOFT)
    lower = scene.add(pbng.shapes.box((0.5, 0.5, 0.5), 4), SOFT, at=(0, -0.5, 0))
    scene.pin(upper.where(y=0.5))
    problem = scene.compile()
    ends = np.column_stack([upper.where(y=0.0).index, lower.where(y=0.0).index]).astype(np.int32)
    m = len(ends)
    springs = WeakConstraints(ends, np.tile([1.0, -1.0], (m, 1)), np.tile(1e8 * np.eye(3), (m, 1, 1)))
    return replace(problem, weak=(springs,)), ends


def test_two_blocks_depend_on_the_order_of_constraints():
    """Fig. 17: elastic first, the lower block's top layer is stretched; weak first, a gap opens. PBNG has neither."""
    problem, ends = two_blocks()
    height = problem.X[:, 1] - 1e-9

    def look(x):
        lower = np.arange(problem.n_vert) >= problem.bodies[1].start
        top, second = lower & (height > -0.1), lower & (height > -0.2) & (height < -0.1)
        layer = (x[top, 1].mean() - x[second, 1].mean()) / (0.5 / 3)
        return float(np.linalg.norm(x[ends[:, 0]] - x[ends[:, 1]], axis=1).max()), layer

    gap, layer = look(solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-6, iterations=1000)).x)
    assert gap < 1e-6
    assert layer < 1.08
    found = {
        order: look(run(problem, pbng.XPBD(dt=1 / 30, order=order, dtype="float64"), 1000))
        for order in ("elastic first", "weak first")
    }
    gap, layer = found["elastic first"]
    assert gap < 1e-6
    assert layer > 1.3
    gap, layer = found["weak first"]
    assert gap > 0.05
    assert layer < 1.1
    ten = pbng.XPBD(dt=1 / 30, iterations=10, order="weak first", dtype="float64")
    assert look(run(problem, ten, 3000))[0] < 0.3 * gap


def test_backward_euler_stagnates():
    """Section 11.7: λ reaches C + α̃λ = 0 (23), yet not the residual of (20), which PBNG's sweeps do reach."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = scene.add(pbng.shapes.box((1.0, 0.5, 0.5), (5, 3, 3)), SOFT)
    scene.pin(body.where(x=0.0))
    static = scene.compile()
    problem = static.dynamic(1 / 30)
    flown = static.X * [1.2, 1.0, 0.9] + [0.0, -0.1, 0.05]  # where inertia alone would take the vertices
    targets, x = flown[~problem.fixed], static.X
    residuals = {}
    for name, solver in {"XPBD": pbng.XPBD(dtype="float64"), "PBNG": pbng.PBNG(dtype="float64")}.items():
        method = solver.set_up(problem)
        method.start(x, targets)
        for _ in range(400):
            method.step()
        residuals[name] = method.certify().residual / problem.residual(x, targets)
        if name == "XPBD":
            after = method.state()
            form = SOFT.constraints()
            G, V = shape_gradients(problem.X[problem.groups[0].cells])
            F = deformation(after[problem.groups[0].cells], G)
            C = np.array([[c for c, *_ in pair(SOFT, f)] for f in F])
            goal = -np.sort((np.array(form.stiffness) * V[:, None] * problem.dt**2 * C).ravel())[::-1]
            blocks = method.elastic.multipliers
            found = np.unique(blocks[blocks != 0])
            np.testing.assert_allclose(found, np.unique(goal), rtol=0, atol=1e-9 * np.abs(goal).max())
    assert residuals["PBNG"] < 1e-9
    assert 1e-4 < residuals["XPBD"] < 0.5


def test_dynamic_step_begins_at_the_prediction():
    """The first iteration starts from x̂ + Δt² f_ext/m, whatever x is handed over; inertia is no constraint."""
    problem = bound_bodies(plane=False)
    problem = replace(problem, groups=problem.groups, weak=problem.weak[:2]).dynamic(0.01)
    free = ~problem.fixed
    targets = problem.X[free] + 0.01
    states = []
    for x in (problem.X, problem.X * [1.0, 1.1, 1.0]):
        method = pbng.XPBD(dt=1.0, dtype="float64").set_up(problem)
        assert method.dt == 0.01
        method.start(problem.constrain(x, 0.0), targets)
        np.testing.assert_array_equal(method.state()[free], x[free])
        method.step()
        states.append(method.state())
    np.testing.assert_array_equal(states[0], states[1])


# Robustness and the edges.
