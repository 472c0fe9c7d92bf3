"""Stiffness of the grids: UᵀHU with H the positive definite Hessian, by cubature.

The energy of a piece of a cell is summed over a few of its elements, drawn at random and weighted to the volume that
they stand for. An element's vertices are taken to follow the eight corners of its own piece, so that every piece is
like one finite element with eight nodes. Constrained vertices follow nothing.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.coarse.grid import Grid, trilinear
from pbng.jit import inline, serial
from pbng.materials.base import Material
from pbng.materials.hessian import hessians
from pbng.parallel import array, body, each, rows
from pbng.problem import ElementGroup, Problem

SAMPLES = 8  # elements drawn in each piece from each stratum; 4 are too few
FLOOR = 0.01  # of μ: lowest eigenvalue of a Hessian
_8, _16, _24, _48, _72, _96 = (uint64(n) for n in (8, 16, 24, 48, 72, 96))
_120, _144, _168, _192 = (uint64(n) for n in (120, 144, 168, 192))
CORNERS = 4  # of an element at most; those that a triangle lacks have no gradient


class Cubature:
    """Sampled elements of all pieces of some grids, and the stiffness of the pieces at a state.

    Args:
        problem: What is solved.
        grids: Grids over its solids; their pieces are numbered through.
        pieces: For each grid the piece of each element of a solid, in the order of ``problem.groups``.
        slot: Place of each vertex in position arrays.
    """

    def __init__(self, problem: Problem, grids: list[Grid], pieces: list[np.ndarray], slot: np.ndarray) -> None:
        groups = [g for g in problem.groups if g.kind.solid]
        group = np.repeat(np.arange(len(groups)), [len(g.cells) for g in groups])
        volume = np.concatenate([g.kind.volume(problem.X[g.cells]) for g in groups])
        held = np.concatenate([problem.fixed[g.cells].any(1) for g in groups])
        movable = np.concatenate([~problem.fixed[g.cells].all(1) for g in groups])
        deck = np.random.default_rng(0).permutation(np.flatnonzero(movable))  # any seed will do, if always the same
        chosen, weight, owner, first = [], [], [], 0
        for grid, piece in zip(grids, pieces):
            stratum = (piece * len(groups) + group) * 2 + held
            e, w = _sample(deck, stratum, volume, 2 * len(groups) * len(grid.node))
            order = np.argsort(piece[e], kind="stable")
            chosen.append(e[order])
            weight.append(w[order])
            owner.append(piece[e[order]] + first)
            first += len(grid.node)
        e, where = np.concatenate(chosen), np.concatenate(owner)
        cells, gradients = _corners(problem.X, groups, group, e)
        origin, size = (
            np.concatenate([getattr(g, name) for g in grids])[where][:, None] for name in ("origin", "size")
        )
        follow = trilinear((problem.X[cells] - origin) / size) * ~problem.fixed[cells][..., None]
        models = dict.fromkeys(g.term.model for g in groups)
        self.terms = []  # model, its samples, and their parameters
        for model in models:
            numbers = {n: g.material.parameters() for n, g in enumerate(groups) if g.term.model == model}
            mine = np.flatnonzero(np.isin(group[e], list(numbers)))
            table = np.zeros((len(groups), model.n_parameters))
            table[list(numbers)] = list(numbers.values())
            self.terms.append((model, mine, table[group[e[mine]]]))
        self.floor = FLOOR * np.array([g.material.mu for g in groups if isinstance(g.material, Material)])[group[e]]
        self.place = (4 * slot[cells]).astype(np.int64)
        self.gradients = gradients.reshape(-1, 3 * CORNERS)
        self.coarse = np.einsum("nak,nai->nik", follow, gradients).reshape(-1, 24)
        self.weight = np.concatenate(weight)
        self.across = np.array([g.kind.across for g in groups])[group[e]]
        self.start = np.searchsorted(where, np.arange(first + 1))
        self.stiffness = np.empty((first, 3, 8, 3, 8))

    def evaluate(self, x: np.ndarray) -> np.ndarray:
        """Stiffness (n_piece, 3, 8, 3, 8) [N/m] of the corners' directions at a flat position array."""
        n = len(self.weight)
        F, e, M = np.empty((n, 3, 3)), np.empty((n, 9)), np.empty((n, 9, 9))
        deformation = make_deformation(x.dtype)
        each(deformation, (x, self.place, self.gradients, self.across, F), n, grain=256)
        for model, mine, numbers in self.terms:
            e[mine], M[mine] = hessians(model, F[mine], numbers, self.floor[mine])
        arrays = self.start, e, M, self.weight, self.coarse, self.stiffness
        each(_pieces, arrays, len(self.stiffness), grain=16)
        return self.stiffness


def _corners(
    X: np.ndarray, groups: Sequence[ElementGroup], group: np.ndarray, e: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, CORNERS) of the elements e and gradients (n, CORNERS, 3) of their shape functions."""
    cells, gradients = np.zeros((len(e), CORNERS), np.int64), np.zeros((len(e), CORNERS, 3))
    start = 0
    for n, g in enumerate(groups):
        mine = np.flatnonzero(group[e] == n)
        corners = g.cells[e[mine] - start]
        cells[mine[:, None], np.arange(g.kind.corners)] = corners
        gradients[mine, : g.kind.corners] = g.kind.gradients(X[corners])
        start += len(g.cells)
    return cells, gradients


@serial
def _sample(deck, stratum, volume, n_stratum):
    """The first SAMPLES elements of each stratum in the deck, and the volume that each stands for."""
    count, total, drawn = np.zeros(n_stratum, np.int64), np.zeros(n_stratum), np.zeros(n_stratum)
    chosen = np.empty(deck.size, np.int64)
    n = 0
    for e in deck:
        s = stratum[e]
        total[s] += volume[e]
        if count[s] < SAMPLES:
            count[s] += 1
            drawn[s] += volume[e]
            chosen[n] = e
            n += 1
    chosen = chosen[:n].copy()
    weight = np.empty(n)
    for k in range(n):
        s = stratum[chosen[k]]
        weight[k] = volume[chosen[k]] * total[s] / drawn[s]
    return chosen, weight


@cache
def make_deformation(dtype: np.dtype) -> Any:
    """Body that writes F = Σ_a x_a ⊗ ∂N_a/∂X in float64 for elements low .. high."""
    real = dtype.type

    @body
    def deformation(arguments, low, high):
        x, place = array(arguments, 0, real), rows(arguments, 1, CORNERS, np.int64)
        gradients, across = rows(arguments, 2, 3 * CORNERS, np.float64), array(arguments, 3, np.float64)
        F = rows(arguments, 4, 9, np.float64)
        for s in range(low, high):
            F[s] = 0.0
            F[s, 8] = across[s]
            for a in range(CORNERS):
                for i in range(3):
                    u = np.float64(x[place[s, a] + i])
                    for k in range(3):
                        F[s, 3 * i + k] += u * gradients[s, 3 * a + k]

    return deformation


@body
def _pieces(arguments, low, high):
    """Body that sums the stiffness of pieces low .. high."""
    start, e, M = array(arguments, 0, np.int64), rows(arguments, 1, 9, np.float64), rows(arguments, 2, 81, np.float64)
    weight, coarse = array(arguments, 3, np.float64), rows(arguments, 4, 24, np.float64)
    out = rows(arguments, 5, 576, np.float64)
    v = np.empty(216)
    for c in range(low, high):
        K = out[c]
        K[:] = 0.0
        for s in range(start[c], start[c + 1]):
            _add(e[s], M[s], weight[s], coarse[s], v, K)


@inline
def _add(e, M, weight, g, v, K):
    """Add Σ_n w e_n v_n v_nᵀ to K, where v_n (3, 8) is how mode n sees each direction of each corner; v is scratch.

    The nine terms are written out because LLVM turns only innermost loops into vector instructions.
    """
    for n in range(9):
        root = math.sqrt(weight * e[n])
        for i in range(3):
            m0, m1, m2 = root * M[9 * n + 3 * i], root * M[9 * n + 3 * i + 1], root * M[9 * n + 3 * i + 2]
            to = uint64(24 * n + 8 * i)
            for a_ in range(8):
                a = uint64(a_)
                v[to + a] = m0 * g[a] + m1 * g[_8 + a] + m2 * g[_16 + a]
    for row_ in range(24):
        row = uint64(row_)
        v0, v1, v2 = v[row], v[_24 + row], v[_48 + row]
        v3, v4, v5 = v[_72 + row], v[_96 + row], v[_120 + row]
        v6, v7, v8 = v[_144 + row], v[_168 + row], v[_192 + row]
        at = row * _24
        for column_ in range(24):
            c = uint64(column_)
            K[at + c] += (
                (v0 * v[c] + v1 * v[_24 + c] + v2 * v[_48 + c])
                + (v3 * v[_72 + c] + v4 * v[_96 + c] + v5 * v[_120 + c])
                + (v6 * v[_144 + c] + v7 * v[_168 + c] + v8 * v[_192 + c])
            )
