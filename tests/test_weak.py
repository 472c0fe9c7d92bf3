"""Weak constraints: energy, forces, Hessian, sweep and colouring (Eqs. 18-19, 31)."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from conftest import held_box

import pbng
from pbng.coloring import is_valid
from pbng.compounds import Compounds
from pbng.constraints import WeakConstraints
from pbng.packing import pack_problem
from pbng.sweep import sweep


def random_stiffness(rng, m, k=1e4):
    """Symmetric positive semidefinite matrices (m, 3, 3), some of rank one."""
    A = rng.standard_normal((m, 3, 3))
    A[::3, :, 1:] = 0
    return k * A @ A.transpose(0, 2, 1)


def random_weak(problem, rng):
    """Weak constraints with stencils of 1 to 7 vertices, to points and between vertices, prescribed ones included."""
    out = []
    for s, anchored in ((1, True), (2, False), (4, False), (7, True), (4, True)):
        m = 5
        vertices = np.stack([rng.permutation(problem.n_vert)[:s] for _ in range(m)]).astype(np.int32)
        weights = rng.uniform(0.2, 1, (m, s))
        weights = weights / weights.sum(1, keepdims=True)
        if not anchored:
            half = s // 2
            weights[:, :half] /= weights[:, :half].sum(1, keepdims=True)
            weights[:, half:] /= -weights[:, half:].sum(1, keepdims=True)
        points = rng.standard_normal((m, 3))
        targets = (lambda t, p=points: p + t) if anchored else None
        out.append(WeakConstraints(vertices, weights, random_stiffness(rng, m), targets))
    return tuple(out)


@pytest.fixture
def bound(rng):
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    return replace(problem, weak=random_weak(problem, rng), end=0.25)


def test_energy_is_half_ckc(bound, rng):
    """½ Cᵀ K C, summed one by one."""
    x = bound.X + 0.1 * rng.standard_normal(bound.X.shape)
    expected = replace(bound, weak=()).energy(x)
    for w in bound.weak:
        target = w.targets(bound.end) if w.anchored else np.zeros((len(w.vertices), 3))
        for i, p in enumerate(target):
            C = w.weights[i] @ x[w.vertices[i]] - p
            expected += 0.5 * C @ w.K[i] @ C
    assert bound.energy(x) == pytest.approx(expected, rel=1e-13)


def test_forces_are_the_gradient(bound, rng):
    x = bound.X + 0.1 * rng.standard_normal(bound.X.shape)
    f = bound.forces(x)
    for _ in range(5):
        d = rng.standard_normal(x.shape)
        slope = oracle.energy_gradient(bound.energy, x, d, 1e-4)
        assert slope == pytest.approx(-np.sum(f * d), rel=1e-8)


def test_hessian_is_the_derivative_of_the_forces(bound, rng):
    """It is constant, so one difference is exact."""
    targets = bound.targets(bound.end)
    weak = bound.weak_energy
    x, d = rng.standard_normal((2, *bound.X.shape))
    change = weak.forces(x + d, targets)[0] - weak.forces(x, targets)[0]
    H = weak.hessian()
    np.testing.assert_allclose((H @ d.ravel()).reshape(-1, 3), -change, atol=1e-10 * np.abs(change).max())
    np.testing.assert_allclose((H - H.T).toarray(), 0, atol=1e-9)


def test_sweep_is_the_oracles(bound, rng):
    """Node by node in float64, also far from the origin, where positions are stored relative to a middle."""
    for shift in (np.zeros(3), np.array([100.0, -50, 20])):
        problem = replace(
            bound,
            X=bound.X + shift,
            weak=tuple(replace(w, targets=_shifted(w.targets, shift)) if w.anchored else w for w in bound.weak),
        )
        x = problem.X + 0.05 * rng.standard_normal(problem.X.shape)
        packed = pack_problem(problem, np.float64)
        targets = problem.targets(problem.end)
        flat = packed.pack(x, targets)
        n_color = packed.n_color
        sweep(packed, flat, np.arange(n_color), 1.3)
        nodes = [i for c in range(n_color) for i in np.flatnonzero(problem.color == c)]
        expected = oracle.sweep(problem, x, nodes, 1.3)
        compounds = Compounds(problem)
        assert compounds.n > 5
        for i in np.argsort(compounds.color, kind="stable"):
            expected = oracle.move_compound(problem, expected, compounds.beta[i].toarray()[0], 1.3)
        np.testing.assert_allclose(packed.unpack(flat), expected, atol=1e-12 * (1 + np.abs(shift).max()))


def _shifted(targets, shift):
    return lambda t: targets(t) + shift


def test_nodes_of_one_color_share_no_weak_constraint(bound):
    for w in bound.weak:
        assert is_valid(bound.color, w.vertices)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_energy_never_rises(bound, rng, dtype):
    """The constant block w² K is exact, so every update still lowers the energy, from any start."""
    method = pbng.PBNG(acceleration=None, dtype=dtype).set_up(bound)
    for x in (bound.X + 0.5 * rng.standard_normal(bound.X.shape), np.zeros_like(bound.X)):
        method.start(bound.constrain(x, 0.25))
        energies = [method.certify().energy]
        for _ in range(8):
            method.apply(method.x, 1.9)
            energies.append(method.certify().energy)
        assert (np.diff(energies) <= 1e-6 * np.abs(energies[:-1])).all()
        assert energies[-1] < energies[0]


@pytest.mark.parametrize("solver", [pbng.PBNG(dtype="float64"), pbng.MultigridPBNG()])
def test_solvers_reach_the_equilibrium(bound, solver):
    result = pbng.solve(bound, solver, pbng.Budget(rtol=1e-8, iterations=400))
    assert result.status is pbng.Status.CONVERGED
    assert bound.residual(result.x) == pytest.approx(result.residual, rel=1e-6, abs=1e-9)
    assert result.energy == pytest.approx(bound.energy(result.x), rel=1e-9)


def test_same_bits_for_one_and_two_threads(bound):
    results = [
        pbng.solve(bound, pbng.MultigridPBNG(threads=threads), pbng.Budget(iterations=4)).x for threads in (1, 2)
    ]
    assert (results[0] == results[1]).all()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"weights": np.array([[0.5, -0.4], [1, -1]])}, "constraint 0 between two sides: weights sum to 0.1, not 0"),
        ({"weights": np.array([[1, -1], [np.nan, -1]])}, "weak constraint 1: weights is not finite"),
        ({"vertices": np.array([[0, 1], [3, 3]], np.int32)}, "weak constraint 1: a vertex stands twice"),
        ({"K": -np.tile(np.eye(3), (2, 1, 1))}, "weak constraint 0: K must be symmetric without negative"),
        ({"K": np.tile(np.eye(3), (3, 1, 1))}, "K must have shape"),
        ({"weights": np.ones((2, 3))}, "must have one shape"),
        ({"targets": lambda t: np.zeros((2, 3))}, "to a point: weights sum to 0, not 1"),
    ],
)
def test_bad_constraints_are_named(change, word):
    good = {
        "vertices": np.array([[0, 1], [2, 3]], np.int32),
        "weights": np.array([[1.0, -1], [1, -1]]),
        "K": np.tile(np.eye(3), (2, 1, 1)),
    }
    WeakConstraints(**good)
    with pytest.raises(pbng.InputError, match=word):
        WeakConstraints(**{**good, **change})


def two_blocks(k, n=6, shift=0.0):
    """Paper, section 11.3: a block hangs below another, bound by springs that close a gap."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    flesh = pbng.Corotated(E=1e3, nu=0.3, density=10)
    block = pbng.shapes.box(size=(1, 1, 1), vertices=(n, n, n))
    upper, lower = scene.add(block, flesh, at=(0, 1.1, 0)), scene.add(block, flesh, at=(shift, 0, shift))
    scene.pin(upper.where(y=2.1))
    scene.bind(lower.where(y=1.0), upper.where(y=1.1), k=k)
    return scene.compile()


@pytest.mark.parametrize(
    ("solver", "shift", "iterations"),
    [
        (pbng.PBNG(dtype="float64"), 0.0, 120),
        (pbng.MultigridPBNG(dtype="float64"), 0.0, 14),
        (pbng.MultigridPBNG(), 0.1, 40),
    ],
)
def test_stiff_springs_do_not_stall(solver, shift, iterations):
    """k = 1e8 beside E = 1e3: without compound nodes thousands of sweeps move the lower block by a fraction only."""
    problem = two_blocks(1e8, shift=shift)
    result = pbng.solve(problem, solver, pbng.Budget(atol=1e-4, iterations=iterations))
    assert result.status is pbng.Status.CONVERGED
    gaps = problem.weak_energy.gaps(result.x, np.empty((0, 3)))
    assert np.abs(gaps).max() < 1e-5
    carried = problem.f_ext[~problem.fixed].sum(0)  # what hangs on the pins
    np.testing.assert_allclose(problem.forces(result.x)[problem.fixed].sum(0), carried, atol=1e-2)


def test_compounds_carry_what_is_tied_to_them():
    """No spring of the vertex changes its length, whatever the sides' weights; prescribed vertices never move."""
    problem = two_blocks(1e4, shift=0.1)
    compounds = Compounds(problem)
    assert len(problem.weak) > 1
    assert compounds.n > 10
    lower = problem.bodies[1].start
    for i in range(compounds.n):
        beta = compounds.beta[i].toarray()[0]
        leader = int(np.flatnonzero((beta == 1) & (np.arange(problem.n_vert) < lower))[0])
        assert not problem.fixed[beta != 0].any()
        for weak in problem.weak:
            mine = (weak.vertices == leader).any(1)
            np.testing.assert_allclose((weak.weights * beta[weak.vertices]).sum(1)[mine], 0, atol=1e-14)


@pytest.mark.parametrize("solver", [pbng.PBNG(), pbng.MultigridPBNG()])
def test_stiff_springs_without_a_gap_are_not_taken_for_rest(solver):
    """Rounding them to float32 makes forces above the weight; the default precision sees to it."""
    problem = two_blocks(1e8, n=4)
    problem = replace(problem, X=problem.X - np.where(np.arange(problem.n_vert) < 64, 0.1, 0)[:, None] * [0, 1, 0])
    result = pbng.solve(problem, solver, pbng.Budget(rtol=1e-5, iterations=300), start=problem.X)
    assert result.status is pbng.Status.CONVERGED
    assert result.iterations > 2


def three_blocks(turned):
    """A tied to B, and B to C, at the vertices of one edge."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    flesh, box = pbng.Corotated(E=1e3, nu=0.3, density=10), pbng.shapes.box(size=(1, 1, 1), vertices=(4, 4, 4))
    a, b, c = (scene.add(box, flesh, at=at) for at in ((0, 0, 0), (0, 1, 0), (1, 0, 0)))
    scene.pin(b.where(y=2.0))
    edge = {"x": 1.0, "y": 1.0}
    ties = (a.where(**edge), b.where(**edge)), (b.where(**edge), c.where(**edge))
    for first, second in ties:
        scene.bind(*((second, first) if turned and first.body is b else (first, second)), k=1e8)
    return scene.compile()


@pytest.mark.parametrize("turned", [False, True])
def test_chains_of_ties_move_as_one(turned):
    result = pbng.solve(three_blocks(turned), pbng.PBNG(), pbng.Budget(rtol=1e-5, iterations=400))
    assert result.status is pbng.Status.CONVERGED


@pytest.mark.parametrize("k", [1e8, 1e-3])
def test_springs_beside_springs(k):
    """A second spring between the same vertices, stiff or weak, does not change who moves with whom."""
    problem = two_blocks(1e8)
    w = problem.weak[0]
    twice = replace(problem, weak=(*problem.weak, replace(w, K=k / 1e8 * w.K)))
    np.testing.assert_array_equal(Compounds(twice).beta.toarray(), Compounds(problem).beta.toarray())
    result = pbng.solve(twice, pbng.PBNG(), pbng.Budget(rtol=1e-7, iterations=200))
    assert result.status is pbng.Status.CONVERGED


def test_precision_at_the_start_is_kept_when_a_movement_is_extended():
    """Stiff springs make a solve begin in float64; the start by extension does not take it back."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    flesh, box = pbng.Corotated(E=1e3, nu=0.3, density=10), pbng.shapes.box(size=(1, 1, 1), vertices=(4, 4, 4))
    upper, lower, apart = (scene.add(box, flesh, at=at) for at in ((0, 1, 0), (0, 0, 0), (3, 0, 0)))
    scene.pin(upper.where(y=2.0))
    scene.bind(lower.where(y=1.0), upper.where(y=1.0), k=1e8)
    scene.pin(apart.where(y=0.0))
    scene.move(apart.where(y=1.0), pbng.Translate((0, 0.03, 0)))
    result = pbng.solve(scene, pbng.MultigridPBNG(), pbng.Budget(rtol=1e-7, iterations=60))
    assert result.status is pbng.Status.CONVERGED
