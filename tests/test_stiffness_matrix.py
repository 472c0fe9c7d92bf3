"""The stiffness matrix: against differences of forces, its pattern, and its projections against a dense oracle."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from conftest import hard_start, held_box, mixed_problem, twisted_bar
from models import RootMooney, SoftVolume
from oracle import deformation, shape_gradients
from test_hessian import Fibred

import pbng
from pbng.constraints import WeakConstraints
from pbng.elements.base import ElementKind
from pbng.elements.stiffness import check_kind
from pbng.materials.base import model_of
from pbng.materials.check import derivatives
from pbng.stiffness import FLOOR, StiffnessMatrix

ISOTROPIC = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, SoftVolume, RootMooney)
FULL = (pbng.LinearElastic, Fibred)


def shaken(problem, size, rng):
    """Positions near rest, plane bodies in their plane, prescribed vertices in place."""
    u = size * rng.standard_normal(problem.X.shape)
    u[plane(problem), 2] = 0
    return problem.constrain(problem.X + u, problem.end)


def plane(problem):
    """Which vertices are of plane bodies."""
    out = np.zeros(problem.n_vert, bool)
    for b in problem.bodies:
        out[b.start : b.stop] = isinstance(b.mesh, pbng.TriMesh)
    return out


def with_weak(problem, rng):
    """The problem with weak constraints within and between bodies, to points, of two stiffnesses and sizes."""

    def K(m):
        A = rng.standard_normal((m, 3, 3))
        return 1e4 * (A @ A.transpose(0, 2, 1))

    solid = np.flatnonzero(~plane(problem))
    between = WeakConstraints(
        np.array([rng.choice(solid, 4, replace=False) for _ in range(6)], np.int32),
        np.tile([0.4, 0.6, -0.5, -0.5], (6, 1)),
        K(6),
    )
    points = np.tile([0.3, 0.3, 0.3], (5, 1))
    fixed = WeakConstraints(solid[-5:, None].astype(np.int32), np.ones((5, 1)), K(5), lambda t: points)
    return replace(problem, weak=(between, fixed))


def differences(problem, x, u, h=1e-6):
    """∂²E/∂x∂x : u by differences of forces."""
    return -(problem.forces(x + h * u) - problem.forces(x - h * u)) / (2 * h)


@pytest.mark.parametrize("weak", [False, True])
def test_it_is_the_derivative_of_the_forces(mixed, weak, rng):
    """Tets and plane triangles, five materials, several bodies, weak constraints: along directions that are allowed."""
    problem = with_weak(mixed, rng) if weak else mixed
    x = shaken(problem, 0.02, rng)
    K = StiffnessMatrix(problem)
    K.fill(x)
    for _ in range(3):
        u = rng.standard_normal(x.shape)
        u[problem.fixed] = 0
        u[plane(problem), 2] = 0
        want = differences(problem, x, u)[K.vertex]
        got = K.matrix @ np.ascontiguousarray(u[K.vertex])
        np.testing.assert_allclose(got, want, atol=1e-7 * np.abs(want).max())


@pytest.mark.parametrize("model", [*ISOTROPIC, *FULL])
def test_at_large_strain(model, rng):
    """One body of each material, strongly deformed but not inverted."""
    problem = held_box(model(E=1e5, nu=0.3), vertices=(5, 4, 4))
    x = problem.constrain(problem.X * [1.6, 0.8, 0.7] + 0.03 * rng.standard_normal(problem.X.shape), 0.0)
    K = StiffnessMatrix(problem)
    K.fill(x)
    u = np.where(problem.fixed[:, None], 0, rng.standard_normal(x.shape))
    want = differences(problem, x, u)[K.vertex]
    np.testing.assert_allclose(K.matrix @ u[K.vertex], want, atol=1e-6 * np.abs(want).max())


def dense(problem, x, change):
    """The matrix (3 n_vert, 3 n_vert) of Hessians ∂P/∂F (n, 9, 9) that have been changed."""
    out = np.zeros((problem.n_vert, 3, problem.n_vert, 3))
    for g in problem.groups:
        G, V = shape_gradients(problem.X[g.cells])
        numbers = g.material.parameters()
        H = derivatives(model_of(type(g.material), len(numbers)), deformation(x[g.cells], G), numbers)
        H = change(H, FLOOR * g.block().a).reshape(-1, 3, 3, 3, 3)
        local = np.einsum("n,nak,nikjl,nbl->naibj", V, G, H, G, optimize=True)
        k = g.cells.shape[1]
        for a in range(k):
            for b in range(k):
                np.add.at(out, (g.cells[:, a], slice(None), g.cells[:, b]), local[:, a, :, b])
    return out.reshape(3 * problem.n_vert, 3 * problem.n_vert)


def clamped(H, floor):
    e, Q = np.linalg.eigh((H + H.transpose(0, 2, 1)) / 2)
    return (Q * np.maximum(e, floor)[:, None, :]) @ Q.transpose(0, 2, 1)


def reflected(H, floor):
    e, Q = np.linalg.eigh((H + H.transpose(0, 2, 1)) / 2)
    return (Q * np.maximum(np.abs(e), floor)[:, None, :]) @ Q.transpose(0, 2, 1)


@pytest.mark.parametrize("projection", ["clamp", "abs"])
@pytest.mark.parametrize("model", [*ISOTROPIC, Fibred])
def test_projection_is_that_of_every_element(model, projection, rng):
    """Each element's ∂P/∂F with its eigenvalues raised or reflected, assembled; some elements are inverted."""
    problem = held_box(model(E=1e5, nu=0.3), vertices=(4, 3, 3))
    x = problem.constrain(problem.X + 0.2 * rng.standard_normal(problem.X.shape), 0.0)
    assert problem.inverted(x) > 0
    K = StiffnessMatrix(problem)
    K.fill(x, projection)
    rows = (3 * K.vertex[:, None] + np.arange(3)).ravel()
    want = dense(problem, x, clamped if projection == "clamp" else reflected)[np.ix_(rows, rows)]
    np.testing.assert_allclose(K.matrix.sparse().toarray(), want, atol=1e-5 * np.abs(want).max())


def test_linear_elasticity_needs_no_projection(rng):
    """Its ∂P/∂F is positive semidefinite already, though singular: nothing is changed, not even by the floor."""
    problem = held_box(pbng.LinearElastic(E=1e5, nu=0.3))
    x = shaken(problem, 0.1, rng)
    K = StiffnessMatrix(problem)
    K.fill(x)
    exact = K.matrix.value.copy()
    K.fill(x, "clamp")
    np.testing.assert_allclose(K.matrix.value, exact, atol=1e-9 * np.abs(exact).max())


@pytest.mark.parametrize("projection", ["clamp", "abs"])
@pytest.mark.parametrize("model", [*ISOTROPIC, *FULL])
def test_projected_is_positive_definite_anywhere(model, projection):
    """From scrambled to collapsed to a point: finite, symmetric, positive definite."""
    problem = held_box(model(E=1e5, nu=0.3))
    K = StiffnessMatrix(problem)
    for kind in ("scrambled", "mirrored", "plane", "line", "point"):
        if model is RootMooney and kind == "point":  # sqrt(I1) has no derivatives there
            continue
        K.fill(hard_start(problem, kind), projection)
        A = K.matrix.sparse().toarray()
        size = np.abs(A).max()
        assert np.isfinite(A).all(), kind
        np.testing.assert_allclose(A, A.T, atol=1e-8 * size, err_msg=kind)
        assert np.linalg.eigvalsh(A)[0] > -1e-9 * size, kind


def test_plane_bodies_stay_in_their_plane(mixed, rng):
    """z of plane bodies is coupled to nothing, and stiff."""
    K = StiffnessMatrix(mixed)
    K.fill(shaken(mixed, 0.02, rng))
    A = K.matrix.sparse().toarray()
    z = 3 * np.flatnonzero(plane(mixed)[K.vertex]) + 2
    assert len(z)
    assert (np.diag(A)[z] > 0).all()
    A[z, z] = 0
    assert not A[z].any()
    assert not A[:, z].any()


def test_rows_of_a_colour_are_not_coupled(mixed, rng):
    """So that sweeps over a colour may be parallel; also with weak constraints."""
    for problem in (mixed, with_weak(mixed, rng)):
        K = StiffnessMatrix(problem)
        m = K.matrix
        color = np.searchsorted(K.color_start, np.arange(len(m)), side="right")
        row = np.repeat(np.arange(len(m)), np.diff(m.start))
        assert (row[color[row] == color[m.column]] == m.column[color[row] == color[m.column]]).all()
        np.testing.assert_array_equal(m.column[m.diagonal], np.arange(len(m)))
        assert sorted(K.vertex) == np.flatnonzero(~problem.fixed).tolist()


def test_product_is_scipys(rng):
    problem = twisted_bar().compile()
    K = StiffnessMatrix(problem)
    K.fill(shaken(problem, 0.01, rng))
    x = rng.standard_normal((len(K.matrix), 3))
    want = K.matrix.sparse() @ x.ravel()
    np.testing.assert_allclose((K.matrix @ x).ravel(), want, atol=1e-12 * np.abs(want).max())


def test_refilled_it_forgets(rng):
    """The matrix at a state does not depend on what it was filled with before; other states give other values."""
    problem = twisted_bar().compile()
    K = StiffnessMatrix(problem)
    x = shaken(problem, 0.01, rng)
    K.fill(x)
    first = K.matrix.value.copy()
    K.fill(problem.X, "abs")
    assert (K.matrix.value != first).any()
    K.fill(x)
    np.testing.assert_array_equal(K.matrix.value, first)


def test_same_bits_for_one_and_two_threads(rng):
    problem = mixed_problem() if numba.config.NUMBA_NUM_THREADS < 2 else twisted_bar(vertices=(15, 11, 11)).compile()
    K, x = StiffnessMatrix(problem), shaken(problem, 0.01, rng)
    found, before = [], numba.get_num_threads()
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS), 1):
            numba.set_num_threads(threads)
            for projection in ("none", "clamp"):
                K.fill(x, projection)
                found.append(K.matrix.value.tobytes() + (K.matrix @ x[K.vertex]).tobytes())
    finally:
        numba.set_num_threads(before)
    assert len(set(found)) == 2


def test_bad_input_is_named():
    K = StiffnessMatrix(held_box(pbng.NeoHookean(E=1e5, nu=0.3)))
    with pytest.raises(pbng.InputError, match="projection must be one of none, clamp, abs, not 'psd'"):
        K.fill(np.zeros((36, 3)), "psd")

    class Strange(ElementKind):
        name = "strange"
        width = gradients = volume = pack = sweep = energy = forces = compound_pack = compound_sweep = None

    with pytest.raises(pbng.InputError, match="elements of kind 'strange' have no Hessian"):
        check_kind(Strange())
