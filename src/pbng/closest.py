"""Closest points of simplices: of points, edges or triangles, and of many of them."""

import numpy as np
from scipy.spatial import cKDTree

PAIRS = 1 << 20  # point-face pairs looked at together


def closest_on_triangles(p: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Barycentric weights (n, 3) of the points of triangles (n, 3, 3) that are closest to points p (n, 3).

    Either the projection onto the plane lies inside, or the closest point lies on the closest of the three edges.
    """
    a, b, c = triangles.transpose(1, 0, 2)
    ab, ac, ap = b - a, c - a, p - a
    d00, d01, d11 = _dot(ab, ab), _dot(ab, ac), _dot(ac, ac)
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = d00 * d11 - d01 * d01
    flat = area <= 1e-14 * d00 * d11  # a sliver: one of its edges will do
    area = np.where(flat, 1.0, area)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    weights = np.column_stack([1 - v - w, v, w])
    outside = flat | (weights < 0).any(1)
    if outside.any():
        q, corners = p[outside], triangles[outside]
        candidates = np.zeros((len(q), 3, 3))
        for k in range(3):
            i, j = k, (k + 1) % 3
            s = closest_on_edges(q, corners[:, [i, j]])
            candidates[:, k, i], candidates[:, k, j] = s[:, 0], s[:, 1]
        found = np.einsum("nkc,ncd->nkd", candidates, corners)
        best = ((found - q[:, None]) ** 2).sum(-1).argmin(1)
        weights[outside] = candidates[np.arange(len(q)), best]
    return weights


def closest_on_edges(p: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Barycentric weights (n, 2) of the points of edges (n, 2, 3) that are closest to points p (n, 3)."""
    d = edges[:, 1] - edges[:, 0]
    length2 = _dot(d, d)
    s = np.clip(_dot(p - edges[:, 0], d) / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
    return np.column_stack([1 - s, s])


def closest_on_faces(p: np.ndarray, X: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each point p (n, 3) the closest of faces (m, k), k = 1, 2 or 3 (ties: the lowest), and weights (n, k) there.

    Faces whose centroid is too far away to be closest are left out with the help of a tree over the centroids.
    """
    corners = X[faces]
    centroid = corners.mean(1)
    reach = np.linalg.norm(corners - centroid[:, None], axis=2).max()
    tree = cKDTree(centroid)
    near = tree.query(p)[0]  # a face is never farther away than its centroid
    face, weights = np.zeros(len(p), np.int64), np.zeros((len(p), faces.shape[1]))
    chunk = max(1, PAIRS // max(len(faces), 1))
    for first in range(0, len(p), chunk):
        mine = np.arange(first, min(first + chunk, len(p)))
        lists = tree.query_ball_point(p[mine], (near[mine] + reach) * (1 + 1e-9), return_sorted=True)
        counts = np.array([len(l) for l in lists])
        point, candidate = np.repeat(mine, counts), np.concatenate([np.asarray(l, np.int64) for l in lists])
        w = _weights(p[point], corners[candidate])
        distance2 = ((np.einsum("nk,nkd->nd", w, corners[candidate]) - p[point]) ** 2).sum(1)
        order = np.lexsort((candidate, distance2, point))
        chosen = order[np.searchsorted(point[order], mine)]
        face[mine], weights[mine] = candidate[chosen], w[chosen]
    return face, weights


def _weights(p: np.ndarray, corners: np.ndarray) -> np.ndarray:
    if corners.shape[1] == 1:
        return np.ones((len(p), 1))
    return closest_on_edges(p, corners) if corners.shape[1] == 2 else closest_on_triangles(p, corners)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("nd,nd->n", a, b)
