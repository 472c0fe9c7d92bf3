"""How a compound node (:mod:`pbng.compounds`) sees a simplex: F changes by d ⊗ g with g = Σ β_v ∂N_v/∂X.

All corners are gathered, since several may move; coefficients are the shape gradients, g and the volume. Other kinds
say themselves how a compound sees them.
"""

from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.elements.base import ElementKind, W, gather, parameters, vec
from pbng.elements.simplex import Simplex, corner, gradients, outer_sum
from pbng.jit import inline
from pbng.linalg import cofactor, mat_vec, scale, sub
from pbng.materials.base import Model

WIDTH = 13  # coefficients of an incidence of a simplex
zero = uint64(0)
_1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12 = (uint64(W * j) for j in range(1, 13))


def corners(kind: ElementKind) -> np.ndarray:
    """Which corners an incidence refers to, in their order, (1, corners)."""
    return np.array([kind.order], np.int64)


def width(kind: ElementKind) -> int:
    """Coefficients stored for one incidence."""
    return WIDTH if isinstance(kind, Simplex) else kind.compound_width


def pack(kind: ElementKind) -> Any:
    """As :meth:`pbng.elements.base.ElementKind.pack`; ``data`` holds how much each corner moves with the compound."""
    return _pack(kind) if isinstance(kind, Simplex) else kind.compound_pack()


def sweep(kind: ElementKind, model: Model) -> Any:
    """As :meth:`pbng.elements.base.ElementKind.sweep`."""
    return _sweep(kind, model) if isinstance(kind, Simplex) else kind.compound_sweep(model)


@cache
def _pack(kind: Simplex) -> Any:
    plane, share = kind.plane, kind.share

    @inline
    def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
        last = opposite.shape[1] - 1
        p = corner(X, cells[e, opposite[0, 0]])
        ea = sub(corner(X, cells[e, opposite[0, 1]]), p)
        eb = (0.0, 0.0, 1.0) if plane else sub(corner(X, cells[e, opposite[0, 2]]), p)
        ee = sub(corner(X, cells[e, opposite[0, last]]), p)
        ga, gb, ge, V = gradients(ea, eb, ee, once * share)
        bp, ba, be = data[e, opposite[0, 0]], data[e, opposite[0, 1]], data[e, opposite[0, last]]
        bb = 0.0 if plane else data[e, opposite[0, 2]]
        for k in range(3):
            through = 0.0 if plane else gb[k]  # along z nothing varies in the plane
            g = ba * ga[k] + bb * through + be * ge[k] - bp * (ga[k] + through + ge[k])
            coef[at + W * k], coef[at + W * (3 + k)], coef[at + W * (6 + k)] = ga[k], gb[k], ge[k]
            coef[at + W * (9 + k)] = g
        coef[at + W * 12] = V
        g0, g1, g2 = coef[at + W * 9], coef[at + W * 10], coef[at + W * 11]
        s, t = V * block[0] * (g0 * g0 + g1 * g1 + g2 * g2), V * block[2]
        nodal[to] += s + t * g0 * g0
        nodal[to + W] += t * g0 * g1
        nodal[to + 2 * W] += t * g0 * g2
        nodal[to + 3 * W] += s + t * g1 * g1
        nodal[to + 4 * W] += t * g1 * g2
        nodal[to + 5 * W] += s + t * g2 * g2

    return pack


@cache
def _sweep(kind: Simplex, model: Model) -> Any:
    edges, numbers, stress, n_corner = kind.edges(vec), parameters(model.n_parameters), model.stress, kind.corners
    last, row = uint64(4 * W * (n_corner - 1)), uint64(W * n_corner)

    @inline
    def sweep(n, i, c, x, idx, coef, par, p, g, acc):
        b = par[p]
        m = numbers(par, p + uint64(1))
        for _ in range(n):
            gather(n_corner, i, x, idx, g, zero)
            for l_ in range(W):
                l = uint64(l_)
                j, k = l * uint64(4), c + l
                a, d, e = edges(g, j, vec(g, last + j))
                ga = coef[k], coef[k + _1], coef[k + _2]
                gd = coef[k + _3], coef[k + _4], coef[k + _5]
                ge = coef[k + _6], coef[k + _7], coef[k + _8]
                shape = coef[k + _9], coef[k + _10], coef[k + _11]
                V = coef[k + _12]
                F = outer_sum(a, ga, d, gd, e, ge)
                f, v = scale(V, mat_vec(stress(F, *m), shape)), mat_vec(cofactor(F), shape)
                acc[l] -= f[0]
                acc[_1 + l] -= f[1]
                acc[_2 + l] -= f[2]
                u = scale(b * V, v)
                acc[_3 + l] += u[0] * v[0]
                acc[_4 + l] += u[0] * v[1]
                acc[_5 + l] += u[0] * v[2]
                acc[_6 + l] += u[1] * v[1]
                acc[_7 + l] += u[1] * v[2]
                acc[_8 + l] += u[2] * v[2]
            i += row
            c += uint64(WIDTH * W)

    return sweep
