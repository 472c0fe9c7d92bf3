"""Friction of colliders: Coulomb's law on a slope, sliding and at rest."""

import numpy as np
import pytest

import pbng

RUBBER = pbng.Corotated(E=1e5, nu=0.3, density=100.0)
SLOPE = np.deg2rad(20)


def on_a_slope(colliders):
    """A block of 100 kg on the plane y = 0; gravity is that of a slope."""
    scene = pbng.Scene(gravity=(9.8 * np.sin(SLOPE), -9.8 * np.cos(SLOPE), 0))
    block = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), RUBBER, name="block")
    scene.collide_with(colliders)
    return scene, block


def floor(friction):
    return pbng.Plane((0, 0, 0), (0, 1, 0), friction=friction)


def acceleration_of(colliders):
    """Down the slope, after a while [m/s²]."""
    scene, _ = on_a_slope(colliders)
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-4), frames=41, inertia=True))
    return (frames[-1].momentum[0] - frames[-16].momentum[0]) / 100.0 / 0.5


@pytest.mark.parametrize("friction", [0.0, 0.2, 0.5])
def test_a_block_slides_down_a_slope_as_coulomb_says(friction):
    wanted = max(9.8 * (np.sin(SLOPE) - friction * np.cos(SLOPE)), 0.0)
    assert acceleration_of(floor(friction)) == pytest.approx(wanted, abs=0.05 * 9.8)


@pytest.mark.parametrize(
    "colliders",
    [
        [floor(0.2), floor(0.2)],
        [floor(0.2), *pbng.container((-3, 0, -3), (30, 4, 4), friction=0.2)],
    ],
    ids=["twice", "container"],
)
def test_what_two_colliders_bear_together_rubs_once(colliders):
    assert acceleration_of(colliders) == pytest.approx(9.8 * (np.sin(SLOPE) - 0.2 * np.cos(SLOPE)), rel=0.02)


def test_friction_holds_a_block_at_rest():
    """Without inertia, and nothing else that holds: the first round knows nothing of what the slope bears."""
    scene, _ = on_a_slope(floor(0.8))
    problem = scene.compile(free=True)
    result = pbng.solve(problem, pbng.PBNG(), pbng.Budget(rtol=1e-3, iterations=1000))
    assert result.status is pbng.Status.CONVERGED
    assert np.abs((result.x - problem.X).mean(0)).max() < 0.01


def test_friction_is_not_lost_when_something_else_is_released():
    scene, block = on_a_slope(floor(0.8))
    far = scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 2, origin=(0, 3, 5)), RUBBER, name="far")
    scene.pin(far.where(), until=0.5)
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-4), frames=18, inertia=True))
    mine = slice(block.start, block.start + block.mesh.n_vert)
    assert frames[-1].v[far.start, 0] > 0.2
    slid = [(f.x[mine, 0] - frames[15].x[mine, 0]).mean() for f in frames[15:]]
    assert np.abs(slid).max() < 1e-3
