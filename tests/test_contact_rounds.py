"""Equilibria with contact, found in rounds: what each begins with, and that the result tells of all of them."""

from dataclasses import replace

import numpy as np
import pytest
from test_contact import SOFT, energy_of

import pbng
from pbng.contact.detection import Detector
from pbng.equilibrium import Equilibria

FLESH = pbng.Corotated(E=1e4, nu=0.3, density=100.0)


def pressed(n=4, down=0.15, k_tau=0.0, over=0.25, along=0.0):
    """A block upon a larger one, whose top is moved down and then, perhaps, aside."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    lower = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), n, origin=(-0.5, 0, -0.5)), FLESH, name="lower")
    upper = scene.add(pbng.shapes.box((0.7, 0.7, 0.7), n, origin=(-0.35, 1.001, -0.35)), FLESH, name="upper")
    scene.pin(lower.where(y=0.0))
    scene.move(upper.where(y=1.701), pbng.Translate((0, -down, 0)), over=over)
    if along:
        scene.move(upper.where(y=1.701), pbng.Translate((along, 0, 0)), over=over, start=over)
    scene.contact(k_tau=k_tau)
    return scene, upper


def test_what_is_far_from_a_collider_is_left_alone_in_every_round(monkeypatch):
    seen, find = [], Detector.find

    def spy(*args, **options):
        contacts = find(*args, **options)
        seen.append(len(contacts.vertex))
        return contacts

    monkeypatch.setattr(Detector, "find", spy)
    for at, touches in ((100.0, False), (0.5, True)):
        scene = pbng.Scene(gravity=(0, -9.8, 0))
        block = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), FLESH, name="block")
        scene.pin(block.where(y=1.0))
        scene.collide_with(pbng.Sphere((at, -1.01, 0.5), 1.0))
        seen.clear()
        assert pbng.solve(scene, pbng.PBNG(), pbng.Budget(rtol=1e-3)).status is pbng.Status.CONVERGED
        assert len(seen) > 1
        assert (np.array(seen) > 0).all() == touches
        assert touches or not any(seen)


@pytest.mark.parametrize("solver", [pbng.PBNG(dtype="float64"), pbng.MultigridPBNG(dtype="float64")])
def test_the_certificate_without_iterations_is_that_of_the_state(solver):
    """Blocks overlap, and what is held has moved far: a solve would begin elsewhere."""
    problem = pressed(down=-0.15)[0].compile()
    start, free = problem.X.copy(), ~problem.fixed
    start[problem.bodies[1].start :, 1] -= 0.02
    equilibria = Equilibria(problem, solver, start)
    result, report = equilibria.at(0.25, pbng.Budget(iterations=0), None)
    assert result.iterations == 0
    assert report.pairs > 10
    np.testing.assert_allclose(result.x[free], start[free], rtol=1e-15)
    energy = energy_of(equilibria.toucher.contacts, problem)
    f = problem.evaluate(result.x, problem.targets(0.25))[0] + problem.f_ext + energy.forces(result.x)[0]
    assert result.residual == pytest.approx(np.linalg.norm(f[free]), rel=1e-9)
    assert result.energy == pytest.approx(problem.energy(result.x) + energy.energy(result.x), rel=1e-9)


@pytest.mark.parametrize("dtype", ["auto", "float64"])
def test_the_first_frame_of_a_motion_is_that_of_its_certificate(dtype):
    """Blocks overlap, and one stands in the floor."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), SOFT, name="a")
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), SOFT, name="b", at=(0.1, 0.9, 0.07))
    scene.contact()
    scene.collide_with(pbng.Plane((0, 0.05, 0), (0, 1, 0)))
    frame = next(pbng.simulate(scene, pbng.PBNG(dtype=dtype), frames=2, inertia=True))
    np.testing.assert_allclose(frame.x, frame.result.x, atol=1e-6 if dtype == "auto" else 0)
    assert frame.x[:, 1].min() >= 0.05
    assert frame.contact.pairs > 0


@pytest.mark.parametrize("solver", [pbng.PBNG(), pbng.MultigridPBNG()])
def test_a_monitor_sees_one_solve(solver):
    told = []
    result = pbng.solve(pressed()[0], solver, pbng.Budget(rtol=1e-3, every=1), monitor=told.append)
    assert result.status is pbng.Status.CONVERGED
    assert (np.diff(result.monitored) == 0).any()  # a round ends, another begins
    iterations = [p.iteration for p in told]
    assert iterations == list(range(1, result.iterations + 1))
    assert {p.first for p in told} == {result.residuals[0]}
    assert (np.diff([p.seconds for p in told]) >= 0).all()
    assert result.correction > 0


def test_what_sticks_is_held_from_frame_to_frame():
    shift = []
    for k_tau in (0.0, 1e3):
        scene, upper = pressed(k_tau=k_tau, along=0.2)
        frames = list(pbng.simulate(scene, pbng.MultigridPBNG(), pbng.Budget(rtol=1e-3), frames=16))
        bottom = upper.where(y=1.001).index
        shift.append((frames[-1].x[bottom, 0] - frames[-1].problem.X[bottom, 0]).mean())
    assert all(f.result.status is pbng.Status.CONVERGED for f in frames)
    assert frames[-1].contact.pairs > 10
    assert shift[0] > 0.19
    assert 0 < shift[1] < 0.7 * shift[0]


def test_springs_across_the_normal_are_at_rest_when_they_are_found():
    """Cloth drawn over a ball, closer than its thickness: normals are not those between closest points."""
    scene = pbng.Scene()
    ball = scene.add(pbng.shapes.sphere(0.3, 6), FLESH, name="ball")
    cloth = scene.add(pbng.shapes.sheet((0.4, 0.4), 9, origin=(-0.2, 0, -0.2)), pbng.Membrane(E=100.0, nu=0.3))
    scene.contact(k_tau=1e4)
    problem = scene.compile(free=True)
    x = problem.X.copy()
    sheet = x[cloth.start :]
    sheet[:, 1] = 0.3
    sheet *= 0.303 / np.linalg.norm(sheet, axis=1)[:, None]
    contacts = Detector(problem.contact, problem.X, problem.fixed).find(x, x, 0, 0)
    sticks = contacts.k_tau > 0
    assert sticks.sum() > 20
    along = (contacts.normal * contacts.start).sum(1)
    aslant = np.linalg.norm(contacts.start - along[:, None] * contacts.normal, axis=1)
    assert aslant[sticks].max() > 1e-4
    energy, slides = energy_of(contacts, problem), energy_of(replace(contacts, k_tau=0 * contacts.k_tau), problem)
    f = energy.forces(x)[0]
    assert np.abs(f).max() > 0
    np.testing.assert_allclose(f, slides.forces(x)[0], atol=1e-12 * np.abs(f).max())
    x[ball.start : cloth.start] += [1e-3, 0, 0]
    assert energy.energy(x) > slides.energy(x) + 1e-4 * 1e4 * 1e-6 * sticks.sum()


@pytest.mark.parametrize("solver", [pbng.PBNG(), pbng.MultigridPBNG()])
def test_a_plane_body_stays_in_its_plane(solver):
    """A ball whose middle is off the plane keeps it out of a smaller circle."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    flat = scene.add(pbng.shapes.rectangle((1.0, 1.0), 7), FLESH, name="flat")
    scene.pin(flat.where(y=1.0))
    scene.collide_with(pbng.Sphere((0.5, 0.1, 0.2), 0.35))
    result = pbng.solve(scene, solver, pbng.Budget(rtol=1e-4))
    assert result.status is pbng.Status.CONVERGED
    assert (result.x[:, 2] == 0).all()
    rim = np.unique(flat.faces)
    distance = np.linalg.norm(result.x[rim, :2] - [0.5, 0.1], axis=1)
    cut = np.sqrt(0.35**2 - 0.2**2)
    assert distance.min() == pytest.approx(cut, abs=1e-4)
    assert distance.min() > cut - 1e-6
