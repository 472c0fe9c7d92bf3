"""Eigenvalues and singular values of small matrices by Jacobi rotations: exact for multiple ones too."""

import math

from pbng.jit import serial
from pbng.linalg import cross, dot, mat_vec

SWEEPS = 12  # over all pairs; three or four are what a 3x3 matrix needs


@serial
def jacobi(A, Q):
    """Diagonalise the symmetric matrix A in place, A = Q diag Qᵀ; Q is overwritten."""
    n = A.shape[0]
    total = 0.0
    for i in range(n):
        for j in range(n):
            Q[i, j] = 1.0 if i == j else 0.0
            total += A[i, j] * A[i, j]
    for _ in range(SWEEPS):
        off = 0.0
        for i in range(n):
            for j in range(i):
                off += A[i, j] * A[i, j]
        if not off > 1e-26 * total:
            break
        for p in range(n - 1):
            for r in range(p + 1, n):
                a = A[p, r]
                if a == 0.0:
                    continue
                theta = (A[r, r] - A[p, p]) / (2 * a)
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + math.sqrt(theta * theta + 1))
                c = 1 / math.sqrt(t * t + 1)
                s = t * c
                for k in range(n):
                    u, v = A[k, p], A[k, r]
                    A[k, p], A[k, r] = c * u - s * v, s * u + c * v
                for k in range(n):
                    u, v = A[p, k], A[r, k]
                    A[p, k], A[r, k] = c * u - s * v, s * u + c * v
                for k in range(n):
                    u, v = Q[k, p], Q[k, r]
                    Q[k, p], Q[k, r] = c * u - s * v, s * u + c * v


@serial
def signed_svd(F, U, S, V, A):
    """F = U diag(S) Vᵀ with rotations U and V, S falling in size, and only the last perhaps negative.

    F is a tuple of columns; U, S, V are written, A is scratch (3, 3).
    """
    for i in range(3):
        for j in range(3):
            A[i, j] = dot(F[i], F[j])
    jacobi(A, V)
    for a in range(2):  # sort by falling eigenvalue
        for b in range(2 - a):
            if A[b, b] < A[b + 1, b + 1]:
                A[b, b], A[b + 1, b + 1] = A[b + 1, b + 1], A[b, b]
                for k in range(3):
                    V[k, b], V[k, b + 1] = V[k, b + 1], -V[k, b]
    v0, v1 = (V[0, 0], V[1, 0], V[2, 0]), (V[0, 1], V[1, 1], V[2, 1])
    v2 = cross(v0, v1)
    V[0, 2], V[1, 2], V[2, 2] = v2
    u0, S[0] = _unit(mat_vec(F, v0), (1.0, 0.0, 0.0), 1e-30)
    w = mat_vec(F, v1)
    along = dot(u0, w)
    w = (w[0] - along * u0[0], w[1] - along * u0[1], w[2] - along * u0[2])
    # Where F has rank one any unit vector across u0 will do.
    other = (0.0, 1.0, 0.0) if abs(u0[0]) > 0.6 else (1.0, 0.0, 0.0)
    across, _ = _unit(cross(u0, other), other, 0.0)
    u1, S[1] = _unit(w, across, 1e-12 * S[0] + 1e-30)
    u2 = cross(u0, u1)
    S[2] = dot(u2, mat_vec(F, v2))
    for k in range(3):
        U[k, 0], U[k, 1], U[k, 2] = u0[k], u1[k], u2[k]


@serial
def _unit(a, otherwise, least):
    """The direction of a and its length; another direction if it is no longer than ``least``."""
    length = math.sqrt(dot(a, a))
    if not length > least:
        return otherwise, length
    return (a[0] / length, a[1] / length, a[2] / length), length
