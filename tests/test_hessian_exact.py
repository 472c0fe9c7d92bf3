"""Exact Hessians ∂P/∂F of materials: against differences of the stress, wherever F may be."""

import numpy as np
import pytest
from models import RootMooney, SoftVolume, polar
from test_hessian import BUILT_IN, Fibred, generic, off, stress, true_hessian, turned

import pbng
from pbng.materials.base import has_hessian, model_of
from pbng.materials.check import derivatives

E = 1e5
OWN = (SoftVolume, RootMooney, Fibred)
KINDS = ("near rest", "stretched", "flattened", "inverted")


@pbng.material
class Quadratic(pbng.Material):
    """A user's material with a Hessian of its own: Ψ = μ |F - I|² + λ/2 (tr F - 3)², not isotropic."""

    isotropic = False

    def energy(F, mu, lam):
        D = pbng.linalg.mat_sub(F, pbng.linalg.identity(mu))
        t = pbng.linalg.trace(D)
        return mu * pbng.linalg.norm2(D) + 0.5 * lam * t * t

    def stress(F, mu, lam):
        D = pbng.linalg.mat_sub(F, pbng.linalg.identity(mu))
        return pbng.linalg.mat_combine(2.0 * mu, D, lam * pbng.linalg.trace(D), pbng.linalg.identity(mu))

    def hessian(F, D, mu, lam):
        return pbng.linalg.mat_combine(2.0 * mu, D, lam * pbng.linalg.trace(D), pbng.linalg.identity(mu))


@pbng.material
class Wrong(pbng.NeoHookean):
    """Neo-Hookean with a Hessian that forgets that the pressure changes."""

    def hessian(F, D, mu, lam_hat):
        return pbng.linalg.mat_scale(mu, D)


def exact(material, F):
    numbers = material.parameters()
    return derivatives(model_of(type(material), len(numbers)), F, numbers)


@pytest.mark.parametrize("nu", [0.3, 0.49])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", [*BUILT_IN, *OWN])
def test_it_is_the_derivative_of_the_stress(model, kind, nu):
    """To the accuracy of the differences it is compared with; symmetric. Users' are differences themselves."""
    material = model(E=E, nu=nu)
    got = exact(material, generic(kind))
    assert off(got, true_hessian(material, generic(kind))) < (1e-8 if model in BUILT_IN else 2e-7)
    symmetric = 1e-12 if model in BUILT_IN else 1e-7
    np.testing.assert_allclose(got, got.transpose(0, 2, 1), atol=symmetric * np.abs(got).max())


@pytest.mark.parametrize("model", BUILT_IN)
def test_at_random_gradients(model, rng):
    """Gaussian F, half of them inverted: along random directions, but where differences cross a jump of R."""
    material, F = model(E=E, nu=0.3), rng.standard_normal((2000, 3, 3))
    s = np.linalg.svd(F)[1]
    s[:, 2] *= np.sign(np.linalg.det(F))
    F = F[s[:, 1] + s[:, 2] > 0.05]
    D, h = rng.standard_normal(F.shape), 1e-5
    want = (stress(material, F + h * D) - stress(material, F - h * D)) / (2 * h)
    got = np.einsum("nij,nj->ni", exact(material, F), D.reshape(-1, 9)).reshape(-1, 3, 3)
    assert (np.abs(got - want).max((1, 2)) / np.abs(want).max((1, 2))).max() < 1e-5


@pytest.mark.parametrize("sigma", [(1.5, 0.6, 0), (1.5, 1e-6, 0), (1.5, 0.6, 1e-9), (1.5, 0.6, -1e-9)])
@pytest.mark.parametrize("model", BUILT_IN)
def test_rank_deficient(model, sigma, rng):
    """Flattened to a plane, or nearly: like elsewhere. Differences have an end at a line, where R jumps."""
    material = model(E=E, nu=0.3)
    F = turned(rng, np.tile(np.array(sigma, float), (50, 1)))
    got = exact(material, F)
    assert np.isfinite(got).all()
    if sigma[1] > 0.1:
        assert off(got, true_hessian(material, F)) < 1e-7


SINGULAR = {
    "line": (1.5, 0, 0),
    "point": (0, 0, 0),
    "mirrored": (1, 1, -1),
    "opposite": (1.5, 0.6, -0.6),
    "nearly opposite": (1.5, 0.6 + 1e-9, -0.6),
}


@pytest.mark.parametrize("model", [*BUILT_IN, *OWN])
def test_bounded_where_the_rotation_jumps(model, rng):
    """σ₂ + σ₃ = 0: finite, and no larger than 1e8 of the modulus."""
    material = model(E=E, nu=0.3)
    for shape, sigma in SINGULAR.items():
        got = exact(material, turned(rng, np.tile(np.array(sigma, float), (100, 1))))
        if not (model is RootMooney and shape == "point"):  # its Hessian has no bound there
            assert np.isfinite(got).all(), shape
            assert np.abs(got).max() < 1e8 * E, shape


@pytest.mark.parametrize("nu", [0.3, 0.49, -0.3])
@pytest.mark.parametrize("model", [*BUILT_IN, SoftVolume, RootMooney])
def test_at_rest_it_is_linear_elasticity(model, nu):
    """μ (δδ + swap) + λ δ⊗δ, Eq. (42)."""
    material = model(E=E, nu=nu)
    (got,) = exact(material, np.eye(3)[None])
    D = np.eye(9).reshape(9, 3, 3)
    want = material.mu * (D + D.transpose(0, 2, 1)) + material.lam * np.einsum("nii->n", D)[:, None, None] * np.eye(3)
    np.testing.assert_allclose(
        got, want.reshape(9, 9), atol=(1e-12 if model in BUILT_IN else 1e-8) * np.abs(want).max()
    )


def test_turned_frames(rng):
    """H(Q F R) is H(F) turned, also where F is inverted."""
    material, F = pbng.Corotated(E=E, nu=0.3), generic("inverted")
    Q, R = polar(rng.standard_normal((2, len(F), 3, 3)))
    H = exact(material, F).reshape(-1, 3, 3, 3, 3)
    turn = np.einsum("nia,nbk,njc,ndl,nabcd->nikjl", Q, R, Q, R, H)
    assert off(exact(material, Q @ F @ R), turn.reshape(-1, 9, 9)) < 1e-9


def test_a_hessian_belongs_to_its_stress():
    """A class that replaces the stress does not inherit the Hessian; one that gives its own has it."""
    assert all(has_hessian(m) for m in BUILT_IN)
    assert has_hessian(Quadratic)
    assert has_hessian(Wrong)
    assert not any(has_hessian(m) for m in OWN)

    class Heavier(pbng.Corotated):
        pass

    assert has_hessian(Heavier)


def test_check_material_measures_it():
    """Built-in ones hold, one that is wrong does not, and one that is not there is not asked for."""
    names = [f"Hessian, {state}" for state in ("regular", "near-singular", "inverted")]
    report = pbng.check_material(pbng.Corotated(E=E, nu=0.3))
    assert all(report[n].ok and report[n].value is not None for n in names)
    assert set(names) <= set(pbng.check_material(Wrong(E=E, nu=0.3)).failed)
    report = pbng.check_material(SoftVolume(E=E, nu=0.3))
    assert report.ok
    assert not any(a.name in names for a in report.axioms)


def test_a_users_own_hessian_is_used():
    """Quadratic energy: its Hessian is constant, to the last bit, which differences are not."""
    got = exact(Quadratic(E=E, nu=0.3), generic("inverted"))
    assert (got == got[0]).all()
