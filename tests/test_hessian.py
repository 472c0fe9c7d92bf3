"""Eigenvalues and singular values by Jacobi rotations, and the positive definite Hessians of materials."""

from functools import cache

import numpy as np
import pytest
from models import RootMooney, SoftVolume, oracle_stress, polar

import pbng
from pbng.materials.base import model_of
from pbng.materials.hessian import hessians
from pbng.spectral import jacobi, signed_svd

E = 1e5


@pbng.material
class Fibred(pbng.NeoHookean):
    """Neo-Hookean with a fibre along the first rest axis: Ψ + μ/2 (|F e₁|² - 1)², objective but not isotropic."""

    isotropic = False

    def energy(F, mu, lam_hat):
        real = type(mu)
        dJ, growth = pbng.linalg.det(F) - real(1), pbng.linalg.norm2(F) - real(3)
        fibre = pbng.linalg.dot(F[0], F[0]) - real(1)
        return real(0.5) * mu * (growth + fibre * fibre) + (real(0.5) * lam_hat * dJ - mu) * dJ

    def stress(F, mu, lam_hat):
        one = type(mu)(1)
        fibre = pbng.linalg.dot(F[0], F[0]) - one
        P = pbng.linalg.mat_combine(mu, F, lam_hat * (pbng.linalg.det(F) - one) - mu, pbng.linalg.cofactor(F))
        return pbng.linalg.combine(one, P[0], (mu + mu) * fibre, F[0]), P[1], P[2]


BUILT_IN = (pbng.Corotated, pbng.NeoHookean, pbng.StableNeoHookean, pbng.LinearElastic)
MODELS = (*BUILT_IN, SoftVolume, RootMooney, Fibred)


def modes(material, F, floor):
    """Eigenvalues (n, 9) and modes (n, 9, 9), as rows, of a material's Hessian at F (n, 3, 3)."""
    numbers = material.parameters()
    model = model_of(type(material), len(numbers))
    return hessians(model, F, np.tile(numbers, (len(F), 1)), np.full(len(F), float(floor)))


def assembled(e, M):
    return np.einsum("nk,nki,nkj->nij", e, M, M)


def stress(material, F):
    """P (n, 3, 3) in NumPy."""
    if isinstance(material, Fibred):
        fibre = ((F[:, :, 0] ** 2).sum(1) - 1)[:, None, None] * [1, 0, 0]
        return oracle_stress(pbng.NeoHookean(E=material.E, nu=material.nu), F) + 2 * material.mu * fibre * F
    return oracle_stress(material, F)


def true_hessian(material, F):
    """∂P/∂F (n, 9, 9) of the NumPy stress by differences of fourth order, rows and columns in order of F_ik."""
    out, h = np.empty((len(F), 9, 9)), 1e-4
    for k, D in enumerate(np.eye(9).reshape(9, 3, 3)):
        near = stress(material, F + h * D) - stress(material, F - h * D)
        far = stress(material, F + 2 * h * D) - stress(material, F - 2 * h * D)
        out[:, :, k] = ((8 * near - far) / (12 * h)).reshape(-1, 9)
    np.testing.assert_allclose(out, out.transpose(0, 2, 1), atol=1e-7 * np.abs(out).max())
    return out


def projected(H, floor):
    """The nearest matrices with no eigenvalue below the floor."""
    e, Q = np.linalg.eigh(H)
    return (Q * np.maximum(e, floor)[:, None, :]) @ Q.transpose(0, 2, 1)


def off(got, want):
    """Largest error over the largest entry, matrix by matrix."""
    return (np.abs(got - want).max((1, 2)) / np.abs(want).max((1, 2))).max()


def turned(rng, sigma):
    """F (n, 3, 3) with the given signed singular values (n, 3) and random axes."""
    n = len(sigma)
    return polar(rng.standard_normal((n, 3, 3))) * sigma[:, None, :] @ polar(rng.standard_normal((n, 3, 3)))


@cache
def generic(kind, n=200):
    """Deformation gradients away from what makes a stress singular: σ₂ + σ₃ = 0 with σ₃ < 0 (corotated)."""
    rng = np.random.default_rng(7)
    low, high = {
        "near rest": ([0.99, 0.99, 0.99], [1.01, 1.01, 1.01]),
        "stretched": ([0.5, 0.5, 0.5], [2.0, 2.0, 2.0]),
        "flattened": ([0.6, 0.6, 0.0], [2.0, 2.0, 0.1]),
        "inverted": ([0.8, 0.8, -0.6], [2.0, 2.0, -0.05]),
    }[kind]
    return turned(rng, rng.uniform(low, high, (n, 3)))


# ------------------------------------------------------------------------------------------------- small matrices


@pytest.mark.parametrize("n", [1, 2, 3, 9])
def test_jacobi_is_eigh(rng, n):
    """A = Q diag Qᵀ with Q orthonormal and NumPy's eigenvalues, also simple ones of a large and a small scale."""
    for scale in (1e-12, 1.0, 1e12):
        A = scale * rng.standard_normal((n, n))
        A += A.T
        D, Q = A.copy(), np.full((n, n), np.nan)
        jacobi(D, Q)
        np.testing.assert_allclose(Q.T @ Q, np.eye(n), atol=1e-14)
        np.testing.assert_allclose(D, np.diag(np.diag(D)), atol=2e-13 * n * scale)
        np.testing.assert_allclose(Q * np.diag(D) @ Q.T, A, atol=2e-13 * n * scale)
        np.testing.assert_allclose(np.sort(np.diag(D)), np.linalg.eigvalsh(A), atol=2e-13 * n * scale)


@pytest.mark.parametrize("values", [(2, 2, 2), (3, 1, 1), (1, 1, -2), (0, 0, 5), (0, 0, 0), (1, 1 + 1e-9, 1 - 1e-9)])
def test_jacobi_at_multiple_eigenvalues(rng, values):
    """Axes are orthonormal where eigenvalues coincide, and a zero matrix has zero eigenvalues."""
    for _ in range(50):
        R = polar(rng.standard_normal((1, 3, 3)))[0]
        A = R * np.array(values, float) @ R.T
        D, Q = A.copy(), np.full((3, 3), np.nan)
        jacobi(D, Q)
        np.testing.assert_allclose(Q.T @ Q, np.eye(3), atol=1e-14)
        np.testing.assert_allclose(Q * np.diag(D) @ Q.T, A, atol=1e-12)
        np.testing.assert_allclose(np.sort(np.diag(D)), np.sort(values), atol=1e-12)


def svd(F):
    U, S, V = np.full((3, 3), np.nan), np.full(3, np.nan), np.full((3, 3), np.nan)
    signed_svd(tuple(map(tuple, F.T)), U, S, V, np.full((3, 3), np.nan))
    return U, S, V


SHAPES = {  # signed singular values, and the relative error allowed: FᵀF holds half of the digits of small ones
    "random": (None, 1e-11),
    "rest": ((1, 1, 1), 1e-14),
    "mirrored": ((1, 1, -1), 1e-14),
    "two alike": ((1, 0.5, 0.5), 1e-12),
    "two alike, inverted": ((1, 0.5, -0.5), 1e-12),
    "nearly alike": ((2, 1 + 1e-9, 1), 1e-12),
    "inverted": ((3, 1, -0.4), 1e-11),
    "rank two": ((1, 0.6, 0), 1e-11),
    "rank two, alike": ((1, 1, 0), 1e-12),
    "rank one": ((2, 0, 0), 1e-14),
    "rank zero": ((0, 0, 0), 0),
    "nearly rank two": ((1, 0.5, -1e-9), 1e-11),
    "nearly rank one": ((1, 3e-7, 1e-7), 1e-6),
    "needle": ((1e3, 1e-4, -1e-4), 1e-6),
    "pancake": ((1e3, 1e3, 1e-3), 1e-11),
    "small": ((2e-9, 1e-9, 1e-9), 1e-12),
    "large": ((1e9, 5e8, -1e8), 1e-11),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_signed_svd(rng, shape):
    """F = U diag(S) Vᵀ with rotations U and V; |S| falls, only the last is negative, and |S| are NumPy's."""
    sigma, allowed = SHAPES[shape]
    for _ in range(200):
        F = rng.standard_normal((3, 3)) if sigma is None else turned(rng, np.array([sigma], float))[0]
        U, S, V = svd(F)
        for R in (U, V):
            np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
            assert np.linalg.det(R) == pytest.approx(1, abs=1e-14)
        size = np.linalg.norm(F)
        np.testing.assert_allclose(U * S @ V.T, F, atol=allowed * size)
        slack = (allowed + 1e-14) * size
        np.testing.assert_allclose(np.abs(S), np.linalg.svd(F)[1], atol=slack)
        assert S[0] >= S[1] - slack
        assert S[1] >= max(0, abs(S[2]) - slack)
        if sigma is not None and abs(sigma[2]) > slack:
            assert np.sign(S[2]) == np.sign(sigma[2])


@pytest.mark.parametrize(
    "F",
    [np.diag([0, 0, 1.0]), np.diag([0, -2.0, 0]), np.outer([0, 0, 1.0], [0, 1, 0]), np.ones((3, 3)), -np.eye(3)],
    ids=["z only", "-y only", "zy only", "ones", "minus one"],
)
def test_signed_svd_along_the_axes(F):
    """What a search for a direction across the first one could trip over."""
    U, S, V = svd(F)
    for R in (U, V):
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=1e-14)
        assert np.linalg.det(R) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(U * S @ V.T, F, atol=1e-14)


# ----------------------------------------------------------------------------------------------------- Hessians


@pytest.mark.parametrize("nu", [0.3, 0.49])
@pytest.mark.parametrize("model", MODELS)
def test_hessian_is_the_true_one_where_that_is_positive(model, nu):
    """Σ e M Mᵀ = ∂P/∂F to 1e-4 where all its eigenvalues lie above the floor."""
    material = model(E=E, nu=nu)
    F = np.concatenate([generic("near rest"), generic("stretched")])
    H, floor = true_hessian(material, F), 1e-3 * material.mu
    positive = np.linalg.eigvalsh(H)[:, 0] > floor
    if model is pbng.LinearElastic:  # no stiffness against rotation at all
        assert not positive.any()
        return
    assert positive.sum() > 20
    assert off(assembled(*modes(material, F[positive], floor)), H[positive]) < 1e-4


@pytest.mark.parametrize("kind", ["stretched", "flattened", "inverted"])
@pytest.mark.parametrize("model", MODELS)
def test_hessian_is_projected(model, kind):
    """Elsewhere it is the symmetric ∂P/∂F with eigenvalues raised to the floor."""
    material = model(E=E, nu=0.3)
    F = generic(kind)
    floor = 0.01 * material.mu
    H = true_hessian(material, F)
    if kind == "inverted":
        assert (np.linalg.eigvalsh(H)[:, 0] < floor).all()
    assert off(assembled(*modes(material, F, floor)), projected(H, floor)) < 1e-4


WILD = {
    "any": None,
    "scaled": (0.3, 0.3, 0.3),
    "two alike": (1.4, 0.7, 0.7),
    "two alike, inverted": (1.4, 0.7, -0.7),
    "nearly alike": (1.4, 0.7 + 1e-7, 0.7),
    "nearly opposite": (1.4, 0.7 + 1e-9, -0.7),
    "mirrored": (1, 1, -1),
    "plane": (1.5, 0.6, 0),
    "line": (1.5, 0, 0),
    "point": (0, 0, 0),
    "needle": (1e3, 1e-4, -1e-4),
    "pancake": (1e3, 1e3, 1e-3),
    "tiny": (1e-8, 1e-9, -1e-9),
}


@pytest.mark.parametrize("model", MODELS)
def test_hessian_is_positive_at_any_state(model, rng):
    """Finite, all e >= floor > 0, and nine orthonormal modes, whatever F."""
    material = model(E=E, nu=0.3)
    floor = 0.01 * material.mu
    for shape, sigma in WILD.items():
        n = 100
        F = rng.standard_normal((n, 3, 3)) if sigma is None else turned(rng, np.tile(np.array(sigma, float), (n, 1)))
        e, M = modes(material, F, floor)
        assert np.isfinite(e).all(), shape
        assert (e >= floor).all(), shape
        np.testing.assert_allclose(
            M @ M.transpose(0, 2, 1), np.broadcast_to(np.eye(9), M.shape), atol=1e-12, err_msg=shape
        )


@pytest.mark.parametrize("nu", [0.3, 0.49, -0.3])
@pytest.mark.parametrize("model", MODELS)
def test_hessian_of_rest_is_linear_elasticity(model, nu):
    """At F = I: 2μ on deviatoric strains, 2μ + 3λ on the volume, the floor on rotations; fibres add to the first."""
    material = model(E=E, nu=nu)
    floor, one = 1e-3 * material.mu, np.eye(3)
    (H,) = assembled(*modes(material, one[None], floor))
    D = np.eye(9).reshape(9, 3, 3)
    strain, spin = (D + D.transpose(0, 2, 1)) / 2, (D - D.transpose(0, 2, 1)) / 2
    P = 2 * material.mu * strain + material.lam * np.einsum("nii->n", D)[:, None, None] * one + floor * spin
    if model is Fibred:
        P[0, 0, 0] += 4 * material.mu
    np.testing.assert_allclose(H, P.reshape(9, 9), atol=2e-5 * np.abs(P).max())


@pytest.mark.parametrize("model", [pbng.Corotated, Fibred])
def test_floor_is_a_floor_and_nothing_else(model):
    """A higher floor raises the eigenvalues below it and leaves modes and the others alone, to the last bit."""
    material = model(E=E, nu=0.3)
    F = generic("inverted")
    e, M = modes(material, F, 0.0)
    again, same = modes(material, F, material.mu)
    assert (e < material.mu).any()
    np.testing.assert_array_equal(M, same)
    np.testing.assert_array_equal(np.maximum(e, material.mu), again)


def test_hessian_is_that_of_the_models_own_axes(rng):
    """H(Q F R) is H(F) turned, for isotropic materials: nothing prefers an axis."""
    material = pbng.StableNeoHookean(E=E, nu=0.3)
    F = generic("inverted")
    Q, R = polar(rng.standard_normal((2, len(F), 3, 3)))
    floor = 0.01 * material.mu
    H = assembled(*modes(material, F, floor)).reshape(-1, 3, 3, 3, 3)
    turn = np.einsum("nia,nbk,njc,ndl,nabcd->nikjl", Q, R, Q, R, H)
    assert off(assembled(*modes(material, Q @ F @ R, floor)), turn.reshape(-1, 9, 9)) < 1e-6


@pytest.mark.parametrize("model", [pbng.StableNeoHookean, RootMooney, Fibred])
def test_each_point_has_its_own_numbers(model, rng):
    """A batch of any size, with parameters and floors that differ, is the same as point by point, to the last bit."""
    F = np.concatenate([generic("stretched"), generic("inverted")])[::7]
    materials = [model(E=e, nu=nu) for e, nu in zip(10 ** rng.uniform(3, 7, len(F)), rng.uniform(0.1, 0.45, len(F)))]
    numbers = np.array([m.parameters() for m in materials])
    floor = np.array([0.01 * m.mu for m in materials])
    kind = model_of(model, numbers.shape[1])
    for n in (0, 1, 2, 7, 16, 17, len(F)):
        e, M = hessians(kind, F[:n], numbers[:n], floor[:n])
        assert e.shape == (n, 9)
        assert M.shape == (n, 9, 9)
        for k in range(n):
            one_e, one_M = hessians(kind, F[k : k + 1], numbers[k : k + 1], floor[k : k + 1])
            np.testing.assert_array_equal(e[k], one_e[0])
            np.testing.assert_array_equal(M[k], one_M[0])


def test_strided_arguments():
    """F, numbers and floors need not lie densely in memory."""
    material = pbng.NeoHookean(E=E, nu=0.3)
    F, model = generic("stretched"), model_of(pbng.NeoHookean, 2)
    numbers, floor = np.tile(material.parameters(), (len(F), 1)), np.linspace(1.0, 2.0, len(F))
    dense = hessians(model, F[::3].copy(), numbers[::3].copy(), floor[::3].copy())
    turned = np.asfortranarray(F[::3])
    for e, M in (hessians(model, F[::3], numbers[::3], floor[::3]), hessians(model, turned, numbers[::3], floor[::3])):
        np.testing.assert_array_equal(e, dense[0])
        np.testing.assert_array_equal(M, dense[1])


@pbng.material
class Fixed(pbng.NeoHookean):
    """A user's material with its constants written into it: μ = 1e5 Pa, λ = 0, no parameters."""

    def energy(F):
        dJ, growth = pbng.linalg.det(F) - 1.0, pbng.linalg.norm2(F) - 3.0
        return 1e5 * (0.5 * growth + (0.5 * dJ - 1.0) * dJ)

    def stress(F):
        return pbng.linalg.mat_combine(1e5, F, 1e5 * (pbng.linalg.det(F) - 2.0), pbng.linalg.cofactor(F))

    def parameters(self):
        return ()


def test_material_without_parameters():
    """It has the Hessian of the same material with parameters."""
    plain, F = pbng.NeoHookean(E=2e5, nu=0.0), generic("stretched")
    e, M = modes(Fixed(E=2e5, nu=0.0), F, 10.0)
    want_e, want_M = modes(plain, F, 10.0)
    np.testing.assert_allclose(assembled(e, M), assembled(want_e, want_M), rtol=1e-6, atol=1e-2)
