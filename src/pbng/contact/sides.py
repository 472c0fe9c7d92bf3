"""On which side of a closed surface a point lies, told by the closest point alone.

Where that is on an edge or a vertex, the normals of the triangles there may disagree. What tells is the pseudonormal
(Baerentzen and Aanaes, 2005): of an edge the sum of the unit normals of the triangles at it, of a vertex the sum of
those around it, each times its triangle's angle there. It is right also where more than two triangles share an edge.
"""

from math import atan2, sqrt

import numpy as np

from pbng.contact.normals import SmoothNormals
from pbng.jit import inline
from pbng.linalg import add, combine3, dot, point, scale, sub, unit
from pbng.parallel import array, body, each, rows

SPIKE = 0.5  # cosine of the angle of a triangle's normal to the pseudonormal below which the surface may be folded
GRAIN = 256  # points that a thread takes at a time


class Sides:
    """Tells which points lie behind a surface.

    Args:
        normals: Normals of its triangles, fitted anew where these move.
        start, sides: Which sides of triangles are at each edge, as :func:`pbng.topology.edge_sides` gives them.
    """

    def __init__(self, normals: SmoothNormals, start: np.ndarray, sides: np.ndarray) -> None:
        self.normals = normals
        self.start = np.ascontiguousarray(start, np.int64)
        self.beside = (sides // 3).astype(np.int32)
        self.edge = np.empty(len(sides), np.int32)  # of each side
        self.edge[sides] = np.repeat(np.arange(len(start) - 1), np.diff(start))

    def behind(
        self, x: np.ndarray, points: np.ndarray, triangle: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which points (k, 3) [m] lie behind the surface, whose vertices are at x (n_vert, 3) [m].

        Args:
            x: Positions that the normals are fitted to.
            points: The points.
            triangle, weights: Where the surface is closest to each: its triangle (k,) int32, and there its weights
                (k, 3), which are zero, exactly, for what is on an edge or a vertex.

        Returns:
            Which lie behind the surface, (k,) bool; of which that is sure: not where the closest point is at a spike,
            which may be a surface that passes through itself; and which lie behind the plane of their triangle.
        """
        first, around = self.normals.around
        out, sure, below = (np.empty(len(points), np.bool_) for _ in range(3))
        arrays = (
            x, self.normals.triangles, self.normals.areas, self.edge, self.start, self.beside, first, around,
            points, triangle, weights, out, sure, below,
        )  # fmt: skip
        each(_behind, arrays, len(points), GRAIN)
        return out, sure, below


@body
def _behind(arguments, low, high):
    """Body of :meth:`Sides.behind` for points low .. high."""
    x, triangles = rows(arguments, 0, 3, np.float64), rows(arguments, 1, 3, np.int32)
    areas, edge = rows(arguments, 2, 3, np.float64), array(arguments, 3, np.int32)
    start, beside = array(arguments, 4, np.int64), array(arguments, 5, np.int32)
    first, around = array(arguments, 6, np.int64), array(arguments, 7, np.int32)
    points, triangle = rows(arguments, 8, 3, np.float64), array(arguments, 9, np.int32)
    weights, out = rows(arguments, 10, 3, np.float64), array(arguments, 11, np.bool_)
    sure, below = array(arguments, 12, np.bool_), array(arguments, 13, np.bool_)
    for k in range(low, high):
        t = triangle[k]
        u, v, w = point(weights, k)
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        way = sub(point(points, k), combine3(u, point(x, a), v, point(x, b), w, point(x, c)))
        below[k] = dot(point(areas, t), way) < 0.0
        n, sure[k] = point(areas, t), True
        corners = (1 if u > 0.0 else 0) + (1 if v > 0.0 else 0) + (1 if w > 0.0 else 0)
        if corners == 2:
            e = edge[3 * t + (0 if not w > 0.0 else (1 if not u > 0.0 else 2))]
            n = 0.0, 0.0, 0.0
            for i in range(start[e], start[e + 1]):
                n = add(n, unit(point(areas, beside[i])))
            for i in range(start[e], start[e + 1]):
                sure[k] = sure[k] and _is_smooth(n, point(areas, beside[i]))
        elif corners == 1:
            vertex = a if u > 0.0 else (b if v > 0.0 else c)
            n = 0.0, 0.0, 0.0
            for i in range(first[vertex], first[vertex + 1]):
                area = point(areas, around[i])
                n = add(n, scale(_angle(x, triangles, around[i], vertex, area), unit(area)))
            for i in range(first[vertex], first[vertex + 1]):
                sure[k] = sure[k] and _is_smooth(n, point(areas, around[i]))
        out[k] = dot(n, way) < 0.0


@inline
def _is_smooth(n, area):
    """Whether an area vector is not far from the direction n."""
    return dot(n, area) >= SPIKE * sqrt(dot(n, n) * dot(area, area))


@inline
def _angle(x, triangles, t, v, area):
    """The angle [rad] of triangle t at its vertex v; ``area`` is twice its area vector."""
    a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    one, other = (b, c) if a == v else ((c, a) if b == v else (a, b))
    p = point(x, v)
    return atan2(sqrt(dot(area, area)), dot(sub(point(x, one), p), sub(point(x, other), p)))
