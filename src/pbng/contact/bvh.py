"""Trees of boxes over edges, triangles or tets: built once, refitted as their vertices move."""

import numpy as np

from pbng.errors import InputError
from pbng.jit import inline, serial
from pbng.parallel import array, body, rows, run

LEAF = 4  # primitives in a leaf at most
DEPTH = 96  # levels that the stacks of queries have room for
GRAIN = 1024  # nodes that a thread refits at a time


class BoxTree:
    """A bounding-volume hierarchy over primitives of k vertices each: 2 (edges), 3 (triangles) or 4 (tets).

    The tree separates the groups of primitives first and halves them by their centroids then, so that a query that
    leaves out a group leaves out whole branches.

    Attributes:
        cells: The primitives, (m, k) int32, as given.
        group: The group of each, (m,) int32; their number is ``n_group``.
        n_vert: One more than the highest vertex.
        order: The primitives in the order of the tree, (m,) int32; ``sorted_cells`` are their vertices in that order.
        nodes: (n, 4) int32: the first of two children, which follow each other, or -1; the range of primitives; the
            group, or -1 where there are several. Parents come before children, level by level.
        boxes: Lowest and highest corner of each node, (n, 6) [m].
        margin: By how much they are wider about each vertex than it is, (n_vert,) [m].
        way: Where each vertex is expected to go, (n_vert, 3) [m], or None; ``ways`` (n, 6) are boxes about the ways of
            each node's vertices.
    """

    def __init__(self, x: np.ndarray, cells: np.ndarray, group: np.ndarray | None = None, leaf: int = LEAF) -> None:
        """Build the tree, and fit it to x.

        Args:
            x: Positions (n_vert, 3) [m] to build it from.
            cells: Vertices of the primitives, (m, k).
            group: Group of each primitive, (m,), numbered from 0; all are of one by default.
            leaf: Primitives in a leaf at most.
        """
        x = np.ascontiguousarray(x, np.float64)
        self.cells = np.ascontiguousarray(cells, np.int32)
        self.n_vert = int(self.cells.max(initial=-1)) + 1
        m = len(self.cells)
        self.group = np.zeros(m, np.int32) if group is None else np.ascontiguousarray(group, np.int32)
        self.n_group = int(self.group.max(initial=0)) + 1
        center = x[self.cells].mean(1) if m else np.empty((0, 3))
        if not np.isfinite(center).all():
            raise InputError(f"BoxTree: primitive {np.flatnonzero(~np.isfinite(center).all(1))[0]} is not finite")
        self.order = _by_group(center, self.group)
        self.nodes, levels = _build(self.order, center[self.order], self.group, leaf)
        if len(levels) > DEPTH:
            raise InputError(f"BoxTree: {len(levels)} levels; at most {DEPTH} are supported")
        self.sorted_cells = self.cells[self.order]
        self.boxes, self.ways = np.empty((2, len(self.nodes), 6))
        # Levels from the lowest up, the upper ones, too small to share, as one range: bodies go through it backwards.
        top = int(np.searchsorted(levels, GRAIN, "right")) - 1
        self._start = np.concatenate([[0], levels[max(top, 1) :]])
        self.refit(x)

    def refit(
        self,
        x: np.ndarray,
        y: np.ndarray | None = None,
        margin: float | np.ndarray = 0.0,
        way: np.ndarray | None = None,
    ) -> None:
        """Fit the boxes to positions x (n_vert, 3) [m], or to both x and y.

        Each vertex counts as a cube of half the edge ``margin`` [m], one for all or (n_vert,): as far as it may go.
        Queries look for what is so much farther away; and, where ways (n_vert, 3) [m] are given, by how far it is
        expected to go relative to who asks.
        """
        x = np.ascontiguousarray(x, np.float64)
        self.margin = np.full(len(x), margin, np.float64)
        self._fit(self.boxes, x, x if y is None else np.ascontiguousarray(y, np.float64), self.margin)
        self.way = way
        if way is not None:
            self.way = np.ascontiguousarray(way, np.float64)
            self._fit(self.ways, self.way, self.way, np.zeros(len(way)))

    def _fit(self, boxes: np.ndarray, x: np.ndarray, y: np.ndarray, margin: np.ndarray) -> None:
        assert x.shape[1:] == y.shape[1:] == (3,), "positions must have shape (n_vert, 3)"
        assert min(len(x), len(y)) >= self.n_vert, "a vertex has no position"
        numbers = np.array([self.cells.shape[1], y is not x], np.int64)
        arrays = (self.nodes, boxes, self.sorted_cells.ravel(), x, y, numbers, margin)
        run(_refit, arrays, np.arange(len(self._start) - 1)[::-1].copy(), self._start, GRAIN)


@body
def _refit(arguments, low, high):
    """Body of :meth:`BoxTree._fit` for nodes low .. high, whose children are done or among them."""
    nodes, boxes = rows(arguments, 0, 4, np.int32), rows(arguments, 1, 6, np.float64)
    cells, x, y = array(arguments, 2, np.int32), rows(arguments, 3, 3, np.float64), rows(arguments, 4, 3, np.float64)
    k, swept = array(arguments, 5, np.int64)[0], array(arguments, 5, np.int64)[1]
    margin = array(arguments, 6, np.float64)
    for i in range(high - 1, low - 1, -1):
        child = nodes[i, 0]
        if child >= 0:
            for j in range(3):
                a, b = boxes[child, j], boxes[child + 1, j]
                boxes[i, j] = a if a < b else b
            for j in range(3, 6):
                a, b = boxes[child, j], boxes[child + 1, j]
                boxes[i, j] = a if a > b else b
            continue
        first, last = k * nodes[i, 1], k * nodes[i, 2]
        a, b = _extended(x, margin, cells, first, last, (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf))
        if swept:
            a, b = _extended(y, margin, cells, first, last, a, b)
        for j in range(3):
            boxes[i, j], boxes[i, 3 + j] = a[j], b[j]


@inline
def _extended(x, margin, vertices, first, last, a, b):
    """Corners a, b of a box extended by the cubes about some vertices."""
    ax, ay, az = a
    bx, by, bz = b
    for e in range(first, last):
        v = vertices[e]
        m = margin[v]
        px, py, pz = x[v, 0] - m, x[v, 1] - m, x[v, 2] - m
        ax, ay, az = px if px < ax else ax, py if py < ay else ay, pz if pz < az else az
        px, py, pz = x[v, 0] + m, x[v, 1] + m, x[v, 2] + m
        bx, by, bz = px if px > bx else bx, py if py > by else by, pz if pz > bz else bz
    return (ax, ay, az), (bx, by, bz)


def _by_group(center: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Order (m,) int32 of the primitives in which groups follow each other as the nodes above them divide them."""
    n_group = int(group.max(initial=0)) + 1
    if n_group == 1:
        return np.arange(len(group), dtype=np.int32)
    count = np.bincount(group, minlength=n_group)
    middle = np.column_stack([np.bincount(group, c, n_group) for c in center.T]) / np.maximum(count, 1)[:, None]
    rank = np.empty(n_group, np.int64)
    ranges = [(np.flatnonzero(count), 0)]
    while ranges:
        groups, first = ranges.pop()
        if len(groups) <= 1:
            rank[groups] = first
            continue
        groups = groups[np.argsort(middle[groups, np.ptp(middle[groups], axis=0).argmax()], kind="stable")]
        total = np.cumsum(count[groups])
        cut = 1 + int(np.abs(2 * total[:-1] - total[-1]).argmin())  # as _boundary finds it
        ranges += [(groups[:cut], first), (groups[cut:], first + cut)]
    return np.argsort(rank[group], kind="stable").astype(np.int32)


@serial
def _build(order, key, group, leaf):
    """Nodes and the first node of each level (with their number at the end); sorts ``order`` and the centroids ``key``.

    Groups must follow each other in the order.
    """
    m = len(order)
    nodes = np.empty((max(2 * m, 1), 4), np.int32)
    nodes[0, 0], nodes[0, 1], nodes[0, 2], nodes[0, 3] = -1, 0, m, -1
    n = 1
    levels = [0]
    i = 0
    while i < n:
        if i == levels[-1]:
            levels.append(n)  # all before i have their children: this level ends where the nodes end now
        a, b = nodes[i, 1], nodes[i, 2]
        if b > a and group[order[a]] == group[order[b - 1]]:
            nodes[i, 3] = group[order[a]]
        mixed = b > a and nodes[i, 3] < 0
        if mixed or b - a > leaf:
            if mixed:
                middle = _boundary(order, group, a, b)
            else:
                middle = (a + b) // 2
                _select(order, key, _longest(key, a, b), a, b, middle)
            nodes[i, 0] = n
            nodes[n, 0], nodes[n, 1], nodes[n, 2], nodes[n, 3] = -1, a, middle, -1
            nodes[n + 1, 0], nodes[n + 1, 1], nodes[n + 1, 2], nodes[n + 1, 3] = -1, middle, b, -1
            n += 2
        i += 1
    return nodes[:n].copy(), np.array(levels)


@serial
def _boundary(order, group, a, b):
    """The boundary of groups next to the middle of a .. b, of two the lower."""
    best, middle = b - a, a
    for e in range(a + 1, b):
        if group[order[e]] != group[order[e - 1]] and abs(2 * e - a - b) < best:
            best, middle = abs(2 * e - a - b), e
    return middle


@serial
def _longest(key, a, b):
    """The axis along which the points a .. b spread most."""
    axis, most = 0, -1.0
    for j in range(3):
        low = high = key[a, j]
        for e in range(a, b):
            low, high = min(low, key[e, j]), max(high, key[e, j])
        if high - low > most:
            axis, most = j, high - low
    return axis


@serial
def _select(order, key, axis, a, b, middle):
    """Permute a .. b so that the lower ones along an axis (ties: lower numbers) come before the middle."""
    low, high = a, b - 1
    while low < high:
        # The median of three as pivot: it lies within, so that neither scan leaves the range.
        e, f, g = low, (low + high) // 2, high
        if _before(order, key, axis, f, e):
            e, f = f, e
        if _before(order, key, axis, g, f):
            f = g if _before(order, key, axis, e, g) else e
        value, number = key[f, axis], order[f]
        i, j = low, high
        while i <= j:
            while key[i, axis] < value or (key[i, axis] == value and order[i] < number):
                i += 1
            while key[j, axis] > value or (key[j, axis] == value and order[j] > number):
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                for c in range(3):
                    key[i, c], key[j, c] = key[j, c], key[i, c]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@serial
def _before(order, key, axis, e, f):
    return key[e, axis] < key[f, axis] or (key[e, axis] == key[f, axis] and order[e] < order[f])
