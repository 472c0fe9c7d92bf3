"""Normals that vary smoothly over surfaces, but for their creases: along them contacts push.

With the triangles' own normals a vertex at an edge between two would be pushed now along one and now along the other,
and of two surfaces that meet vertex upon vertex, or edge upon edge, contacts would never come to rest.
"""

import numpy as np

from pbng.contact.rings import neighbourhoods
from pbng.linalg import add, cross, point, scale, sub, unit
from pbng.parallel import array, body, each, rows
from pbng.topology import entries

SHARP = 0.9  # cosine of the angle between normals below which an edge counts as sharp


class SmoothNormals:
    """Normals over triangles, interpolated between their corners; a corner's is the mean, by area, of those around.

    Only triangles count that belong to the same smooth part of the surface: whose normals at rest are close.

    Args:
        X: Rest positions [m], (n_vert, 3), to which they are fitted.
        triangles: Outward triangles, (m, 3) int32.

    Attributes:
        around: The triangles around each vertex, as :func:`pbng.contact.rings.neighbourhoods` gives them.
        areas: Twice the area vector [m²] of each triangle, (m, 3).
    """

    def __init__(self, X: np.ndarray, triangles: np.ndarray) -> None:
        self.triangles = np.ascontiguousarray(triangles, np.int32)
        first, around = self.around = neighbourhoods(self.triangles, len(X), 1)
        owner, at = entries(first, self.triangles.ravel())
        other = around[at]
        self.areas = np.empty((len(self.triangles), 3))
        self.fit(X)
        normal = self.areas / np.maximum(np.linalg.norm(self.areas, axis=1), 1e-300)[:, None]
        near = (normal[owner // 3] * normal[other]).sum(1) > SHARP
        near |= owner // 3 == other  # a triangle of no area has no normal
        self.ids = other[near]
        self.start = np.concatenate([[0], np.cumsum(np.bincount(owner[near], minlength=self.triangles.size))])

    def fit(self, x: np.ndarray) -> None:
        """Take the triangles to be at positions x (n_vert, 3) [m]."""
        arrays = np.ascontiguousarray(x, np.float64), self.triangles, self.areas
        each(_areas, arrays, len(self.triangles), grain=1024)

    def at(self, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Unit normals (k, 3) at points of triangles (k,), given by their weights (k, 3); zero where all is flat."""
        normals = np.empty((len(triangle), 3))
        arrays = (
            self.areas, self.start, self.ids,
            np.ascontiguousarray(triangle, np.int32), np.ascontiguousarray(weights, np.float64), normals,
        )  # fmt: skip
        each(_interpolate, arrays, len(triangle), grain=64)
        return normals

    def around_vertices(self, vertex: np.ndarray) -> np.ndarray:
        """Sum of twice the area vectors [m²] of the triangles around vertices (k,) int32: (k, 3)."""
        total = np.empty((len(vertex), 3))
        each(_around, (self.areas, *self.around, vertex, total), len(vertex), grain=256)
        return total


@body
def _areas(arguments, low, high):
    """Body of :meth:`SmoothNormals.fit` for triangles low .. high."""
    x, triangles = rows(arguments, 0, 3, np.float64), rows(arguments, 1, 3, np.int32)
    areas = rows(arguments, 2, 3, np.float64)
    for t in range(low, high):
        a = point(x, triangles[t, 0])
        b, c = sub(point(x, triangles[t, 1]), a), sub(point(x, triangles[t, 2]), a)
        areas[t, 0], areas[t, 1], areas[t, 2] = cross(b, c)


@body
def _interpolate(arguments, low, high):
    """Body of :meth:`SmoothNormals.at` for points low .. high."""
    areas, start, ids = rows(arguments, 0, 3, np.float64), array(arguments, 1, np.int64), array(arguments, 2, np.int32)
    triangle, weights = array(arguments, 3, np.int32), rows(arguments, 4, 3, np.float64)
    normals = rows(arguments, 5, 3, np.float64)
    for k in range(low, high):
        n = 0.0, 0.0, 0.0
        for j in range(3):
            if weights[k, j] == 0.0:
                continue
            corner = 3 * triangle[k] + j
            around = 0.0, 0.0, 0.0
            for i in range(start[corner], start[corner + 1]):
                around = add(around, point(areas, ids[i]))
            n = add(n, scale(weights[k, j], unit(around)))
        normals[k, 0], normals[k, 1], normals[k, 2] = unit(n)


@body
def _around(arguments, low, high):
    """Body of :meth:`SmoothNormals.around_vertices` for vertices low .. high."""
    areas, first, around = (
        rows(arguments, 0, 3, np.float64),
        array(arguments, 1, np.int64),
        array(arguments, 2, np.int32),
    )
    vertex, total = array(arguments, 3, np.int32), rows(arguments, 4, 3, np.float64)
    for k in range(low, high):
        n = 0.0, 0.0, 0.0
        for i in range(first[vertex[k]], first[vertex[k] + 1]):
            n = add(n, point(areas, around[i]))
        total[k, 0], total[k, 1], total[k, 2] = n
