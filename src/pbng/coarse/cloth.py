"""Cloth in the coarse space: it is corrected vertex by vertex, with grids only to precondition that.

Grids do not serve cloth as they serve solids: what is soft in it, folds as wide as a few triangles, lies in no grid.
So its own free vertices are nodes of the finest level, with UᵀHU the Hessian itself, and the grids follow by exact
restriction of it: RᵀKR, summed by constant matrices over the blocks of K.

For F = U diag(σ) Vᵀ the Hessian of a membrane has the modes of :mod:`pbng.materials.hessian` in the plane of the
triangle, and out of it two with eigenvalues p_i / σ_i, the tension over the stretch. Hinges count w k g gᵀ with
g = ∂θ/∂x. Conjugate gradients are preconditioned with eigenvalues raised to a floor; they take the matrix as it is,
until it is found indefinite.
"""

import math
from functools import cache
from typing import Any

import numpy as np
import scipy.sparse

from pbng.dispatch import call, specialised
from pbng.elements.base import parameters
from pbng.elements.hinge import Hinge, fold, gradients, least_squares
from pbng.elements.membrane import plane_gradients
from pbng.jit import inline, serial
from pbng.linalg import combine, cross, dot, scale
from pbng.materials.base import Model
from pbng.parallel import array, body, each, rows
from pbng.problem import ElementGroup, Problem
from pbng.topology import entries

FLOOR = 1e-5  # of the a of a material's block: lowest eigenvalue; the tension that holds cloth is little more
STEP = 1e-6  # of a difference of stresses


class ClothHessian:
    """The Hessian of the cloth of a problem over its free vertices, in blocks of 3x3.

    Args:
        problem: What is solved.
        slot: Place of each vertex in position arrays.
        node: Number of each free vertex of cloth, (n_vert,); -1 for others.
        n: How many numbers there are.

    Attributes:
        keys: n * row + column of the blocks, rising, (n_block,) int64.
    """

    def __init__(self, problem: Problem, slot: np.ndarray, node: np.ndarray, n: int) -> None:
        self.parts: list[tuple[Any, tuple[np.ndarray, ...], int]] = []  # bodies, what they read, and blocks an element
        pairs = []
        for group in problem.groups:
            if group.kind.solid:
                continue
            cells = group.cells
            place, X = np.ascontiguousarray(4 * slot[cells], np.int64), problem.X[cells]
            if isinstance(group.kind, Hinge):
                self.parts.append((_hinges, (place, _hinge_data(group, X)), len(cells)))
            else:
                numbers = np.array(group.material.parameters(), float)
                read = place, _membrane_data(group, X), numbers
                self.parts.append((_membranes(group.term.model), read, len(cells)))
            k, row = cells.shape[1], node[cells]
            i, j = np.repeat(row, k, axis=1).ravel(), np.tile(row, (1, k)).ravel()
            pairs.append(np.where((i < 0) | (j < 0), -1, i.astype(np.int64) * n + j))
        pair = np.concatenate(pairs)
        counted = np.flatnonzero(pair >= 0)
        self.keys, block = np.unique(pair[counted], return_inverse=True)
        self.sum = scipy.sparse.csr_matrix((np.ones(len(block)), (block, counted)), (len(self.keys), len(pair)))
        self.value = np.empty((2, len(pair), 9))

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Its blocks (n_block, 9) [N/m] at a flat position array, made positive definite, and as they are."""
        x, first = np.asarray(x, np.float64), 0
        for kernel, (place, data, *more), n in self.parts:
            last = first + n * place.shape[1] ** 2
            each(kernel, (x, place, data, *more, *self.value[:, first:last]), n, grain=64)
            first = last
        return np.asarray(self.sum @ self.value[0]), np.asarray(self.sum @ self.value[1])


class Restriction:
    """K -> RᵀKR for matrices of blocks with one pattern, as two constant matrices over their blocks.

    Args:
        keys: n * row + column of the blocks of K.
        R: Weights (n, m).

    Attributes:
        keys: m * row + column of the blocks of RᵀKR.
    """

    def __init__(self, keys: np.ndarray, R: scipy.sparse.csr_matrix) -> None:
        n, m = R.shape
        right, self.right = _expanded(keys // n, keys % n, R)  # K R, blocks by m * row + column
        left, self.left = _expanded(right % m, right // m, R)
        order = np.argsort(left % m * m + left // m)
        self.keys, self.left = (left % m * m + left // m)[order], self.left[order]

    def __call__(self, value: np.ndarray) -> np.ndarray:
        """Blocks of RᵀKR from those of K, (n_block, 9)."""
        return np.asarray(self.left @ (self.right @ value))


def _expanded(
    kept: np.ndarray, summed: np.ndarray, R: scipy.sparse.csr_matrix
) -> tuple[np.ndarray, scipy.sparse.csr_matrix]:
    """Keys m * kept + j of Σ_s K[kept, s] R[s, j], and the matrix over the blocks of K that sums them."""
    of, at = entries(R.indptr, summed)
    keys, to = np.unique(kept[of] * R.shape[1] + R.indices[at], return_inverse=True)
    return keys, scipy.sparse.csr_matrix((R.data[at], (to, of)), (len(keys), len(summed)))


# ------------------------------------------------------------------------------------------------------- membranes


def _membrane_data(group: ElementGroup, X: np.ndarray) -> np.ndarray:
    """Gradients of the shape functions (3, 2), the first axis along an edge, the area and the floor, (n, 8)."""
    floor = np.full(len(X), FLOOR * group.block().a)
    return np.column_stack([plane_gradients(X).reshape(-1, 6), group.kind.volume(X), floor])


@cache
def _membranes(model: Model) -> Any:
    numbers, stress = parameters(model.n_parameters), model.stress
    return specialised(make_membranes, (inline(lambda F, par, p: stress(F, *numbers(par, p))),))


def make_membranes(key: str) -> Any:
    """Body that writes the blocks of membranes low .. high, 9 for each."""

    @body
    def membranes(arguments, low, high):
        x, place = array(arguments, 0, np.float64), rows(arguments, 1, 3, np.int64)
        data, par = rows(arguments, 2, 8, np.float64), array(arguments, 3, np.float64)
        out, exact = rows(arguments, 4, 81, np.float64), rows(arguments, 5, 81, np.float64)
        for t in range(low, high):
            G, area, floor = data[t], data[t, 6], data[t, 7]
            x0, x1, x2 = _at(x, place[t, 0]), _at(x, place[t, 1]), _at(x, place[t, 2])
            F0, F1 = _sum(G[0], x0, G[2], x1, G[4], x2), _sum(G[1], x0, G[3], x1, G[5], x2)
            s0, s1, u0, u1, n, c, s = _decomposed(F0, F1)
            zero, h = 0.0, STEP * (1.0 + s0)
            P = call(key, 0, (((s0, zero, zero), (zero, s1, zero)), par, np.uint64(0)))
            A = call(key, 0, (((s0 + h, zero, zero), (zero, s1, zero)), par, np.uint64(0)))
            B = call(key, 0, (((s0, zero, zero), (zero, s1 + h, zero)), par, np.uint64(0)))
            p0, p1 = P[0][0], P[1][1]
            a00, a11 = (A[0][0] - p0) / h, (B[1][1] - p1) / h
            a01 = 0.5 * ((A[1][1] - p1) + (B[0][0] - p0)) / h
            apart = s0 - s1
            flip = (p0 - p1) / apart if apart > 1e-3 * (1.0 + s0) else 0.5 * (a00 + a11) - a01
            twist = (p0 + p1) / max(s0 + s1, 1e-9)
            e0, e1, q0, q1 = _eigen(a00, a01, a11)
            across0, across1 = p0 / max(s0, 1e-9), p1 / max(s1, 1e-9)
            frame, modes = (u0, u1, n, c, s), (a00, a01, a11, 0.5 * (flip + twist), 0.5 * (flip - twist))
            _store(exact[t], area, G, frame, modes, (across0, across1))
            e0, e1, flip, twist = max(e0, floor), max(e1, floor), max(flip, floor), max(twist, floor)
            k00, k01, k11 = e0 * q0 * q0 + e1 * q1 * q1, (e0 - e1) * q0 * q1, e0 * q1 * q1 + e1 * q0 * q0
            modes = k00, k01, k11, 0.5 * (flip + twist), 0.5 * (flip - twist)
            _store(out[t], area, G, frame, modes, (max(across0, floor), max(across1, floor)))

    return membranes


@serial
def _store(out, area, G, frame, modes, across):
    """Write the nine blocks of a membrane."""
    u0, u1, n, c, s = frame
    k00, k01, k11, same, other = modes
    for a in range(3):
        ga0, ga1 = c * G[2 * a] + s * G[2 * a + 1], c * G[2 * a + 1] - s * G[2 * a]
        for b in range(3):
            gb0, gb1 = c * G[2 * b] + s * G[2 * b + 1], c * G[2 * b + 1] - s * G[2 * b]
            m00 = area * (k00 * ga0 * gb0 + same * ga1 * gb1)
            m01 = area * (k01 * ga0 * gb1 + other * ga1 * gb0)
            m10 = area * (k01 * ga1 * gb0 + other * ga0 * gb1)
            m11 = area * (k11 * ga1 * gb1 + same * ga0 * gb0)
            m = area * (across[0] * ga0 * gb0 + across[1] * ga1 * gb1)
            v0, v1 = combine(m00, u0, m10, u1), combine(m01, u0, m11, u1)
            at = 27 * a + 9 * b
            for i in range(3):
                for j in range(3):
                    out[at + 3 * i + j] = v0[i] * u0[j] + v1[i] * u1[j] + m * n[i] * n[j]


@inline
def _at(x, p):
    return x[p], x[p + 1], x[p + 2]


@inline
def _sum(a, x, b, y, c, z):
    return a * x[0] + b * y[0] + c * z[0], a * x[1] + b * y[1] + c * z[1], a * x[2] + b * y[2] + c * z[2]


@inline
def _eigen(a, b, d):
    """Eigenvalues of the matrix (a, b; b, d), the larger first, with the eigenvector (q0, q1) of that."""
    mean, half = 0.5 * (a + d), 0.5 * (a - d)
    r = math.sqrt(half * half + b * b)
    if r == 0.0:
        return mean, mean, 1.0, 0.0
    cosine = math.sqrt(0.5 * (1.0 + abs(half) / r))  # of the angle to the nearer axis
    sine = 0.5 * b / (r * cosine)
    q0, q1 = (cosine, sine) if half >= 0 else (abs(sine), math.copysign(cosine, b))
    return mean + r, mean - r, q0, q1


@inline
def _decomposed(F0, F1):
    """σ₀ >= σ₁ >= 0, u₀, u₁, u₀ x u₁, and the rotation (c, s) of V = (c, -s; s, c); any axes where F is degenerate."""
    _e0, _e1, c, s = _eigen(dot(F0, F0), dot(F0, F1), dot(F1, F1))
    a, b = combine(c, F0, s, F1), combine(-s, F0, c, F1)
    s0 = math.sqrt(dot(a, a))
    u0 = scale(1.0 / s0, a) if s0 > 1e-30 else (1.0, 0.0, 0.0)
    b = combine(1.0, b, -dot(u0, b), u0)
    s1 = math.sqrt(dot(b, b))
    if s1 > 1e-12 * s0 + 1e-30:
        u1 = scale(1.0 / s1, b)
    else:
        m = cross(u0, (0.0, 1.0, 0.0) if abs(u0[0]) > 0.6 else (1.0, 0.0, 0.0))
        u1 = scale(1.0 / math.sqrt(dot(m, m)), m)
    return s0, s1, u0, u1, cross(u0, u1), c, s


# ---------------------------------------------------------------------------------------------------------- hinges


def _hinge_data(group: ElementGroup, X: np.ndarray) -> np.ndarray:
    """w k and the least |n|², (n, 2)."""
    return np.column_stack([group.kind.volume(X) * group.block().a, least_squares(X)])


@body
def _hinges(arguments, low, high):
    """Body that writes the blocks of hinges low .. high, 16 for each."""
    x, place = array(arguments, 0, np.float64), rows(arguments, 1, 4, np.int64)
    data, out, exact = (
        rows(arguments, 2, 2, np.float64),
        rows(arguments, 3, 144, np.float64),
        rows(arguments, 4, 144, np.float64),
    )
    for t in range(low, high):
        x0, x1, x2, x3 = _at(x, place[t, 0]), _at(x, place[t, 1]), _at(x, place[t, 2]), _at(x, place[t, 3])
        _angle, e, length, unit, a, b, p, q = fold(x0, x1, x2, x3, data[t, 1])
        g = gradients(e, length, unit, a, b, p, q)
        for i in range(4):
            for j in range(4):
                for k in range(3):
                    for l in range(3):
                        out[t, 36 * i + 9 * j + 3 * k + l] = data[t, 0] * g[i][k] * g[j][l]
        exact[t] = out[t]
