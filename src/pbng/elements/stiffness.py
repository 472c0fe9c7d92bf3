"""Stiffness matrices of simplices, ∂²E/∂x∂x = V ∂F/∂x : ∂P/∂F : ∂F/∂x, exact or made positive semidefinite.

Each is symmetric, and what the first corner sees follows from the others, whose gradients sum with its own to zero. So
the six blocks of the corners q, r and x are computed, or three in the plane. The work goes in three steps, so that only
the second, a few lines, is compiled for each material: where the change of the stress is needed, and along which
directions; the change there; what follows from it. There are two ways:

full
    ∂P/∂F as a matrix (9, 9), from all nine directions at F. To project it, its eigenvalues are sought unless it is
    positive semidefinite anyway; but isotropic materials are rather projected in the way that follows.
spectral
    With F = U diag(σ) Vᵀ and δP = U H Vᵀ, H is known at the diagonal F alone: the matrix A_ij = ∂p_i/∂σ_j, and for
    each pair i, j the eigenvalues s + d of a flip and s - d of a twist, where the direction e_i e_jᵀ gives δP_ij = s
    and δP_ji = d (Smith et al. 2019, "Analytic Eigensystems for Isotropic Distortion Energies").

What is negative is raised to a floor (*clamp*) or reflected (*abs*).
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.dispatch import call, specialised
from pbng.elements.base import W, parameters
from pbng.elements.simplex import Simplex
from pbng.errors import InputError
from pbng.jit import inline, serial
from pbng.linalg import add, combine, combine3, dot, mat_vec, polar, scale, transpose
from pbng.materials.base import Model
from pbng.materials.differentials import differential
from pbng.parallel import array, body
from pbng.spectral import jacobi, signed_svd

# Numbers a lane: F, gradients and volume; ∂P/∂F; U, V, σ and how far the rotation is from one; ten blocks.
N_ELEMENT, N_CHANGE, N_FRAME, N_BLOCKS = 19, 81, 22, 90
UNSURE = 1e-9  # of a rotation: how far from orthonormal it may be
SEMIDEFINITE = 1e-10  # of the trace: what a matrix may lack to be taken for positive semidefinite


def _directions(*places: tuple[int, int]) -> np.ndarray:
    """e_i e_kᵀ for each (i, k), as columns, (n, 9)."""
    out = np.zeros((len(places), 9))
    out[np.arange(len(places)), [3 * k + i for i, k in places]] = 1.0
    return out


FULL = _directions(*((i, k) for k in range(3) for i in range(3)))
SPECTRAL = _directions((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def check_kind(kind: Any) -> None:
    """InputError if there is no stiffness for elements of a kind."""
    if not isinstance(kind, Simplex):
        raise InputError(f"Newton: elements of kind {kind.name!r} have no Hessian; use PBNG")


@cache
def change_of_stress(model: Model) -> Any:
    """Body of the second step: the changes of a model's stress at W points along ``count`` directions.

    Its arguments: entries of F, W points side by side, columns first; the directions (count, 9); the changes, as F;
    the numbers of groups, of which the one at ``p`` is skipped. Its range is (count, p).
    """
    numbers, change = parameters(model.n_parameters), differential(model)
    return specialised(make_change, (inline(lambda F, D, par, p: change(F, D, *numbers(par, p))),))


def make_change(key: str) -> Any:
    """The body of :func:`change_of_stress`."""

    @body
    def change(arguments, count, p):
        F, D = array(arguments, 0, np.float64), array(arguments, 1, np.float64)
        out, par = array(arguments, 2, np.float64), array(arguments, 3, np.float64)
        for n in range(count):
            d, to = uint64(9) * uint64(n), uint64(9 * W) * uint64(n)
            direction = matrix_at(D, d, uint64(1))
            for l_ in range(W):
                l = uint64(l_)
                P = call(key, 0, (matrix_at(F, l, uint64(W)), direction, par, uint64(p) + uint64(1)))
                put(out, to + l, P[0])
                put(out, to + uint64(3 * W) + l, P[1])
                put(out, to + uint64(6 * W) + l, P[2])

    return change


@inline
def vector_at(a, at, stride):
    """The vector whose entries stand from ``at`` on, a stride apart."""
    return a[at], a[at + stride], a[at + stride + stride]


@inline
def matrix_at(a, at, stride):
    """The matrix whose columns stand one after the other from ``at`` on, entries a stride apart."""
    next_ = uint64(3) * stride
    return vector_at(a, at, stride), vector_at(a, at + next_, stride), vector_at(a, at + next_ + next_, stride)


@inline
def put(a, at, v):
    """Write the vector v of one lane to ``a[at:]``."""
    a[at], a[at + uint64(W)], a[at + uint64(2 * W)] = v


@inline
def load(a, j, l):
    """The vector at position j of lane l."""
    return vector_at(a, uint64(W) * uint64(j) + l, uint64(W))


@inline
def save(a, j, l, v):
    """Write v as the vector at position j of lane l."""
    put(a, uint64(W) * uint64(j) + l, v)


@inline
def matrix(a, j, l):
    """The matrix at position j of lane l."""
    return matrix_at(a, uint64(W) * uint64(j) + l, uint64(W))


@inline
def save_element(out, l, element, moves):
    """F, the gradients and the volume of an element, to lane l; the second gradient only if its corner moves."""
    F, ga, gb, ge, volume = element
    save(out, 0, l, F[0])
    save(out, 3, l, F[1])
    save(out, 6, l, F[2])
    save(out, 9, l, ga)
    save(out, 12, l, gb if moves else scale(0.0, gb))
    save(out, 15, l, ge)
    out[uint64(18 * W) + l] = volume


# -------------------------------------------------------------------------------------------------------- spectral


@inline
def _turn(app, arr, apr, akp, akr, p, r):
    """One Jacobi rotation of a symmetric matrix in the plane of axes p and r (columns), k being the third."""
    d = arr - app
    sign = 1.0 if d >= 0.0 else -1.0
    t = 2.0 * apr * sign / (abs(d) + math.sqrt(d * d + 4.0 * apr * apr) + 1e-300)
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = t * c
    return app - t * apr, arr + t * apr, c * akp - s * akr, s * akp + c * akr, combine(c, p, -s, r), combine(s, p, c, r)


@inline
def _round(a):
    """A sweep of Jacobi rotations over (diagonal, off-diagonal 01, 02, 12, axes); each zeroes one of the latter."""
    (a00, a11, a22, a01, a02, a12), (q0, q1, q2) = a
    a00, a11, a02, a12, q0, q1 = _turn(a00, a11, a01, a02, a12, q0, q1)
    a00, a22, a01, a12, q0, q2 = _turn(a00, a22, a02, 0.0, a12, q0, q2)
    a11, a22, a01, a02, q1, q2 = _turn(a11, a22, a12, a01, 0.0, q1, q2)
    return (a00, a11, a22, a01, a02, 0.0), (q0, q1, q2)


@inline
def eigen(a00, a11, a22, a01, a02, a12):
    """Eigenvalues and orthonormal axes of a symmetric 3x3 matrix, without a branch; the axes form a rotation."""
    one, o = 1.0 + 0.0 * a00, 0.0 * a00
    a = (a00, a11, a22, a01, a02, a12), ((one, o, o), (o, one, o), (o, o, one))
    (e0, e1, e2, _a01, _a02, _a12), axes = _round(_round(_round(_round(_round(a)))))
    return (e0, e1, e2), axes


@inline
def _positive(e, floor, fold):
    return max(max(e, -fold * e), floor)


@inline
def decompose(element, frame, points, work):
    """F = U diag(σ) Vᵀ in the lanes of a frame, by way of F = R S, which keeps small σ exact; and points = diag(σ)."""
    for l_ in range(W):
        l = uint64(l_)
        F = matrix(element, 0, l)
        R, _s = polar(F)
        s00, s11, s22 = dot(R[0], F[0]), dot(R[1], F[1]), dot(R[2], F[2])
        s01 = 0.5 * (dot(R[0], F[1]) + dot(R[1], F[0]))
        s02 = 0.5 * (dot(R[0], F[2]) + dot(R[2], F[0]))
        s12 = 0.5 * (dot(R[1], F[2]) + dot(R[2], F[1]))
        sigma, (v0, v1, v2) = eigen(s00, s11, s22, s01, s02, s12)
        save(frame, 0, l, mat_vec(R, v0))
        save(frame, 3, l, mat_vec(R, v1))
        save(frame, 6, l, mat_vec(R, v2))
        save(frame, 9, l, v0)
        save(frame, 12, l, v1)
        save(frame, 15, l, v2)
        save(frame, 18, l, sigma)
        r00, r11, r22 = dot(R[0], R[0]) - 1.0, dot(R[1], R[1]) - 1.0, dot(R[2], R[2]) - 1.0
        r01, r02, r12 = dot(R[0], R[1]), dot(R[0], R[2]), dot(R[1], R[2])
        frame[uint64(21 * W) + l] = r00 * r00 + r11 * r11 + r22 * r22 + r01 * r01 + r02 * r02 + r12 * r12
    U, S, V, A = work[0], work[1], work[2], work[3]
    for l_ in range(W):
        l = uint64(l_)
        if frame[uint64(21 * W) + l] > UNSURE * UNSURE:  # R is not unique
            signed_svd(matrix(element, 0, l), U, S, V, A)
            for k in range(3):
                save(frame, 3 * k, l, (U[0, k], U[1, k], U[2, k]))
                save(frame, 9 + 3 * k, l, (V[0, k], V[1, k], V[2, k]))
            save(frame, 18, l, (S[0], S[1], S[2]))
        sigma = load(frame, 18, l)
        save(points, 0, l, (sigma[0], 0.0, 0.0))
        save(points, 3, l, (0.0, sigma[1], 0.0))
        save(points, 6, l, (0.0, 0.0, sigma[2]))


@inline
def spectral_blocks(element, frame, change, l, floor, fold):
    """The blocks aa, ab, ae, bb, be, ee of lane l, projected, from the changes along SPECTRAL."""
    U, Vt = matrix(frame, 0, l), transpose(matrix(frame, 9, l))
    P0, P1, P2 = matrix(change, 0, l), matrix(change, 9, l), matrix(change, 18, l)
    off01, off02, off12 = 0.5 * (P0[1][1] + P1[0][0]), 0.5 * (P0[2][2] + P2[0][0]), 0.5 * (P1[2][2] + P2[1][1])
    (f0, f1, f2), (q0, q1, q2) = eigen(P0[0][0], P1[1][1], P2[2][2], off01, off02, off12)
    f0, f1, f2 = _positive(f0, floor, fold), _positive(f1, floor, fold), _positive(f2, floor, fold)
    A0 = combine3(f0 * q0[0], q0, f1 * q1[0], q1, f2 * q2[0], q2)
    A1 = combine3(f0 * q0[1], q0, f1 * q1[1], q1, f2 * q2[1], q2)
    A2 = combine3(f0 * q0[2], q0, f1 * q1[2], q1, f2 * q2[2], q2)
    p01 = _pair(matrix(change, 27, l), 0, 1, floor, fold)
    p02 = _pair(matrix(change, 36, l), 0, 2, floor, fold)
    p12 = _pair(matrix(change, 45, l), 1, 2, floor, fold)
    a = mat_vec(Vt, load(element, 9, l))
    b = mat_vec(Vt, load(element, 12, l))
    e = mat_vec(Vt, load(element, 15, l))
    return (
        _block(U, A0, A1, A2, p01, p02, p12, a, a),
        _block(U, A0, A1, A2, p01, p02, p12, a, b),
        _block(U, A0, A1, A2, p01, p02, p12, a, e),
        _block(U, A0, A1, A2, p01, p02, p12, b, b),
        _block(U, A0, A1, A2, p01, p02, p12, b, e),
        _block(U, A0, A1, A2, p01, p02, p12, e, e),
    )


@inline
def _pair(P, i, j, floor, fold):
    """Half the sum and half the difference of the eigenvalues of flip and twist, made positive, from δP (e_i e_jᵀ)."""
    s, d = P[j][i], P[i][j]
    flip, twist = _positive(s + d, floor, fold), _positive(s - d, floor, fold)
    return 0.5 * (flip + twist), 0.5 * (flip - twist)


@inline
def _block(U, A0, A1, A2, p01, p02, p12, g, h):
    """U K Uᵀ with K_ij = A_ij g_i h_j + d_ij g_j h_i off the diagonal, K_ii = A_ii g_i h_i + Σ_r s_ir g_r h_r."""
    w00, w11, w22 = g[0] * h[0], g[1] * h[1], g[2] * h[2]
    w01, w10 = g[0] * h[1], g[1] * h[0]
    w02, w20 = g[0] * h[2], g[2] * h[0]
    w12, w21 = g[1] * h[2], g[2] * h[1]
    K0 = (
        A0[0] * w00 + p01[0] * w11 + p02[0] * w22,
        A0[1] * w10 + p01[1] * w01,
        A0[2] * w20 + p02[1] * w02,
    )
    K1 = (
        A0[1] * w01 + p01[1] * w10,
        A1[1] * w11 + p01[0] * w00 + p12[0] * w22,
        A1[2] * w21 + p12[1] * w12,
    )
    K2 = (
        A0[2] * w02 + p02[1] * w20,
        A1[2] * w12 + p12[1] * w21,
        A2[2] * w22 + p02[0] * w00 + p12[0] * w11,
    )
    L0, L1, L2 = mat_vec(U, K0), mat_vec(U, K1), mat_vec(U, K2)  # columns of U K
    return (
        combine3(U[0][0], L0, U[1][0], L1, U[2][0], L2),
        combine3(U[0][1], L0, U[1][1], L1, U[2][1], L2),
        combine3(U[0][2], L0, U[1][2], L1, U[2][2], L2),
    )


# ------------------------------------------------------------------------------------------------------------ full


@inline
def full_blocks(element, change, l):
    """The blocks aa, ab, ae, bb, be, ee of lane l from ∂P_jk/∂F_im, at ``W * (9 * (3 m + i) + 3 k + j)``."""
    a, b, e = load(element, 9, l), load(element, 12, l), load(element, 15, l)
    return (
        _contracted(change, l, a, a),
        _contracted(change, l, a, b),
        _contracted(change, l, a, e),
        _contracted(change, l, b, b),
        _contracted(change, l, b, e),
        _contracted(change, l, e, e),
    )


@inline
def _contracted(change, l, g, h):
    """Columns i of Σ_km g_k h_m ∂P_jk/∂F_im."""
    return _column(change, l, 0, g, h), _column(change, l, 9, g, h), _column(change, l, 18, g, h)


@inline
def _column(change, l, at, g, h):
    x = combine3(g[0], load(change, at, l), g[1], load(change, at + 3, l), g[2], load(change, at + 6, l))
    y = combine3(g[0], load(change, at + 27, l), g[1], load(change, at + 30, l), g[2], load(change, at + 33, l))
    z = combine3(g[0], load(change, at + 54, l), g[1], load(change, at + 57, l), g[2], load(change, at + 60, l))
    return combine3(h[0], x, h[1], y, h[2], z)


@serial
def project(change, l, A, Q, floor, fold):
    """Make the matrix (9, 9) of lane l positive semidefinite, if it is not; A and Q are scratch (9, 9)."""
    total = 0.0
    for i in range(9):
        for j in range(i + 1):
            A[i, j] = A[j, i] = 0.5 * (change[W * (9 * i + j) + l] + change[W * (9 * j + i) + l])
        total += abs(A[i, i])
    if not _semidefinite(A, Q, SEMIDEFINITE * total):
        jacobi(A, Q)
        for n in range(9):
            A[n, n] = max(max(A[n, n], -fold * A[n, n]), floor)
        for i in range(9):
            for j in range(9):
                value = 0.0
                for n in range(9):
                    value += A[n, n] * Q[i, n] * Q[j, n]
                change[W * (9 * i + j) + l] = value


@serial
def _semidefinite(A, L, shift):
    """Whether A + shift I has a Cholesky factor, which is written to L."""
    for j in range(9):
        d = A[j, j] + shift
        for k in range(j):
            d -= L[j, k] * L[j, k]
        if not d > 0.0:
            return False
        L[j, j] = math.sqrt(d)
        for i in range(j + 1, 9):
            value = A[i, j]
            for k in range(j):
                value -= L[i, k] * L[j, k]
            L[i, j] = value / L[j, j]
    return True


# ------------------------------------------------------------------------------------------------------- the matrix


@inline
def _put(out, j, l, v, K):
    """Write v times a block, given by columns, row by row as number j."""
    at = uint64(9 * W * j) + l
    w = uint64(W)
    out[at], out[at + w], out[at + uint64(2) * w] = v * K[0][0], v * K[1][0], v * K[2][0]
    at += uint64(3) * w
    out[at], out[at + w], out[at + uint64(2) * w] = v * K[0][1], v * K[1][1], v * K[2][1]
    at += uint64(3) * w
    out[at], out[at + w], out[at + uint64(2) * w] = v * K[0][2], v * K[1][2], v * K[2][2]


@inline
def _sum(A, B):
    return add(A[0], B[0]), add(A[1], B[1]), add(A[2], B[2])


@inline
def store(out, l, element, blocks):
    """Write the blocks of corners a <= b, in order p, q, r, x, times the volume."""
    aa, ab, ae, bb, be, ee = blocks
    volume = element[uint64(18 * W) + l]
    pa = _sum(_sum(aa, transpose(ab)), transpose(ae))
    pb = _sum(_sum(ab, bb), transpose(be))
    pe = _sum(_sum(ae, be), ee)
    _put(out, 0, l, volume, _sum(_sum(pa, pb), pe))
    _put(out, 1, l, -volume, pa)
    _put(out, 2, l, -volume, pb)
    _put(out, 3, l, -volume, pe)
    _put(out, 4, l, volume, aa)
    _put(out, 5, l, volume, ab)
    _put(out, 6, l, volume, ae)
    _put(out, 7, l, volume, bb)
    _put(out, 8, l, volume, be)
    _put(out, 9, l, volume, ee)


@inline
def scatter(m, place, at, value, out, corners, plane):
    """Add the blocks of the first m lanes to their places, and those of exchanged corners transposed.

    The block of corners a, b goes to number ``place[at + W * (corners * a + b) + l]``, or nowhere if that is -1. In the
    plane there is no corner r, and z is decoupled, and stiff, so that nothing moves along it.
    """
    w = uint64(W)
    for l_ in range(m):
        l = uint64(l_)
        for a in range(corners):
            for b in range(a, corners):
                first, second = a + (corners == 3 and a == 2), b + (corners == 3 and b == 2)
                j = l + uint64(9 * W) * uint64(first * (9 - first) // 2 + second - first)
                to = place[at + w * uint64(corners * a + b) + l]
                if to >= 0:
                    v = uint64(9) * uint64(to)
                    value[v] += out[j]
                    value[v + uint64(1)] += out[j + w]
                    value[v + uint64(3)] += out[j + uint64(3) * w]
                    value[v + uint64(4)] += out[j + uint64(4) * w]
                    if not plane:
                        value[v + uint64(2)] += out[j + uint64(2) * w]
                        value[v + uint64(5)] += out[j + uint64(5) * w]
                        value[v + uint64(6)] += out[j + uint64(6) * w]
                        value[v + uint64(7)] += out[j + uint64(7) * w]
                        value[v + uint64(8)] += out[j + uint64(8) * w]
                    elif a == b:
                        value[v + uint64(8)] += abs(out[j]) + abs(out[j + uint64(4) * w])
                    if a != b:
                        v = uint64(9) * uint64(place[at + w * uint64(corners * b + a) + l])
                        value[v] += out[j]
                        value[v + uint64(1)] += out[j + uint64(3) * w]
                        value[v + uint64(3)] += out[j + w]
                        value[v + uint64(4)] += out[j + uint64(4) * w]
                        if not plane:
                            value[v + uint64(2)] += out[j + uint64(6) * w]
                            value[v + uint64(5)] += out[j + uint64(7) * w]
                            value[v + uint64(6)] += out[j + uint64(2) * w]
                            value[v + uint64(7)] += out[j + uint64(5) * w]
                            value[v + uint64(8)] += out[j + uint64(8) * w]
