"""Triangles in space with constant F of two columns: the membrane of cloth, Eq. (36).

An incidence is a node x with the other corners p, q; a = q - p is the edge opposite to x, and e = x - p. The rest
state's axes are turned so that the first lies along a: then the gradient of x's shape function lies along the second,
and F = [k0 a, k1 a + k2 e]. What a node displaced by u sees is J = |m + k2 F₀ x u| with F₀ the first column, and

    b/2 (J - 1)² = b/2 J² - b J + b/2,    J² a quadratic with the Hessian 2 k2² (|F₀|² I - F₀ F₀ᵀ),  J convex,

so that b k2² (|F₀|² I - F₀ F₀ᵀ) majorises it; the paper's b c cᵀ with c = ∂J/∂x = k2 n x F₀ lacks what is along n.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.elements.base import AHEAD, ElementKind, W, add_outer, gather, parameters, spread, summed, vec, wide_vec
from pbng.elements.simplex import corner
from pbng.errors import InputError
from pbng.jit import inline
from pbng.linalg import add, combine, cross, dot, scale, sub
from pbng.materials.base import Model

COEFFICIENTS, COMPOUND = 4, 6  # of an incidence: k0, k1, k2, w = A₀ k2; of a compound's: k0, k1, k2, A₀, g0, g1
zero = uint64(0)
_1, _2, _3, _4, _5, _6 = (uint64(W * j) for j in range(1, 7))
_7, _8, _9, _10, _11, _12 = (uint64(W * j) for j in range(7, 13))
_Q, _R = (uint64(4 * W * j) for j in range(1, 3))  # second and third vertex in the scratch array


@inline
def frame(a, e):
    """k0, k1, k2 and the rest area A₀ from the rest edges."""
    one = type(a[0])(1)
    la = math.sqrt(dot(a, a))
    m = cross(a, e)
    twice = math.sqrt(dot(m, m))
    return one / la, -dot(a, e) / (la * twice), la / twice, type(a[0])(0.5) * twice


@inline
def add_perpendicular(acc, l, h, v):
    """Add h (|v|² I - v vᵀ) to the Hessians of lane l."""
    xx, yy, zz = v[0] * v[0], v[1] * v[1], v[2] * v[2]
    acc[_3 + l] += h * (yy + zz)
    acc[_4 + l] -= h * v[0] * v[1]
    acc[_5 + l] -= h * v[0] * v[2]
    acc[_6 + l] += h * (xx + zz)
    acc[_7 + l] -= h * v[1] * v[2]
    acc[_8 + l] += h * (xx + yy)


@inline
def paper_direction(F):
    """∂J/∂x over k2, n x F₀; zero where F is degenerate."""
    m = cross(F[0], F[1])
    n = scale(type(m[0])(1) / max(math.sqrt(dot(m, m)), type(m[0])(1e-18)), m)
    return cross(n, F[0])


@inline
def add_block(acc, l, h, F):
    """The majorising block."""
    add_perpendicular(acc, l, h, F[0])


@inline
def add_paper_block(acc, l, h, F):
    """The paper's block."""
    add_outer(acc, l, h, paper_direction(F))


def plane_gradients(X: np.ndarray) -> np.ndarray:
    """Gradients of the shape functions in each triangle's own plane, the first axis along its first edge, (n, 3, 2)."""
    a, e = X[:, 1] - X[:, 0], X[:, 2] - X[:, 0]
    length, twice = np.linalg.norm(a, axis=1), np.linalg.norm(np.cross(a, e), axis=1)
    G = np.zeros((len(X), 3, 2))
    G[:, 1, 0], G[:, 1, 1], G[:, 2, 1] = 1 / length, -(a * e).sum(1) / (length * twice), length / twice
    G[:, 0] = -G[:, 1] - G[:, 2]
    return G


class SurfaceTriangle(ElementKind):
    """Linear triangles in space."""

    name = "membrane"
    corners = 3
    others = 2
    opposite = np.array([[1, 2], [2, 0], [0, 1]])
    solid = False

    def width(self, isotropic: bool) -> int:
        if not isotropic:
            raise InputError("materials of surfaces must be isotropic: a triangle in space has no axes of its own")
        return COEFFICIENTS

    def gradients(self, X: np.ndarray) -> np.ndarray:
        area = np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0])
        over = area / (area**2).sum(1, keepdims=True)
        return np.stack([np.cross(over, X[:, (k + 2) % 3] - X[:, (k + 1) % 3]) for k in range(3)], axis=1)

    def volume(self, X: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.cross(X[:, 1] - X[:, 0], X[:, 2] - X[:, 0]), axis=1) / 2

    @cache
    def pack(self, isotropic: bool) -> Any:
        @inline
        def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
            p = corner(X, cells[e, opposite[a, 0]])
            ea, ee = sub(corner(X, cells[e, opposite[a, 1]]), p), sub(corner(X, cells[e, a]), p)
            k0, k1, k2, area = frame(ea, ee)
            coef[at], coef[at + W], coef[at + 2 * W], coef[at + 3 * W] = k0, k1, k2, once * area * k2
            s = once * area * k2 * k2 * block[0]
            nodal[to] += s
            nodal[to + 3 * W] += s
            nodal[to + 5 * W] += s

        return pack

    @cache
    def sweep(self, model: Model) -> Any:
        return self._sweep(model, add_block)

    @cache
    def paper_sweep(self, model: Model) -> Any:
        return self._sweep(model, add_paper_block)

    def _sweep(self, model: Model, add_to: Any) -> Any:
        stress, numbers = model.stress, parameters(model.n_parameters)

        @inline
        def sweep(n, i, c, x, idx, coef, par, p, g, acc):
            b = par[p]
            m = numbers(par, p + uint64(1))
            for first in range(0, n, AHEAD):
                rows = min(AHEAD, n - first)
                gather(rows * 2, i, x, idx, g, zero)
                i += uint64(rows * 2 * W)
                for row in range(rows):
                    here = uint64(row * 8 * W)
                    for l_ in range(W):
                        l = uint64(l_)
                        j, k = here + l * uint64(4), c + l
                        o = vec(g, j)
                        a, e = sub(vec(g, j + _Q), o), sub((acc[_9 + l], acc[_10 + l], acc[_11 + l]), o)
                        k2, w = coef[k + _2], coef[k + _3]
                        F = scale(coef[k], a), combine(coef[k + _1], a, k2, e)
                        f = scale(w, stress(F, *m)[1])
                        acc[l] -= f[0]
                        acc[_1 + l] -= f[1]
                        acc[_2 + l] -= f[2]
                        add_to(acc, l, b * w * k2, F)
                    c += uint64(COEFFICIENTS * W)

        return sweep

    @cache
    def energy(self, model: Model) -> Any:
        psi, numbers = model.energy, parameters(model.n_parameters)

        @inline
        def energy(m, i, x, X, idx, par, p, gx, gX, out, f):
            number = numbers(par, p + uint64(1))
            gather(3, i, x, idx, gx, zero)
            gather(3, i, X, idx, gX, zero)
            for l_ in range(W):
                l = uint64(l_)
                F, (_k0, _k1, _k2, area) = element(gx, gX, l * uint64(4))
                out[l] = area * psi(F, *number)
            return summed(out, m), 0

        return energy

    @cache
    def forces(self, model: Model) -> Any:
        stress, numbers = model.stress, parameters(model.n_parameters)

        @inline
        def forces(m, i, x, X, idx, par, p, gx, gX, out, f):
            number = numbers(par, p + uint64(1))
            gather(3, i, x, idx, gx, zero)
            gather(3, i, X, idx, gX, zero)
            for l_ in range(W):
                l = uint64(l_)
                F, (k0, k1, k2, area) = element(gx, gX, l * uint64(4))
                P = stress(F, *number)
                fa, fe = combine(-area * k0, P[0], -area * k1, P[1]), scale(-area * k2, P[1])
                fp = scale(-1.0, add(fa, fe))
                out[l], out[_1 + l], out[_2 + l] = fp
                out[_3 + l], out[_4 + l], out[_5 + l] = fa
                out[_6 + l], out[_7 + l], out[_8 + l] = fe
                out[_9 + l] = math.sqrt(dot(fp, fp) + dot(fa, fa) + dot(fe, fe))
            spread(3, m, i, idx, out, f)
            return summed(out[_9:], m), 0

        return forces

    # How a compound node sees it: F changes by d ⊗ g, so that J = |m + d x v| with v = g0 F₁ - g1 F₀.

    compound_width = COMPOUND

    @cache
    def compound_pack(self) -> Any:
        @inline
        def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
            ip, ia, ie = opposite[0, 0], opposite[0, 1], opposite[0, 2]
            p = corner(X, cells[e, ip])
            k0, k1, k2, area = frame(sub(corner(X, cells[e, ia]), p), sub(corner(X, cells[e, ie]), p))
            ba, be = data[e, ia] - data[e, ip], data[e, ie] - data[e, ip]
            g0, g1 = ba * k0, ba * k1 + be * k2
            coef[at], coef[at + W], coef[at + 2 * W] = k0, k1, k2
            coef[at + 3 * W], coef[at + 4 * W], coef[at + 5 * W] = once * area, g0, g1
            s = once * area * block[0] * (g0 * g0 + g1 * g1)
            nodal[to] += s
            nodal[to + 3 * W] += s
            nodal[to + 5 * W] += s

        return pack

    @cache
    def compound_sweep(self, model: Model) -> Any:
        stress, numbers = model.stress, parameters(model.n_parameters)

        @inline
        def sweep(n, i, c, x, idx, coef, par, p, g, acc):
            b = par[p]
            m = numbers(par, p + uint64(1))
            for _ in range(n):
                gather(3, i, x, idx, g, zero)
                for l_ in range(W):
                    l = uint64(l_)
                    j, k = l * uint64(4), c + l
                    o = vec(g, j)
                    a, e = sub(vec(g, j + _Q), o), sub(vec(g, j + _R), o)
                    F = scale(coef[k], a), combine(coef[k + _1], a, coef[k + _2], e)
                    area, g0, g1 = coef[k + _3], coef[k + _4], coef[k + _5]
                    P = stress(F, *m)
                    f = combine(area * g0, P[0], area * g1, P[1])
                    acc[l] -= f[0]
                    acc[_1 + l] -= f[1]
                    acc[_2 + l] -= f[2]
                    add_perpendicular(acc, l, b * area, combine(g0, F[1], -g1, F[0]))
                i += uint64(3 * W)
                c += uint64(COMPOUND * W)

        return sweep


@inline
def element(gx, gX, j):
    """F in float64 and the numbers of :func:`frame` from the current and the rest positions in scratch arrays."""
    O = vec(gX, j)
    k = frame(sub(vec(gX, j + _Q), O), sub(vec(gX, j + _R), O))
    o = wide_vec(gx, j)
    a, e = sub(wide_vec(gx, j + _Q), o), sub(wide_vec(gx, j + _R), o)
    return (scale(k[0], a), combine(k[1], a, k[2], e)), k


MEMBRANE = SurfaceTriangle()
