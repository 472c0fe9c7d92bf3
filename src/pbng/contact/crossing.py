"""Where moving points first pass through moving triangles."""

from math import sqrt

import numpy as np

from pbng.contact.bvh import DEPTH, BoxTree
from pbng.jit import inline
from pbng.linalg import add, cross, dot, point, sub
from pbng.parallel import array, body, each, rows

GRAIN = 128  # points that a thread takes at a time
EDGE = 1e-9  # by how much a weight may be negative: paths through an edge must not slip between its triangles
ROOT = 1e-15  # relative size of a residual that counts as zero
HALVINGS = 100


def first_crossings(
    tree: BoxTree, x: np.ndarray, y: np.ndarray, start: np.ndarray, stop: np.ndarray, entering: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangle that each point first passes through while all move steadily along straight lines.

    Args:
        tree: Tree over triangles, fitted to both x and y.
        x, y: Positions of the triangles' vertices in the beginning and the end [m], (n_vert, 3).
        start, stop: Those of the points, (k, 3).
        entering: Look for points only that come from the side that a triangle's normal points to.

    Returns:
        Triangles (k,) int32, -1 for none; weights (k, 3) of where they are passed through; the side (k,) that the point
        comes from: 1 for that of the normal, else -1. A point in a triangle's plane counts as on the normal's side.
    """
    k = len(start)
    found, weights, side = np.empty(k, np.int32), np.empty((k, 3)), np.empty(k)
    x, y, start, stop = (np.ascontiguousarray(a, np.float64) for a in (x, y, start, stop))
    flags = np.array([entering], np.int64)
    arrays = (tree.nodes, tree.boxes, tree.order, tree.sorted_cells, x, y, start, stop, flags, found, weights, side)
    each(_first_crossings, arrays, k, GRAIN)
    return found, weights, side


@body
def _first_crossings(arguments, low, high):
    """Body of :func:`first_crossings` for points low .. high."""
    nodes, boxes = rows(arguments, 0, 4, np.int32), rows(arguments, 1, 6, np.float64)
    order, cells = array(arguments, 2, np.int32), rows(arguments, 3, 3, np.int32)
    x, y = rows(arguments, 4, 3, np.float64), rows(arguments, 5, 3, np.float64)
    start, stop = rows(arguments, 6, 3, np.float64), rows(arguments, 7, 3, np.float64)
    entering, found = array(arguments, 8, np.int64)[0] != 0, array(arguments, 9, np.int32)
    weights, side = rows(arguments, 10, 3, np.float64), array(arguments, 11, np.float64)
    stack = np.empty(DEPTH, np.int32)
    for q in range(low, high):
        p0, p1 = point(start, q), point(stop, q)
        path = sub(p1, p0)
        first, which, u, v, w, where = 2.0, -1, 0.0, 0.0, 0.0, 0.0
        stack[0], top = 0, 1
        while top > 0:
            top -= 1
            i = stack[top]
            if not _enters(boxes, i, p0, path) <= min(first, 1.0):
                continue
            child = nodes[i, 0]
            if child >= 0:
                stack[top], stack[top + 1] = child + 1, child
                top += 2
                continue
            for e in range(nodes[i, 1], nodes[i, 2]):
                a, b, c = cells[e, 0], cells[e, 1], cells[e, 2]
                t, weight, s = _crossing(
                    p0, p1, point(x, a), point(y, a), point(x, b), point(y, b), point(x, c), point(y, c), entering
                )
                if t < first or (t == first and t <= 1.0 and order[e] < which):
                    first, which, where = t, order[e], s
                    u, v, w = weight
        found[q], side[q] = which, where
        weights[q, 0], weights[q, 1], weights[q, 2] = u, v, w


@inline
def _enters(boxes, i, p, path):
    """Share of the path from p after which it is in box i; 2 if it never is."""
    enter, leave = 0.0, 1.0
    for j in range(3):
        low, high = boxes[i, j] - p[j], boxes[i, 3 + j] - p[j]
        if abs(path[j]) < 1e-300:
            if low > 0.0 or high < 0.0:
                leave = -1.0
        else:
            s, t = low / path[j], high / path[j]
            enter, leave = max(enter, min(s, t)), min(leave, max(s, t))
    return enter if enter <= leave else 2.0


@inline
def _crossing(p0, p1, a0, a1, b0, b1, c0, c1, entering):
    """When the point p passes through the triangle abc: share of the time (2 for never), weights, side it comes from.

    With r = p - a, e = b - a and g = c - a, r · (e × g) is a cubic in time whose sign is the side. Between its extrema
    it is monotone, which leaves at most three passages through the plane; the first inside of the triangle counts.
    """
    r0, e0, g0 = sub(p0, a0), sub(b0, a0), sub(c0, a0)
    r1, e1, g1 = sub(sub(p1, a1), r0), sub(sub(b1, a1), e0), sub(sub(c1, a1), g0)
    n0, n1, n2 = cross(e0, g0), add(cross(e0, g1), cross(e1, g0)), cross(e1, g1)
    k0, k1, k2, k3 = dot(r0, n0), dot(r1, n0) + dot(r0, n1), dot(r1, n1) + dot(r0, n2), dot(r1, n2)
    s, t = _extrema(k1, k2, k3)
    time, weight, side = 2.0, (0.0, 0.0, 0.0), 0.0
    low, at_low = 0.0, k0
    for interval in range(3):
        high = s if interval == 0 else (t if interval == 1 else 1.0)
        at_high = _cubic(k0, k1, k2, k3, high)
        inward, outward = at_low >= 0.0 and at_high < 0.0, at_low < 0.0 and at_high >= 0.0
        if inward or (outward and not entering):
            root = _root(k0, k1, k2, k3, low, at_low, high, at_high)
            r, e, g = _along(r0, root, r1), _along(e0, root, e1), _along(g0, root, g1)
            n = cross(e, g)
            nn = dot(n, n)
            if nn > 0.0:
                v, w = dot(cross(r, g), n) / nn, dot(cross(e, r), n) / nn
                u = 1.0 - v - w
                if u >= -EDGE and v >= -EDGE and w >= -EDGE:
                    u, v, w = max(u, 0.0), max(v, 0.0), max(w, 0.0)
                    total = u + v + w
                    time, weight, side = root, (u / total, v / total, w / total), 1.0 if inward else -1.0
                    break
        low, at_low = high, at_high
    return time, weight, side


@inline
def _along(a, t, d):
    return a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]


@inline
def _cubic(k0, k1, k2, k3, t):
    return k0 + t * (k1 + t * (k2 + t * k3))


@inline
def _extrema(k1, k2, k3):
    """Where k1 + 2 k2 t + 3 k3 t² vanishes, rising and clamped to [0, 1]."""
    s, t = 1.0, 1.0
    inside = k2 * k2 - 3.0 * k3 * k1
    if inside > 0.0:
        q = -(k2 + sqrt(inside)) if k2 >= 0.0 else sqrt(inside) - k2
        s = k1 / q if q != 0.0 else 1.0
        t = q / (3.0 * k3) if abs(3.0 * k3) > 1e-300 else 1.0
        s, t = min(max(s, 0.0), 1.0), min(max(t, 0.0), 1.0)
    return min(s, t), max(s, t)


@inline
def _root(k0, k1, k2, k3, low, at_low, high, at_high):
    """The root of the cubic between two times at which its signs differ: secants and bisections in turn."""
    small = ROOT * (abs(at_low) + abs(at_high))
    t = low
    for step in range(HALVINGS):
        t = low + (high - low) * at_low / (at_low - at_high) if step % 2 == 0 else 0.5 * (low + high)
        f = _cubic(k0, k1, k2, k3, t)
        if abs(f) <= small or not low < t < high:
            break
        if (f >= 0.0) == (at_low >= 0.0):
            low, at_low = t, f
        else:
            high, at_high = t, f
    return t
