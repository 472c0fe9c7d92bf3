"""Normals that vary smoothly over surfaces, but for their creases: along them contacts push.

With the triangles' own normals a vertex at an edge between two would be pushed now along one and now along the other,
and of two surfaces that meet vertex upon vertex, or edge upon edge, contacts would never come to rest.
"""

import numpy as np

from pbng.contact.rings import neighbourhoods
from pbng.linalg import add, cross, point, scale, sub, unit
from pbng.mesh import triangle_areas
from pbng.parallel import array, body, each, rows
from pbng.topology import entries

SHARP = 0.9  # cosine of the angle between normals below which an edge counts as sharp


class SmoothNormals:
    """Normals over triangles, interpolated between their corners; a corner's is the mean, by area, of those around.

    Only triangles count that belong to the same smooth part of the surface: whose normals at rest are close.

    Args:
        X: Rest positions [m], (n_vert, 3).
        triangles: Outward triangles, (m, 3) int32.

    Attributes:
        around: The triangles around each vertex, as :func:`pbng.contact.rings.neighbourhoods` gives them.
    """

    def __init__(self, X: np.ndarray, triangles: np.ndarray) -> None:
        self.triangles = np.ascontiguousarray(triangles, np.int32)
        first, around = self.around = neighbourhoods(self.triangles, len(X), 1)
        owner, at = entries(first, self.triangles.ravel())
        other = around[at]
        normal = triangle_areas(X, self.triangles)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        near = (normal[owner // 3] * normal[other]).sum(1) > SHARP
        near |= owner // 3 == other  # a triangle of no area has no normal
        self.ids = other[near]
        self.start = np.concatenate([[0], np.cumsum(np.bincount(owner[near], minlength=self.triangles.size))])

    def at(self, x: np.ndarray, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Unit normals (k, 3) at points of triangles (k,), given by their weights (k, 3), at positions x (n_vert, 3).

        Zero where triangles have no area.
        """
        normals = np.empty((len(triangle), 3))
        arrays = (
            np.ascontiguousarray(x, np.float64), self.triangles, self.start, self.ids,
            np.ascontiguousarray(triangle, np.int32), np.ascontiguousarray(weights, np.float64), normals,
        )  # fmt: skip
        each(_interpolate, arrays, len(triangle), grain=64)
        return normals


@body
def _interpolate(arguments, low, high):
    """Body of :meth:`SmoothNormals.at` for points low .. high."""
    x, triangles = rows(arguments, 0, 3, np.float64), rows(arguments, 1, 3, np.int32)
    start, ids = array(arguments, 2, np.int64), array(arguments, 3, np.int32)
    triangle, weights = array(arguments, 4, np.int32), rows(arguments, 5, 3, np.float64)
    normals = rows(arguments, 6, 3, np.float64)
    for k in range(low, high):
        n = 0.0, 0.0, 0.0
        for j in range(3):
            corner = 3 * triangle[k] + j
            around = 0.0, 0.0, 0.0
            for i in range(start[corner], start[corner + 1]):
                a, b, c = triangles[ids[i], 0], triangles[ids[i], 1], triangles[ids[i], 2]
                p = point(x, a)
                around = add(around, cross(sub(point(x, b), p), sub(point(x, c), p)))
            n = add(n, scale(weights[k, j], unit(around)))
        normals[k, 0], normals[k, 1], normals[k, 2] = unit(n)
