"""Pins that let go, motions that stop, bodies that wait."""

import numpy as np
import pytest

import pbng

RUBBER = pbng.Corotated(E=1e4, nu=0.3, density=100.0)


def cube(scene, name="cube", **options):
    return scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 3), RUBBER, name=name, **options)


@pytest.mark.parametrize("compiled", [False, True])
def test_what_is_let_go_falls_freely(compiled):
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = cube(scene)
    scene.pin(body.where(), until=0.5)
    scene = scene.compile(free=True) if compiled else scene
    frames = list(
        pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-6), frames=11, fps=10, inertia=True, substeps=5)
    )
    height = np.array([f.x[:, 1].mean() for f in frames]) - 0.1
    assert np.all(height[:6] == pytest.approx(0, abs=1e-8))
    steps = 5 * np.arange(1, 6)
    assert height[6:] == pytest.approx(-9.8 * 0.02**2 * steps * (steps + 1) / 2, rel=1e-4)


def test_a_body_waits_and_then_falls():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    cube(scene, "early")
    cube(scene, "late", at=(1, 0, 0), wait=0.3)
    *_, last = pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-6), frames=7, fps=10, inertia=True, substeps=4)
    early, late = (last.x[b.start : b.stop, 1].mean() - 0.1 for b in last.problem.bodies)
    assert early == pytest.approx(-9.8 * 0.6**2 / 2, rel=0.06)
    assert late == pytest.approx(-9.8 * 0.3**2 / 2, rel=0.1)


def test_quasistatic_release_goes_to_the_other_equilibrium():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    bar = scene.add(pbng.shapes.box((1.0, 0.2, 0.2), (11, 3, 3)), RUBBER)
    scene.pin(bar.where(x=0))
    scene.pin(bar.where(x=1), until=0.1)
    frames = list(pbng.simulate(scene, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-8), frames=3, fps=10))
    free = pbng.Scene(gravity=(0, -9.8, 0))
    other = free.add(pbng.shapes.box((1.0, 0.2, 0.2), (11, 3, 3)), RUBBER)
    free.pin(other.where(x=0))
    wanted = pbng.solve(free, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-9)).x
    assert np.abs(frames[0].x[bar.where(x=1).index] - bar.mesh.X[bar.where(x=1).index]).max() == 0
    assert np.abs(frames[2].x - wanted).max() < 1e-4


def test_a_motion_can_stop_and_let_go():
    scene = pbng.Scene()
    body = cube(scene)
    scene.move(body.where(x=0.2), pbng.Translate((1.0, 0, 0)), over=1.0, until=0.5)
    *_, last = pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-6), frames=11, fps=10, inertia=True, substeps=4)
    assert last.problem.fixed.sum() == 0
    assert last.momentum[0] / 0.8 == pytest.approx(1.0, abs=0.2)  # it flies on about as fast as it was drawn


def test_bad_times():
    scene = pbng.Scene()
    body = cube(scene)
    with pytest.raises(pbng.InputError, match="until must be positive"):
        scene.pin(body.where(), until=0.0)
    with pytest.raises(pbng.InputError, match="wait must be finite"):
        cube(scene, "other", wait=-1.0)
