"""Energy and forces of all elements in float64: the certificate every method shares.

Elements are laid out in blocks of W of one group (lanes, see :mod:`pbng.elements.base`). Shape gradients are recomputed
from the rest positions, which costs less than to read them. Forces go to a buffer, a place a corner, from which each
node then sums its own: no atomics, and the same bits for any number of threads.
"""

import numpy as np
from numba import njit, prange, uint64

from pbng.coloring import morton
from pbng.dispatch import call, specialised
from pbng.elements.base import W
from pbng.jit import FLAGS, exact, serial

CHUNK = 64  # blocks a thread takes at a time; sums are formed chunk by chunk, so that their rounding is fixed


class ElementBlocks:
    """Element groups laid out for evaluation, for any numbering of the vertices.

    Args:
        groups: The element groups (:class:`pbng.problem.ElementGroup`).
        X: Rest positions [m], (n_vert, 3).
        slot: Number of each vertex in the arrays that will be evaluated, (n_vert,); by default its own.
        n_slot: Length of those arrays.
    """

    def __init__(self, groups, X: np.ndarray, slot: np.ndarray | None = None, n_slot: int | None = None) -> None:
        slot = np.arange(len(X)) if slot is None else slot
        self.n_slot = len(X) if n_slot is None else n_slot
        self.X = np.zeros(4 * self.n_slot)
        self.X.reshape(-1, 4)[slot, :3] = X
        self.terms = tuple(dict.fromkeys(g.term for g in groups))
        self.parameters, first = group_parameters(groups, np.float64)
        rank = np.empty(len(X), np.int64)
        rank[np.argsort(morton(X), kind="stable")] = np.arange(len(X))
        idx, blocks, at = [], [], 0
        for number, group in enumerate(groups):
            cells = (4 * slot[group.cells][:, group.term.kind.order]).astype(np.uint32)
            cells = cells[np.argsort(rank[group.cells].min(1), kind="stable")]  # neighbours in space stay neighbours
            n, corners = cells.shape
            n_block = -(-n // W)
            padded = np.concatenate([cells, np.repeat(cells[-1:], n_block * W - n, axis=0)])
            idx.append(padded.reshape(n_block, W, corners).transpose(0, 2, 1).ravel())
            rows = np.empty((n_block, 4), np.int64)
            rows[:, 0] = self.terms.index(group.term)
            rows[:, 1] = first[number]
            rows[:, 2] = at + np.arange(n_block) * (W * corners)
            rows[:, 3] = np.minimum(W, n - np.arange(n_block) * W)
            blocks.append(rows)
            at += n_block * W * corners
        self.idx, self.blocks = np.concatenate(idx), np.concatenate(blocks)
        self._forces: np.ndarray | None = None
        self._start = self._place = np.empty(0, np.int64)

    def energy(self, x: np.ndarray) -> float:
        """Elastic energy [J] at x, flat (4 n_slot,) with a zero fourth component, of either precision."""
        return float(self._run(x, np.empty(0), 0)[0])

    def forces(self, x: np.ndarray, f: np.ndarray) -> tuple[float, int]:
        """Write the internal force of every node [N] to f (4 n_slot,) float64; x as for :meth:`energy`.

        Returns the sum of the norms of all elements' forces [N] and the number of inverted elements.
        """
        if self._forces is None:
            self._forces = np.empty(3 * len(self.idx))
            self._start, self._place = _places(self.blocks, self.idx, self.n_slot)
        force_scale, inverted = self._run(x, self._forces, len(self.terms))
        _gather(self._start, self._place, self._forces, f)
        return float(force_scale), int(inverted)

    def _run(self, x: np.ndarray, f: np.ndarray, shift: int) -> np.ndarray:
        functions = [t.kind.energy(t.model) for t in self.terms] + [t.kind.forces(t.model) for t in self.terms]
        run = specialised(make_evaluate, tuple(functions))
        return run(x, self.X, self.blocks, self.idx, self.parameters, shift, f).sum(0)


def group_parameters(groups, dtype, paper_block: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The numbers kernels read: for each group b, then the model's parameters; and where each group's start."""
    rows = []
    for group in groups:
        block = group.block(paper_block)
        rows.append([0.0 if block.at_rest else block.b, *group.material.parameters()])
    first = np.cumsum([0] + [len(r) for r in rows])[:-1]
    return np.array([v for r in rows for v in r], dtype), first


def make_evaluate(key: str):
    """Kernel of :class:`ElementBlocks`: the two sums of each chunk.

    ``shift`` is 0 for energy, or the number of terms for forces.
    """

    @njit(parallel=True, cache=True, **FLAGS)
    def evaluate(x, X, blocks, idx, par, shift, f):
        n = blocks.shape[0]
        part = np.zeros(((n + CHUNK - 1) // CHUNK, 2))
        for chunk in prange(part.shape[0]):
            gx, gX = np.empty(16 * W, x.dtype), np.empty(16 * W)
            out = np.empty(14 * W)
            for b in range(chunk * CHUNK, min(n, (chunk + 1) * CHUNK)):
                k, p, first, m = blocks[b]
                i = uint64(first)
                total, inverted = call(key, k + shift, (m, i, x, X, idx, par, uint64(p), gx, gX, out, f, uint64(3) * i))
                part[chunk, 0] += total
                part[chunk, 1] += inverted
        return part

    return evaluate


@serial
def _places(blocks, idx, n_slot):
    """Where in the force buffer the corners of each vertex are, in compressed rows (real elements only)."""
    start = np.zeros(n_slot + 1, np.int64)
    for b in range(blocks.shape[0]):
        first, m = blocks[b, 2], blocks[b, 3]
        end = blocks[b + 1, 2] if b + 1 < blocks.shape[0] else idx.size
        for i in range(first, end):
            if (i - first) % W < m:
                start[idx[i] // 4 + 1] += 1
    for v in range(n_slot):
        start[v + 1] += start[v]
    position = start[:-1].copy()
    place = np.empty(start[-1], np.int64)
    for b in range(blocks.shape[0]):
        first, m = blocks[b, 2], blocks[b, 3]
        end = blocks[b + 1, 2] if b + 1 < blocks.shape[0] else idx.size
        for i in range(first, end):
            lane = (i - first) % W
            if lane < m:
                v = idx[i] // 4
                place[position[v]] = 3 * first + (i - first) // W * (3 * W) + lane
                position[v] += 1
    return start, place


@exact
def _gather(start, place, buffer, f):
    n = start.size - 1
    for chunk in prange((n + 1023) // 1024):
        for v in range(chunk * 1024, min(n, (chunk + 1) * 1024)):
            a, b, c = 0.0, 0.0, 0.0
            for k in range(start[v], start[v + 1]):
                o = place[k]
                a += buffer[o]
                b += buffer[o + W]
                c += buffer[o + 2 * W]
            f[4 * v] = a
            f[4 * v + 1] = b
            f[4 * v + 2] = c
            f[4 * v + 3] = 0.0
