"""Newton's method: quadratic convergence, all its linear solvers, the equilibria of other methods, honest failure."""

import os
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import STARTS, hard_start, held_box, mixed_problem, twisted_bar
from models import RootMooney, SoftVolume
from test_hessian import Fibred

import pbng
from pbng.constraints import WeakConstraints
from pbng.solvers.linear import conjugate_gradients, symmetric_gauss_seidel
from pbng.solvers.loop import run
from pbng.solvers.system import System
from pbng.stiffness import StiffnessMatrix

MODELS = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, SoftVolume, RootMooney)
LINEAR = {
    "cg": pbng.CG,
    "cg, jacobi": pbng.CG(preconditioner="jacobi"),
    "bicgstab": pbng.BiCGSTAB,
    "direct": pbng.Direct,
    "gauss-seidel": pbng.GaussSeidel(sweeps=20),
    "amg": pbng.AMG,
}


def twisted_block(n, material=None, turns=0.25):
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=n), material or pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Rotate("x", turns) + pbng.Translate((0.5, 0, 0)))
    return scene.compile()


def gravity():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    beam = scene.add(pbng.shapes.box((3.0, 1.0, 1.0), (10, 4, 4)), pbng.NeoHookean(E=1e5, nu=0.45, density=100.0))
    scene.pin(beam.where(x=0.0))
    return scene.compile()


def bound():
    """A box that springs between its vertices, and to points in space, pull at."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3), (6, 4, 4))
    free = np.flatnonzero(~problem.fixed)
    points = problem.X[free[:7]] + [0.1, 0.2, 0.0]
    springs = WeakConstraints(
        free[:7, None].astype(np.int32), np.ones((7, 1)), np.tile(1e4 * np.eye(3), (7, 1, 1)), lambda t: points
    )
    ties = np.stack([free[-5:], free[8:13]], axis=1).astype(np.int32)
    normal = np.tile(1e4 * np.diag([1.0, 0.0, 0.3]), (5, 1, 1))
    return replace(problem, weak=(springs, WeakConstraints(ties, np.tile([1.0, -1.0], (5, 1)), normal)))


SCENES = {
    "twist": lambda: twisted_block(7),
    "bar": lambda: twisted_bar().compile(),
    "gravity": gravity,
    "mixed": mixed_problem,
    "weak constraints": bound,
}


@pytest.mark.parametrize("linear", LINEAR)
def test_every_linear_solver_reaches_equilibrium(linear):
    """To 1e-10 of the first residual, all to the same state."""
    problem = twisted_block(6)
    result = pbng.solve(problem, pbng.Newton(LINEAR[linear]), pbng.Budget(rtol=1e-10, iterations=200))
    assert result.status is pbng.Status.CONVERGED
    assert result.inverted == 0
    want = pbng.solve(problem, pbng.Newton("direct"), pbng.Budget(rtol=1e-12)).x
    np.testing.assert_allclose(result.x, want, atol=1e-9)


@pytest.mark.parametrize("line_search", [True, False])
@pytest.mark.parametrize("projection", ["auto", "none", "clamp", "abs"])
def test_every_projection_reaches_equilibrium(projection, line_search):
    """On a load that is small enough for all of them."""
    problem = twisted_block(5, turns=0.02)
    solver = pbng.Newton(projection=projection, line_search=line_search)
    result = pbng.solve(problem, solver, pbng.Budget(rtol=1e-9, iterations=100))
    assert result.status is pbng.Status.CONVERGED


@pytest.mark.parametrize("model", [*MODELS, Fibred])
def test_quadratic_convergence(model):
    """With the exact Hessian and a direct solver the error squares itself, until rounding is what is left."""
    problem = twisted_block(5, model(E=1e5, nu=0.3))
    start = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-4)).x
    truth = pbng.solve(problem, pbng.Newton("direct", "none"), pbng.Budget(rtol=1e-13, iterations=12), start=start).x
    method = pbng.Newton("direct", "none", line_search=False).set_up(problem)
    method.start(start + 1e-3 * np.where(problem.fixed[:, None], 0, np.sin(20 * problem.X)))
    errors = []
    for _ in range(5):
        method.step()
        errors.append(np.abs(method.state() - truth).max())
    large = [e for e in errors if e > 1e-7]
    assert 1 <= len(large) <= 3
    for before, after in pairwise(errors):
        assert after < 30 * before**2 + 1e-10  # in units of a block of size one


@pytest.mark.parametrize("scene", SCENES)
def test_it_is_the_equilibrium_of_other_methods(scene):
    """Sweeps in float64 end in the same state, to 1e-6 of the size, wherever they get there."""
    problem = SCENES[scene]()
    got = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-10, iterations=60))
    assert got.status is pbng.Status.CONVERGED
    want = pbng.solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-9, iterations=3000))
    assert want.status is pbng.Status.CONVERGED
    np.testing.assert_allclose(got.x, want.x, atol=1e-6 * np.ptp(problem.X, axis=0).max())
    assert got.energy == pytest.approx(want.energy, rel=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_it_is_the_equilibrium_of_the_two_grid_method(model):
    problem = twisted_block(8, model(E=1e5, nu=0.3))
    got = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-10, iterations=60))
    want = pbng.solve(problem, pbng.MultigridPBNG(dtype="float64"), pbng.Budget(rtol=1e-9, iterations=100))
    assert got.status is want.status is pbng.Status.CONVERGED
    np.testing.assert_allclose(got.x, want.x, atol=1e-6)


@pytest.mark.parametrize("model", [pbng.Corotated, pbng.NeoHookean])
@pytest.mark.parametrize("kind", STARTS)
def test_the_energy_never_rises(model, kind):
    """From wild starts, with the line search: never up, and finite to the end."""
    problem = held_box(model(E=1e5, nu=0.3), vertices=(6, 5, 5))
    x = hard_start(problem, kind)
    result = pbng.solve(problem, pbng.Newton(), pbng.Budget(rtol=1e-8, iterations=60), start=x)
    assert result.status.ok
    rises = np.diff(result.energies)
    assert (rises <= 1e-12 * np.abs(result.energies[:-1]) + 1e-12 * result.energies[0]).all()
    assert result.reduction < 1e-2


def test_linear_problem_takes_one_step():
    """Linear elasticity: the first step is the last, whatever the projection."""
    problem = twisted_bar(pbng.LinearElastic(E=1e5, nu=0.3)).compile()
    for projection in ("none", "clamp", "auto"):
        result = pbng.solve(problem, pbng.Newton("direct", projection, start="previous"), pbng.Budget(rtol=1e-10))
        assert result.iterations == 1
        assert result.status is pbng.Status.CONVERGED


def test_movement_of_the_boundary_is_taken_along():
    """A rigid translation of the whole boundary is followed at once; "previous" leaves the free vertices alone."""
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=5), pbng.Corotated(E=1e5, nu=0.3))
    ends = np.concatenate([block.where(x=0.0).index, block.where(x=1.0).index])
    scene.move(block.where(np.isin(np.arange(block.mesh.n_vert), ends)), pbng.Translate((2, 1, 0)))
    problem = scene.compile()
    x = problem.constrain(problem.X, problem.end)
    method = pbng.Newton("direct").set_up(problem)
    method.start(x)
    np.testing.assert_allclose(method.prepare(problem.X, x), problem.X + np.array([2, 1, 0]), atol=1e-4)
    assert pbng.Newton(start="previous").set_up(problem).prepare(problem.X, x) is None
    assert method.prepare(x, x) is None


@pytest.mark.parametrize("linear", ["direct", "cg", "bicgstab", "gauss-seidel"])
def test_the_papers_newton_fails_honestly(linear):
    """Exact Hessian, no line search, a hard start in one step: it may diverge or run on, and says which."""
    problem = twisted_block(6, pbng.NeoHookean(E=1e5, nu=0.45), turns=0.5)
    x = hard_start(problem, "scrambled")
    solver = pbng.Newton(linear, projection="none", line_search=False)
    result = pbng.solve(problem, solver, pbng.Budget(rtol=1e-8, iterations=15), start=x)
    assert result.status in (pbng.Status.DIVERGED, pbng.Status.ITERATIONS, pbng.Status.CONVERGED)
    if result.status is not pbng.Status.DIVERGED:
        assert np.isfinite(result.x).all()


def test_divergence_is_reported():
    """What overflows ends as DIVERGED, not in an exception."""
    problem = twisted_block(5)
    x = np.where(problem.fixed[:, None], problem.X, 1e120 * problem.X)
    for linear in ("direct", "cg", "bicgstab", "gauss-seidel", "amg"):
        result = pbng.solve(problem, pbng.Newton(linear), pbng.Budget(iterations=5), start=x)
        assert result.status is pbng.Status.DIVERGED


def test_nothing_moves_that_is_fixed(rng):
    """All vertices prescribed: no unknowns, no step, and no complaint."""
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=3), pbng.Corotated(E=1e5, nu=0.3))
    scene.move(block.where(np.ones(27, bool)), pbng.Translate((1, 0, 0)))
    problem = scene.compile()
    for linear in LINEAR.values():
        method = pbng.Newton(linear).set_up(problem)
        method.start(problem.constrain(problem.X, problem.end))
        before = method.state()
        method.step()
        np.testing.assert_array_equal(method.state(), before)
    result = pbng.solve(problem, pbng.Newton(), pbng.Budget(iterations=3))
    assert result.status is pbng.Status.CONVERGED


def test_a_single_tet():
    tet = pbng.TetMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), [[0, 1, 2, 3]])
    for linear in LINEAR.values():
        scene = pbng.Scene(gravity=(0, -9.8, 0))
        body = scene.add(tet, pbng.Corotated(E=1e5, nu=0.3))
        scene.pin(body.where(np.arange(4) < 3))
        result = pbng.solve(scene, pbng.Newton(linear), pbng.Budget(rtol=1e-9, iterations=30))
        assert result.status is pbng.Status.CONVERGED


def test_backward_euler():
    """The incremental potential of a step, whose inertia is a weak constraint: Newton solves it like any other."""
    problem = gravity().dynamic(0.02)
    targets = problem.X[~problem.fixed] + [0.0, -0.01, 0.0]
    method = pbng.Newton().set_up(problem)
    result = run(method, problem.X.copy(), pbng.Budget(rtol=1e-9), targets=targets)
    assert result.status is pbng.Status.CONVERGED
    assert problem.residual(result.x, targets) <= 1.01e-9 * problem.residual(problem.X, targets)


def test_it_starts_afresh():
    """A method set up once serves any number of starts, and forgets the one before."""
    problem = twisted_block(6)
    method = pbng.Newton().set_up(problem)
    x = problem.constrain(problem.X, problem.end)
    first = run(method, x, pbng.Budget(iterations=4))
    assert method.linear_iterations > 0
    assert min(method.seconds.values()) > 0
    assert sum(method.seconds.values()) <= first.seconds
    run(method, problem.constrain(problem.X * [1, 0.5, 1], problem.end), pbng.Budget(iterations=3))
    np.testing.assert_array_equal(run(method, x, pbng.Budget(iterations=4)).x, first.x)


THREADS = """
import hashlib
import pbng
from conftest import twisted_bar
problem = twisted_bar(vertices=(14, 10, 10)).compile()
for linear in ("cg", pbng.CG(preconditioner="jacobi"), "bicgstab", "gauss-seidel"):
    digests = set()
    for threads in (1, 2, None):
        result = pbng.solve(problem, pbng.Newton(linear, threads=threads), pbng.Budget(iterations=4))
        parts = (result.x, result.residuals, result.energies)
        digests.add(hashlib.sha256(b"".join(p.tobytes() for p in parts)).hexdigest())
    print(len(digests))
"""


def test_same_bits_for_one_and_two_threads():
    tests = Path(__file__).parent
    path = os.pathsep.join([str(tests), str(tests.parent / "src"), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "NUMBA_NUM_THREADS": "2", "PYTHONPATH": path}
    out = subprocess.run([sys.executable, "-c", THREADS], env=env, capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["1"] * 4


# ------------------------------------------------------------------------------------------------ linear systems


@pytest.fixture(scope="module")
def system():
    problem = twisted_bar().compile()
    K = StiffnessMatrix(problem)
    K.fill(problem.X, "clamp")
    return System(K.matrix, K.color_start, problem.X[K.vertex])


@pytest.mark.parametrize("linear", ["cg", "cg, jacobi", "bicgstab", "direct", "amg"])
def test_linear_systems_are_solved(system, linear, rng):
    b = rng.standard_normal((len(system.matrix), 3))
    chosen = LINEAR[linear]
    solution = (chosen() if isinstance(chosen, type) else chosen).start(system).solve(b, 1e-10)
    assert not solution.indefinite
    assert np.linalg.norm(b - system.matrix @ solution.x) < 1e-7 * np.linalg.norm(b)


def test_gauss_seidel_sweeps(system, rng):
    """A sweep with ω is that of the textbook, row after row, and sweeps converge to the solution."""
    b = rng.standard_normal((len(system.matrix), 3))
    A = system.matrix.sparse().toarray()
    want = np.zeros(b.size)
    for r in range(len(b)):
        rows = slice(3 * r, 3 * r + 3)
        want[rows] += 1.3 * np.linalg.solve(A[rows, rows], b[r] - A[rows] @ want)
    got = pbng.GaussSeidel(sweeps=1).start(system).solve(b, 0.1).x
    np.testing.assert_allclose(got.ravel(), want, atol=1e-12 * np.abs(want).max())
    far = pbng.GaussSeidel(sweeps=2000).start(system).solve(b, 0.1).x
    np.testing.assert_allclose(A @ far.ravel(), b.ravel(), atol=1e-6)


def test_eisenstats_trick(system, rng):
    """It is conjugate gradients with a symmetric sweep for preconditioner, iterate by iterate, at half the price."""
    b, A = rng.standard_normal((len(system.matrix), 3)), system.matrix.sparse().toarray()
    D = np.zeros_like(A)
    for r in range(len(b)):
        rows = slice(3 * r, 3 * r + 3)
        D[rows, rows] = A[rows, rows]
    lower = np.tril(A - D) + D
    M = lower @ np.linalg.solve(D, lower.T)
    system.invert_diagonal(True)

    def precondition(r):
        return np.linalg.solve(M, r.ravel()).reshape(r.shape)

    for most in (1, 2, 5, 20):
        got = symmetric_gauss_seidel(system, b, 0.0, most).x
        want = conjugate_gradients(system.matrix, b, precondition, 0.0, most).x
        np.testing.assert_allclose(got, want, atol=1e-8 * np.abs(want).max())


@pytest.mark.parametrize("linear", ["cg", "cg, jacobi", "direct"])
def test_indefinite_matrices_are_noticed(linear, rng):
    """A squashed block has directions of negative curvature; what CG returns still points downhill."""
    problem = twisted_bar().compile()
    K = StiffnessMatrix(problem)
    K.fill(problem.X * [0.3, 1, 1])
    system = System(K.matrix, K.color_start, problem.X[K.vertex])
    assert np.linalg.eigvalsh(K.matrix.sparse().toarray())[0] < 0
    chosen = LINEAR[linear]
    b = rng.standard_normal((len(system.matrix), 3))
    solution = (chosen() if isinstance(chosen, type) else chosen).start(system).solve(b, 1e-8)
    assert solution.indefinite
    if linear != "direct":
        assert np.vdot(solution.x, b) > 0


def test_amg_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyamg", None)
    with pytest.raises(pbng.InputError, match=r"pip install 'pbng\[amg\]'"):
        pbng.Newton("amg").set_up(twisted_block(3))


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: pbng.Newton("lu"), "linear must be one of direct, cg, bicgstab, gauss-seidel, amg, not 'lu'"),
        (lambda: pbng.Newton(3), "3 is not a linear solver"),
        (lambda: pbng.Newton(projection="psd"), "projection must be one of auto, none, clamp, abs, not 'psd'"),
        (lambda: pbng.Newton(start="rest"), "start must be 'extend' or 'previous', not 'rest'"),
        (lambda: pbng.Newton(threads=99999), "Newton: threads must lie between"),
        (lambda: pbng.CG(tolerance=1.0), r"CG: tolerance must lie in \[0, 1\), not 1.0"),
        (lambda: pbng.CG(iterations=0), "CG: iterations must be a whole number of at least 1, not 0"),
        (lambda: pbng.CG(preconditioner="ilu"), "CG: preconditioner must be"),
        (lambda: pbng.BiCGSTAB(iterations=2.5), "BiCGSTAB: iterations must be a whole number"),
        (lambda: pbng.GaussSeidel(sweeps=0), "GaussSeidel: sweeps must be a whole number of at least 1, not 0"),
        (lambda: pbng.GaussSeidel(omega=2.0), "omega must lie strictly between 0 and 2, not 2.0"),
        (lambda: pbng.AMG(tolerance=-1.0), "AMG: tolerance must lie in"),
    ],
)
def test_bad_options_are_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()
