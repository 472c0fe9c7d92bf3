"""Closest triangles and edges and containing tets, found with a tree; all points at once, in parallel.

What a query may find is restricted by keywords, all optional, which mean the same everywhere:

``own`` (k,) the group of each query, and ``meets`` (groups of queries, groups of the tree) bool, which of them look at
which: ``~numpy.eye(n, dtype=bool)`` for contact with others, ``numpy.eye(n, dtype=bool)`` with oneself; a row of False
is not asked, a column of False is never found. ``excluded`` says which primitives each vertex never finds, as
:func:`pbng.contact.rings.spans` gives them; ``vertex`` (k,) tells which vertex a point is.

Results are the same for any number of threads. Of primitives at the same distance, up to rounding, the lowest is found.
"""

from math import sqrt

import numpy as np

from pbng.contact.bvh import DEPTH, BoxTree
from pbng.contact.descent import (
    CORNERS,
    LARGEST,
    STACK,
    STARTS,
    begin,
    common_ground,
    find_starts,
    go_on,
    leave_out,
    lower_corner,
    next_leaf,
    put_nearest_on_top,
    same_as,
    seek,
    slack_of,
    squared,
    upper_corner,
)
from pbng.contact.primitives import closest_on_triangle, closest_segments, tet_weights
from pbng.contact.rings import Spans
from pbng.linalg import combine, combine3, cross, dot, point, sub
from pbng.parallel import array, body, each, rows, scratch

GRAIN = 128  # queries that a thread takes at a time
BUNCH = 8  # queries in a row, which are best near each other, that begin their ways down the tree together
NONE = 1 << 31  # above every number


def closest_triangles(
    tree: BoxTree,
    x: np.ndarray,
    points: np.ndarray,
    reach: float | np.ndarray = np.inf,
    *,
    own: np.ndarray | None = None,
    meets: np.ndarray | None = None,
    vertex: np.ndarray | None = None,
    excluded: Spans | None = None,
    behind: bool = False,
    against: np.ndarray | None = None,
    limit: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangle of a tree closest to each point.

    Args:
        tree: Tree over triangles, fitted to x.
        x: Positions (n_vert, 3) [m].
        points: Points (k, 3) [m].
        reach: How far to look [m], a number or one a point (k,), to which what is looked at adds the largest margin
            of its vertices, and how far it is expected to go relative to the point, which rests unless it is a vertex
            (:meth:`pbng.contact.bvh.BoxTree.refit`); below 0 a point is not asked.
        own, meets, vertex, excluded: What may be found, see above.
        behind: Find only triangles that the point is behind: (point - closest point) · normal < 0.
        against: Directions (k, 3): find only triangles whose normals do not point along them, all where one is zero.
        limit: Cosine of the angle from which on a normal does not, from 0 to 1.

    Returns:
        Triangles (k,) int32, -1 for none; weights (k, 3) of the closest points; distances (k,) [m], infinite for none.
    """
    points = np.ascontiguousarray(points, np.float64)
    assert points.shape[1:] == (3,), "points must have shape (k, 3)"
    assert excluded is None or vertex is not None, "excluded needs vertex"
    k = len(points)
    found, weights, distance = np.empty(k, np.int32), np.empty((k, 3)), np.empty(k)
    flags = np.array([behind, against is not None, vertex is not None], np.int64)
    against = np.zeros((1, 3)) if against is None else np.ascontiguousarray(against, np.float64)
    arrays = (points, flags, found, weights, distance, against, np.array([limit * limit]))
    each(_closest_triangles, (*_common(tree, 3, x, k, reach, own, meets, vertex, excluded), *arrays), k, GRAIN)
    return found, weights, distance


def closest_edges(
    tree: BoxTree,
    x: np.ndarray,
    edges: np.ndarray,
    reach: float | np.ndarray = np.inf,
    *,
    own: np.ndarray | None = None,
    meets: np.ndarray | None = None,
    excluded: Spans | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The edge of a tree closest to each edge, among those that share no vertex with it.

    Args:
        tree: Tree over edges, fitted to x.
        x: Positions (n_vert, 3) [m].
        edges: Vertices (k, 2) of the edges that ask.
        reach: How far to look [m], a number or one an edge (k,), to which what is looked at adds the larger margin of
            its vertices, and how far it is expected to go relative to the edge; below 0 an edge is not asked.
        own, meets, excluded: What may be found, see above; what either vertex excludes is excluded.

    Returns:
        Edges (k,) int32 of the tree, -1 for none; the closest points' parameters s (k,) along the edge that asks and
        t (k,) along the one found, from 0 at the first vertex to 1; distances (k,) [m], infinite for none.
    """
    edges = np.ascontiguousarray(edges, np.int32).reshape(-1, 2)
    k = len(edges)
    assert edges.min(initial=0) >= 0, "an edge has no vertex"
    end = len(x) if excluded is None else min(len(x), len(excluded.start) - 1)
    assert edges.max(initial=-1) < end, "a vertex has no position, or no list of what it excludes"
    found, s, t, distance = np.empty(k, np.int32), np.empty(k), np.empty(k), np.empty(k)
    common = _common(tree, 2, x, k, reach, own, meets, None, excluded)
    each(_closest_edges, (*common, edges, found, s, t, distance), k, GRAIN)
    return found, s, t, distance


def containing_tets(
    tree: BoxTree,
    x: np.ndarray,
    points: np.ndarray,
    vertex: np.ndarray | None = None,
    *,
    own: np.ndarray | None = None,
    meets: np.ndarray | None = None,
    excluded: Spans | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """The tet of a tree that contains each point, of several the lowest; inverted tets contain points too.

    Args:
        tree: Tree over tets, fitted to x.
        x: Positions (n_vert, 3) [m].
        points: Points (k, 3) [m].
        vertex: The vertex that each point is, (k,): its own tets are left out.
        own, meets, excluded: What may be found, see above.

    Returns:
        Tets (k,) int32, -1 for none, and the weights (k, 4) of the points there, none negative.
    """
    points = np.ascontiguousarray(points, np.float64)
    assert points.shape[1:] == (3,), "points must have shape (k, 3)"
    assert excluded is None or vertex is not None, "excluded needs vertex"
    k = len(points)
    found, weights = np.empty(k, np.int32), np.empty((k, 4))
    numbers = np.array([vertex is not None], np.int64)
    arrays = (points, numbers, found, weights)
    each(_containing_tets, (*_common(tree, 4, x, k, 0.0, own, meets, vertex, excluded), *arrays), k, GRAIN)
    return found, weights


def _common(
    tree: BoxTree,
    corners: int,
    x: np.ndarray,
    k: int,
    reach: float | np.ndarray,
    own: np.ndarray | None,
    meets: np.ndarray | None,
    vertex: np.ndarray | None,
    excluded: Spans | None,
) -> tuple[np.ndarray, ...]:
    """The first 16 arguments of every body; what does not fit is refused here, as bodies read without looking."""
    assert tree.cells.shape[1] == corners, f"a tree over primitives of {corners} vertices is needed"
    x = np.ascontiguousarray(x, np.float64)
    assert x.shape[1:] == (3,), "positions must have shape (n_vert, 3)"
    assert len(x) >= tree.n_vert, "a vertex has no position"
    reaches = np.full(k, reach, np.float64)
    assert (own is None) == (meets is None), "own and meets go together"
    grouped = own is not None
    meets = np.ones((1, tree.n_group), bool) if meets is None else np.ascontiguousarray(meets, np.bool_)
    assert meets.shape[1] >= tree.n_group, "meets has no column for some group of the tree"
    own = _numbers(own, k, len(meets))
    if grouped:
        asks = np.any(meets, axis=1)
        if not np.all(asks):
            reaches[~asks[own]] = -1.0
    listed = (
        Spans(np.zeros(1, np.int64), np.zeros(1, np.int32), np.zeros(1, np.int32)) if excluded is None else excluded
    )
    assert listed.start.dtype == np.int64, "spans begin at numbers of 64 bits"
    assert tree.way is None or len(tree.way) == len(x), "some position has no way"
    vertex = _numbers(vertex, k, len(x) if excluded is None else min(len(x), len(listed.start) - 1))
    way = np.zeros((1, 3)) if tree.way is None else tree.way
    sizes = np.array([grouped, meets.shape[1], excluded is not None, tree.way is not None], np.int64)
    asked = reaches, sizes, meets, own, vertex, *listed
    return tree.nodes, tree.boxes, tree.order, tree.sorted_cells, x, *asked, tree.margin, tree.ways, way


def _numbers(a: np.ndarray | None, k: int, end: int) -> np.ndarray:
    """One number a query, below ``end``; a placeholder for none."""
    if a is None:
        return np.zeros(1, np.int32)
    a = np.ascontiguousarray(a, np.int32)
    assert a.shape == (k,), f"one number a query is needed, {(k,)}, not {a.shape}"
    assert a.min(initial=0) >= 0, "a number is negative"
    assert a.max(initial=-1) < end, "a number is too high"
    return a


@body
def _closest_triangles(arguments, low, high):
    """Body of :func:`closest_triangles` for points low .. high."""
    nodes, boxes = rows(arguments, 0, 4, np.int32), rows(arguments, 1, 6, np.float64)
    order, cells, x = array(arguments, 2, np.int32), rows(arguments, 3, 3, np.int32), rows(arguments, 4, 3, np.float64)
    reach, sizes, meets = array(arguments, 5, np.float64), array(arguments, 6, np.int64), array(arguments, 7, np.bool_)
    own, vertex = array(arguments, 8, np.int32), array(arguments, 9, np.int32)
    start, first, past = array(arguments, 10, np.int64), array(arguments, 11, np.int32), array(arguments, 12, np.int32)
    margin = array(arguments, 13, np.float64)
    points, behind = rows(arguments, 16, 3, np.float64), array(arguments, 17, np.int64)[0]
    directed, named = array(arguments, 17, np.int64)[1], array(arguments, 17, np.int64)[2]
    against = rows(arguments, 21, 3, np.float64)
    found, weights = array(arguments, 18, np.int32), rows(arguments, 19, 3, np.float64)
    distance, cosine2 = array(arguments, 20, np.float64), array(arguments, 22, np.float64)[0]
    grouped, n_group, listed, moving = sizes[0], sizes[1], sizes[2], sizes[3]
    tree, way = (nodes, boxes, rows(arguments, 14, 6, np.float64), moving), rows(arguments, 15, 3, np.float64)
    stack, gaps = scratch(STACK, np.int32), scratch(STACK, np.float64)
    starts, corners = scratch(STARTS, np.int32), scratch(CORNERS, np.float64)
    slack = slack_of(boxes)
    n_start = 0
    for q in range(low, high):
        if (q - low) % BUNCH == 0:
            lowest, highest, last = (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf), min(q + BUNCH, high)
            w_low, w_high = lowest, highest
            for j in range(q, last):
                if reach[j] >= 0.0:
                    p = point(points, j)
                    lowest, highest = lower_corner(lowest, p), upper_corner(highest, p)
                    mine = point(way, vertex[j]) if moving and named else (0.0, 0.0, 0.0)
                    w_low, w_high = lower_corner(w_low, mine), upper_corner(w_high, mine)
            farthest, together = common_ground(reach, own, n_group, grouped, q, last)
            if farthest >= 0.0:
                who = lowest, highest, w_low, w_high
                n_start = find_starts(tree, meets, together, who, farthest, starts, corners, stack)
        found[q], distance[q] = -1, np.inf
        weights[q, 0] = weights[q, 1] = weights[q, 2] = 0.0
        if not reach[q] >= 0.0:
            continue
        p = point(points, q)
        row = own[q] * n_group if grouped else 0
        closest = NONE
        u = v = w = 0.0
        best = least = most = np.inf
        within = LARGEST  # of boxes worth a look
        mine = point(way, vertex[q]) if moving and named else (0.0, 0.0, 0.0)
        who = p, p, mine, mine
        top = begin(moving, starts, corners, n_start, who, reach[q], stack, gaps)
        if listed:
            top = leave_out(nodes, start, first, past, vertex[q], stack, gaps, top)
        put_nearest_on_top(stack, gaps, top)
        end = start[vertex[q] + 1] if listed else 0
        while True:
            i, top = next_leaf(tree, meets, row, who, reach[q], within, stack, gaps, top)
            if i < 0:
                break
            r = seek(start, past, vertex[q], nodes[i, 1]) if listed else end
            for e in range(nodes[i, 1], nodes[i, 2]):
                r, left_out = go_on(first, past, r, end, e)
                if left_out:
                    continue
                t = order[e]
                a, b, c = point(x, cells[e, 0]), point(x, cells[e, 1]), point(x, cells[e, 2])
                n = 0.0, 0.0, 0.0
                if directed or behind:
                    n = cross(sub(b, a), sub(c, a))
                if directed:
                    along = dot(point(against, q), n)
                    if along > 0.0 and along * along > cosine2 * dot(n, n) * dot(point(against, q), point(against, q)):
                        continue
                weight, offset, d2 = closest_on_triangle(p, a, b, c)
                if not d2 <= most or (d2 >= least and t > closest):  # not a number is not found
                    continue
                far = reach[q] + max(margin[cells[e, 0]], margin[cells[e, 1]], margin[cells[e, 2]])
                if moving:
                    f, g, h = point(way, cells[e, 0]), point(way, cells[e, 1]), point(way, cells[e, 2])
                    apart = sub(combine3(weight[0], f, weight[1], g, weight[2], h), mine)
                    far += sqrt(dot(apart, apart))
                if d2 > squared(far):
                    continue
                if behind and not dot(offset, n) > 0.0:
                    continue
                best, closest = d2, t
                u, v, w = weight
                least, most = same_as(best, slack)
                within = min(within, most)
        if closest < NONE:
            found[q], distance[q] = closest, sqrt(best)
            weights[q, 0], weights[q, 1], weights[q, 2] = u, v, w


@body
def _closest_edges(arguments, low, high):
    """Body of :func:`closest_edges` for edges low .. high."""
    nodes, boxes = rows(arguments, 0, 4, np.int32), rows(arguments, 1, 6, np.float64)
    order, cells, x = array(arguments, 2, np.int32), rows(arguments, 3, 2, np.int32), rows(arguments, 4, 3, np.float64)
    reach, sizes, meets = array(arguments, 5, np.float64), array(arguments, 6, np.int64), array(arguments, 7, np.bool_)
    own, start = array(arguments, 8, np.int32), array(arguments, 10, np.int64)
    first, past = array(arguments, 11, np.int32), array(arguments, 12, np.int32)
    margin = array(arguments, 13, np.float64)
    edges, found = rows(arguments, 16, 2, np.int32), array(arguments, 17, np.int32)
    s, t = array(arguments, 18, np.float64), array(arguments, 19, np.float64)
    distance = array(arguments, 20, np.float64)
    grouped, n_group, listed, moving = sizes[0], sizes[1], sizes[2], sizes[3]
    tree, way = (nodes, boxes, rows(arguments, 14, 6, np.float64), moving), rows(arguments, 15, 3, np.float64)
    stack, gaps = scratch(STACK, np.int32), scratch(STACK, np.float64)
    starts, corners = scratch(STARTS, np.int32), scratch(CORNERS, np.float64)
    slack = slack_of(boxes)
    n_start = 0
    for q in range(low, high):
        if (q - low) % BUNCH == 0:
            lowest, highest, last = (np.inf, np.inf, np.inf), (-np.inf, -np.inf, -np.inf), min(q + BUNCH, high)
            w_low, w_high = lowest, highest
            for j in range(q, last):
                if reach[j] >= 0.0:
                    a, b = point(x, edges[j, 0]), point(x, edges[j, 1])
                    lowest, highest = (
                        lower_corner(lowest, lower_corner(a, b)),
                        upper_corner(highest, upper_corner(a, b)),
                    )
                    if moving:
                        a, b = point(way, edges[j, 0]), point(way, edges[j, 1])
                        w_low = lower_corner(w_low, lower_corner(a, b))
                        w_high = upper_corner(w_high, upper_corner(a, b))
            farthest, together = common_ground(reach, own, n_group, grouped, q, last)
            if farthest >= 0.0:
                who = lowest, highest, w_low, w_high
                n_start = find_starts(tree, meets, together, who, farthest, starts, corners, stack)
        found[q], s[q], t[q], distance[q] = -1, 0.0, 0.0, np.inf
        if not reach[q] >= 0.0:
            continue
        v, w = edges[q, 0], edges[q, 1]
        a, b = point(x, v), point(x, w)
        lowest, highest = lower_corner(a, b), upper_corner(a, b)
        row = own[q] * n_group if grouped else 0
        closest = NONE
        along, across = 0.0, 0.0
        best = least = most = np.inf
        within = LARGEST  # of boxes worth a look
        from_v, from_w = (point(way, v), point(way, w)) if moving else ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        who = lowest, highest, lower_corner(from_v, from_w), upper_corner(from_v, from_w)
        top = begin(moving, starts, corners, n_start, who, reach[q], stack, gaps)
        if listed:
            top = leave_out(nodes, start, first, past, v, stack, gaps, top)
            top = leave_out(nodes, start, first, past, w, stack, gaps, top)
        put_nearest_on_top(stack, gaps, top)
        r_end, h_end = (start[v + 1], start[w + 1]) if listed else (0, 0)
        while True:
            i, top = next_leaf(tree, meets, row, who, reach[q], within, stack, gaps, top)
            if i < 0:
                break
            r = seek(start, past, v, nodes[i, 1]) if listed else r_end
            h = seek(start, past, w, nodes[i, 1]) if listed else h_end
            for e in range(nodes[i, 1], nodes[i, 2]):
                r, by_v = go_on(first, past, r, r_end, e)
                h, by_w = go_on(first, past, h, h_end, e)
                if by_v or by_w:
                    continue
                edge = order[e]
                c, d = cells[e, 0], cells[e, 1]
                if c == v or c == w or d == v or d == w:  # noqa: SIM109 (a tuple would be searched)
                    continue
                s1, t1, _, d2 = closest_segments(a, b, point(x, c), point(x, d))
                if not d2 <= most or (d2 >= least and edge > closest):
                    continue
                far = reach[q] + max(margin[c], margin[d])
                if moving:
                    apart = sub(
                        combine(1.0 - s1, from_v, s1, from_w), combine(1.0 - t1, point(way, c), t1, point(way, d))
                    )
                    far += sqrt(dot(apart, apart))
                if d2 > squared(far):
                    continue
                best, closest, along, across = d2, edge, s1, t1
                least, most = same_as(best, slack)
                within = min(within, most)
        if closest < NONE:
            found[q], s[q], t[q], distance[q] = closest, along, across, sqrt(best)


@body
def _containing_tets(arguments, low, high):
    """Body of :func:`containing_tets` for points low .. high."""
    nodes, boxes = rows(arguments, 0, 4, np.int32), rows(arguments, 1, 6, np.float64)
    order, cells, x = array(arguments, 2, np.int32), rows(arguments, 3, 4, np.int32), rows(arguments, 4, 3, np.float64)
    reach, sizes, meets = array(arguments, 5, np.float64), array(arguments, 6, np.int64), array(arguments, 7, np.bool_)
    own, vertex = array(arguments, 8, np.int32), array(arguments, 9, np.int32)
    start, first, past = array(arguments, 10, np.int64), array(arguments, 11, np.int32), array(arguments, 12, np.int32)
    points, named = rows(arguments, 16, 3, np.float64), array(arguments, 17, np.int64)[0]
    found, weights = array(arguments, 18, np.int32), rows(arguments, 19, 4, np.float64)
    grouped, n_group, listed = sizes[0], sizes[1], sizes[2]
    tree = nodes, boxes, rows(arguments, 14, 6, np.float64), False
    stack, gaps = scratch(DEPTH, np.int32), scratch(DEPTH, np.float64)
    for q in range(low, high):
        found[q] = -1
        weights[q, 0] = weights[q, 1] = weights[q, 2] = weights[q, 3] = 0.0
        if not reach[q] >= 0.0:
            continue
        p = point(points, q)
        row = own[q] * n_group if grouped else 0
        v = vertex[q] if named else -1
        lowest = NONE
        stack[0], gaps[0] = 0, 0.0
        who = p, p, p, p
        i, top = next_leaf(tree, meets, row, who, 0.0, 0.0, stack, gaps, 1)
        while i >= 0:
            for e in range(nodes[i, 1], nodes[i, 2]):
                t = order[e]
                a, b, c, d = cells[e, 0], cells[e, 1], cells[e, 2], cells[e, 3]
                if t >= lowest or a == v or b == v or c == v or d == v:
                    continue
                (wa, wb, wc, wd), _ = tet_weights(p, point(x, a), point(x, b), point(x, c), point(x, d))
                if not (wa >= 0.0 and wb >= 0.0 and wc >= 0.0 and wd >= 0.0):
                    continue
                if listed and go_on(first, past, seek(start, past, v, e), start[v + 1], e)[1]:
                    continue
                lowest = t
                weights[q, 0], weights[q, 1], weights[q, 2], weights[q, 3] = wa, wb, wc, wd
            i, top = next_leaf(tree, meets, row, who, 0.0, 0.0, stack, gaps, top)
        if lowest < NONE:
            found[q] = lowest
