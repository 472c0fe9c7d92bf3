"""Accelerations of the sweeps: formulae as printed, the same equilibrium, and what they refuse."""

import numpy as np
import pytest
from conftest import twisted_bar

import pbng
from pbng.solvers.acceleration import MixingHistory

DOUBLE = pbng.PBNG(dtype="float64")
PLAIN = pbng.PBNG(acceleration=None, dtype="float64")


@pytest.fixture(scope="module")
def bar():
    return twisted_bar().compile()


def start_of(problem):
    return problem.constrain(problem.X, problem.end)


@pytest.mark.parametrize(
    "acceleration",
    [None, pbng.NodeSOR(1.5), pbng.NodeSOR, pbng.Anderson(memory=3), pbng.Anderson, pbng.SOR(1.3), pbng.Chebyshev(0.9)],
)
def test_accelerations_reach_the_same_equilibrium(bar, acceleration):
    """Every acceleration ends at the same state, and none moves a prescribed vertex."""
    reference = pbng.solve(bar, DOUBLE, pbng.Budget(rtol=1e-9)).x
    result = pbng.solve(bar, pbng.PBNG(acceleration, dtype="float64"), pbng.Budget(rtol=1e-7))
    assert result.status is pbng.Status.CONVERGED
    np.testing.assert_allclose(result.x, reference, atol=1e-5)
    np.testing.assert_array_equal(result.x[bar.fixed], reference[bar.fixed])


def test_sor_as_printed(bar):
    """Section 7.3: x⁺ = ω (G(x) - x⁻) + x⁻ with x⁻ = x at the first step, and the plain method for ω = 1."""
    sweeps = PLAIN.set_up(bar)
    sor = pbng.PBNG(pbng.SOR(1.6), dtype="float64").set_up(bar)
    x0 = start_of(bar)
    sor.start(x0)
    states, before = [x0], x0
    for _ in range(3):
        sweeps.start(states[-1])
        sweeps.step()
        states.append(np.where(bar.fixed[:, None], x0, 1.6 * (sweeps.state() - before) + before))
        before = states[-2]
        sor.step()
        np.testing.assert_allclose(sor.state(), states[-1], atol=1e-13)
    one = pbng.solve(bar, pbng.PBNG(pbng.SOR(1.0), dtype="float64"), pbng.Budget(iterations=5))
    np.testing.assert_allclose(one.x, pbng.solve(bar, PLAIN, pbng.Budget(iterations=5)).x, atol=1e-14)


def test_chebyshev_as_printed(bar):
    """x⁺ = ω_l (γ (G(x) - x) + x - x⁻) + x⁻ with ω = 1, 2/(2 - ρ²), 4/(4 - ρ² ω)."""
    rho, gamma = 0.95, 1.7
    omegas = [1.0, 2 / (2 - rho**2)]
    omegas += [4 / (4 - rho**2 * omegas[1])]
    sweeps, method = PLAIN.set_up(bar), pbng.PBNG(pbng.Chebyshev(rho, gamma), dtype="float64").set_up(bar)
    x0 = start_of(bar)
    method.start(x0)
    x, before = x0, x0
    for omega in omegas:
        sweeps.start(x)
        sweeps.step()
        new = omega * (gamma * (sweeps.state() - x) + x - before) + before
        x, before = np.where(bar.fixed[:, None], x0, new), x
        method.step()
        np.testing.assert_allclose(method.state(), x, atol=1e-13)


def test_anderson_minimises_the_linear_model(bar):
    """One memory: x₂ = G(x₁) - θ (G(x₁) - G(x₀)) with θ = Δf·f₁ / Δf·Δf, if that lowers the energy."""
    sweeps, method = PLAIN.set_up(bar), pbng.PBNG(pbng.Anderson(1, 1.0), dtype="float64").set_up(bar)
    x0 = start_of(bar)
    states = []
    for x in (x0, None):
        sweeps.start(x0 if x is not None else states[0])
        sweeps.step()
        states.append(sweeps.state())
    f0, f1 = states[0] - x0, states[1] - states[0]
    theta = np.sum((f1 - f0) * f1) / np.sum((f1 - f0) ** 2)
    mixed = states[1] - theta * (states[1] - states[0])
    assert bar.energy(mixed) < bar.energy(states[0])
    method.start(x0)
    method.step()
    method.step()
    np.testing.assert_allclose(method.state(), mixed, atol=1e-10)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: pbng.NodeSOR(2.0), r"omega must lie strictly between 0 and 2, not 2\.0"),
        (lambda: pbng.NodeSOR(0.0), "omega must lie strictly"),
        (lambda: pbng.Anderson(memory=0), "memory must be a whole number of at least 1, not 0"),
        (lambda: pbng.Anderson(omega=2.5), "omega must lie strictly"),
        (lambda: pbng.Chebyshev(rho=1.0), r"rho must lie in \[0, 1\), not 1\.0"),
        (lambda: pbng.PBNG(acceleration=3), "PBNG: 3 is not an acceleration"),
        (lambda: pbng.PBNG(block="mine"), "block must be 'majorizer' or 'paper', not 'mine'"),
        (lambda: pbng.PBNG(dtype="float16"), "dtype must be 'float32', 'float64' or 'auto', not 'float16'"),
        (lambda: pbng.PBNG(dtype="real"), "dtype must be 'float32', 'float64' or 'auto', not 'real'"),
        (lambda: pbng.PBNG(threads=0), "threads must lie between 1 and"),
        (lambda: pbng.PBNG(device="tpu"), "device must be 'cpu', not 'tpu'"),
    ],
)
def test_bad_solvers_are_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()


def test_symmetric_sweeps(bar):
    """One symmetric iteration is a sweep and one in the reverse order of colours: it gets further than one sweep."""
    plain = pbng.solve(bar, PLAIN, pbng.Budget(iterations=20))
    both = pbng.solve(bar, pbng.PBNG(None, dtype="float64", symmetric=True), pbng.Budget(iterations=20))
    assert both.energy < plain.energy


def test_mixtures_are_the_best_there_are(rng):
    """Whatever the sizes of the differences, also where some are lost, alike or nearly alike."""
    for k in range(300):
        history, m = MixingHistory(5), int(rng.integers(1, 6))
        F, f = rng.normal(size=(m, 30)) * 10.0 ** rng.uniform(-5, 5, size=(m, 1)), rng.normal(size=30)
        if m > 1 and k % 3:
            F[1] = F[0] * (1 + (k % 3 - 1) * 1e-4 * rng.normal(size=30))
        if k % 7 == 0:
            F[m - 1] = 0
        history.count, history.gram[:m, :m], history.rhs[:m] = m, F @ F.T, F @ f
        theta = history._weights()
        if not F.any():
            assert theta is None
            continue
        size = np.maximum(np.linalg.norm(F, axis=1), 1e-300)
        best = f - np.linalg.lstsq((F / size[:, None]).T, f, rcond=1e-7)[0] @ (F / size[:, None])
        assert np.linalg.norm(f - theta @ F) < np.linalg.norm(best) * (1 + 1e-6)
    history.gram[0, 0] = np.nan
    assert history._weights() is None
