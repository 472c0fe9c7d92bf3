"""Connectivity of cells: which cells meet at a vertex, which faces are shared, what hangs together."""

import numpy as np

from pbng.jit import inline, serial

# Faces of a positively oriented tet, each ordered so that its normal points outward.
TET_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], np.int32)
TET_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]], np.int32)
TRIANGLE_EDGES = np.array([[0, 1], [1, 2], [2, 0]], np.int32)


@serial
def incidence(cells, n_vert):
    """Vertex-to-cell incidence in compressed rows.

    Returns ``start`` (n_vert + 1,) int64 and ``incident`` (n_cell * k,) int32: the entries ``k * cell + corner`` of
    vertex v are ``incident[start[v]:start[v + 1]]``, in order of the cells.
    """
    n, k = cells.shape
    start = np.zeros(n_vert + 1, np.int64)
    for e in range(n):
        for a in range(k):
            start[cells[e, a] + 1] += 1
    for v in range(n_vert):
        start[v + 1] += start[v]
    position = start[:-1].copy()
    incident = np.empty(n * k, np.int32)
    for e in range(n):
        for a in range(k):
            v = cells[e, a]
            incident[position[v]] = k * e + a
            position[v] += 1
    return start, incident


def entries(start: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The entries of some of the rows of a compressed table, one row after the other.

    Args:
        start: Where the rows start, (n + 1,): row r has the entries ``start[r]`` to ``start[r + 1] - 1``.
        row: The rows asked for, (k,), in any order; one may be asked for more than once.

    Returns:
        For each entry which of the rows asked for it is of, from 0 to k - 1, and its number.
    """
    first, count = start[row], start[row + 1] - start[row]
    of = np.repeat(np.arange(len(row)), count)
    return of, np.arange(len(of)) + (first - np.cumsum(count) + count)[of]


@serial
def _match_faces(cells, faces, n_vert):
    """Partner of every face: -1 on the boundary, else the other face; and the first bad pair found.

    A face is numbered ``4 * cell + local face``. ``bad`` is (code, face, face): code 1 for two cells on the same side
    of their common face, 2 for a face of more than two cells, 3 for a cell given twice, 0 for none.
    """
    n = cells.shape[0]
    start = np.zeros(n_vert + 1, np.int64)
    smallest = np.empty(4 * n, np.int32)
    for e in range(n):
        for f in range(4):
            v = min(cells[e, faces[f, 0]], cells[e, faces[f, 1]], cells[e, faces[f, 2]])
            smallest[4 * e + f] = v
            start[v + 1] += 1
    for v in range(n_vert):
        start[v + 1] += start[v]
    position = start[:-1].copy()
    bucket = np.empty(4 * n, np.int64)
    for i in range(4 * n):
        v = smallest[i]
        bucket[position[v]] = i
        position[v] += 1
    partner = np.full(4 * n, -1, np.int64)
    bad = np.zeros(3, np.int64)
    for v in range(n_vert):
        for p in range(start[v], start[v + 1]):
            i = bucket[p]
            _, b, c = _rotated(cells, faces, i)
            for q in range(p + 1, start[v + 1]):
                j = bucket[q]
                _, s, t = _rotated(cells, faces, j)
                if not ((b == s and c == t) or (b == t and c == s)):
                    continue
                code = 0
                if _opposite(cells, i) == _opposite(cells, j):
                    code = 3
                elif partner[i] >= 0 or partner[j] >= 0:
                    code = 2
                elif b == s:
                    code = 1
                if code and (bad[0] == 0 or (code == 3 and bad[0] != 3)):
                    bad[0], bad[1], bad[2] = code, i, j
                partner[i], partner[j] = j, i
    return partner, bad


@inline
def _rotated(cells, faces, i):
    """The face's vertices, rotated so that the smallest comes first (its orientation is kept)."""
    e, f = i // 4, i % 4
    a, b, c = cells[e, faces[f, 0]], cells[e, faces[f, 1]], cells[e, faces[f, 2]]
    if b < a and b < c:
        return b, c, a
    if c < a and c < b:
        return c, a, b
    return a, b, c


@inline
def _opposite(cells, i):
    return cells[i // 4, i % 4]


def tet_faces(cells: np.ndarray, n_vert: int) -> tuple[np.ndarray, np.ndarray]:
    """Match the faces of tets; returns the boundary faces (m, 3) int32, outward, and the first bad pair (3,)."""
    partner, bad = _match_faces(cells, TET_FACES, n_vert)
    boundary = np.flatnonzero(partner < 0)
    return cells[boundary // 4][np.arange(len(boundary))[:, None], TET_FACES[boundary % 4]], bad


def unique_edges(cells: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Edges (m, 2) int32 of cells, each once, the smaller vertex first, in lexicographic order."""
    return _ends(np.unique(_edge_keys(cells, local)))


def edge_sides(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The edges of triangles, and which triangles are at each.

    Returns the edges (n_edge, 2) int32 as :func:`unique_edges` does, and compressed rows: the sides
    ``3 * triangle + side`` at edge e, numbered as in ``TRIANGLE_EDGES``, are ``sides[start[e]:start[e + 1]]``, rising.
    """
    key = _edge_keys(triangles, TRIANGLE_EDGES)
    sides = np.argsort(key, kind="stable")
    edges, first = np.unique(key[sides], return_index=True)
    return _ends(edges), np.append(first, len(key)), sides


def _edge_keys(cells: np.ndarray, local: np.ndarray) -> np.ndarray:
    """A number for each edge of each cell, (n_cell * n_local,) int64: the same for the same edge, and in its order."""
    a, b = cells[:, local].reshape(-1, 2).astype(np.int64).T
    return np.minimum(a, b) << 32 | np.maximum(a, b)


def _ends(keys: np.ndarray) -> np.ndarray:
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1).astype(np.int32)


@serial
def components(cells, n_vert):
    """Label (n_vert,) int32 of the connected part each vertex belongs to, numbered by its smallest vertex."""
    parent = np.arange(n_vert).astype(np.int32)
    for e in range(cells.shape[0]):
        a = _root(parent, cells[e, 0])
        for k in range(1, cells.shape[1]):
            b = _root(parent, cells[e, k])
            if a < b:
                parent[b] = a
            elif b < a:
                parent[a] = b
                a = b
    label = np.empty(n_vert, np.int32)
    count = 0
    for v in range(n_vert):
        root = _root(parent, v)
        if root == v:
            label[v] = count
            count += 1
        else:
            label[v] = label[root]
    return label


@inline
def _root(parent, v):
    while parent[v] != v:
        parent[v] = parent[parent[v]]
        v = parent[v]
    return v


def hinges(triangles: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
    """Pairs of triangles that share an edge, as hinges.

    Returns the hinges (m, 4) int32, in order of their edges: the ends of the edge as they follow upon each other in the
    first triangle, its third vertex, and that of the second; and the first bad edge as a code with its triangles: 1 for
    an edge of more than two triangles, 2 for two that run along it the same way, 0 for none.
    """
    _, start, sides = edge_sides(triangles)
    first, count = start[:-1], np.diff(start)
    many = np.flatnonzero(count > 2)
    if len(many):
        return np.empty((0, 4), np.int32), 1, sides[first[many[0]] :][: count[many[0]]] // 3
    one, two = sides[first[count == 2]], sides[first[count == 2] + 1]
    ends = triangles[:, TRIANGLE_EDGES].reshape(-1, 2)
    same = np.flatnonzero(ends[one, 0] == ends[two, 0])
    bad = np.array([one[same[:1]], two[same[:1]]]).ravel() // 3
    wings = (triangles[k // 3, (k % 3 + 2) % 3] for k in (one, two))
    return np.column_stack([ends[one], *wings]).astype(np.int32), 2 if len(same) else 0, bad
