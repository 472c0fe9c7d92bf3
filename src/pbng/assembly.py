"""Energy and forces of all elements in float64: the certificate every method shares.

Elements are laid out in blocks of W of one group (lanes, see :mod:`pbng.elements.base`). Shape gradients are recomputed
from the rest positions, which costs less than to read them. Forces are added to the nodes chunk by chunk, chunks that
share no node in parallel: no atomics, and the same bits for any number of threads.
"""

from functools import cached_property

import numpy as np
from numba import uint64

from pbng.coloring import morton
from pbng.dispatch import call, specialised
from pbng.elements.base import W
from pbng.jit import serial
from pbng.parallel import array, body, rows, run, scratch

CHUNK = 32  # blocks a thread takes at a time; sums are formed chunk by chunk, so that their rounding is fixed


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
        self.idx = np.concatenate([np.empty(0, np.uint32), *idx])
        self.blocks = np.concatenate([np.empty((0, 4), np.int64), *blocks])
        self._all = np.arange(-(-len(self.blocks) // CHUNK))

    def energy(self, x: np.ndarray) -> float:
        """Elastic energy [J] at x, flat (4 n_slot,) with a zero fourth component, of either precision."""
        once = np.array([0, len(self._all)])
        return float(self._run(x, np.empty(0), 0, self._all, once)[0])

    def forces(self, x: np.ndarray, f: np.ndarray) -> tuple[float, int]:
        """Write the internal force of every node [N] to f (4 n_slot,) float64; x as for :meth:`energy`.

        Returns the sum of the norms of all elements' forces [N] and the number of inverted elements.
        """
        f[:] = 0.0
        force_scale, inverted = self._run(x, f, len(self.terms), *self._disjoint)
        return float(force_scale), int(inverted)

    @cached_property
    def _disjoint(self) -> tuple[np.ndarray, np.ndarray]:
        """The chunks in an order, and where in it each set of chunks that share no node starts."""
        color = np.empty(len(self._all), np.int64)
        _color_chunks(self.blocks, self.idx, np.zeros(self.n_slot, np.uint64), color)
        return np.argsort(color, kind="stable"), np.cumsum(np.bincount(color + 1))

    def _run(self, x: np.ndarray, f: np.ndarray, shift: int, order: np.ndarray, start: np.ndarray) -> np.ndarray:
        functions = [t.kind.energy(t.model) for t in self.terms] + [t.kind.forces(t.model) for t in self.terms]
        part = np.empty((len(self._all), 2))
        sizes = np.array([len(self.blocks), shift])
        arrays = x, self.X, self.blocks, self.idx, self.parameters, f, order, part, sizes
        chunks = specialised(make_evaluate, tuple(functions), x.dtype)
        run(chunks, arrays, np.arange(len(start) - 1), start)
        return part.sum(0)


def group_parameters(groups, dtype, paper_block: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """The numbers kernels read: for each group b, then the model's parameters; and where each group's start."""
    rows = []
    for group in groups:
        block = group.block(paper_block)
        rows.append([0.0 if block.at_rest else block.b, *group.material.parameters()])
    first = np.cumsum([0] + [len(r) for r in rows])[:-1]
    return np.array([v for r in rows for v in r], dtype), first


def make_evaluate(key: str, dtype: np.dtype):
    """Body of :class:`ElementBlocks`: the two sums of chunks low .. high of the given order.

    ``shift`` is 0 for energy, or the number of terms for forces.
    """
    real = dtype.type
    n_position, n_result = 16 * W, 14 * W

    @body
    def evaluate(arguments, low, high):
        x, X, blocks = array(arguments, 0, real), array(arguments, 1, np.float64), rows(arguments, 2, 4, np.int64)
        idx, par, f = array(arguments, 3, np.uint32), array(arguments, 4, np.float64), array(arguments, 5, np.float64)
        order, part = array(arguments, 6, np.int64), rows(arguments, 7, 2, np.float64)
        n_block, shift = array(arguments, 8, np.int64)[0], array(arguments, 8, np.int64)[1]
        gx, gX = scratch(n_position, real), scratch(n_position, np.float64)
        out = scratch(n_result, np.float64)
        for turn in range(low, high):
            chunk = order[turn]
            first, second = 0.0, 0.0
            for b in range(chunk * CHUNK, min(n_block, (chunk + 1) * CHUNK)):
                k, p, i, m = blocks[b]
                total, inverted = call(key, k + shift, (m, uint64(i), x, X, idx, par, uint64(p), gx, gX, out, f))
                first += total
                second += inverted
            part[chunk, 0] = first
            part[chunk, 1] = second

    return evaluate


@serial
def _color_chunks(blocks, idx, used, color):
    """Colour chunks greedily; ``used`` holds, for each node, the colours of the chunks that it is in, as bits."""
    one, base, highest = np.uint64(1), 0, 0
    for chunk in range(color.size):
        last = min((chunk + 1) * CHUNK, blocks.shape[0])
        end = blocks[last, 2] if last < blocks.shape[0] else idx.size
        taken = np.uint64(0)
        for i in range(blocks[chunk * CHUNK, 2], end):
            taken |= used[idx[i] // 4]
        c = 0
        while c < 64 and (taken >> np.uint64(c)) & one:
            c += 1
        if c == 64:  # a node in very many chunks: begin a new set of colours
            used[:] = 0
            base, c = highest + 1, 0
        color[chunk] = base + c
        highest = max(highest, base + c)
        for i in range(blocks[chunk * CHUNK, 2], end):
            used[idx[i] // 4] |= one << np.uint64(c)
