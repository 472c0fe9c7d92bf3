"""Which cells lie around a vertex: what it must not be found in contact with."""

from typing import NamedTuple

import numpy as np

from pbng.jit import serial
from pbng.topology import incidence


class Spans(NamedTuple):
    """Some primitives for each vertex, by where a tree has them: near ones follow each other there.

    Attributes:
        start: Those of vertex v are the spans ``start[v] .. start[v + 1]``, (n_vert + 1,) int64.
        low, high: Its first place in the order of the tree, and the first past its last, int32; sorted, and apart.
    """

    start: np.ndarray
    low: np.ndarray
    high: np.ndarray


def spans(order: np.ndarray, start: np.ndarray, ids: np.ndarray) -> Spans:
    """Where the primitives ``ids[start[v]:start[v + 1]]`` of each vertex are in an ``order`` (m,) of all."""
    place = np.empty(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    found, low, high = np.zeros(len(start), np.int64), np.empty(len(ids), np.int32), np.empty(len(ids), np.int32)
    _join(place, start, ids, found, low, high)
    return Spans(found, low[: found[-1]].copy(), high[: found[-1]].copy())


def neighbourhoods(cells: np.ndarray, n_vert: int, rings: int) -> tuple[np.ndarray, np.ndarray]:
    """The cells within some rings of each vertex: those that have it are one ring, those that touch these the next.

    Args:
        cells: Edges, triangles or tets, (m, k).
        n_vert: Number of vertices.
        rings: Number of rings; none for 0.

    Returns:
        ``start`` (n_vert + 1,) int64 and ``ids`` int32: those of vertex v are ``ids[start[v]:start[v + 1]]``, sorted.
    """
    cells = np.ascontiguousarray(cells, np.int32)
    first, incident = incidence(cells, n_vert)
    incident //= cells.shape[1]
    ids = np.zeros(0, np.int32)
    start = np.zeros(n_vert + 1, np.int64)
    seen_cell, seen_vertex = np.full(len(cells), -1, np.int32), np.full(n_vert, -1, np.int32)
    if rings > 0:
        _count(cells, first, incident, rings, seen_cell, seen_vertex, start, ids)
        ids = np.empty(start[-1], np.int32)
        seen_cell[:], seen_vertex[:] = -1, -1
        _count(cells, first, incident, rings, seen_cell, seen_vertex, start, ids)
    return start, ids


@serial
def _count(cells, first, incident, rings, seen_cell, seen_vertex, start, ids):
    """Count the cells around every vertex into ``start``, or note them where there is room for them."""
    n, k = len(first) - 1, cells.shape[1]
    queue, found = np.empty(n, np.int32), np.empty(len(cells), np.int32)
    for v in range(n):
        queue[0], seen_vertex[v] = v, v
        head, tail, count = 0, 1, 0
        for _ in range(rings):
            end = tail
            while head < end:
                for j in range(first[queue[head]], first[queue[head] + 1]):
                    e = incident[j]
                    if seen_cell[e] == v:
                        continue
                    seen_cell[e] = v
                    found[count] = e
                    count += 1
                    for c in range(k):
                        w = cells[e, c]
                        if seen_vertex[w] != v:
                            seen_vertex[w] = v
                            queue[tail] = w
                            tail += 1
                head += 1
        if len(ids):
            ids[start[v] : start[v + 1]] = np.sort(found[:count])
        else:
            start[v + 1] = start[v] + count


@serial
def _join(place, start, ids, found, low, high):
    """Join places that follow each other to spans."""
    n = 0
    for v in range(len(start) - 1):
        for e in np.sort(place[ids[start[v] : start[v + 1]]]):
            if n > found[v] and high[n - 1] == e:
                high[n - 1] = e + 1
            else:
                low[n], high[n] = e, e + 1
                n += 1
        found[v + 1] = n
