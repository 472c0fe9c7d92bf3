"""The compiled sweep equals the NumPy oracle, node by node (design test 2)."""

import numpy as np
import oracle
import pytest
from conftest import held_box, twisted_bar
from models import RootMooney, SoftVolume

import pbng
from pbng.packing import pack_problem
from pbng.sweep import sweep

MODELS = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, pbng.LinearElastic, SoftVolume, RootMooney)


def disturbed(problem, amount, rng):
    """Free vertices moved at random by about ``amount`` [m]; those of plane domains in their plane."""
    step = amount * rng.standard_normal(problem.X.shape)
    for group in problem.groups:
        if group.kind.name == "triangle":
            step[group.cells, 2] = 0
    return problem.X + np.where(problem.fixed[:, None], 0, step)


def against_oracle(problem, x, omega=1.0, paper=False, dtype=np.float64, order=None):
    """Largest difference to the oracle after each colour of a sweep, relative to the size of the problem."""
    packed = pack_problem(problem, dtype, paper)
    colors = np.arange(packed.n_color) if order is None else order
    flat, worst = packed.pack(x), 0.0
    for c in colors:
        before = packed.unpack(flat).astype(float)
        sweep(packed, flat, np.array([c]), omega)
        expected = oracle.sweep(problem, before, np.flatnonzero(problem.color == c), omega, paper)
        worst = max(worst, np.abs(packed.unpack(flat) - expected).max())
        assert np.abs(expected - before).max() > 0
    return worst / np.abs(x).max()


@pytest.mark.parametrize(("omega", "paper"), [(1.0, False), (1.7, False), (1.0, True), (0.5, True)])
def test_mixed_problem(mixed, rng, omega, paper):
    """Eqs. (28)-(34): five models on tets and plane triangles, several in one mesh, loads, four bodies; to 1e-12."""
    assert {g.kind.name for g in mixed.groups} == {"tet", "triangle"}
    assert len({g.term for g in mixed.groups}) == 7
    assert against_oracle(mixed, disturbed(mixed, 0.05, rng), omega, paper) < 1e-12


@pytest.mark.parametrize("paper", [False, True])
@pytest.mark.parametrize("model", MODELS)
def test_each_model_far_from_rest(model, paper, rng):
    """From states with many inverted elements."""
    problem = held_box(model(E=1e5, nu=0.3))
    x = disturbed(problem, 0.3, rng)
    assert problem.inverted(x) > 10
    assert against_oracle(problem, x, omega=1.3, paper=paper) < 1e-12


def test_paper_block_matters():
    """The two blocks give different updates for Neo-Hookean, the same for corotated."""
    change = {}
    for model in (pbng.NeoHookean, pbng.Corotated):
        problem = held_box(model(E=1e5, nu=0.3))
        x = disturbed(problem, 0.05, np.random.default_rng(1))
        found = []
        for paper in (False, True):
            packed = pack_problem(problem, np.float64, paper)
            flat = packed.pack(x)
            sweep(packed, flat, np.arange(packed.n_color))
            found.append(packed.unpack(flat))
        change[model] = np.abs(found[1] - found[0]).max()
    assert change[pbng.Corotated] == 0
    assert change[pbng.NeoHookean] > 1e-3


def test_order_of_colours(rng):
    """Colours are taken in the order given, and repeated if they are repeated."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    x, n = disturbed(problem, 0.05, rng), problem.color.max() + 1
    packed = pack_problem(problem, np.float64)
    order = np.array([*range(n), *reversed(range(n))])
    together, apart = packed.pack(x), packed.pack(x)
    sweep(packed, together, order)
    for c in order:
        sweep(packed, apart, np.array([c]))
    np.testing.assert_array_equal(together, apart)
    assert against_oracle(problem, x, order=order) < 1e-12
    expected = x
    for c in order:
        expected = oracle.sweep(problem, expected, np.flatnonzero(problem.color == c))
    np.testing.assert_allclose(packed.unpack(together), expected, atol=1e-12)


@pytest.mark.parametrize("omega", [1.0, 1.7])
def test_float32_is_close(rng, omega):
    problem = twisted_bar().compile()
    assert against_oracle(problem, disturbed(problem, 0.03, rng), omega, dtype=np.float32) < 2e-6


@pytest.mark.parametrize("vertices", [(2, 2, 2), (3, 2, 2), (5, 2, 2), (4, 4, 3), (7, 3, 3)])
def test_padding_lanes(vertices, rng):
    """Colours of any number of nodes: what fills the lanes of a block changes nothing, and never moves."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3), vertices)
    assert against_oracle(problem, disturbed(problem, 0.1, rng)) < 1e-12
    packed = pack_problem(problem, np.float64)
    flat = packed.pack(disturbed(problem, 0.1, rng))
    assert packed.n_slot > problem.n_vert
    padding = np.setdiff1d(np.arange(packed.n_slot), packed.slot)
    before = flat.reshape(-1, 4).copy()
    sweep(packed, flat, np.arange(packed.n_color))
    np.testing.assert_array_equal(flat.reshape(-1, 4)[padding], before[padding])
    np.testing.assert_array_equal(flat.reshape(-1, 4)[packed.slot[problem.fixed]], before[packed.slot[problem.fixed]])
    np.testing.assert_array_equal(flat.reshape(-1, 4)[:, 3], 0)


@pytest.mark.parametrize("n_free", [1, 2, 3, 4])
def test_single_tet(n_free, rng):
    """One element, one to four free nodes; with all four free nothing holds it (made without a scene)."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    X = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    body = scene.add(pbng.TetMesh(X, [[0, 1, 2, 3]]), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(np.arange(4 - min(n_free, 3))))
    problem = scene.compile()
    if n_free == 4:
        problem = pbng.Problem(
            problem.name, problem.X, problem.groups, problem.bodies, np.zeros(4, bool), problem.prescribed,
            problem.f_ext, problem.mass,
        )  # fmt: skip
    assert (~problem.fixed).sum() == n_free
    assert against_oracle(problem, disturbed(problem, 0.3, rng)) < 1e-12


def test_plane_triangles_stay_in_their_plane(rng):
    """z never moves, to the last bit, wherever the plane is."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.rectangle((1.0, 0.7), (5, 4)), pbng.Corotated(E=1e5, nu=0.3), at=(0, 0, 0.123456789))
    scene.pin(body.where(x=0.0))
    problem = scene.compile()
    packed = pack_problem(problem, np.float64)
    flat = packed.pack(disturbed(problem, 0.2, rng))
    for _ in range(20):
        sweep(packed, flat, np.arange(packed.n_color), 1.5)
    np.testing.assert_array_equal(packed.unpack(flat)[:, 2], 0.123456789)
    assert np.ptp(packed.unpack(flat)[:, 1] - problem.X[:, 1]) > 0


def test_rest_is_left_alone():
    """Without load the rest state stays put to rounding: P(I) = 0 in the kernels as well."""
    problem = held_box(pbng.StableNeoHookean(E=1e5, nu=0.3))
    packed = pack_problem(problem, np.float64)
    flat = packed.pack(problem.X)
    sweep(packed, flat, np.arange(packed.n_color))
    np.testing.assert_allclose(packed.unpack(flat), problem.X, atol=1e-14)
