"""Which cells lie around a vertex: what it must not be found in contact with."""

import numpy as np

from pbng.jit import serial
from pbng.topology import incidence


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
