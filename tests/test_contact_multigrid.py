"""The two-grid cycle where things touch: its counts stay, and its estimate of the error is true."""

import numba
import numpy as np
import pytest

import pbng

FLESH = pbng.Corotated(E=1e4, nu=0.3, density=100.0)


def squeezed(n, friction=0.0):
    """A ball, its middle held, between two plates that close."""
    scene = pbng.Scene()
    ball = scene.add(pbng.shapes.sphere(1.0, n), FLESH, name="ball")
    scene.pin(ball.where(lambda X: np.linalg.norm(X, axis=1) < 0.25))
    for side in (-1, 1):
        motion = pbng.Translate((0, -0.3 * side, 0))
        plate = pbng.Plane((0, side, 0), (0, -side, 0), motion=motion, over=0.5, friction=friction)
        scene.collide_with(plate)
    return scene


def stacked(n):
    """A soft block upon a larger one, pressed into it by its top."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    lower = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), n, origin=(-0.5, 0, -0.5)), FLESH, name="lower")
    upper = scene.add(pbng.shapes.box((0.7, 0.7, 0.7), n, origin=(-0.35, 1.001, -0.35)), FLESH, name="upper")
    scene.pin(lower.where(y=0.0))
    scene.move(upper.where(y=1.701), pbng.Translate((0, -0.2, 0)), over=0.5)
    scene.contact()
    return scene


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_cycles_do_not_grow_with_the_mesh_in_contact(friction):
    cycles = []
    for n in (9, 17):
        frames = pbng.simulate(squeezed(n, friction), pbng.MultigridPBNG(), pbng.Budget(rtol=1e-3), frames=8)
        results = [f.result for f in frames]
        assert all(r.status is pbng.Status.CONVERGED for r in results[1:])
        cycles.append(np.median([r.iterations for r in results[1:]]))
    assert cycles[1] <= cycles[0] + 3
    assert cycles[1] <= 12


@pytest.mark.parametrize("n", [5, 9, 13])
def test_cycles_of_a_stack(n):
    """Vertices lie on vertices and edges, where the closest triangle changes with every movement: rounds settle."""
    frames = list(pbng.simulate(stacked(n), pbng.MultigridPBNG(), pbng.Budget(rtol=1e-3), frames=8))
    assert all(f.result.status is pbng.Status.CONVERGED for f in frames)
    assert frames[-1].contact.pairs > 10
    assert frames[-1].result.inverted == 0
    assert max(f.result.iterations for f in frames) <= 16


@pytest.mark.parametrize(
    ("scene", "ratio"),
    [(squeezed(9), 10.7), (squeezed(9, 0.3), 28.9), (stacked(5), 1.27)],
    ids=["ball", "rough plates", "stack"],
)
def test_the_error_estimate_is_true_in_contact(scene, ratio):
    """It is not too low, and too high, as measured, only where a round may move more than is left to be moved."""
    rough = pbng.solve(scene, pbng.MultigridPBNG(), pbng.Budget(rtol=1e-3))
    fine = pbng.solve(scene, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-7))
    assert fine.status is pbng.Status.CONVERGED
    error = np.linalg.norm(rough.x - fine.x, axis=1).max()
    assert 0.5 * ratio <= rough.error / error <= 2 * ratio


def test_the_same_bits_for_any_number_of_threads():
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one thread only")
    found = []
    for threads in (1, 2):
        budget = pbng.Budget(rtol=1e-3)
        *_, last = pbng.simulate(stacked(6), pbng.MultigridPBNG(threads=threads), budget, frames=5)
        assert last.contact.pairs > 0
        found.append((last.x.tobytes(), last.result.iterations, last.result.residual))
    assert found[0] == found[1]


@pytest.mark.parametrize("solver", [pbng.PBNG(), pbng.MultigridPBNG()])
def test_rough_walls_let_a_solve_go_on_in_float64(solver):
    """What rubs is stiff, and rounding shows in it; and the second round begins where float32 has ended."""
    result = pbng.solve(squeezed(9, 0.3), solver, pbng.Budget(rtol=1e-6, iterations=1000))
    assert result.status is pbng.Status.CONVERGED
    assert result.residual <= 1e-6 * result.residuals[0]
