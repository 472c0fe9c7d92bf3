"""The coarse space: grids over the rest shape, their stiffness by cubature, the V-cycle and what it is used for."""

from dataclasses import replace

import numba
import numpy as np
import oracle
import pytest
import scipy.linalg
from conftest import hard_start, held_box
from models import polar
from scipy.sparse.csgraph import connected_components

import pbng
from pbng.coarse import linear, space
from pbng.coarse.grid import CORNERS, coarser, make_grid
from pbng.coarse.linear import SHIFT, BlockMatrix, GridSolver, interpolation
from pbng.coarse.space import CoarseSpace
from pbng.coarse.stiffness import SAMPLES, Cubature
from pbng.elements.simplex import PLANE_TRIANGLE, TET
from pbng.packing import pack_problem

SOFT = pbng.Corotated(E=1e5, nu=0.3)


def coarse_space(problem, dtype=np.float64):
    packed = pack_problem(problem, dtype)
    return CoarseSpace(problem, packed), packed


@pytest.fixture
def small_bottom(monkeypatch):
    """Grids are coarsened as far as they go, not only until a dense matrix is cheap."""
    monkeypatch.setattr(space, "DENSE", 10)


@pytest.fixture(scope="module")
def tower():
    """A box held at one side with grids of 64, 27 and 8 nodes, and the stiffness of a stretched and shaken state."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(space, "DENSE", 10)
        problem = held_box(SOFT, (12, 12, 12), (1.0, 1.0, 1.0))
        coarse, packed = coarse_space(problem)
    x = shaken(problem, 1.1, 0.01)
    coarse.refresh(packed.pack(x))
    return coarse, packed


def shaken(problem, stretch, amount):
    """Positions stretched evenly, and then each vertex moved by about ``amount`` [m]."""
    return stretch * problem.X + amount * np.random.default_rng(3).standard_normal(problem.X.shape)


def free(problem):
    """The problem without constraints, which no scene would make."""
    return replace(problem, fixed=np.zeros(problem.n_vert, bool))


def part(mesh, keep):
    """The mesh of the cells for which keep(centroid) holds."""
    cells = mesh.cells[keep(mesh.X[mesh.cells].mean(1))]
    used, number = np.unique(cells, return_inverse=True)
    return type(mesh)(mesh.X[used], number.reshape(cells.shape))


def u_shape():
    """Two legs along y at x < 2 and x > 4, joined below y = 2."""
    return part(pbng.shapes.box((6.0, 8.0, 2.0), (7, 9, 3)), lambda c: (abs(c[:, 0] - 3) > 1) | (c[:, 1] < 2))


def grid_over(mesh, size):
    """A grid over one mesh, its cells of the given size [m]."""
    return make_grid(mesh.X, mesh.cells, np.zeros(mesh.n_vert, int), np.zeros((1, 3)), np.array([size], float))


def nodes_of(grid, vertices):
    """Nodes that the vertices follow."""
    return set(grid.parents[vertices][np.abs(grid.weights[vertices]) > 1e-9].tolist())


def element_pieces(coarse):
    """For each grid the piece of each element."""
    pieces = [coarse.grids[0].piece]
    for grid in coarse.grids[1:]:
        pieces.append(grid.piece[pieces[-1]])
    return pieces


def dense(pieces, node, n_node):
    """Matrix (3 n_node, 3 n_node) of the stiffness (n, 3, 8, 3, 8) of pieces with nodes (n, 8)."""
    K = np.zeros((n_node, 3, n_node, 3))
    for k, n in zip(pieces, node):
        for i in range(3):
            for j in range(3):
                np.add.at(K, (n[:, None], i, n[None], j), k[i, :, j])
    return K.reshape(3 * n_node, 3 * n_node)


# --------------------------------------------------------------------------------------------------------- elements


@pytest.mark.parametrize("n", [3, 4])
def test_gradients_and_volumes_of_elements(n, rng):
    """Those of the oracle, for either orientation; the gradients of a triangle lie in its plane."""
    X = rng.standard_normal((50, n, 3))
    if n == 3:
        X[..., 2] = 0.7
    kind = PLANE_TRIANGLE if n == 3 else TET
    G, V = oracle.shape_gradients(X)
    np.testing.assert_allclose(kind.gradients(X), G, atol=1e-9 * np.abs(G).max())
    np.testing.assert_allclose(kind.volume(X), V, rtol=1e-12)


# ------------------------------------------------------------------------------------------------------------ grids


def turned_problem():
    """A box with its cells askew to the axes, some of them missing."""
    box = part(pbng.shapes.box((2.0, 1.0, 1.0), (19, 10, 10)), lambda c: (np.abs(c - [1, 0.5, 0.5]) > 0.2).any(1))
    turn = polar(np.random.default_rng(0).standard_normal((1, 3, 3)))[0]
    scene = pbng.Scene()
    body = scene.add(pbng.TetMesh(box.X @ turn.T, box.cells), SOFT)
    scene.pin(body.where(box.X[:, 0] == 0))
    return scene.compile()


@pytest.fixture(params=["several bodies", "turned"])
def gridded(request, mixed, small_bottom):
    problem = mixed if request.param == "several bodies" else turned_problem()
    return problem, coarse_space(problem)[0]


def test_weights_reproduce_linear_functions(gridded):
    """At every vertex: weights sum to one, their mean of the nodes' positions is the vertex, all nodes of its body."""
    problem, coarse = gridded
    grid = coarse.grids[0]
    np.testing.assert_allclose(grid.weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(
        np.einsum("vk,vki->vi", grid.weights, grid.position[grid.parents]), problem.X, atol=1e-12
    )
    body = np.repeat(np.arange(len(problem.bodies)), [b.stop - b.start for b in problem.bodies])
    np.testing.assert_array_equal(grid.body[grid.parents], np.broadcast_to(body[:, None], grid.parents.shape))
    np.testing.assert_array_equal(np.unique(grid.node), np.arange(grid.n_node))


def test_vertices_follow_the_nearest_piece(gridded):
    """Of the pieces that its elements are in, a vertex follows that whose cell holds it, or is nearest, in cells."""
    problem, coarse = gridded
    grid = coarse.grids[0]
    nearest, at = np.full(problem.n_vert, np.inf), 0
    for g in problem.groups:
        piece = grid.piece[at : at + len(g.cells), None]
        u = (problem.X[g.cells] - grid.origin[piece]) / grid.size[piece]
        np.minimum.at(nearest, g.cells, np.abs(u - u.clip(0, 1)).max(2))
        at += len(g.cells)
    u = grid.weights @ CORNERS
    np.testing.assert_allclose(np.abs(u - u.clip(0, 1)).max(1), nearest, atol=1e-12)
    assert ((nearest > 0.01).any()) == (len(problem.bodies) == 1)  # where cells of the mesh are not those of the grid


def test_corners_are_one_node_where_pieces_touch(gridded):
    """Nodes by brute force: corners at one place of pieces that have a vertex in common, and chains of such."""
    problem, coarse = gridded
    grid, at = coarse.grids[0], 0
    touching = np.zeros((len(grid.node), problem.n_vert), bool)
    for g in problem.groups:
        touching[grid.piece[at : at + len(g.cells), None], g.cells] = True
        at += len(g.cells)
    corner = (grid.origin[:, None] / grid.size[:, None] + CORNERS).reshape(-1, 3)  # of one body, whole numbers apart
    piece = np.repeat(np.arange(len(grid.node)), 8)
    same = ((touching.astype(int) @ touching.T) > 0)[piece[:, None], piece]
    for k in range(3):
        same &= np.abs(corner[:, None, k] - corner[None, :, k]) < 0.5
    n_node, node = connected_components(same)
    assert n_node == grid.n_node
    assert len(np.unique(np.stack([node, grid.node.ravel()]), axis=1).T) == n_node


def test_grids_nest(gridded):
    """Cells of the next grid are twice as large and hold those of the last; their nodes interpolate its nodes."""
    _, coarse = gridded
    for fine, wide in zip(coarse.grids, coarse.grids[1:]):
        np.testing.assert_allclose(interpolation(wide) @ wide.position, fine.position, atol=1e-12)
        np.testing.assert_allclose(wide.size[wide.piece], 2 * fine.size, rtol=1e-12)
        inside = (fine.origin - wide.origin[wide.piece]) / fine.size
        assert np.minimum(np.abs(inside), np.abs(inside - 1)).max() < 1e-6
        np.testing.assert_array_equal(wide.body[wide.parents], np.broadcast_to(fine.body[:, None], wide.parents.shape))
    if len(coarse.problem.bodies) == 1:
        assert len(coarse.grids) >= 3


def test_grids_of_a_box(small_bottom):
    """A box has one node at each corner of its cells: (6 + 1)³ for 24³ vertices, then (3 + 1)³, (2 + 1)³ and 2³."""
    coarse, _ = coarse_space(held_box(SOFT, (24, 24, 24), (1.0, 1.0, 1.0)))
    assert [g.n_node for g in coarse.grids] == [343, 64, 27, 8]
    assert [len(g.node) for g in coarse.grids] == [216, 27, 8, 1]
    for grid in coarse.grids:
        assert len(np.unique(grid.position.round(9), axis=0)) == grid.n_node


@pytest.mark.parametrize(("width", "n_node"), [(2.0, 16), (1.0, 16), (0.5, 24)])
def test_parts_that_only_touch_share_no_node(width, n_node):
    """Two boxes of one mesh with a common side but no common vertex: both in one cell, in two, in two each."""
    box = pbng.shapes.box((1.0, 1.0, 1.0), 3)
    moved = box.X + np.array([1.0, 0.0, 0.0])
    mesh = pbng.TetMesh(np.concatenate([box.X, moved]), np.concatenate([box.cells, box.cells + box.n_vert]))
    grid = grid_over(mesh, (width, 1.0, 1.0))
    assert not nodes_of(grid, mesh.component == 0) & nodes_of(grid, mesh.component == 1)
    assert grid.n_node == n_node


def test_bodies_share_no_node(rng):
    """Many bodies, more than a few bits can number, all at one place and with the same cells."""
    n, X = 40, rng.random((40, 4, 3))
    grid = make_grid(
        X.reshape(-1, 3), np.arange(4 * n).reshape(n, 4), np.repeat(np.arange(n), 4), np.zeros((n, 3)), np.ones((n, 3))
    )
    assert grid.node.shape == (n, 8)
    assert grid.n_node == 8 * n
    np.testing.assert_array_equal(grid.body[grid.parents].reshape(n, -1), np.repeat(np.arange(n), 32).reshape(n, 32))


@pytest.mark.parametrize(("size", "n_node"), [((6, 4, 2), 16), ((3, 4, 2), 20)], ids=["one cell", "two cells"])
def test_legs_share_nodes_only_where_they_are_joined(size, n_node):
    """The gap of a U is narrower than a cell: tips of the legs follow different nodes, the joint the same."""
    mesh = u_shape()
    grid = grid_over(mesh, size)
    left, right = mesh.where(x=(0, 2), y=8.0), mesh.where(x=(4, 6), y=8.0)
    assert len(left) == len(right) == 9
    assert not nodes_of(grid, left) & nodes_of(grid, right)
    low_left, low_right = mesh.where(x=(0, 2), y=4.0), mesh.where(x=(4, 6), y=4.0)
    assert nodes_of(grid, low_left) & nodes_of(grid, low_right)
    assert nodes_of(grid, left) & nodes_of(grid, mesh.where(x=(0, 2), y=7.0))
    assert grid.n_node == n_node


def test_legs_stay_apart_on_coarser_grids():
    """The coarser grid of a U is the grid of its cells, cut likewise, until legs and joint lie in one cell."""
    mesh = u_shape()
    fine = grid_over(mesh, (3, 2, 2))
    wide = coarser(fine, np.zeros((1, 3)), np.array([[3.0, 2, 2]]))
    assert (len(wide.node), wide.n_node) == (3, 16)
    left, right = nodes_of(fine, mesh.where(x=(0, 2), y=8.0)), nodes_of(fine, mesh.where(x=(4, 6), y=8.0))
    assert not nodes_of(wide, list(left)) & nodes_of(wide, list(right))
    widest = coarser(wide, np.zeros((1, 3)), np.array([[6.0, 4, 4]]))
    assert (len(widest.node), widest.n_node) == (1, 8)


# --------------------------------------------------------------------------------------------------------- cubature


def test_samples_stand_for_the_volume_of_each_piece(gridded):
    """In each piece, for each stiffness, weights sum to the volume of the elements that can move; few are drawn."""
    problem, coarse = gridded
    groups, cubature, n_piece = problem.groups, coarse.cubature, [len(g.node) for g in coarse.grids]
    volume = np.concatenate([oracle.shape_gradients(problem.X[g.cells])[1] for g in groups])
    volume *= np.concatenate([~problem.fixed[g.cells].all(1) for g in groups])
    stiff, level = np.unique(
        np.repeat([g.material.mu for g in groups], [len(g.cells) for g in groups]), return_inverse=True
    )
    expected = np.zeros((sum(n_piece), len(stiff)))
    for first, piece in zip(np.cumsum([0, *n_piece]), element_pieces(coarse)):
        np.add.at(expected, (first + piece, level), volume)
    _, sampled = np.unique(cubature.floor, return_inverse=True)  # a share of μ
    where = np.repeat(np.arange(sum(n_piece)), np.diff(cubature.start))
    found, count = np.zeros_like(expected), np.zeros(expected.shape, int)
    np.add.at(found, (where, sampled), cubature.weight)
    np.add.at(count, (where, sampled), 1)
    np.testing.assert_allclose(found, expected, atol=1e-12 * volume.sum())
    assert SAMPLES <= count.max() <= 2 * SAMPLES  # away from constraints and next to them


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


# ---------------------------------------------------------------------------------------------------- linear systems


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
    matrix = BlockMatrix(grid.node, grid.n_node)
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


# --------------------------------------------------------------------------------------------------------- direction


def force_on(problem, packed, rng):
    """A force on every free vertex, in plane ones in their plane, and NaN where nothing should look."""
    f = rng.standard_normal((problem.n_vert, 3))
    for g in problem.groups:
        if g.kind.name == "triangle":
            f[g.cells, 2] = 0
    out = np.zeros((packed.n_free // 4, 4))
    out[:, 3] = np.nan
    at = packed.slot[~problem.fixed]
    out[at, :3] = f[~problem.fixed]
    return out.ravel()


def check_direction(problem, coarse, packed, rng):
    """d = U y with UᵀHU y = Uᵀf, zero in padding; returns d (n_vert, 3), zero where constrained."""
    f, d = force_on(problem, packed, rng), np.full(packed.n_free, np.nan)
    slope = coarse.direction(f, d, 1e-12)
    rows, moves, at = d.reshape(-1, 4), ~problem.fixed, packed.slot[~problem.fixed]
    padding = np.setdiff1d(np.arange(len(rows)), at)
    assert len(padding)
    np.testing.assert_array_equal(rows[padding], 0)
    np.testing.assert_array_equal(rows[:, 3], 0)
    assert slope == pytest.approx(np.nansum(f * d), rel=1e-9)
    assert slope > 0
    U = interpolation(coarse.grids[0]).toarray()[moves]
    A = coarse.solver.matrices[0].sparse().toarray()
    y = np.linalg.solve(A, (U.T @ f.reshape(-1, 4)[at, :3]).ravel()).reshape(-1, 3)
    np.testing.assert_allclose(rows[at, :3], U @ y, atol=1e-6 * np.abs(rows).max())
    out = np.zeros((problem.n_vert, 3))
    out[moves] = rows[at, :3]
    return out


def test_direction(tower, rng):
    """On three levels: U (UᵀHU)⁻¹ Uᵀ f at free vertices, zero elsewhere; the returned slope is f·d > 0."""
    coarse, packed = tower
    check_direction(coarse.problem, coarse, packed, rng)


def test_direction_of_several_bodies(mixed, rng):
    """The same with plane bodies, several materials and one grid; plane bodies stay in their plane."""
    coarse, packed = coarse_space(mixed)
    coarse.refresh(packed.pack(mixed.X))
    d = check_direction(mixed, coarse, packed, rng)
    plane = np.concatenate([np.arange(b.start, b.stop) for b in mixed.bodies if b.mesh.cells.shape[1] == 3])
    assert (d[plane, 2] == 0).all()
    assert np.abs(d[plane, :2]).max() > 0


def test_direction_ignores_forces_across_a_plane(rng):
    """A force along z on a plane body moves nothing, and does no work."""
    scene = pbng.Scene()
    plate = scene.add(pbng.shapes.rectangle((2.0, 1.0), (17, 9)), SOFT)
    scene.pin(plate.where(x=0.0))
    problem = scene.compile()
    coarse, packed = coarse_space(problem)
    coarse.refresh(packed.pack(problem.X))
    check_direction(problem, coarse, packed, rng)
    f, d = np.zeros(packed.n_free), np.empty(packed.n_free)
    f.reshape(-1, 4)[packed.slot[~problem.fixed], 2] = 1.0
    assert coarse.direction(f, d, 1e-12) == 0
    assert (d == 0).all()


def test_direction_takes_out_a_smooth_load():
    """A bar under an even pull: one direction gains most of the energy, though few elements are sampled."""
    scene = pbng.Scene()
    bar = scene.add(pbng.shapes.box((4.0, 1.0, 1.0), (33, 9, 9)), pbng.LinearElastic(E=1e5, nu=0.0))
    scene.pin(bar.where(x=0.0))
    scene.traction(bar.where(x=4.0), (1e3, 0, 0))
    problem = scene.compile()
    coarse, packed = coarse_space(problem)
    coarse.refresh(packed.pack(problem.X))
    f, d = packed.pack(problem.f_ext)[: packed.n_free].copy(), np.empty(packed.n_free)
    slope = coarse.direction(f, d, 1e-10)
    u = np.zeros(problem.X.shape)
    u[~problem.fixed] = d.reshape(-1, 4)[packed.slot[~problem.fixed], :3]
    assert slope == pytest.approx(np.sum(problem.f_ext * u), rel=1e-9)
    equilibrium = problem.X * [0.01, 0, 0]  # strain is traction / E
    assert problem.energy(problem.X + u) < 0.8 * problem.energy(problem.X + equilibrium) < 0


# --------------------------------------------------------------------------------------------------------- extension


def stretched_bar(end=(0.0, 0.0, 0.0)):
    """A bar prescribed at both ends, and the displacements of its prescribed vertices for a displacement of one end."""
    scene = pbng.Scene()
    bar = scene.add(pbng.shapes.box((3.0, 1.0, 1.0), (25, 9, 9)), SOFT)
    scene.pin(bar.where(x=0.0))
    scene.move(bar.where(x=3.0), pbng.Translate(end))
    problem = scene.compile()
    return problem, (problem.prescribed(problem.end) - problem.X[problem.fixed])


@pytest.mark.parametrize("most", [6000, 20], ids=["finest grid", "coarser grid"])
def test_extension_of_a_translation(most, monkeypatch, small_bottom):
    """Constraints that all move alike carry the body along."""
    monkeypatch.setattr(space, "EXTENSION", most)
    problem, _ = stretched_bar()
    coarse, _ = coarse_space(problem)
    by = np.array([0.3, -0.2, 0.1])
    u = coarse.extend(np.broadcast_to(by, (problem.fixed.sum(), 3)))
    assert u.shape == (problem.n_vert, 3)
    np.testing.assert_allclose(u, np.broadcast_to(by, u.shape), atol=1e-2 * np.linalg.norm(by))


@pytest.mark.parametrize(("most", "allowed"), [(6000, 0.01), (20, 0.1)], ids=["finest grid", "coarser grid"])
def test_extension_between_two_ends(most, allowed, monkeypatch, small_bottom):
    """A bar drawn out at one end stretches nearly evenly; less so where cells reach beyond it."""
    monkeypatch.setattr(space, "EXTENSION", most)
    problem, increment = stretched_bar((0.4, 0.0, -0.2))
    coarse, _ = coarse_space(problem)
    u = coarse.extend(increment)
    want = problem.X[:, :1] / 3 * [0.4, 0.0, -0.2]
    np.testing.assert_allclose(u, want, atol=allowed * np.linalg.norm([0.4, 0.2]))


def test_extension_stays_in_its_body():
    """Other bodies, held or loose, stay; and a leg of a U moves without the other."""
    mesh = u_shape()
    scene = pbng.Scene()
    body = scene.add(mesh, SOFT)
    other = scene.add(mesh, SOFT, at=(0.5, 0.0, 0.0))
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 5), SOFT)
    scene.pin(body.where(y=0.0))
    scene.pin(other.where(y=0.0))
    scene.move(body.where(x=(0, 2), y=8.0), pbng.Translate((0.0, 0.0, 1.0)))
    problem = scene.compile()
    coarse, _ = coarse_space(problem)
    u = coarse.extend(problem.prescribed(problem.end) - problem.X[problem.fixed])
    np.testing.assert_allclose(u[mesh.n_vert :], 0, atol=1e-9)
    np.testing.assert_allclose(u[mesh.where(x=(0, 2), y=8.0)], np.broadcast_to([0, 0, 1.0], (9, 3)), atol=0.05)
    assert np.abs(u[mesh.where(x=(4, 6), y=8.0)]).max() < 0.25


# --------------------------------------------------------------------------------------------- determinism, hard cases


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")
def test_same_bits_for_one_and_two_threads(small_bottom, rng):
    """Stiffness, direction, its slope and the extension do not depend on the number of threads."""
    problem = held_box(SOFT, (24, 24, 24), (1.0, 1.0, 1.0))
    coarse, packed = coarse_space(problem)
    assert len(coarse.grids) == 4
    x, f = packed.pack(shaken(problem, 1.0, 0.02)), force_on(problem, packed, rng)
    increment = rng.standard_normal((problem.fixed.sum(), 3))
    found, before = [], numba.get_num_threads()
    try:
        for threads in (1, 2, 1):
            numba.set_num_threads(threads)
            d = np.empty(packed.n_free)
            coarse.refresh(x)
            slope = coarse.direction(f, d, 1e-6)
            found.append((coarse.cubature.stiffness.tobytes(), d.tobytes(), slope, coarse.extend(increment).tobytes()))
    finally:
        numba.set_num_threads(before)
    assert found[0] == found[1] == found[2]


def single_tet(X, pins):
    scene = pbng.Scene()
    body = scene.add(pbng.TetMesh(X, [[0, 1, 2, 3]]), SOFT)
    scene.pin(body.where(np.arange(pins)))
    return scene.compile()


def check_finite(problem, rng):
    """A direction at rest and from hard starts: finite and uphill, zero at most in rounding."""
    coarse, packed = coarse_space(problem)
    for x in (problem.X, hard_start(problem, "point"), hard_start(problem, "scrambled")):
        coarse.refresh(packed.pack(x))
        f, d = force_on(problem, packed, rng), np.full(packed.n_free, np.nan)
        slope = coarse.direction(f, d, 0.1)
        assert np.isfinite(slope)
        assert slope > 0
        assert np.isfinite(d).all()
    assert np.isfinite(coarse.extend(rng.standard_normal((problem.fixed.sum(), 3)))).all()


# Where the elements of a piece feel fewer directions than its corners have, or nothing holds a body, the sum over
# pieces is singular; a shift makes it definite.
UNIT = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])


@pytest.mark.parametrize("pins", [1, 2, 3])
def test_single_tet_along_the_axes(pins, rng):
    """Its corners are corners of the one cell; four nodes move nothing."""
    check_finite(single_tet(UNIT, pins), rng)


@pytest.mark.parametrize("pins", [1, 2, 3])
def test_single_tet(pins, rng):
    """One tet askew in its cell: 24 directions of the nodes, of which it feels nine."""
    check_finite(single_tet(np.random.default_rng(pins).random((4, 3)), pins), rng)


@pytest.mark.parametrize("seed", [22, 37, 46])
def test_thin_plate_askew(seed, rng):
    """A plate one layer of cells thick, turned: some pieces hold a few elements only."""
    box = pbng.shapes.box((1.0, 1.0, 0.1), (12, 12, 2))
    turn = polar(np.random.default_rng(seed).standard_normal((1, 3, 3)))[0]
    scene = pbng.Scene()
    body = scene.add(pbng.TetMesh(box.X @ turn.T, box.cells), SOFT)
    scene.pin(body.where(box.X[:, 0] == 0))
    check_finite(scene.compile(), rng)


def test_loose_body(rng):
    """A scene may hold a body that nothing holds (it warns); directions stay finite."""
    scene = pbng.Scene()
    held = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 5), SOFT)
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 5), SOFT, at=(3.0, 0.0, 0.0))
    scene.pin(held.where(x=0.0))
    check_finite(scene.compile(), rng)


@pytest.mark.filterwarnings("error")
def test_nothing_is_free():
    """A body all of whose vertices are prescribed has no direction, and gives no warning."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT)
    scene.pin(body.where())
    problem = scene.compile()
    coarse, packed = coarse_space(problem)
    coarse.refresh(packed.pack(problem.X))
    assert coarse.direction(np.empty(0), np.empty(0), 0.1) == 0
    by = np.random.default_rng(0).standard_normal((problem.n_vert, 3))
    assert np.isfinite(coarse.extend(by)).all()


def test_material_that_cannot_move(rng):
    """All elements of one of two materials are held: nothing is sampled of it."""
    box = pbng.shapes.box((2.0, 1.0, 1.0), (9, 5, 5))
    low = box.X[box.cells][:, :, 0].max(1) <= 1.0
    scene = pbng.Scene()
    body = scene.add(
        pbng.TetMesh(box.X, box.cells, cell_groups={"a": low, "b": ~low}),
        {"a": pbng.NeoHookean(E=1e5, nu=0.3), "b": SOFT},
    )
    scene.pin(body.where(x=(0.0, 1.0)))
    check_finite(scene.compile(), rng)
