"""Closest points of faces of a mesh at rest: of its vertices, edges or triangles."""

import numpy as np

from pbng.contact.bvh import BoxTree
from pbng.contact.queries import closest_triangles


def closest_on_faces(p: np.ndarray, X: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each point p (n, 3) the closest of faces (m, k), k = 1, 2 or 3 (ties: the lowest), and weights (n, k)."""
    k = faces.shape[1]
    triangles = faces[:, np.minimum(np.arange(3), k - 1)]  # the last corner several times over
    face, weights, _ = closest_triangles(BoxTree(X, triangles), X, p)
    return face, np.column_stack([weights[:, : k - 1], weights[:, k - 1 :].sum(1)])
