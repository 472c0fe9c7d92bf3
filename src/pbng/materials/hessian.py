"""Positive definite Hessians ∂P/∂F of any material, from its stress alone.

For an isotropic material and F = U diag(σ) Vᵀ the Hessian is known from the principal stresses p(σ), which are the
stress of a diagonal F: in the axes of U and V it consists of the 3x3 matrix ∂p_i/∂σ_j and, for each pair i, j, of the
eigenvalues (p_i + p_j) / (σ_i + σ_j) of a twist and (p_i - p_j) / (σ_i - σ_j) of a flip (Smith et al. 2019, "Analytic
Eigensystems for Isotropic Distortion Energies"). Derivatives are taken by differences, and eigenvalues below a floor
are raised to it. A material that is not isotropic is differenced in all nine entries.
"""

import math
from functools import cache
from typing import Any

from pbng.jit import inline, serial
from pbng.materials.base import Model
from pbng.spectral import jacobi, signed_svd

STEP = 1e-6  # of a difference
WORK = 96  # scratch numbers that a Hessian needs


@cache
def hessian(model: Model) -> Any:
    """``(F, numbers, floor, e, M, work)``: write ∂P/∂F = Σ_n e_n M_n M_nᵀ, the symmetric part with all e_n >= floor.

    F is a tuple of columns in float64, ``numbers`` the model's parameters; e (9,), the modes M (9, 9), whose entry
    ``M[n, 3 * i + k]`` belongs to F_ik, are written; ``work`` is scratch of WORK numbers.
    """
    return _isotropic(model.stress) if model.isotropic else _general(model.stress)


def _isotropic(stress: Any) -> Any:
    @inline
    def hessian(F, numbers, floor, e, M, work):
        U, V, A = work[:9].reshape((3, 3)), work[9:18].reshape((3, 3)), work[18:27].reshape((3, 3))
        Q, S, p = work[27:36].reshape((3, 3)), work[36:39], work[39:51].reshape((4, 3))
        signed_svd(F, U, S, V, A)
        h = STEP * (1.0 + abs(S[0]))
        for t in range(4):  # p at σ, then with one stretch after the other increased
            s0 = S[0] + (h if t == 1 else 0.0)
            s1 = S[1] + (h if t == 2 else 0.0)
            s2 = S[2] + (h if t == 3 else 0.0)
            P = stress(((s0, 0.0, 0.0), (0.0, s1, 0.0), (0.0, 0.0, s2)), *numbers)
            p[t, 0], p[t, 1], p[t, 2] = P[0][0], P[1][1], P[2][2]
        _modes(U, S, V, p, h, floor, A, Q, e, M)

    return hessian


@serial
def _modes(U, S, V, p, h, floor, A, Q, e, M):
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
        e[6 + pair] = max((p[0, m] + p[0, r]) / (total if abs(total) > 1e-9 else 1e-9), floor)
        for i in range(3):
            for k in range(3):
                u, v = math.sqrt(0.5) * U[i, m] * V[k, r], math.sqrt(0.5) * U[i, r] * V[k, m]
                M[3 + pair, 3 * i + k], M[6 + pair, 3 * i + k] = u + v, u - v
    jacobi(A, Q)
    for n in range(3):
        e[n] = max(A[n, n], floor)
        for i in range(3):
            for k in range(3):
                M[n, 3 * i + k] = (
                    Q[0, n] * U[i, 0] * V[k, 0] + Q[1, n] * U[i, 1] * V[k, 1] + Q[2, n] * U[i, 2] * V[k, 2]
                )


def _general(stress: Any) -> Any:
    @inline
    def hessian(F, numbers, floor, e, M, work):
        f, H = work[:9], work[9:90].reshape((9, 9))
        for j in range(3):
            for l in range(3):
                f[3 * j + l] = F[j][l]
        for n in range(18):  # column j, row l of F; above, then below
            at = n // 2
            own = f[at]
            f[at] = own + (STEP if n % 2 == 0 else -STEP)
            P = stress(((f[0], f[1], f[2]), (f[3], f[4], f[5]), (f[6], f[7], f[8])), *numbers)
            f[at] = own
            to = 3 * (at % 3) + at // 3
            for k in range(3):
                for i in range(3):
                    H[3 * i + k, to] = P[k][i] if n % 2 == 0 else (H[3 * i + k, to] - P[k][i]) / (2 * STEP)
        _raised(H, floor, e, M)

    return hessian


@serial
def _raised(H, floor, e, M):
    for i in range(9):
        for j in range(i):
            H[i, j] = H[j, i] = 0.5 * (H[i, j] + H[j, i])
    Q = M.T
    jacobi(H, Q)
    for n in range(9):
        e[n] = max(H[n, n], floor)
