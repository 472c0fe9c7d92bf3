"""The two-grid method: few cycles whatever the mesh, no rise of energy, recovery from wild starts, errors to trust."""

import numpy as np
import pytest
from conftest import STARTS, hard_start, held_box, mixed_problem, twisted_bar
from models import SoftVolume, StVK

import pbng
from pbng.solvers.loop import run

DOUBLE = pbng.MultigridPBNG(dtype="float64")
MODELS = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, SoftVolume)


def twisted_block(n, material=None):
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=n), material or pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Rotate("x", 0.25) + pbng.Translate((0.5, 0, 0)))
    return scene.compile()


def reference(problem):
    return pbng.solve(problem, DOUBLE, pbng.Budget(rtol=1e-11, iterations=80)).x


@pytest.mark.parametrize("model", MODELS)
def test_cycles_do_not_grow_with_the_mesh(model):
    """A quarter turn and half the length in one step, to 1e-6: at most 12 cycles, at 8³ as at 24³ vertices."""
    budget = pbng.Budget(rtol=1e-6, iterations=40)
    results = [pbng.solve(twisted_block(n, model(E=1e5, nu=0.3)), DOUBLE, budget) for n in (8, 16, 24)]
    assert [r.status for r in results] == [pbng.Status.CONVERGED] * 3
    assert max(r.iterations for r in results) <= 12
    assert max(r.inverted for r in results) == 0


def test_it_is_the_equilibrium_that_sweeps_find():
    """Two methods with nothing in common but the sweep end in the same state."""
    problem = twisted_bar().compile()
    sweeps = pbng.solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-10, iterations=3000))
    np.testing.assert_allclose(reference(problem), sweeps.x, atol=1e-8)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("kind", STARTS)
def test_recovers_and_never_raises_the_energy(model, kind):
    """From wild starts: the energy of every cycle is no higher than before, and what is reached is rest, or at least an
    equilibrium (a tangled start may end in one that is not rest)."""
    problem = held_box(model(E=1e5, nu=0.3), vertices=(7, 6, 6))
    x = hard_start(problem, kind)
    result = pbng.solve(problem, DOUBLE, pbng.Budget(rtol=1e-9, iterations=200), start=x)
    rises = np.diff(result.energies)
    assert (rises <= 1e-12 * np.abs(result.energies[:-1]) + 1e-15 * result.energies[0]).all()
    assert result.status is pbng.Status.CONVERGED
    if result.inverted == 0:
        np.testing.assert_allclose(result.x, problem.X, atol=1e-6)


@pytest.mark.parametrize(
    ("model", "nu", "load"),
    [
        (pbng.Corotated, 0.3, "twist"),
        (pbng.NeoHookean, 0.45, "twist"),
        (pbng.StableNeoHookean, 0.3, "twist"),
        (pbng.Corotated, 0.3, "gravity"),
        (pbng.NeoHookean, 0.4, "gravity"),
    ],
)
def test_estimated_error_is_within_a_factor_of_the_true_one(model, nu, load):
    """At every cycle but the first two, above 1e-6: never more than 3 times too low; mostly within 3 both ways."""
    material = model(E=1e5, nu=nu, density=200.0)
    if load == "twist":
        problem = twisted_block(12, material)
    else:
        scene = pbng.Scene(gravity=(0, -9.8, 0))
        beam = scene.add(pbng.shapes.box((3.0, 1.0, 1.0), (25, 9, 9)), material)
        scene.pin(beam.where(x=0.0))
        problem = scene.compile()
    truth, method = reference(problem), DOUBLE.set_up(problem)
    method.start(problem.constrain(problem.X, problem.end))
    ratios = []
    for cycle in range(30):
        method.step()
        true = np.linalg.norm(method.state() - truth, axis=1).max()
        if true < 1e-6:
            break
        if cycle >= 2:
            ratios.append(method.certify().error / true)
    assert len(ratios) >= 4
    assert min(ratios) > 1 / 3
    assert np.median(ratios) < 3.5


def test_budget_of_an_error():
    """It stops once the estimate is below what was asked for, and the state is that close to equilibrium."""
    problem = twisted_block(12)
    result = pbng.solve(problem, budget=pbng.Budget(error=1e-4))
    assert result.status is pbng.Status.CONVERGED
    assert 3 * result.error <= 1e-4
    assert np.linalg.norm(result.x - reference(problem), axis=1).max() <= 1e-4


def test_sweeps_have_no_estimate():
    problem = twisted_block(5)
    assert np.isnan(pbng.solve(problem, pbng.PBNG(), pbng.Budget(iterations=3)).error)
    with pytest.raises(pbng.InputError, match="no estimate of the error; use MultigridPBNG"):
        pbng.solve(problem, pbng.PBNG(), pbng.Budget(error=1e-3))


def test_auto_finishes_in_float64():
    """float32 stops at its floor and says so; "auto" goes on to what is asked for, in a handful of cycles more."""
    problem, budget = twisted_block(10), pbng.Budget(rtol=1e-10, iterations=60)
    single = pbng.solve(problem, pbng.MultigridPBNG(dtype="float32"), budget)
    assert single.status is pbng.Status.PRECISION
    assert single.x.dtype == np.float32
    auto = pbng.solve(problem, pbng.MultigridPBNG(), budget)
    assert auto.status is pbng.Status.CONVERGED
    assert auto.x.dtype == np.float64
    sweeps = pbng.solve(problem, pbng.PBNG(dtype="auto"), pbng.Budget(rtol=1e-9, iterations=2000))
    assert sweeps.status is pbng.Status.CONVERGED


@pytest.mark.parametrize("motion", ["twist", "translate"])
def test_extended_start(motion):
    """Moving the whole boundary rigidly moves the body; otherwise the extended start has the lower energy."""
    if motion == "twist":
        problem = twisted_block(10)
    else:
        scene = pbng.Scene()
        block = scene.add(pbng.shapes.box(vertices=6), pbng.Corotated(E=1e5, nu=0.3))
        ends = block.where(x=0.0).index, block.where(x=1.0).index
        scene.move(block.where(np.isin(np.arange(block.mesh.n_vert), np.concatenate(ends))), pbng.Translate((2, 1, 0)))
        problem = scene.compile()
    method = DOUBLE.set_up(problem)
    x = problem.constrain(problem.X, problem.end)
    better = method.prepare(problem.X, x)
    np.testing.assert_array_equal(better[problem.fixed], x[problem.fixed])
    assert problem.energy(better) < problem.energy(x)
    if motion == "translate":
        np.testing.assert_allclose(better, problem.X + np.array([2, 1, 0]), atol=0.02)
    assert pbng.MultigridPBNG(start="previous").set_up(problem).prepare(problem.X, x) is None


def test_frames_start_from_the_frame_before():
    """Frames of a slow motion take fewer cycles than their poses do from rest, and are as good."""
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box(vertices=9), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(block.where(x=0.0))
    scene.move(block.where(x=1.0), pbng.Rotate("x", 0.25) + pbng.Translate((0.5, 0, 0)), over=0.2)
    problem = scene.compile()
    frames = list(pbng.simulate(problem, DOUBLE, pbng.Budget(rtol=1e-4), frames=7, fps=30))
    last = frames[-1]
    direct = pbng.solve(problem, DOUBLE, pbng.Budget(rtol=1e-8), at=last.t)
    np.testing.assert_allclose(last.x, direct.x, atol=1e-4)
    assert all(f.result.status is pbng.Status.CONVERGED for f in frames)


def test_several_bodies_materials_and_kinds():
    """Tets and plane triangles, five materials, two bodies of each, under load; plane bodies stay in their plane."""
    problem = mixed_problem()
    result = pbng.solve(problem, DOUBLE, pbng.Budget(rtol=1e-8, iterations=100))
    assert result.status is pbng.Status.CONVERGED
    for body in problem.bodies:
        if isinstance(body.mesh, pbng.TriMesh):
            np.testing.assert_array_equal(result.x[body.start : body.stop, 2], body.mesh.X[:, 2])


@pytest.mark.parametrize("contrast", [1e2, 1e4])
def test_stiff_and_soft_halves(contrast):
    """A bar, one half of it stiffer than the other."""
    mesh = pbng.shapes.box((3.0, 1.0, 1.0), (19, 7, 7))
    soft = mesh.X[mesh.cells].mean(1)[:, 0] < 1.5
    mesh = pbng.TetMesh(mesh.X, mesh.cells, cell_groups={"soft": soft, "stiff": ~soft})
    scene = pbng.Scene()
    materials = {"soft": pbng.Corotated(E=1e4, nu=0.3), "stiff": pbng.Corotated(E=1e4 * contrast, nu=0.3)}
    bar = scene.add(mesh, materials)
    scene.pin(bar.where(x=0.0))
    scene.move(bar.where(x=3.0), pbng.Rotate("x", 0.25) + pbng.Translate((1.0, 0, 0)))
    result = pbng.solve(scene, budget=pbng.Budget(rtol=1e-6, iterations=60))
    assert result.status is pbng.Status.CONVERGED


@pytest.mark.parametrize("pinned", [1, 3])
def test_a_single_tet(pinned):
    """One element under gravity, hung by one vertex or by three."""
    tet = pbng.TetMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]), [[0, 1, 2, 3]])
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = scene.add(tet, pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(np.arange(4) < pinned))
    result = pbng.solve(scene, DOUBLE, pbng.Budget(rtol=1e-8, iterations=60))
    assert result.status is pbng.Status.CONVERGED
    assert result.energy < 0


def test_method_is_reused():
    """A method set up once serves any number of starts, and forgets the one before."""
    problem = twisted_block(8)
    method = DOUBLE.set_up(problem)
    x = problem.constrain(problem.X, problem.end)
    first = run(method, x, pbng.Budget(iterations=4))
    run(method, problem.constrain(problem.X * [1, 0.5, 1], problem.end), pbng.Budget(iterations=3))
    np.testing.assert_array_equal(run(method, x, pbng.Budget(iterations=4)).x, first.x)


def test_divergence_is_reported():
    """A start that overflows ends as DIVERGED, not in an exception of the linear algebra."""
    problem = twisted_block(6)
    x = np.where(problem.fixed[:, None], problem.X, 1e30 * problem.X)
    result = pbng.solve(problem, pbng.MultigridPBNG(dtype="float32"), pbng.Budget(iterations=5), start=x)
    assert result.status is pbng.Status.DIVERGED


def test_default_solver():
    """An accuracy is solved for by two grids, an amount of work is spent on sweeps."""
    assert isinstance(pbng.default_solver(pbng.Budget(rtol=1e-3)), pbng.MultigridPBNG)
    assert isinstance(pbng.default_solver(pbng.Budget(error=1e-3, seconds=1)), pbng.MultigridPBNG)
    assert isinstance(pbng.default_solver(pbng.Budget(iterations=6)), pbng.PBNG)
    assert isinstance(pbng.default_solver(pbng.Budget(seconds=0.02)), pbng.PBNG)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: pbng.MultigridPBNG(sweeps=0), "sweeps must be a whole number of at least 1, not 0"),
        (lambda: pbng.MultigridPBNG(memory=-1), "memory must be a whole number of at least 0, not -1"),
        (lambda: pbng.MultigridPBNG(omega=2.0), "omega must lie strictly between 0 and 2"),
        (lambda: pbng.MultigridPBNG(start="rest"), "start must be 'extend' or 'previous', not 'rest'"),
        (lambda: pbng.MultigridPBNG(dtype="half"), "MultigridPBNG: dtype must be"),
        (lambda: pbng.MultigridPBNG(threads=99999), "MultigridPBNG: threads must lie between"),
        (lambda: pbng.Budget(error=-1.0), "error must be finite and at least 0"),
    ],
)
def test_bad_options_are_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()


@pytest.mark.parametrize("solver", [pbng.PBNG(), pbng.PBNG(dtype="float64"), pbng.MultigridPBNG()])
@pytest.mark.parametrize("start", ["rest", *STARTS])
def test_blocks_that_do_not_bound_the_energy(solver, start):
    """Of a quartic energy no two numbers do: sweeps raise it, and are then relaxed until they do not."""
    problem = twisted_bar(StVK(E=1e5, nu=0.3)).compile()
    x = problem.X if start == "rest" else hard_start(problem, start)
    result = pbng.solve(problem, solver, pbng.Budget(rtol=1e-4, iterations=1500), start=x)
    assert result.status is pbng.Status.CONVERGED
