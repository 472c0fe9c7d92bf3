"""Where points are with respect to shapes, and which half-spaces they have to respect on their way (section 7.2).

Compiled, and of all shapes at once: a scene with five walls asks as fast as one with a floor.
"""

from collections.abc import Sequence
from itertools import accumulate
from math import sqrt
from typing import Any

import numpy as np

from pbng.contact.collider import ON_SURFACE, Pose, Touches
from pbng.errors import InputError
from pbng.jit import inline
from pbng.linalg import add, combine, dot, point, scale, sub
from pbng.parallel import array, body, each, rows

PLANE, ROUND, BOX = range(3)  # what is behind a plane; near a segment, or a point; and between two corners
NUMBERS = 10  # of a shape at most
NEWTON = 64  # a grazing path converges linearly, by halves
GRAIN = 512  # points that a thread takes at a time
AT_REST = np.concatenate([np.eye(3).ravel(), np.zeros(3)])


def packed(poses: Sequence[Pose | None]) -> np.ndarray:
    """Poses as compiled code reads them, (k, 12): R row by row, then p."""
    return np.array([AT_REST if p is None else np.concatenate([p[0].ravel(), p[1]]) for p in poses])


def distances(
    kind: int, numbers: np.ndarray, pose: Pose | None, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Signed distance (k,) [m], closest point (k, 3) and outward normal (k, 3) of a shape for points x (k, 3)."""
    x = np.ascontiguousarray(x, float)
    _check_points(x)
    d, closest, normal = np.empty(len(x)), np.empty((len(x), 3)), np.empty((len(x), 3))
    each(_distances, (np.array([kind]), numbers, packed([pose]), x, d, closest, normal), len(x), GRAIN)
    return d, closest, normal


def _check_points(*several: np.ndarray) -> None:
    """InputError unless these are points, all as many."""
    shapes = [x.shape for x in several]
    if any(len(shape) != 2 or shape[1] != 3 for shape in shapes) or len(set(shapes)) > 1:
        raise InputError(f"colliders: points must have shape (k, 3), not {' and '.join(map(str, shapes))}")


class Shapes:
    """Shapes that are asked together; see :meth:`pbng.contact.collider.Collider.touch`.

    Args:
        shapes: The :class:`pbng.contact.colliders.Shape` s.
    """

    def __init__(self, shapes: Sequence[Any]) -> None:
        self.shapes = shapes
        self.kind = np.array([s.kind for s in shapes], np.int64)
        self.numbers = np.array([s.numbers for s in shapes]).reshape(-1, NUMBERS)
        self.thickness = np.array([s.thickness for s in shapes])

    def touch(
        self, before: np.ndarray, after: np.ndarray, t0: float, t1: float, reach: float | np.ndarray
    ) -> tuple[np.ndarray, Touches]:
        """Which shape each half-space is of, (j,) rising, and the half-spaces of all shapes, one after the other."""
        poses = [s.poses(t0, t1) for s in self.shapes]
        poses = [p[:1] if p[0] is p[-1] else p for p in poses]
        first = np.array([0, *accumulate(len(p) for p in poses)])
        before, after = np.ascontiguousarray(before, float), np.ascontiguousarray(after, float)
        _check_points(before, after)
        n, m = len(before), len(self.shapes)
        reach = np.full(n, reach, float)
        chosen, where, normal = np.empty(n * m, np.bool_), np.empty((n * m, 3)), np.empty((n * m, 3))
        arrays = (
            np.array([n]), self.kind, self.numbers, self.thickness, first, packed([p for s in poses for p in s]),
            before, after, reach, chosen, where, normal,
        )  # fmt: skip
        each(_touches, arrays, n * m, GRAIN)
        found = np.flatnonzero(chosen)
        shape, vertex = np.divmod(found, max(n, 1))
        return shape, Touches(vertex, where[found], normal[found])


@inline
def _norm(v):
    return sqrt(dot(v, v))


@inline
def _near(kind, numbers, s, x):
    """Signed distance of shape s, the closest point and the outward normal for a point in its frame."""
    if kind == PLANE:
        n = point(numbers, s)
        d = dot(n, x) - numbers[s, 3]
        return d, sub(x, scale(d, n)), n
    if kind == ROUND:
        a, axis = point(numbers, s), (numbers[s, 3], numbers[s, 4], numbers[s, 5])
        radius, n = numbers[s, 6], (numbers[s, 7], numbers[s, 8], numbers[s, 9])
        long2 = dot(axis, axis)
        core = add(a, scale(min(max(dot(sub(x, a), axis) / long2, 0.0), 1.0), axis)) if long2 > 0.0 else a
        off = sub(x, core)
        d = _norm(off)
        if d > 0.0:
            n = scale(1.0 / d, off)
        return d - radius, add(core, scale(radius, n)), n
    low, high = point(numbers, s), (numbers[s, 3], numbers[s, 4], numbers[s, 5])
    closest = (
        min(max(x[0], low[0]), high[0]),
        min(max(x[1], low[1]), high[1]),
        min(max(x[2], low[2]), high[2]),
    )
    off = sub(x, closest)
    d = _norm(off)
    if not d <= 0.0:
        return d, closest, scale(1.0 / d, off)
    # Inside: the closest face, among equals the first of high x, y, z, low x, y, z.
    depth, n = high[0] - x[0], (1.0, 0.0, 0.0)
    closest = high[0], x[1], x[2]
    if high[1] - x[1] < depth:
        depth, n, closest = high[1] - x[1], (0.0, 1.0, 0.0), (x[0], high[1], x[2])
    if high[2] - x[2] < depth:
        depth, n, closest = high[2] - x[2], (0.0, 0.0, 1.0), (x[0], x[1], high[2])
    if x[0] - low[0] < depth:
        depth, n, closest = x[0] - low[0], (-1.0, 0.0, 0.0), (low[0], x[1], x[2])
    if x[1] - low[1] < depth:
        depth, n, closest = x[1] - low[1], (0.0, -1.0, 0.0), (x[0], low[1], x[2])
    if x[2] - low[2] < depth:
        depth, n, closest = x[2] - low[2], (0.0, 0.0, -1.0), (x[0], x[1], low[2])
    return -depth, closest, n


@inline
def _to_body(poses, k, x):
    """World to body frame by pose k: (x - p) R."""
    a, b, c = x[0] - poses[k, 9], x[1] - poses[k, 10], x[2] - poses[k, 11]
    return (
        a * poses[k, 0] + b * poses[k, 3] + c * poses[k, 6],
        a * poses[k, 1] + b * poses[k, 4] + c * poses[k, 7],
        a * poses[k, 2] + b * poses[k, 5] + c * poses[k, 8],
    )


@inline
def _turned(poses, k, v):
    """Directions of the body frame in the world."""
    return (
        v[0] * poses[k, 0] + v[1] * poses[k, 1] + v[2] * poses[k, 2],
        v[0] * poses[k, 3] + v[1] * poses[k, 4] + v[2] * poses[k, 5],
        v[0] * poses[k, 6] + v[1] * poses[k, 7] + v[2] * poses[k, 8],
    )


@inline
def _to_world(poses, k, x):
    return add(_turned(poses, k, x), (poses[k, 9], poses[k, 10], poses[k, 11]))


@body
def _distances(arguments, low, high):
    """Body of :func:`distances` for points low .. high."""
    kind, numbers = array(arguments, 0, np.int64)[0], rows(arguments, 1, NUMBERS, np.float64)
    poses, x = rows(arguments, 2, 12, np.float64), rows(arguments, 3, 3, np.float64)
    d, closest = array(arguments, 4, np.float64), rows(arguments, 5, 3, np.float64)
    normal = rows(arguments, 6, 3, np.float64)
    for q in range(low, high):
        distance, c, n = _near(kind, numbers, 0, _to_body(poses, 0, point(x, q)))
        d[q] = distance
        closest[q, 0], closest[q, 1], closest[q, 2] = _to_world(poses, 0, c)
        normal[q, 0], normal[q, 1], normal[q, 2] = _turned(poses, 0, n)


@inline
def _on_path(poses, first, last, k, start, stop):
    """Where on its way from ``start`` to ``stop`` a point is at pose k of first .. last, in the body's frame."""
    if k == first:
        return _to_body(poses, k, start)
    if k == last:
        return _to_body(poses, k, stop)
    f = (k - first) / (last - first)
    return _to_body(poses, k, combine(1.0 - f, start, f, stop))


@inline
def _hits(kind, numbers, s, start, stop):
    """Whether a straight path that begins outside of a shape meets it, and where with what normal it first does.

    A step of Newton's method along the path ends where the tangent plane of the closest point is met, and the body lies
    behind that plane.
    """
    path = sub(stop, start)
    near = ON_SURFACE * _norm(path)
    share = 0.0
    hit, where, normal = False, start, path
    for _ in range(NEWTON):
        d, where, normal = _near(kind, numbers, s, add(start, scale(share, path)))
        slope = dot(normal, path)
        if not slope < 0.0:  # away from a convex body is away for good
            break
        if d <= near:
            hit = True
            break
        share -= d / slope
        if not share <= 1.0:
            break
    return hit, where, normal


@body
def _touches(arguments, low, high):
    """Body of :meth:`Shapes.touch` for ways low .. high: of each shape with all points."""
    n, kinds = array(arguments, 0, np.int64)[0], array(arguments, 1, np.int64)
    numbers = rows(arguments, 2, NUMBERS, np.float64)
    thickness, ranges = array(arguments, 3, np.float64), array(arguments, 4, np.int64)
    poses, before = rows(arguments, 5, 12, np.float64), rows(arguments, 6, 3, np.float64)
    after, reach = rows(arguments, 7, 3, np.float64), array(arguments, 8, np.float64)
    chosen, out = array(arguments, 9, np.bool_), rows(arguments, 10, 3, np.float64)
    normals = rows(arguments, 11, 3, np.float64)
    for q in range(low, high):
        s = q // n
        i = q - n * s
        kind, first, last = kinds[s], ranges[s], ranges[s + 1] - 1
        start, stop, margin = point(before, i), point(after, i), reach[i] + thickness[s]
        a, b = _to_body(poses, first, start), _to_body(poses, last, stop)
        left, length = a, 0.0  # where it is if it does not move, and how long its path is
        if first == last:
            length = _norm(sub(b, a))
        else:
            left, at = _to_body(poses, last, start), a
            for k in range(first + 1, last + 1):
                to = _on_path(poses, first, last, k, start, stop)
                length, at = length + _norm(sub(to, at)), to
        d = _near(kind, numbers, s, a)[0]
        chosen[q] = False
        if not d <= margin + max(length, _norm(sub(left, a))):
            continue
        d1, where, normal = _near(kind, numbers, s, b)
        held = d1 < margin or d < margin or (first != last and _near(kind, numbers, s, left)[0] < margin)
        if d < -ON_SURFACE * length:
            held = True
            _, where, normal = _near(kind, numbers, s, a)
        elif d <= length:
            at = a
            for k in range(first + 1, max(last, first + 1) + 1):
                to = b if k >= last else _on_path(poses, first, last, k, start, stop)
                hit, p, m = _hits(kind, numbers, s, at, to)
                if hit:
                    held, where, normal = True, p, m
                    break
                at = to
        chosen[q] = held
        if held:
            n_x, n_y, n_z = _turned(poses, last, normal)
            normals[q, 0], normals[q, 1], normals[q, 2] = n_x, n_y, n_z
            x, y, z = _to_world(poses, last, where)
            out[q, 0], out[q, 1], out[q, 2] = x + thickness[s] * n_x, y + thickness[s] * n_y, z + thickness[s] * n_z
