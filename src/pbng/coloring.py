"""Colouring of nodes and of constraints, so that those of one colour can be updated in parallel (section 10).

Nodes of one colour share no cell; constraints of one colour share no node.
"""

from collections.abc import Sequence

import numpy as np

from pbng.errors import InputError
from pbng.jit import serial

MAX_COLORS = 64  # the colours in use around a node are bits of one word


@serial
def _greedy(order, start, incident, corners, used, color):
    """Give each node, in order, the smallest colour that none of its cells' other nodes has; -1 if there is none."""
    one = np.uint64(1)
    for v in order:
        taken = np.uint64(0)
        for k in range(start[v], start[v + 1]):
            taken |= used[incident[k] // corners]
        c = 0
        while c < 64 and (taken >> np.uint64(c)) & one:
            c += 1
        if c == 64:
            return v
        color[v] = c
        for k in range(start[v], start[v + 1]):
            used[incident[k] // corners] |= one << np.uint64(c)
    return -1


def color_nodes(order: np.ndarray, incidences: list[tuple[np.ndarray, np.ndarray, int, int]]) -> np.ndarray:
    """Colours (n_vert,) int32 of the nodes, greedily in the given order; nodes left out of the order get -1.

    Args:
        order: The nodes to colour, (k,); ties are thus broken by index.
        incidences: For each kind of cell: ``start, incident`` as :func:`pbng.topology.incidence` gives them, the
            number of corners and the number of cells.
    """
    if len(incidences) == 1:
        start, incident, corners, n_cell = incidences[0]
    else:  # cells of several kinds: treat every cell as one of the largest kind, numbered through
        corners = max(c for _, _, c, _ in incidences)
        first = np.cumsum([0] + [n for *_, n in incidences])
        n_cell = int(first[-1])
        degree = sum(np.diff(s) for s, *_ in incidences)
        start = np.concatenate([[0], np.cumsum(degree)])
        node = np.concatenate([np.repeat(np.arange(len(s) - 1), np.diff(s)) for s, *_ in incidences])
        cell = np.concatenate([i // c + f for (_, i, c, _), f in zip(incidences, first)])
        incident = (corners * cell[np.argsort(node, kind="stable")]).astype(np.int64)
    color = np.full(len(start) - 1, -1, np.int32)
    stuck = _greedy(order, start, incident, corners, np.zeros(n_cell, np.uint64), color)
    if stuck >= 0:
        raise InputError(f"vertex {stuck} has neighbours of {MAX_COLORS} colours: the mesh is too densely connected")
    return color


@serial
def _greedy_constraints(stencils, used, first, color):
    """Give each constraint the smallest colour from ``first[0]`` on that none of its nodes has used.

    ``used`` holds, for each node, 128 colours as the bits of two words; where all are used a new set begins.
    """
    one, word = np.uint64(1), np.uint64(63)
    for n in range(stencils.shape[0]):
        c = 128
        for half in range(2):
            taken = np.uint64(0)
            for k in range(stencils.shape[1]):
                taken |= used[stencils[n, k], half]
            if ~taken:
                c = 64 * half
                while (taken >> (np.uint64(c) & word)) & one:
                    c += 1
                break
        if c == 128:
            used[:] = 0
            first[0] += 128
            c = 0
        color[n] = first[0] + c
        for k in range(stencils.shape[1]):
            used[stencils[n, k], c >> 6] |= one << (np.uint64(c) & word)


def color_constraints(stencils: Sequence[np.ndarray], n_vert: int) -> np.ndarray:
    """Colours (n,) int32 of constraints, greedily in the given order: each gets the smallest that its nodes have left.

    Args:
        stencils: The nodes of the constraints, arrays (m, k) of as many sizes as there are; numbered through.
        n_vert: Number of nodes.
    """
    used, first = np.zeros((n_vert, 2), np.uint64), np.zeros(1, np.int64)
    colors = [np.empty(len(s), np.int32) for s in stencils]
    for s, color in zip(stencils, colors):
        _greedy_constraints(np.ascontiguousarray(s, np.int32), used, first, color)
    return np.concatenate(colors) if colors else np.empty(0, np.int32)


@serial
def recolor(nodes, color, start, neighbour, stencils, among):
    """Change the colours of nodes, in place and in order, where another of ``among`` that it meets has the same.

    Args:
        nodes: The nodes to look at, (k,).
        color: Colours of all nodes, (n_vert,).
        start, neighbour: Whom each node meets in cells that stay, in compressed rows.
        stencils: Cells that come and go, (m, s).
        among: Which nodes count, (n_vert,) bool.
    """
    n_vert, m = color.size, stencils.shape[0]
    first = np.zeros(n_vert + 1, np.int64)
    for c in range(m):
        for a in range(stencils.shape[1]):
            first[stencils[c, a] + 1] += 1
    for v in range(n_vert):
        first[v + 1] += first[v]
    position = first[:-1].copy()
    cell = np.empty(first[n_vert], np.int64)
    for c in range(m):
        for a in range(stencils.shape[1]):
            cell[position[stencils[c, a]]] = c
            position[stencils[c, a]] += 1
    # Who has last seen a colour taken. There is a free one below their number, and no colour is as high as this.
    seen = np.full(color.max() + 2 + len(nodes), -1, np.int64)
    for v in nodes:
        for k in range(start[v], start[v + 1]):
            u = neighbour[k]
            if among[u]:
                seen[color[u]] = v
        for k in range(first[v], first[v + 1]):
            for a in range(stencils.shape[1]):
                u = stencils[cell[k], a]
                if among[u] and u != v:
                    seen[color[u]] = v
        if seen[color[v]] == v:
            c = 0
            while seen[c] == v:
                c += 1
            color[v] = c


@serial
def _first_conflict(cells, color):
    for e in range(cells.shape[0]):
        for a in range(cells.shape[1]):
            for b in range(a):
                if color[cells[e, a]] == color[cells[e, b]] and color[cells[e, a]] >= 0:
                    return e
    return -1


def is_valid(color: np.ndarray, cells: np.ndarray) -> bool:
    """Whether no cell has two nodes of one colour (nodes of colour -1 do not count)."""
    return bool(_first_conflict(cells, color) < 0)


def morton(X: np.ndarray) -> np.ndarray:
    """Morton code (n,) int64 of points (n, 3): sorting by it keeps neighbours in space close in memory."""
    size = max(float(np.ptp(X, axis=0).max(initial=0)), 1e-300)
    q = np.minimum((X - X.min(0)) / size * 2**20, 2**20 - 1).astype(np.int64)

    def spread(a: np.ndarray) -> np.ndarray:
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            a = (a | a << shift) & mask
        return a

    return spread(q[:, 0]) | spread(q[:, 1]) << 1 | spread(q[:, 2]) << 2
