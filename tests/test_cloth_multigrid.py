"""The two-grid cycle on cloth: its Hessian, its equilibria, cycles that do not grow, errors to trust, mixed scenes."""

import numba
import numpy as np
import pytest
from grids import coarse_space
from test_cloth import BENDINGS, CLOTH, bumpy, crumpled, hung, wardrobe

import pbng
from pbng.coarse.cloth import FLOOR, Restriction
from pbng.elements.cloth_stiffness import ClothStiffness
from pbng.solvers.loop import run

DOUBLE = pbng.MultigridPBNG(dtype="float64")
HEAVY = pbng.Membrane(E=1e3, nu=0.3, density=10.0)


def sheet(n, held="corners", bending=None, material=HEAVY):
    """A level sheet of 1 by 1 under gravity, held by two corners or at its rim, or drawn out and turned at one end."""
    scene = pbng.Scene(gravity=(0, 0 if held == "ends" else -9.8, 0))
    mesh = pbng.shapes.sheet((1.0, 1.0), n, (0.0, 0.0, -0.5))
    body = scene.add(mesh, material, bending)
    x, z = mesh.X[:, 0], 2 * np.abs(mesh.X[:, 2])
    if held == "corners":
        scene.pin(body.where((z == 1.0) & (x == 0.0)))
    elif held == "rim":
        scene.pin(body.where((z == 1.0) | (np.abs(2 * x - 1) == 1.0)))
    else:
        scene.pin(body.where(x=0.0))
        scene.move(body.where(x=1.0), pbng.Rotate("x", 0.1) + pbng.Translate((0.2, 0, 0)))
    return scene.compile()


def dense(keys, value, n):
    out = np.zeros((n, 3, n, 3))
    out[keys // n, :, keys % n, :] = value.reshape(-1, 3, 3)
    return out


@pytest.mark.parametrize("bending", [None, BENDINGS[3]])
@pytest.mark.parametrize("amount", [0.0, 0.03, 0.3])
def test_hessian_of_cloth(bending, amount):
    """Of membranes that of Newton's method, exact and with eigenvalues raised; of hinges w k g gᵀ of both."""
    problem = hung(bending, bumpy())
    coarse, packed = coarse_space(problem)
    n, free = coarse.n_node, np.flatnonzero(~problem.fixed)
    assert n == len(free)
    x = crumpled(problem, amount) * [1.1, 1.0, 0.95]
    own = np.full(problem.n_vert, n)
    own[free] = np.arange(n)
    definite, exact = coarse.cloth.evaluate(packed.pack(x))
    for found, projection in ((definite, "clamp"), (exact, "none")):
        want = np.zeros((n + 1, 3, n + 1, 3))
        for group in problem.groups:
            if group.kind.name == "hinge":
                g = group.kind.gradients(x[group.cells])
                K = np.einsum("n,nai,ncj->nacij", group.material.k * group.kind.volume(problem.X[group.cells]), g, g)
            else:
                K = ClothStiffness(group, problem.X).evaluate(x, projection, FLOOR)
            for cells, block in zip(own[group.cells], K):
                want[np.ix_(cells, range(3), cells, range(3))] += block.transpose(0, 2, 1, 3)
        want, got = want[:n, :, :n], dense(coarse.cloth.keys, found, n)
        np.testing.assert_allclose(got, want, atol=1e-5 * np.abs(want).max())
    assert np.linalg.eigvalsh(dense(coarse.cloth.keys, definite, n).reshape(3 * n, -1))[0] > -1e-9 * np.abs(want).max()


@pytest.mark.parametrize("kind", ["flat", "collapsed", "line", "point"])
def test_hessian_where_cloth_is_degenerate(kind):
    """Finite, and no eigenvalue below zero."""
    problem = hung(BENDINGS[0], bumpy())
    coarse, packed = coarse_space(problem)
    turn = {"flat": [1, 0, 1], "collapsed": [1e-9, 1e-9, 1e-9], "line": [1, 0, 0], "point": [0, 0, 0]}[kind]
    n = coarse.n_node
    definite, exact = coarse.cloth.evaluate(packed.pack(problem.X * turn))
    assert np.isfinite(exact).all()
    K = dense(coarse.cloth.keys, definite, n).reshape(3 * n, -1)
    np.testing.assert_allclose(K, K.T, atol=1e-9 * np.abs(K).max())
    assert np.linalg.eigvalsh(K)[0] > -1e-9 * np.abs(K).max()


def test_restriction(rng):
    """RᵀKR, level after level."""
    coarse, packed = coarse_space(sheet(14))
    keys, n = coarse.cloth.keys, coarse.n_node
    value = coarse.cloth.evaluate(packed.pack(coarse.problem.X))[0]
    for restriction, R in zip(coarse.solver.restrictions, coarse.solver.up):
        assert isinstance(restriction, Restriction)
        R, m = R.toarray(), R.shape[1]
        want = np.einsum("ni,nakb,kj->iajb", R, dense(keys, value, n), R, optimize=True)
        value, keys, n = restriction(value), restriction.keys, m
        assert (np.diff(keys) > 0).all()
        np.testing.assert_allclose(dense(keys, value, n), want, atol=1e-12 * np.abs(want).max())


def test_direction_beside_solids(rng):
    """On all levels at once: d = U (UᵀHU)⁻¹ Uᵀ f, plane bodies in their plane, and f·d > 0."""
    problem = wardrobe()
    coarse, packed = coarse_space(problem)
    x = problem.X * [1.05, 1.02, 1.0]
    coarse.refresh(packed.pack(x))
    coarse.wait = 99  # not the exact Hessian
    f, d = np.zeros((packed.n_free // 4, 4)), np.full(packed.n_free, np.nan)
    free = np.flatnonzero(~problem.fixed)
    force = rng.standard_normal((len(free), 3))
    plane = next(g for g in problem.groups if g.kind.name == "triangle").cells
    force[np.isin(free, plane), 2] = 0
    f[packed.slot[free], :3] = force
    slope = coarse.direction(f.ravel(), d, 1e-12)
    U, A = coarse.up.toarray()[packed.slot[free]], coarse.solver.matrices[0].sparse().toarray()
    y = np.linalg.solve(A, (U.T @ force).ravel()).reshape(-1, 3)
    found = d.reshape(-1, 4)[packed.slot[free], :3]
    np.testing.assert_allclose(found, U @ y, atol=1e-5 * np.abs(found).max())
    assert slope == pytest.approx((force * found).sum(), rel=1e-9)
    assert (found[np.isin(free, plane), 2] == 0).all()


@pytest.mark.parametrize(("held", "most"), [("corners", 30), ("rim", 12)])
def test_cycles_do_not_grow_with_the_mesh(held, most):
    """From level, with stiffness against bending, to 1e-6."""
    found = []
    for n in (16, 32, 48):
        result = pbng.solve(sheet(n, held, pbng.Bending(0.05)), DOUBLE, pbng.Budget(rtol=1e-6, iterations=60))
        assert result.status is pbng.Status.CONVERGED
        found.append(result.iterations)
    assert max(found) <= most


@pytest.mark.parametrize("bending", [None, pbng.Bending(0.05), pbng.Bending(1e-3, weighted=True)])
@pytest.mark.parametrize("held", ["corners", "rim"])
def test_equilibrium_is_that_of_newtons_method(held, bending):
    """To 1e-6, each from level."""
    problem = sheet(12, held, bending)
    found = [pbng.solve(problem, s, pbng.Budget(rtol=1e-10, iterations=300)) for s in (DOUBLE, pbng.Newton())]
    assert [r.status for r in found] == [pbng.Status.CONVERGED] * 2
    np.testing.assert_allclose(found[0].x, found[1].x, atol=1e-6)


def test_energy_never_rises():
    """From level, crumpled and scrambled starts."""
    problem = sheet(12, "corners", BENDINGS[3])
    rng = np.random.default_rng(1)
    for amount in (0.0, 0.05, 1.0):
        x = problem.constrain(problem.X + amount * rng.standard_normal(problem.X.shape), 0.0)
        result = pbng.solve(problem, DOUBLE, pbng.Budget(rtol=1e-8, iterations=200), start=x)
        assert result.status is pbng.Status.CONVERGED
        assert (np.diff(result.energies) <= 1e-12 * np.abs(result.energies[:-1])).all()


@pytest.mark.parametrize(
    ("held", "bending"), [("corners", pbng.Bending(0.05)), ("corners", None), ("rim", pbng.Bending(0.05))]
)
def test_estimated_error(held, bending):
    """Never more than 3 times too low where the true one is below a fiftieth of the sheet."""
    problem = sheet(16, held, bending)
    method = DOUBLE.set_up(problem)
    method.start(problem.X)
    states, estimates = [], []
    first = method.certify().residual
    for _ in range(100):
        method.step()
        certificate = method.certify()
        states.append(method.state())
        estimates.append(certificate.error)
        if certificate.residual < 1e-10 * first:
            break
    true = np.array([np.linalg.norm(x - states[-1], axis=1).max() for x in states])
    seen = (true > 1e-7) & (true < 0.02)
    assert seen.sum() >= 2
    assert (np.array(estimates) / np.maximum(true, 1e-300))[seen].min() > 1 / 3


def test_sheet_drawn_out_and_turned():
    """Prescribed ends: the start extends their movement, and a few cycles do."""
    problem = sheet(24, "ends", pbng.Bending(1e-2))
    method = DOUBLE.set_up(problem)
    x = problem.constrain(problem.X, problem.end)
    better = method.prepare(problem.X, x)
    assert problem.energy(better) < 0.1 * problem.energy(x)
    result = pbng.solve(problem, budget=pbng.Budget(rtol=1e-4, iterations=30))
    assert result.status is pbng.Status.CONVERGED


def test_block_hung_on_a_sheet():
    """A block tied to the free edge of a sheet: both are corrected, and Newton's method ends as low (one movement, by
    which the block swings, costs nothing)."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    block = scene.add(
        pbng.shapes.box((0.3, 0.3, 0.3), 6), pbng.Corotated(E=2e5, nu=0.3, density=100.0), at=(1, -0.15, 0)
    )
    mesh = pbng.shapes.sheet((1.0, 0.3), (13, 5))
    cloth = scene.add(mesh, pbng.Membrane(E=5e3, nu=0.3, density=1.0), pbng.Bending(0.05))
    scene.pin(cloth.where(x=0.0))
    scene.bind(cloth.where(x=1.0), block, k=1e5)
    problem = scene.compile()
    found = [pbng.solve(problem, s, pbng.Budget(rtol=1e-9, iterations=300)) for s in (DOUBLE, pbng.Newton())]
    assert [r.status for r in found] == [pbng.Status.CONVERGED] * 2
    assert found[0].energy == pytest.approx(found[1].energy, rel=1e-10)


def test_sheet_falls_on_a_ball():
    """With contact, backward Euler: steps converge to one state whatever is asked for, no higher than sweeps end."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    mesh = pbng.shapes.sheet((1.0, 1.0), 12, (-0.5, 0.02, -0.5))
    scene.add(mesh, pbng.Membrane(E=500.0, nu=0.3, density=0.2), pbng.Bending(1e-3))
    scene.collide_with(pbng.Sphere((0.0, -0.3, 0.0), 0.3, thickness=0.01))
    problem = scene.compile(free=True)
    runs = []
    for solver, rtol in ((DOUBLE, 1e-5), (DOUBLE, 1e-8), (pbng.PBNG(dtype="float64"), 1e-5)):
        budget = pbng.Budget(rtol=rtol, iterations=600)
        runs.append(list(pbng.simulate(problem, solver, budget, frames=4, fps=30, inertia=True)))
    assert all(f.result.status is pbng.Status.CONVERGED for f in runs[0][1:] + runs[1][1:])
    np.testing.assert_allclose(runs[0][-1].x, runs[1][-1].x, atol=1e-3)
    np.testing.assert_allclose(runs[1][1].x, runs[2][1].x, atol=1e-5)  # still in the air
    assert runs[1][-1].result.energy <= runs[2][-1].result.energy


@pytest.mark.parametrize("dt", [1 / 60, 1 / 240])
def test_inertia(dt):
    """A step takes a few cycles."""
    frames = pbng.simulate(
        sheet(24), pbng.MultigridPBNG(), pbng.Budget(rtol=1e-4, iterations=40), frames=6, fps=1 / dt, inertia=True
    )
    assert max(f.result.iterations for f in frames) <= 8


def test_method_is_reused():
    """A method set up once forgets the solve before."""
    problem = sheet(12, "corners", BENDINGS[3])
    method = DOUBLE.set_up(problem)
    first = run(method, problem.X, pbng.Budget(iterations=6))
    run(method, problem.X * [1, 1, 0.5], pbng.Budget(iterations=9))
    np.testing.assert_array_equal(run(method, problem.X, pbng.Budget(iterations=6)).x, first.x)


def test_nothing_is_free():
    """Cloth all of whose vertices are prescribed."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.sheet(vertices=4), CLOTH, BENDINGS[0])
    scene.pin(body.where())
    problem = scene.compile()
    assert pbng.solve(problem, pbng.MultigridPBNG()).status is pbng.Status.CONVERGED


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")
def test_same_bits_for_one_and_two_threads():
    problem = sheet(32, "corners", BENDINGS[3])
    found = []
    for threads in (1, 2):
        result = pbng.solve(problem, pbng.MultigridPBNG(threads=threads), pbng.Budget(iterations=12))
        found.append((result.x.tobytes(), result.error, result.energy))
    assert found[0] == found[1]
