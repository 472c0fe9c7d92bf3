"""The 3x3 helpers against NumPy, and the polar decomposition without an SVD against the SVD."""

import numpy as np
import pytest
from models import cof, polar
from numba import njit

from pbng import linalg
from pbng.jit import FLAGS

PRECISIONS = (np.float32, np.float64)


@njit(**FLAGS)
def _columns(F):
    return (F[0, 0], F[1, 0], F[2, 0]), (F[0, 1], F[1, 1], F[2, 1]), (F[0, 2], F[1, 2], F[2, 2])


@njit(**FLAGS)
def _rotations(F, R):
    for n in range(len(F)):
        r = linalg.rotation(_columns(F[n]))
        for i in range(3):
            for j in range(3):
                R[n, i, j] = r[j][i]


@njit(**FLAGS)
def _products(A, B, v, out, numbers):
    a, b = _columns(A), _columns(B)
    u = (v[0], v[1], v[2])
    matrices = (
        linalg.mat_mul(a, b),
        linalg.mat_add(a, b),
        linalg.mat_sub(a, b),
        linalg.mat_combine(2.0, a, -3.0, b),
        linalg.mat_scale(0.5, a),
        linalg.transpose(a),
        linalg.cofactor(a),
        linalg.identity(v[0]),
        (linalg.mat_vec(a, u), linalg.cross(u, a[0]), linalg.combine3(1.0, u, 2.0, a[1], 3.0, b[2])),
    )
    for k in range(len(matrices)):
        for i in range(3):
            for j in range(3):
                out[k, i, j] = matrices[k][j][i]
    numbers[0], numbers[1], numbers[2] = linalg.det(a), linalg.trace(a), linalg.norm2(a)


@njit(**FLAGS)
def _solve(A, b, x):
    for n in range(len(A)):
        M = A[n]
        x[n, 0], x[n, 1], x[n, 2] = linalg.solve_spd(
            M[0, 0], M[0, 1], M[0, 2], M[1, 1], M[1, 2], M[2, 2], b[n, 0], b[n, 1], b[n, 2]
        )


def rotations(F):
    R = np.full_like(F, np.nan)
    _rotations(np.ascontiguousarray(F), R)
    return R.astype(float)


def turned(rng, *sigma, n=2000):
    """F with the given signed singular values and random axes."""
    return polar(rng.standard_normal((n, 3, 3))) * np.array(sigma, float) @ polar(rng.standard_normal((n, 3, 3)))


def test_products(rng):
    A, B, v = rng.standard_normal((3, 3)), rng.standard_normal((3, 3)), rng.standard_normal(3)
    out, numbers = np.empty((9, 3, 3)), np.empty(3)
    _products(A, B, v, out, numbers)
    columns = np.stack([A @ v, np.cross(v, A[:, 0]), v + 2 * A[:, 1] + 3 * B[:, 2]], axis=1)
    expected = [A @ B, A + B, A - B, 2 * A - 3 * B, A / 2, A.T, cof(A), np.eye(3), columns]
    np.testing.assert_allclose(out, expected, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(numbers, [np.linalg.det(A), np.trace(A), (A * A).sum()], rtol=1e-13)


def test_cofactor_is_defined_where_the_inverse_is_not(rng):
    """H = J F^{-T} for regular F, and finite for a singular one."""
    F = rng.standard_normal((3, 3))
    np.testing.assert_allclose(cof(F), np.linalg.det(F) * np.linalg.inv(F).T, rtol=1e-11)
    out = np.empty((9, 3, 3))
    flat = F * [1, 1, 0]
    _products(flat, F, F[0], out, np.empty(3))
    np.testing.assert_allclose(out[6], cof(flat), atol=1e-14)
    assert np.abs(out[6]).max() > 0.1


SHAPES = {  # signed singular values, and what condition leaves of the precision
    "rest": ((1, 1, 1), 1),
    "stretched": ((3, 1, 0.4), 1),
    "nearly flat": ((1.3, 0.7, 1e-5), 1),
    "flat": ((1.3, 0.7, 0), 1),
    "nearly flat, inverted": ((1.3, 0.7, -1e-5), 1),
    "inverted": ((1.2, 0.9, -0.4), 30),
    "pancake": ((1e3, 1e3, 1e-3), 1),
    "small": ((1e-3, 0.7e-3, 0.4e-3), 1),
    "large": ((1e3, 0.7e3, 0.4e3), 1),
}


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("shape", SHAPES)
def test_rotation_is_the_svds(rng, shape, dtype):
    """R of F = R S with det R = +1, also where det F <= 0, to a few units in the last place."""
    sigma, condition = SHAPES[shape]
    F = turned(rng, *sigma).astype(dtype)
    R = rotations(F)
    allowed = 20 * condition * np.finfo(dtype).eps
    np.testing.assert_allclose(R, polar(F.astype(float)), atol=allowed)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=2 * allowed)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=2 * allowed)


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_rotation_of_rest_is_exact(dtype):
    """R(Q) = Q for rotations Q, and R(I) = I to the last bit: no forces at rest."""
    np.testing.assert_array_equal(rotations(np.eye(3, dtype=dtype)[None])[0], np.eye(3))


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize(
    "sigma",
    [
        (1, 0, 0),
        (1, 1e-7, -1e-8),
        (1e3, 1e-4, 0),
        (0, 0, 0),
        (1, 0.5, -0.5),
        (1, 0.5, -0.5001),
        (1, 1, -1),
        (1e-9, 0, 0),
    ],
)
def test_rotation_where_it_is_not_unique(rng, sigma, dtype):
    """F collapsed to a line or a point, or σ₂ + σ₃ = 0: R is finite and within the hull of the nearest rotations."""
    R = rotations(turned(rng, *sigma).astype(dtype))
    assert np.isfinite(R).all()
    assert np.linalg.norm(R, 2, (1, 2)).max() <= 1.02


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_rotation_keeps_the_precision(dtype):
    """float32 stays float32: no hidden promotion in the kernels."""
    arguments = (tuple(tuple(dtype(i == j) for i in range(3)) for j in range(3)),)
    typed = njit(lambda F: np.array(linalg.rotation(F)[2]))(*arguments)
    assert typed.dtype == dtype


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_solve_spd(rng, dtype):
    """A x = b for blocks a I + b c cᵀ and sums of such; cofactors lose the square of the condition number."""
    n = 500
    c = rng.standard_normal((n, 3))
    A = np.eye(3) + 10 ** rng.uniform(-3, 3, (n, 1, 1)) * c[:, :, None] * c[:, None, :]
    A[::2] += np.einsum("nij,nkj->nik", *[rng.standard_normal((n, 3, 3))[::2]] * 2)
    b = rng.standard_normal((n, 3))
    x = np.empty((n, 3), dtype)
    _solve(A.astype(dtype), b.astype(dtype), x)
    exact = np.linalg.solve(A, b[:, :, None])[:, :, 0]
    error = np.linalg.norm(x - exact, axis=1) / np.linalg.norm(exact, axis=1)
    assert np.max(error / np.linalg.cond(A) ** 2) < 4 * np.finfo(dtype).eps


def test_solve_spd_of_the_unit_matrix_is_exact():
    """Padding lanes hold the unit matrix and no force; they must never move."""
    x = np.full((1, 3), np.nan)
    _solve(np.eye(3)[None], np.zeros((1, 3)), x)
    np.testing.assert_array_equal(x, 0)
