"""The stiffness of grids by cubature, and the linear systems with it."""

import numpy as np
import pytest
import scipy.linalg
from conftest import hard_start, held_box
from grids import SOFT, coarse_space, dense, free, grid_over, shaken, u_shape

import pbng
from pbng.coarse import linear
from pbng.coarse.grid import make_grid
from pbng.coarse.linear import SHIFT, GridMatrix, GridSolver, interpolation
from pbng.coarse.stiffness import Cubature


def striped_problem(held):
    """A box of 4 x 2 x 2 cubes, materials alternating along x, so that cells of two cubes are sampled in full."""
    box = pbng.shapes.box((4.0, 2.0, 2.0), (5, 3, 3))
    odd = np.floor(box.X[box.cells].mean(1)[:, 0]).astype(int) % 2 == 1
    box = pbng.TetMesh(box.X, box.cells, cell_groups={"a": ~odd, "b": odd})
    scene = pbng.Scene()
    body = scene.add(box, {"a": SOFT, "b": pbng.NeoHookean(E=2e5, nu=0.2)})
    scene.pin(body.where(x=0.0))
    return scene.compile() if held else free(scene.compile())


def cells_of_two(problem):
    """A grid of cells of 2 x 1 x 1 cubes over it, all of whose elements are sampled, and its cubature."""
    cells = np.concatenate([g.cells for g in problem.groups])
    size = np.array([[2.0, 1.0, 1.0]]) * (1 + 1e-9)
    grid = make_grid(problem.X, cells, np.zeros(problem.n_vert, int), np.zeros((1, 3)), size)
    return grid, Cubature(problem, [grid], [grid.piece], np.arange(problem.n_vert))


def flat(x):
    return np.column_stack([x, np.zeros(len(x))]).ravel()


def curvature(problem, x, U):
    """UᵀHU (3n, 3n) for interpolation U (n_vert, n), H the derivative of the forces by differences."""
    n, h = U.shape[1], 1e-5
    out = np.empty((3 * n, 3 * n))
    for c in range(n):
        for i in range(3):
            d = np.outer(U[:, c], np.eye(3)[i])
            change = (problem.forces(x - h * d) - problem.forces(x + h * d)) / (2 * h)
            out[3 * c + i] = (U.T @ change).ravel()
    return out


@pytest.mark.parametrize("held", [False, True])
def test_stiffness_is_the_hessian_of_the_energy(held):
    """UᵀHU where every element is sampled and every Hessian positive: two materials, constrained vertices left out."""
    problem = striped_problem(held)
    grid, cubature = cells_of_two(problem)
    assert len(cubature.weight) == (~problem.fixed[np.concatenate([g.cells for g in problem.groups])].all(1)).sum()
    x = shaken(problem, 1.08, 0.005)
    K = dense(cubature.evaluate(flat(x)), grid.node, grid.n_node)
    U = interpolation(grid).toarray() * ~problem.fixed[:, None]
    H = curvature(problem, x, U)
    np.testing.assert_allclose(K, H, atol=2e-5 * np.abs(H).max())


def test_stiffness_contracted_with_a_linear_displacement(rng):
    """yᵀKy is the second derivative of the energy along u = A X, for a plane body too."""
    scene = pbng.Scene()
    plate = scene.add(pbng.shapes.rectangle((1.0, 1.0), 3), SOFT)
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 2), SOFT, at=(3.0, 0.0, 0.0))
    scene.pin(plate.where(x=0.0))
    problem = free(scene.compile())
    coarse, packed = coarse_space(problem)
    assert [len(g.node) for g in coarse.grids] == [2]
    stretch = np.where(problem.X[:, 2:] + problem.X[:, :1] > 1.5, 1.1, [1.1, 1.1, 1.0])
    x = stretch * problem.X
    K = dense(coarse.cubature.evaluate(packed.pack(x)), coarse.grids[0].node, coarse.grids[0].n_node)
    for _ in range(5):
        A = rng.standard_normal((3, 3))
        A[2] *= 0  # nothing moves along z
        y, u, h = (coarse.grids[0].position @ A.T).ravel(), problem.X @ A.T, 1e-3
        second = (problem.energy(x + h * u) - 2 * problem.energy(x) + problem.energy(x - h * u)) / h**2
        assert y @ K @ y == pytest.approx(second, rel=1e-4)


def test_stiffness_of_a_free_body():
    """Without constraints: symmetric, no eigenvalue below zero, and a translation of the corners costs nothing."""
    problem = free(held_box(SOFT, (9, 5, 5)))
    coarse, packed = coarse_space(problem)
    for x in (
        problem.X,
        hard_start(problem, "scrambled"),
        hard_start(problem, "mirrored"),
        hard_start(problem, "point"),
    ):
        K = coarse.cubature.evaluate(packed.pack(x)).reshape(-1, 24, 24)
        assert np.isfinite(K).all()
        size = np.abs(K).max()
        assert size > 0
        np.testing.assert_allclose(K, K.transpose(0, 2, 1), atol=1e-14 * size)
        assert np.linalg.eigvalsh(K).min() > -1e-13 * size
        for i in range(3):
            np.testing.assert_allclose(K @ np.repeat(np.eye(3)[i], 8), 0, atol=1e-12 * size)


def test_stiffness_in_float32():
    """Positions in float32, as sweeps have them, change the stiffness by their rounding only."""
    problem = held_box(SOFT, (9, 5, 5))
    x = shaken(problem, 1.1, 0.01)
    found = []
    for dtype in (np.float32, np.float64):
        coarse, packed = coarse_space(problem, dtype)
        found.append(coarse.cubature.evaluate(packed.pack(x)).copy())
    np.testing.assert_allclose(found[0], found[1], atol=1e-5 * np.abs(found[1]).max())


def test_assembled_matrix(rng):
    """The matrix of nodes is the sum over pieces; blocks weaker than the least are raised, and inverted."""
    grid = grid_over(u_shape(), (3, 2, 2))
    B = rng.standard_normal((len(grid.node), 24, 24))
    K = (B @ B.transpose(0, 2, 1)).reshape(-1, 3, 8, 3, 8)
    expected = dense(K, grid.node, grid.n_node)
    blocks = np.einsum("ninj->nij", expected.reshape(grid.n_node, 3, grid.n_node, 3)).copy()
    mean = np.einsum("nii->n", blocks) / 3
    least = np.where(np.arange(grid.n_node) % 3 == 0, 1.5, 0.5) * mean
    expected += np.diag(np.repeat(np.maximum(least - mean, SHIFT * mean), 3))
    matrix = GridMatrix(grid.node, grid.n_node)
    matrix.assemble(K, least)
    np.testing.assert_allclose(matrix.sparse().toarray(), expected, atol=1e-12 * np.abs(expected).max())
    v = rng.standard_normal((grid.n_node, 3))
    np.testing.assert_allclose((matrix @ v).ravel(), expected @ v.ravel(), rtol=1e-10, atol=1e-10)
    blocks += np.maximum(least - mean, SHIFT * mean)[:, None, None] * np.eye(3)
    np.testing.assert_allclose(matrix.inverse.reshape(-1, 3, 3), np.linalg.inv(blocks), rtol=1e-9, atol=1e-12)


def cycle_matrix(solver, n):
    """The V-cycle as a matrix (3n, 3n), column by column."""
    return np.stack([solver.cycle(e.reshape(n, 3)).ravel() for e in np.eye(3 * n)], axis=1)


def test_cycle_is_symmetric_and_positive_definite(tower, rng):
    """What conjugate gradients ask of a preconditioner, on three levels; and it is close to the inverse."""
    coarse, _ = tower
    assert len(coarse.grids) == 3
    A = coarse.solver.matrices[0].sparse().toarray()
    C = cycle_matrix(coarse.solver, coarse.grids[0].n_node)
    np.testing.assert_allclose(C, C.T, atol=1e-12 * np.abs(C).max())
    assert np.linalg.eigvalsh(C)[0] > 0
    a, b = rng.standard_normal((2, coarse.grids[0].n_node, 3))
    left, right = np.vdot(a, coarse.solver.cycle(b)), np.vdot(coarse.solver.cycle(a), b)
    assert left == pytest.approx(right, rel=1e-10)
    eigenvalues = scipy.linalg.eigvalsh(C @ A @ C, C)  # of C A
    assert eigenvalues[-1] < 4 * eigenvalues[0]


@pytest.mark.parametrize("bottom", [0, 1300], ids=["sparse", "dense"])
def test_solve(tower, rng, monkeypatch, bottom):
    """Conjugate gradients find A⁻¹ b, whichever way the coarsest matrix is factorised."""
    coarse, _ = tower
    monkeypatch.setattr(linear, "DENSE", bottom)
    solver = GridSolver(coarse.grids)
    solver.factorise(coarse.cubature.stiffness, coarse.least)
    A = solver.matrices[0].sparse().toarray()
    b = rng.standard_normal((coarse.grids[0].n_node, 3))
    want = np.linalg.solve(A, b.ravel())
    np.testing.assert_allclose(solver.solve(b, 1e-12).ravel(), want, atol=1e-9 * np.abs(want).max())
    assert (solver.solve(0 * b, 1e-12) == 0).all()
    alone = GridSolver(coarse.grids[:1])  # the finest grid is the coarsest too: nothing but the factorisation
    alone.factorise(coarse.cubature.stiffness[: len(coarse.grids[0].node)], coarse.least[:1])
    np.testing.assert_allclose(alone.solve(b, 0.5).ravel(), want, atol=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("tolerance", [0.3, 0.1, 1e-3])
def test_solve_to_a_tolerance(tower, rng, tolerance):
    """The residual, measured by the V-cycle, falls by the tolerance; a rougher one leaves more of it."""
    coarse, _ = tower
    solver = coarse.solver
    b = rng.standard_normal((coarse.grids[0].n_node, 3))
    r = b - solver.matrices[0] @ solver.solve(b, tolerance)
    left = np.sqrt(np.vdot(r, solver.cycle(r)) / np.vdot(b, solver.cycle(b)))
    assert tolerance / 50 < left <= tolerance * (1 + 1e-9)


def test_solve_converges_as_conjugate_gradients_do(tower, rng, monkeypatch):
    """As many cycles as the condition κ of the cycle's product with the matrix says, which is by √κ, and not more."""
    coarse, _ = tower
    solver, cycle, count = coarse.solver, coarse.solver.cycle, [0]
    C, A = cycle_matrix(solver, coarse.grids[0].n_node), solver.matrices[0].sparse().toarray()
    eigenvalues = scipy.linalg.eigvalsh(C @ A @ C, C)
    root = np.sqrt(eigenvalues[-1] / eigenvalues[0])

    def counted(b, level=0):
        count[0] += level == 0
        return cycle(b, level)

    monkeypatch.setattr(solver, "cycle", counted)
    solver.solve(rng.standard_normal((coarse.grids[0].n_node, 3)), 1e-8)
    assert count[0] <= 2 + np.log(2 * root / 1e-8) / np.log((root + 1) / (root - 1))


def test_one_grid_is_solved_at_once(mixed, rng):
    """Where the finest grid is the coarsest its factorisation is exact."""
    coarse, packed = coarse_space(mixed)
    coarse.refresh(packed.pack(mixed.X))
    assert len(coarse.grids) == 1
    A, b = coarse.solver.matrices[0].sparse().toarray(), rng.standard_normal((coarse.grids[0].n_node, 3))
    residual = A @ coarse.solver.solve(b, 0.5).ravel() - b.ravel()
    assert np.linalg.norm(residual) < 1e-8 * np.linalg.norm(b)
