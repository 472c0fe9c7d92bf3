"""Weak constraints in the sweep, Eq. (31): how a node sees the springs that it is part of.

The force on node i is -w_i K C with C = Σ_j w_j x_j. Weights sum to zero, a target's included, so C is taken from the
differences x_j - x_i: then it does not suffer where K is large and the scene far away. Its Hessian w_i² K is constant.
"""

from typing import Any

import numpy as np
from numba import uint64

from pbng.elements.base import W
from pbng.jit import inline

STIFFNESS = 6  # coefficients of an incidence besides the weights of the others: -w_i K, upper triangle
_1, _2, _3, _4, _5 = (uint64(W * j) for j in range(1, 6))


def weak_data(weights: np.ndarray, K: np.ndarray, anchored: bool) -> np.ndarray:
    """What ``pack`` reads of each constraint: its weights, a target's included, and the upper triangle of K."""
    target = -np.ones((len(weights), int(anchored)))
    upper = K[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return np.ascontiguousarray(np.concatenate([weights, target, upper], axis=1))


@inline
def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
    """As :meth:`pbng.elements.base.ElementKind.pack`."""
    others = opposite.shape[1]
    weight = data[e, a]
    for j in range(others):
        coef[at + W * j] = data[e, opposite[a, j]]
    for k in range(STIFFNESS):
        stiffness = once * weight * data[e, others + 1 + k]
        coef[at + W * (others + k)] = -stiffness
        nodal[to + W * k] += weight * stiffness


@inline
def sweep(n, i, c, x, idx, coef, par, p, g, acc):
    """As :meth:`pbng.elements.base.ElementKind.sweep`; ``par[p]`` is the number of others."""
    others = uint64(par[p])
    x0, x1, x2 = uint64(9 * W), uint64(10 * W), uint64(11 * W)
    for _ in range(n):
        for l_ in range(W):
            l = uint64(l_)
            g[l] = g[_1 + l] = g[_2 + l] = acc[l] - acc[l]
        for _j in range(others):
            for l_ in range(W):
                l = uint64(l_)
                at, w = uint64(idx[i + l]), coef[c + l]
                g[l] += w * (x[at] - acc[x0 + l])
                g[_1 + l] += w * (x[at + uint64(1)] - acc[x1 + l])
                g[_2 + l] += w * (x[at + uint64(2)] - acc[x2 + l])
            i += uint64(W)
            c += uint64(W)
        for l_ in range(W):
            l = uint64(l_)
            k = c + l
            d0, d1, d2 = g[l], g[_1 + l], g[_2 + l]
            acc[l] += coef[k] * d0 + coef[k + _1] * d1 + coef[k + _2] * d2
            acc[_1 + l] += coef[k + _1] * d0 + coef[k + _3] * d1 + coef[k + _4] * d2
            acc[_2 + l] += coef[k + _2] * d0 + coef[k + _4] * d1 + coef[k + _5] * d2
        c += uint64(STIFFNESS * W)


def width(others: int) -> int:
    """Coefficients stored for one incidence."""
    return others + STIFFNESS


def opposite(corners: int, anchored: bool) -> np.ndarray:
    """For each corner the places of the others in a stencil, a target's last, (corners, others)."""
    everything: Any = np.arange(corners + anchored)
    return np.array([np.delete(everything, a) for a in range(corners)], np.int64).reshape(corners, -1)
