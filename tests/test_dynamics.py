"""Backward Euler: free flight, momentum, order of convergence, agreement with quasistatics."""

from dataclasses import replace

import numpy as np
import pytest

import pbng

RUBBER = pbng.Corotated(E=1e4, nu=0.3, density=100)
TIGHT = pbng.Budget(rtol=1e-9, iterations=200)
SOLVERS = [pbng.PBNG(dtype="float64"), pbng.MultigridPBNG(dtype="float64")]


def free_box(gravity=(0.0, -9.8, 0.0)):
    scene = pbng.Scene(gravity=gravity)
    scene.add(pbng.shapes.box(size=(1, 1, 1), vertices=(4, 4, 4)), RUBBER)
    return scene


def beam():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    bar = scene.add(pbng.shapes.beam(length=2.0, width=0.5, vertices=3), RUBBER)
    scene.pin(bar.where(x=0.0))
    return scene


@pytest.mark.parametrize("solver", SOLVERS)
def test_free_fall(solver):
    """v_n = n Δt g and x_n = n (n + 1)/2 Δt² g exactly, without deformation."""
    frames = list(pbng.simulate(free_box(), solver, TIGHT, frames=4, fps=10, inertia=True, substeps=2))
    for frame in frames:
        n, dt = 2 * frame.index, 0.05
        np.testing.assert_allclose(frame.v, np.broadcast_to([0, -9.8 * n * dt, 0], frame.v.shape), atol=1e-7)
        drop = frame.x - frame.problem.X
        np.testing.assert_allclose(drop[:, 1], -9.8 * n * (n + 1) / 2 * dt**2, atol=1e-7)
        assert frame.t == pytest.approx(n * dt)


def test_momentum_is_conserved(rng):
    """A free body that is thrown, spins and wobbles keeps its linear momentum; spin is damped, never gained."""
    scene = free_box(gravity=(0, 0, 0))
    problem = scene.compile(free=True)
    v = np.cross([0, 0, 2.0], problem.X) + [1, 2, 3] + 0.5 * rng.standard_normal(problem.X.shape)
    frames = list(pbng.simulate(problem, SOLVERS[1], TIGHT, frames=8, fps=30, inertia=True, velocity=v))
    for frame in frames[1:]:
        np.testing.assert_allclose(frame.momentum, frames[0].momentum, rtol=1e-8)
        assert frame.kinetic_energy + frame.potential_energy <= frames[0].kinetic_energy
    # about the centre of mass
    spin = [f.angular_momentum - np.cross(f.problem.mass @ f.x / f.problem.mass.sum(), f.momentum) for f in frames]
    assert np.linalg.norm(spin[-1] - spin[0]) < 0.1 * np.linalg.norm(spin[0])


def test_energy_never_rises():
    """Backward Euler dissipates: at each step kinetic and potential energy together fall."""
    frames = list(pbng.simulate(beam(), SOLVERS[0], TIGHT, frames=12, fps=60, inertia=True))
    total = [f.kinetic_energy + f.potential_energy for f in frames]
    assert (np.diff(total) <= 1e-9 * np.abs(total).max()).all()
    assert frames[3].kinetic_energy > 0


def test_first_order_in_the_time_step():
    """Halving Δt halves the error."""

    def at_the_end(substeps):
        *_, last = pbng.simulate(beam(), SOLVERS[1], TIGHT, frames=2, fps=10, inertia=True, substeps=substeps)
        return last.x

    exact = 2 * at_the_end(256) - at_the_end(128)
    errors = [np.linalg.norm(at_the_end(n) - exact) for n in (8, 16, 32)]
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (np.abs(rates - 1) < 0.2).all()


def test_comes_to_rest_at_the_equilibrium():
    """Large steps damp: what is left is the quasistatic state."""
    *_, last = pbng.simulate(beam(), SOLVERS[1], TIGHT, frames=40, fps=2, inertia=True)
    x = pbng.solve(beam(), SOLVERS[1], TIGHT).x
    np.testing.assert_allclose(last.x, x, atol=1e-6)


def test_prescribed_vertices_move_as_told():
    scene = beam()
    frames = list(pbng.simulate(scene, frames=4, fps=30, inertia=True, dt=0.01))
    held = frames[0].problem.fixed
    assert all((f.x[held] == f.problem.X[held]).all() for f in frames)
    moving = pbng.Scene()
    body = moving.add(pbng.shapes.box(size=(1, 1, 1), vertices=(3, 3, 3)), RUBBER)
    moving.move(body.where(x=0.0), pbng.Translate((0, 3.0, 0)), over=1.0)
    *_, last = pbng.simulate(moving, SOLVERS[0], TIGHT, frames=6, fps=10, inertia=True, substeps=3)
    np.testing.assert_allclose(last.v[body.where(x=0.0).index], [[0, 3, 0]] * 9, atol=1e-9)


def test_weak_constraints_hold_in_motion():
    """A body hung on springs to points that move follows them."""
    scene = free_box(gravity=(0, 0, 0))
    body = scene.bodies[0]
    scene.bind(body.where(y=1.0), pbng.Translate((1, 0, 0)), k=1e6, over=0.5)
    *_, last = pbng.simulate(scene, SOLVERS[1], TIGHT, frames=6, fps=10, inertia=True, substeps=2)
    top = body.where(y=1.0).index
    np.testing.assert_allclose(last.x[top, 0], last.problem.X[top, 0] + 1, atol=1e-2)


@pytest.mark.parametrize("solver", [pbng.PBNG(), pbng.MultigridPBNG()])
def test_cycles_with_inertia(solver):
    """Inertia makes a step easier than an equilibrium: few iterations, and the same bits for 1 and 2 threads."""
    ends = [
        list(
            pbng.simulate(
                beam(), replace(solver, threads=threads), pbng.Budget(rtol=1e-4), frames=3, fps=30, inertia=True
            )
        )
        for threads in (1, 2)
    ]
    assert (ends[0][-1].x == ends[1][-1].x).all()
    assert all(f.result.status is pbng.Status.CONVERGED for f in ends[0][1:])
    assert max(f.result.iterations for f in ends[0][1:]) <= (60 if isinstance(solver, pbng.PBNG) else 10)


@pytest.mark.parametrize(
    ("given", "word"),
    [
        ({"dt": 0.0}, "dt must be positive and finite, not 0"),
        ({"dt": -1.0}, "dt must be positive"),
        ({"dt": np.inf}, "dt must be positive"),
        ({"substeps": 0}, "substeps must be a whole number of at least 1, not 0"),
        ({"substeps": 1.5}, "substeps must be a whole number"),
        ({"dt": 0.1, "substeps": 2}, "dt or substeps, not both"),
        ({"velocity": (1, 2)}, r"velocity must have shape \(3,\)"),
        ({"velocity": (0, np.nan, 0)}, "velocity is not finite"),
        ({"inertia": False, "dt": 0.1}, "are for inertia=True"),
    ],
)
def test_bad_arguments_are_named(given, word):
    with pytest.raises(pbng.InputError, match=word):
        pbng.simulate(beam(), frames=2, **{"inertia": True, **given})


def test_massless_bodies_are_refused():
    scene = pbng.Scene()
    scene.add(pbng.shapes.box(size=(1, 1, 1), vertices=(2, 2, 2)), pbng.Corotated(E=1e3, nu=0.3, density=0.0))
    with pytest.raises(pbng.InputError, match="vertex 0 has no mass"):
        pbng.simulate(scene, frames=2, inertia=True)


def test_free_bodies_need_inertia():
    with pytest.raises(pbng.InputError, match="no vertex is pinned"):
        pbng.simulate(free_box(), frames=2)


@pytest.mark.parametrize("solver", [*SOLVERS, pbng.Newton()])
def test_bodies_bound_by_stiff_springs_move_together(solver):
    """Compound nodes carry mass too: every method takes the same steps, and the springs stay shut."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    box = pbng.shapes.box(size=(1, 1, 1), vertices=(4, 4, 4))
    upper, lower = scene.add(box, RUBBER, at=(0, 1, 0)), scene.add(box, RUBBER, at=(0.1, 0, 0.1))
    scene.pin(upper.where(y=2.0))
    scene.bind(lower.where(y=1.0), upper, k=1e8)
    budget = pbng.Budget(atol=1e-5, iterations=600)
    *_, last = pbng.simulate(scene, solver, budget, frames=4, fps=20, inertia=True)
    assert last.result.status is pbng.Status.CONVERGED
    assert np.linalg.norm(last.springs[:, 0] - last.springs[:, 1], axis=1).max() < 1e-4  # 0.1 at rest, at two edges
    *_, judge = pbng.simulate(scene, pbng.Newton(), budget, frames=4, fps=20, inertia=True)
    np.testing.assert_allclose(last.x, judge.x, atol=1e-6)
