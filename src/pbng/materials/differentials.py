"""Differentials of what stresses are made of, along D = δF: with them a material's Hessian is a few lines."""

import math
from functools import cache
from typing import Any

from pbng.jit import inline
from pbng.linalg import add, combine, cross, dot, mat_vec, norm2, trace
from pbng.materials.base import Model

SINGULAR = 1e-7  # of (tr S)³: least product of the sums σ_i + σ_j that a rotation's differential divides by
STEP = 6e-6  # of a central difference, relative to 1 + |F|: third root of the rounding


@inline
def mat_dot(A, B):
    """A : B, the sum of the products of entries."""
    return dot(A[0], B[0]) + dot(A[1], B[1]) + dot(A[2], B[2])


@inline
def cofactor_differential(F, D):
    """δ cof F, the second derivative of J = det F along D."""
    return (
        add(cross(D[1], F[2]), cross(F[1], D[2])),
        add(cross(D[2], F[0]), cross(F[2], D[0])),
        add(cross(D[0], F[1]), cross(F[0], D[1])),
    )


@inline
def rotation_differential(F, R, D):
    """δR of the rotation R of F = R S, also where det F <= 0.

    RᵀδR is skew, [ω]×, and the skew part of RᵀδF = [ω]× S + δS gives (tr S I - S) ω = a, with a the axis of
    RᵀδF - δFᵀR. The eigenvalues of that matrix are the sums σ_i + σ_j, none of which is negative. Where one vanishes R
    jumps; their product is kept from zero there, so that δR stays bounded.
    """
    real = type(F[0][0])
    half = real(0.5)
    S0, S1, S2 = _times_transposed(R, F[0]), _times_transposed(R, F[1]), _times_transposed(R, F[2])
    t = trace((S0, S1, S2))
    g00, g11, g22 = t - S0[0], t - S1[1], t - S2[2]
    g01, g02, g12 = -half * (S1[0] + S0[1]), -half * (S2[0] + S0[2]), -half * (S2[1] + S1[2])
    c00, c11, c22 = g11 * g22 - g12 * g12, g00 * g22 - g02 * g02, g00 * g11 - g01 * g01
    c01, c02, c12 = g02 * g12 - g01 * g22, g01 * g12 - g02 * g11, g01 * g02 - g12 * g00
    product = g00 * c00 + g01 * c01 + g02 * c02
    d = real(1) / max(product, real(SINGULAR) * t * t * t + real(1e-37))
    M0, M1, M2 = _times_transposed(R, D[0]), _times_transposed(R, D[1]), _times_transposed(R, D[2])
    a = d * (M1[2] - M2[1]), d * (M2[0] - M0[2]), d * (M0[1] - M1[0])
    w = mat_vec(((c00, c01, c02), (c01, c11, c12), (c02, c12, c22)), a)
    return combine(w[2], R[1], -w[1], R[2]), combine(w[0], R[2], -w[2], R[0]), combine(w[1], R[0], -w[0], R[1])


@inline
def _times_transposed(R, v):
    return dot(R[0], v), dot(R[1], v), dot(R[2], v)


@cache
def differential(model: Model) -> Any:
    """``(F, D, *numbers) -> δP`` along D: the model's own, or central differences of its stress."""
    if model.hessian is not None:
        return model.hessian
    stress = model.stress

    @inline
    def difference(F, D, *numbers):
        size = math.sqrt(norm2(D)) + 1e-300
        h = STEP * (1.0 + math.sqrt(norm2(F))) / size
        up = combine(1.0, F[0], h, D[0]), combine(1.0, F[1], h, D[1]), combine(1.0, F[2], h, D[2])
        down = combine(1.0, F[0], -h, D[0]), combine(1.0, F[1], -h, D[1]), combine(1.0, F[2], -h, D[2])
        P, M, d = stress(up, *numbers), stress(down, *numbers), 0.5 / h
        return combine(d, P[0], -d, M[0]), combine(d, P[1], -d, M[1]), combine(d, P[2], -d, M[2])

    return difference
