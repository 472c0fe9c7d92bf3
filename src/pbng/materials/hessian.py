"""Positive definite Hessians ∂P/∂F of any material, from its stress alone.

For an isotropic material and F = U diag(σ) Vᵀ the Hessian is known from the principal stresses p(σ), which are the
stress of a diagonal F: in the axes of U and V it consists of the 3x3 matrix ∂p_i/∂σ_j and, for each pair i, j, of the
eigenvalues (p_i + p_j) / (σ_i + σ_j) of a twist and (p_i - p_j) / (σ_i - σ_j) of a flip (Smith et al. 2019, "Analytic
Eigensystems for Isotropic Distortion Energies"). Derivatives are taken by differences, and eigenvalues below a floor
are raised to it. A material that is not isotropic is differenced in all nine entries.

So that little is compiled for a material, the work goes in three steps: where the stress is needed, the stress there
(the only step that knows the material), and what follows from it.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.dispatch import call, specialised
from pbng.jit import inline, serial
from pbng.materials.base import Model
from pbng.parallel import array, body, each, rows
from pbng.spectral import jacobi, signed_svd

STEP = 1e-6  # of a difference
W = 16  # points side by side
POINTS = {True: 4, False: 10}  # where the stress of an isotropic material is needed, and of another
_1, _2, _3, _4, _5, _6, _7, _8 = (uint64(W * j) for j in range(1, 9))


def hessians(model: Model, F: np.ndarray, numbers: np.ndarray, floor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """∂P/∂F = Σ_k e_k M_k M_kᵀ, the symmetric part with eigenvalues raised to a floor.

    Args:
        model: The material's model.
        F: Deformation gradients, (n, 3, 3) float64.
        numbers: The model's parameters for each, (n, n_parameters).
        floor: Lowest eigenvalues [Pa], (n,).

    Returns:
        e [Pa], (n, 9), and the modes M, (n, 9, 9), of which ``M[:, k, 3 * i + j]`` belongs to F_ij.
    """
    n, count = len(F), POINTS[model.isotropic]
    if n == 0:
        return np.empty((0, 9)), np.empty((0, 9, 9))
    n_block = -(-n * count // W)
    # Entries of W points side by side; what is not a point is rest.
    points, stress = np.empty((n_block, 9, W)), np.empty((n_block, 9, W))
    points[-1:] = np.eye(3).reshape(9, 1)
    repeated = np.repeat(numbers, count, axis=0)
    padded = np.concatenate([repeated, np.repeat(repeated[-1:], n_block * W - len(repeated), axis=0)])
    lanes = np.ascontiguousarray(padded.reshape(n_block, W, -1).transpose(0, 2, 1))
    frames, e, M = np.empty((n, 21)), np.empty((n, 9)), np.empty((n, 9, 9))
    isotropic = np.array([model.isotropic])
    each(_points, (np.ascontiguousarray(F), isotropic, frames, points), n, grain=64)
    kernel = specialised(make_stress, (_stress(model),), model.n_parameters)
    each(kernel, (points, lanes, stress), n_block, grain=16)
    each(_modes, (isotropic, frames, stress, np.ascontiguousarray(floor), e, M), n, grain=64)
    return e, M


@cache
def _stress(model: Model) -> Any:
    numbers, stress = _lane_parameters(model.n_parameters), model.stress
    return inline(lambda F, par, p: stress(F, *numbers(par, p)))


@cache
def _lane_parameters(n: int) -> Any:
    """``(par, p)``: n numbers of one lane, as a tuple."""
    if n == 0:
        return inline(lambda par, p: ())
    before, last = _lane_parameters(n - 1), uint64(W * (n - 1))
    return inline(lambda par, p: (*before(par, p), par[p + last]))


def make_stress(key: str, n_parameters: int) -> Any:
    """Body of the second step: stresses of blocks low .. high of W points."""
    width = uint64(W * n_parameters)

    @body
    def stress(arguments, low, high):
        F, par, P = array(arguments, 0, np.float64), array(arguments, 1, np.float64), array(arguments, 2, np.float64)
        for b in range(low, high):
            first, own = uint64(b) * uint64(9 * W), uint64(b) * width
            for l_ in range(W):
                l = uint64(l_)
                i = first + l
                f = (F[i], F[i + _3], F[i + _6]), (F[i + _1], F[i + _4], F[i + _7]), (F[i + _2], F[i + _5], F[i + _8])
                p = call(key, 0, (f, par, own + l))
                P[i], P[i + _3], P[i + _6] = p[0]
                P[i + _1], P[i + _4], P[i + _7] = p[1]
                P[i + _2], P[i + _5], P[i + _8] = p[2]

    return stress


@body
def _points(arguments, low, high):
    """Body of the first step, for deformation gradients low .. high: U, V, σ to frames, and the points."""
    F, isotropic = rows(arguments, 0, 9, np.float64), array(arguments, 1, np.bool_)[0]
    frames, points = rows(arguments, 2, 21, np.float64), array(arguments, 3, np.float64)
    A = np.empty((3, 3))
    for n in range(low, high):
        f = F[n]
        if isotropic:
            frame = frames[n]
            U, V, S = frame[:9].reshape((3, 3)), frame[9:18].reshape((3, 3)), frame[18:]
            signed_svd(((f[0], f[3], f[6]), (f[1], f[4], f[7]), (f[2], f[5], f[8])), U, S, V, A)
        for t in range(4 if isotropic else 10):  # at F, then with one entry after the other increased
            point = n * (4 if isotropic else 10) + t
            first = point // W * (9 * W) + point % W
            for k in range(9):
                if isotropic:
                    value = frames[n, 18 + k // 4] if k % 4 == 0 else 0.0
                    own = k == 4 * (t - 1)
                else:
                    value, own = f[k], k == t - 1
                points[first + W * k] = value + (_step(frames[n, 18], isotropic) if t > 0 and own else 0.0)


@serial
def _step(largest, isotropic):
    return STEP * (1.0 + abs(largest)) if isotropic else STEP


@body
def _modes(arguments, low, high):
    """Body of the third step: eigenvalues and modes low .. high."""
    isotropic, frames = array(arguments, 0, np.bool_)[0], rows(arguments, 1, 21, np.float64)
    stress, floor = array(arguments, 2, np.float64), array(arguments, 3, np.float64)
    e, M = rows(arguments, 4, 9, np.float64), rows(arguments, 5, 81, np.float64)
    A, Q, p, H = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 3)), np.empty((9, 9))
    for n in range(low, high):
        if isotropic:
            for t in range(4):
                first = (4 * n + t) // W * (9 * W) + (4 * n + t) % W
                for k in range(3):
                    p[t, k] = stress[first + W * 4 * k]
            frame = frames[n]
            U, V, S = frame[:9].reshape((3, 3)), frame[9:18].reshape((3, 3)), frame[18:]
            _principal(U, S, V, p, _step(S[0], True), floor[n], A, Q, e[n], M[n].reshape((9, 9)))
        else:
            for t in range(1, 10):
                origin, first = 10 * n, 10 * n + t
                origin = origin // W * (9 * W) + origin % W
                first = first // W * (9 * W) + first % W
                for k in range(9):
                    H[k, t - 1] = (stress[first + W * k] - stress[origin + W * k]) / _step(0.0, False)
            _raised(H, floor[n], e[n], M[n].reshape((9, 9)))


@serial
def _principal(U, S, V, p, h, floor, A, Q, e, M):
    """Eigenvalues and modes from principal stretches S, axes U, V and principal stresses p; A and Q are scratch."""
    for i in range(3):
        for j in range(3):
            A[i, j] = ((p[1 + j, i] - p[0, i]) + (p[1 + i, j] - p[0, j])) / (2 * h)
    for pair in range(3):
        m, r = (0, 1) if pair == 0 else (0, 2) if pair == 1 else (1, 2)
        total, difference = S[m] + S[r], S[m] - S[r]
        if abs(difference) > 1e-3 * (1.0 + abs(S[m])):
            flip = (p[0, m] - p[0, r]) / difference
        else:  # the limit, which is right to second order in the difference
            flip = 0.5 * (A[m, m] + A[r, r]) - A[m, r]
        e[3 + pair] = max(flip, floor)
        sum_ = p[0, m] + p[0, r]
        if abs(total) > 1e-6 * (1.0 + abs(S[m])):
            twist = sum_ / total
        elif abs(sum_) <= 1e-5 * (abs(p[0, m]) + abs(p[0, r])):  # the limit again
            twist = 0.5 * (A[m, m] + A[r, r]) + A[m, r]
        else:  # a kink: without bound from below
            twist = floor
        e[6 + pair] = max(twist, floor)
        for i in range(3):
            for k in range(3):
                u, v = math.sqrt(0.5) * U[i, m] * V[k, r], math.sqrt(0.5) * U[i, r] * V[k, m]
                M[3 + pair, 3 * i + k], M[6 + pair, 3 * i + k] = u + v, u - v
    jacobi(A, Q)
    for n in range(3):
        e[n] = max(A[n, n], floor)
        for i in range(3):
            for k in range(3):
                mode = Q[0, n] * U[i, 0] * V[k, 0] + Q[1, n] * U[i, 1] * V[k, 1] + Q[2, n] * U[i, 2] * V[k, 2]
                M[n, 3 * i + k] = mode


@serial
def _raised(H, floor, e, M):
    """The same of a matrix (9, 9), which is overwritten."""
    for i in range(9):
        for j in range(i):
            H[i, j] = H[j, i] = 0.5 * (H[i, j] + H[j, i])
    jacobi(H, M)
    for i in range(9):
        for j in range(i):
            M[i, j], M[j, i] = M[j, i], M[i, j]  # modes are rows
    for n in range(9):
        e[n] = max(H[n, n], floor)
