"""Energy and forces of the discrete problem (design test 3)."""

from dataclasses import replace

import numpy as np
import oracle
import pytest
from conftest import hard_start, held_box
from models import RootMooney, SoftVolume, oracle_stress

import pbng

OBJECTIVE = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, SoftVolume, RootMooney)


def in_plane(problem, field):
    """The field without z components on the vertices of plane domains."""
    out = np.array(field, float)
    for group in problem.groups:
        if group.kind.name == "triangle":
            out[group.cells, 2] = 0
    return out


def test_forces_are_the_gradient_of_the_energy(mixed, rng):
    """f + f_ext = -∂E/∂x of Eqs. (11)-(17), by differences along random directions, near rest and far from it."""
    for amount in (0.01, 0.2):
        x = mixed.X + in_plane(mixed, amount * rng.standard_normal(mixed.X.shape))
        f = mixed.forces(x) + mixed.f_ext
        for _ in range(5):
            d = in_plane(mixed, rng.standard_normal(x.shape))
            slope = oracle.energy_gradient(mixed.energy, x, d, 1e-5)
            assert slope == pytest.approx(-np.sum(f * d), abs=1e-9 * np.linalg.norm(f) * np.linalg.norm(d))


def test_forces_are_the_oracles(mixed, rng):
    """f_i = -Σ_e V_e P g_i, vertex by vertex, prescribed ones included."""
    x = mixed.X + in_plane(mixed, 0.1 * rng.standard_normal(mixed.X.shape))
    expected = np.zeros_like(x)
    for group in mixed.groups:
        G, V = oracle.shape_gradients(mixed.X[group.cells])
        P = oracle_stress(group.material, oracle.deformation(x[group.cells], G))
        np.add.at(expected, group.cells, -np.einsum("n,nij,naj->nai", V, P, G))
    np.testing.assert_allclose(mixed.forces(x), expected, atol=1e-12 * np.abs(expected).max())
    free = ~mixed.fixed
    assert mixed.residual(x) == pytest.approx(np.linalg.norm((expected + mixed.f_ext)[free]), rel=1e-12)


@pytest.mark.parametrize("model", OBJECTIVE)
def test_forces_balance(model, rng):
    """Without load Σ f = 0 and Σ x × f = 0: internal forces neither push nor turn a body."""
    problem = held_box(model(E=1e5, nu=0.3))
    x = problem.X + 0.2 * rng.standard_normal(problem.X.shape)
    f = problem.forces(x)
    size = np.abs(f).sum()
    np.testing.assert_allclose(f.sum(0), 0, atol=1e-14 * size)
    np.testing.assert_allclose(np.cross(x, f).sum(0), 0, atol=1e-14 * size)


@pytest.mark.parametrize("model", OBJECTIVE)
def test_rigid_motions_cost_nothing(model, rng):
    """E = 0 and f = 0 at rest and after a rotation and a translation."""
    problem = held_box(model(E=1e5, nu=0.3))
    Q = pbng.Rotate((1, 2, -0.5), 0.37).linear(1.0)
    for x in (problem.X, problem.X @ Q.T + [3.0, -2.0, 1.0]):
        assert problem.energy(x) == pytest.approx(0, abs=1e-9)  # of an E V = 5e4 J
        np.testing.assert_allclose(problem.forces(x), 0, atol=1e-8)
        assert problem.inverted(x) == 0


def test_energy_is_the_sum_over_elements(rng):
    """E = Σ V_e Ψ(F_e) (17), for corotated with an SVD: μ Σ(σ - 1)² + λ/2 (J - 1)²."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    x = problem.X + 0.2 * rng.standard_normal(problem.X.shape)
    (group,) = problem.groups
    G, V = oracle.shape_gradients(problem.X[group.cells])
    F = oracle.deformation(x[group.cells], G)
    s, J, m = np.linalg.svd(F)[1], np.linalg.det(F), group.material
    s[:, 2] *= np.sign(J)
    expected = V @ (m.mu * ((s - 1) ** 2).sum(1) + m.lam / 2 * (J - 1) ** 2)
    assert problem.energy(x) == pytest.approx(expected, rel=1e-12)
    assert problem.inverted(x) == np.count_nonzero(J < 0) > 0


@pytest.mark.parametrize("start", ["mirrored", "plane"])
def test_inverted_counts_negative_determinants(start):
    """det F < 0 counts; det F = 0 does not."""
    problem = held_box(pbng.NeoHookean(E=1e5, nu=0.3))
    problem = replace(problem, fixed=np.zeros(problem.n_vert, bool))
    x = hard_start(problem, start)
    assert problem.inverted(x) == (problem.n_elem if start == "mirrored" else 0)


def test_weight_and_mass():
    """Masses sum to density times volume, in shares V/4 of each tet; gravity's force to mass times gravity (16)."""
    scene = pbng.Scene(gravity=(0.0, -9.8, 0.0))
    body = scene.add(pbng.shapes.box((2.0, 1.0, 0.5), (4, 3, 3)), pbng.Corotated(E=1e5, nu=0.3, density=12.0))
    scene.pin(body.where(x=0.0))
    problem = scene.compile()
    assert problem.mass.sum() == pytest.approx(12.0)
    assert (problem.mass > 0).all()
    np.testing.assert_allclose(problem.f_ext, problem.mass[:, None] * [0, -9.8, 0])


def test_force_total():
    """A force [N] is spread evenly over the selection and sums to what was asked, loads adding up."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((2.0, 1.0, 0.5), (4, 3, 3)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    end = body.where(x=2.0)
    scene.force(end, (1.0, 2.0, 3.0))
    scene.force(end, (1.0, 0.0, 0.0))
    f = scene.compile().f_ext
    np.testing.assert_allclose(f[end.index], np.tile([2 / 9, 2 / 9, 3 / 9], (9, 1)))
    np.testing.assert_allclose(f.sum(0), [2, 2, 3])


def test_traction_total_and_centre():
    """A traction [N/m²] sums to traction times area, and acts at the face's centroid."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((2.0, 1.0, 0.5), (4, 5, 3)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    scene.traction(body.where(x=2.0), (100.0, 0.0, -40.0))
    problem = scene.compile()
    f = problem.f_ext
    np.testing.assert_allclose(f.sum(0), [50, 0, -20])
    np.testing.assert_allclose(f[:, 0] @ problem.X / f[:, 0].sum(), [2.0, 0.5, 0.25])
    assert np.count_nonzero(f[:, 0]) == 15
    assert (f[problem.X[:, 0] < 2.0] == 0).all()


def test_traction_in_the_plane():
    """Edges of the boundary take the place of triangles: traction [N/m] times length, half at each end."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.rectangle((2.0, 1.0), (4, 5)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    scene.traction(body.where(x=2.0), (8.0, 0.0, 0.0))
    f = scene.compile().f_ext[body.where(x=2.0).index]
    np.testing.assert_allclose(f[:, 0], [1, 2, 2, 2, 1])


def test_traction_needs_a_whole_face():
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box(1.0 * np.ones(3), 3), pbng.Corotated(E=1e5, nu=0.3))
    with pytest.raises(pbng.InputError, match="no whole face of the surface is selected"):
        scene.traction(body.where(x=1.0, y=1.0), (1.0, 0.0, 0.0))


def test_load_enters_the_energy(rng):
    """E(x) = elastic - f_ext · (x - X) (17): zero at rest."""
    problem = held_box(pbng.Corotated(E=1e5, nu=0.3))
    loaded = replace(problem, f_ext=rng.standard_normal(problem.X.shape))
    x = problem.X + 0.1 * rng.standard_normal(problem.X.shape)
    assert loaded.energy(problem.X) == pytest.approx(0, abs=1e-12)
    assert problem.energy(x) - loaded.energy(x) == pytest.approx(np.sum(loaded.f_ext * (x - problem.X)))


def test_planes_have_no_force_across(mixed, rng):
    """Plane strain: nothing acts along z on a plane domain."""
    x = mixed.X + in_plane(mixed, 0.1 * rng.standard_normal(mixed.X.shape))
    plane = np.unique(np.concatenate([g.cells.ravel() for g in mixed.groups if g.kind.name == "triangle"]))
    assert len(plane) > 20
    np.testing.assert_array_equal(mixed.forces(x)[plane, 2], 0)


def test_load_across_a_plane_does_not_move_it():
    """z never moves: gravity along z, the habit of half the world, has no effect in plane strain."""
    scene = pbng.Scene(gravity=(0.0, 0.0, -9.8))
    body = scene.add(pbng.shapes.rectangle((1.0, 0.7), (5, 4)), pbng.Corotated(E=1e5, nu=0.3))
    scene.pin(body.where(x=0.0))
    result = pbng.solve(scene, pbng.PBNG(dtype="float64"), pbng.Budget(iterations=10))
    np.testing.assert_array_equal(result.x[:, 2], 0)


def test_positions_of_the_wrong_shape(mixed):
    with pytest.raises(pbng.InputError, match=r"positions must have shape \(116, 3\), not \(5, 3\)"):
        mixed.energy(np.zeros((5, 3)))


def test_constrain_copies(mixed):
    """Prescribed vertices go where they belong; the argument is not written to."""
    x = np.zeros(mixed.X.shape)
    y = mixed.constrain(x, 0.0)
    assert not x.any()
    np.testing.assert_array_equal(y[mixed.fixed], mixed.X[mixed.fixed])
    assert not y[~mixed.fixed].any()


def test_components(mixed):
    """Four bodies hang together in four parts."""
    assert mixed.component.max() == 3
    for label, body in enumerate(mixed.bodies):
        assert (mixed.component[body.start : body.stop] == label).all()
