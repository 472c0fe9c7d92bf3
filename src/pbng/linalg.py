"""Vectors and 3x3 matrices as tuples of scalars: what the kernels are written in.

A vector is a tuple of three scalars, a matrix a tuple of its three columns. Everything is inlined and keeps the type of
its arguments (float32 stays float32), so a formula written with these is as fast as one written out by hand; what a
caller does not use of a result costs nothing.
"""

import math

import numpy as np
from numba import types
from numba.extending import overload

from pbng.jit import FLAGS, leaf


@leaf
def point(x, v):
    """Row v of the array x (n, 3)."""
    return x[v, 0], x[v, 1], x[v, 2]


@leaf
def add(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@leaf
def sub(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@leaf
def scale(s, a):
    return s * a[0], s * a[1], s * a[2]


@leaf
def combine(s, a, t, b):
    """s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@leaf
def combine3(s, a, t, b, u, c):
    """s a + t b + u c."""
    return (
        s * a[0] + t * b[0] + u * c[0],
        s * a[1] + t * b[1] + u * c[1],
        s * a[2] + t * b[2] + u * c[2],
    )


@leaf
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@leaf
def unit(a):
    """The direction of a; zero for zero."""
    real = type(a[0])
    length = math.sqrt(dot(a, a))
    return scale(real(1) / length if length > real(0) else real(0), a)


@leaf
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@leaf
def identity(like):
    """The unit matrix in the type of the scalar ``like``."""
    one = type(like)(1)
    zero = type(like)(0)
    return (one, zero, zero), (zero, one, zero), (zero, zero, one)


@leaf
def mat_add(A, B):
    return add(A[0], B[0]), add(A[1], B[1]), add(A[2], B[2])


@leaf
def mat_sub(A, B):
    return sub(A[0], B[0]), sub(A[1], B[1]), sub(A[2], B[2])


@leaf
def mat_scale(s, A):
    return scale(s, A[0]), scale(s, A[1]), scale(s, A[2])


@leaf
def mat_combine(s, A, t, B):
    """s A + t B."""
    return combine(s, A[0], t, B[0]), combine(s, A[1], t, B[1]), combine(s, A[2], t, B[2])


@leaf
def mat_vec(A, v):
    return combine3(v[0], A[0], v[1], A[1], v[2], A[2])


@leaf
def mat_mul(A, B):
    return mat_vec(A, B[0]), mat_vec(A, B[1]), mat_vec(A, B[2])


@leaf
def transpose(A):
    return (A[0][0], A[1][0], A[2][0]), (A[0][1], A[1][1], A[2][1]), (A[0][2], A[1][2], A[2][2])


@leaf
def trace(A):
    return A[0][0] + A[1][1] + A[2][2]


@leaf
def norm2(A):
    """Squared Frobenius norm |A|²."""
    return dot(A[0], A[0]) + dot(A[1], A[1]) + dot(A[2], A[2])


@leaf
def cofactor(F):
    """H = cof F = ∂J/∂F, from products of entries: defined for singular and inverted F."""
    return cross(F[1], F[2]), cross(F[2], F[0]), cross(F[0], F[1])


@leaf
def det(F):
    """J = det F."""
    return dot(F[2], cross(F[0], F[1]))


@leaf
def adjugate(a):
    """Adjugate, A⁻¹ det A, of a matrix of nine numbers by rows, likewise by rows; and det A."""
    c0, c1, c2 = a[4] * a[8] - a[5] * a[7], a[5] * a[6] - a[3] * a[8], a[3] * a[7] - a[4] * a[6]
    return (
        (c0, a[2] * a[7] - a[1] * a[8], a[1] * a[5] - a[2] * a[4]),
        (c1, a[0] * a[8] - a[2] * a[6], a[2] * a[3] - a[0] * a[5]),
        (c2, a[1] * a[6] - a[0] * a[7], a[0] * a[4] - a[1] * a[3]),
    ), a[0] * c0 + a[1] * c1 + a[2] * c2


@leaf
def _halley(s, I1, I2, J):
    """One Halley step for the largest root of s⁴ - 2 I1 s² - 8 J s + I1² - 4 I2; from above it stays above.

    All four roots are real, sums of the ±σ of fitting signs, which keeps the exact denominator above |b|; where it
    comes out lower, near a double root, all is rounding, and |b| keeps the step small.
    """
    real = type(s)
    q = s * s
    t = q - I1
    value = t * t - real(8) * J * s - real(4) * I2
    slope = s * t - real(2) * J  # a quarter of the derivative
    b = real(0.5) * value * (real(3) * q - I1)  # with a quarter of the second derivative
    return s - value * slope / max(real(4) * slope * slope - b, abs(b) + real(1e-37))


@leaf
def _halley_thrice(s, I1, I2, J):
    """Unrolled: a loop would keep LLVM from vectorising the kernel around it."""
    return _halley(_halley(_halley(s, I1, I2, J), I1, I2, J), I1, I2, J)


@leaf
def _trace_bound(I1, I2, J):
    """An upper bound on tr S, exact at rest: (s² - I1)² = 4 (I2 + 2 J s) is at most 12 I2, or 4 I2 if J <= 0."""
    real = type(I1)
    bound = (real(12) if real(0) < J else real(4)) * max(I2, real(0))
    return math.sqrt(I1 + math.sqrt(bound) + real(1e-30))


def _stretch_trace(I1, I2, J):
    raise TypeError("called from compiled code only")


@overload(_stretch_trace, jit_options={"forceinline": True, **FLAGS})
def _(I1, I2, J):
    """tr S, by three steps in float32 and seven in float64, and its relative accuracy where the root is double."""
    if I1 is types.float32:
        return lambda I1, I2, J: (_halley_thrice(_trace_bound(I1, I2, J), I1, I2, J), np.float32(1e-3))

    def double(I1, I2, J):
        s = _halley_thrice(_trace_bound(I1, I2, J), I1, I2, J)
        return _halley(_halley_thrice(s, I1, I2, J), I1, I2, J), 1e-7

    return double


@leaf
def polar(F):
    """R as :func:`rotation` and s = tr S = tr RᵀF, its largest value over rotations; no SVD.

    s is the largest root of a quartic in the invariants; R = ∂s/∂F then follows in closed form (docs/method.md, "Polar
    decomposition without an SVD"). Where R is not unique both parts of the fraction vanish; with s a little too large
    their ratio is the mean of the rotations that would do, a subgradient of s, so that blocks stay majorisers.
    """
    real = type(F[0][0])
    H = cofactor(F)
    J = dot(F[2], H[2])
    C00 = dot(F[0], F[0])
    C11 = dot(F[1], F[1])
    C22 = dot(F[2], F[2])
    C01 = dot(F[0], F[1])
    C02 = dot(F[0], F[2])
    C12 = dot(F[1], F[2])
    I1 = C00 + C11 + C22
    I2 = dot(H[2], H[2]) + (C00 * C22 - C02 * C02) + (C11 * C22 - C12 * C12)  # |H|², with one column of H
    s, delta = _stretch_trace(I1, I2, J)
    t = s + delta * s if s * (s * s - I1) - real(2) * J < delta * s * s * s else s
    q = t * t
    d = real(1) / (t * (q - I1) - real(2) * J + real(1e-37))
    m = (q + I1) * d
    e = real(2) * t * d
    k = real(2) * d
    R = (
        sub(combine(m - k * C00, F[0], e, H[0]), combine(k * C01, F[1], k * C02, F[2])),
        sub(combine(m - k * C11, F[1], e, H[1]), combine(k * C01, F[0], k * C12, F[2])),
        sub(combine(m - k * C22, F[2], e, H[2]), combine(k * C02, F[0], k * C12, F[1])),
    )
    return R, s


@leaf
def rotation(F):
    """Rotation R of the polar decomposition F = R S with det R = +1 always, also for det F <= 0; see :func:`polar`."""
    return polar(F)[0]


@leaf
def _half_tangent(t):
    """tan(φ/2) from t = tan φ, for φ in [0, π/2]."""
    real = type(t)
    return t / (real(1) + math.sqrt(real(1) + t * t))


@leaf
def arctan2(y, x):
    """The angle of the point (x, y) [rad], as ``math.atan2``, to rounding; 0 at the origin, and without a branch.

    The tangent of the angle to the nearer axis is at most 1; halved three times it is at most tan(π/32), where eight
    terms of the series do in float64.
    """
    real = type(y)
    u, v = abs(x), abs(y)
    t = _half_tangent(_half_tangent(_half_tangent(min(u, v) / max(max(u, v), real(1e-37)))))
    q = t * t
    s = real(1 / 9) + q * (real(-1 / 11) + q * (real(1 / 13) - q * real(1 / 15)))
    a = real(8) * t * (real(1) + q * (real(-1 / 3) + q * (real(1 / 5) + q * (real(-1 / 7) + q * s))))
    a = real(math.pi / 2) - a if v > u else a
    a = real(math.pi) - a if x < real(0) else a
    return -a if y < real(0) else a


@leaf
def solve_spd(a00, a01, a02, a11, a12, a22, b0, b1, b2):
    """Solution of the symmetric positive definite 3x3 system with the given upper triangle, by A = L D Lᵀ.

    Unlike cofactors this neither overflows nor breaks down where the rank-one part of a block drowns the rest; pivots
    lost in rounding are raised, which makes A larger, so that a majoriser remains one.
    """
    real = type(a00)
    r0 = real(1) / a00
    l1 = a01 * r0
    l2 = a02 * r0
    r1 = real(1) / max(a11 - l1 * a01, real(1e-6) * a11)
    m = a12 - l1 * a02
    l3 = m * r1
    r2 = real(1) / max(a22 - l2 * a02 - l3 * m, real(1e-6) * a22)
    y1 = b1 - l1 * b0
    z = (b2 - l2 * b0 - l3 * y1) * r2
    y = y1 * r1 - l3 * z
    return b0 * r0 - l1 * y - l2 * z, y, z
