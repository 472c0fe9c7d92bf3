"""The sweep: every free node moves to the minimum of the energy that it sees, colour by colour (section 7).

One sub-iterate, Eqs. (28)-(34), for the 16 nodes of a block at once::

    f   = f_ext - Σ_e V_e P g_i          forces on the nodes, element group by element group
    A   = A_0 + Σ_e V_e b c cᵀ           their majorising Hessians; A_0 holds all that is constant
    x_i = x_i + ω A⁻¹ f                  one step, no line search
"""

import numpy as np
from numba import get_num_threads, uint64

from pbng.dispatch import call, specialised
from pbng.elements.base import AHEAD, W
from pbng.jit import inline
from pbng.linalg import solve_spd
from pbng.packing import NODAL, Packed
from pbng.parallel import array, body, rows, run, scratch

_1, _2, _3, _4, _5, _6 = (uint64(W * j) for j in range(1, 7))
_7, _8, _9, _10, _11 = (uint64(W * j) for j in range(7, 12))


def sweep(packed: Packed, x: np.ndarray, colors: np.ndarray, omega: float = 1.0, times: int = 1) -> None:
    """Update every free node once, or ``times`` times, in place.

    Args:
        packed: The problem's layout.
        x: Positions as ``packed.pack`` makes them.
        colors: Colours in the order to be taken; compound nodes, if there are any, have their turn after each sweep.
        omega: Relaxation of each node's step; 0 < omega < 2 never raises the energy.
    """
    p = packed
    relaxation = np.array([omega], p.dtype)
    arrays = x, p.seg_start, p.seg, p.idx, p.coef, p.nodal, p.parameters, relaxation
    blocks = specialised(make_sweep, p.functions, p.dtype)
    if not p.carried:
        run(blocks, arrays, np.tile(colors, times), p.color_start, _grain(p))
        return
    place = x.reshape(-1, 4)
    for _ in range(times):
        run(blocks, arrays, colors, p.color_start, _grain(p))
        for color, (to, source, share) in enumerate(p.carried, p.n_color):
            run(blocks, arrays, np.array([color]), p.color_start)
            place[to] += share * place[source]
            place[source] = 0


def _grain(packed: Packed) -> int:
    """Blocks a thread takes at a time: several helpings a thread and colour, to even out, but not too small ones."""
    a_color = packed.n_block / max(len(packed.color_start) - 1, 1)
    return int(min(max(a_color / (8 * get_num_threads()), 4), 64))


def make_sweep(key: str, dtype: np.dtype):
    """Body of :func:`sweep` for blocks low .. high of one colour."""
    real = dtype.type
    size = 12 * W

    @body
    def blocks(arguments, low, high):
        x, seg_start, seg = array(arguments, 0, real), array(arguments, 1, np.int64), rows(arguments, 2, 5, np.int64)
        idx, coef, nodal = array(arguments, 3, np.uint32), array(arguments, 4, real), array(arguments, 5, real)
        par, omega = array(arguments, 6, real), array(arguments, 7, real)[0]
        acc = scratch(size, real)
        g = aligned_part(np.empty(12 * W * AHEAD + W, real))  # on the stack too it is a tenth slower, for corotated
        for b in range(low, high):
            _load(uint64(b), x, nodal, acc)
            for s in range(seg_start[b], seg_start[b + 1]):
                k, p, n, i, c = seg[s]
                call(key, k, (n, uint64(i), uint64(c), x, idx, coef, par, uint64(p), g, acc))
            _step(uint64(b), x, acc, omega)

    return blocks


@inline
def aligned_part(a):
    """The part of a that begins at a cache line."""
    return a[(64 - a.ctypes.data % 64) % 64 // a.itemsize :]


@inline
def _load(b, x, nodal, acc):
    """Start a block: external forces and constant Hessians (rows 0-8 of acc), positions (rows 9-11)."""
    n = b * uint64(NODAL * W)
    at = b * uint64(4 * W)
    for l_ in range(W):
        l = uint64(l_)
        i = at + uint64(4) * l
        acc[l] = nodal[n + l]
        acc[_1 + l] = nodal[n + _1 + l]
        acc[_2 + l] = nodal[n + _2 + l]
        acc[_3 + l] = nodal[n + _3 + l]
        acc[_4 + l] = nodal[n + _4 + l]
        acc[_5 + l] = nodal[n + _5 + l]
        acc[_6 + l] = nodal[n + _6 + l]
        acc[_7 + l] = nodal[n + _7 + l]
        acc[_8 + l] = nodal[n + _8 + l]
        acc[_9 + l] = x[i]
        acc[_10 + l] = x[i + uint64(1)]
        acc[_11 + l] = x[i + uint64(2)]


@inline
def _step(b, x, acc, omega):
    """Finish a block: solve the 3x3 systems and move the nodes, Eq. (30)."""
    at = b * uint64(4 * W)
    for l_ in range(W):
        l = uint64(l_)
        i = at + uint64(4) * l
        dx, dy, dz = solve_spd(
            acc[_3 + l],
            acc[_4 + l],
            acc[_5 + l],
            acc[_6 + l],
            acc[_7 + l],
            acc[_8 + l],
            acc[l],
            acc[_1 + l],
            acc[_2 + l],
        )
        x[i] = acc[_9 + l] + omega * dx
        x[i + uint64(1)] = acc[_10 + l] + omega * dy
        x[i + uint64(2)] = acc[_11 + l] + omega * dz
        x[i + uint64(3)] = omega - omega  # stays zero; without a gap LLVM stores whole vectors
