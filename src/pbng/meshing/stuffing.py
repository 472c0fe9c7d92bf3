"""Isosurface stuffing: fills a solid with well-shaped tets (Labelle and Shewchuk 2007, doi 10.1145/1276377.1276448).

A body-centred cubic lattice covers the solid. Where its surface crosses a lattice edge close to an end, that vertex is
warped onto the surface; tets that still straddle the surface are cut and their inner part is kept. However the surface
runs, every tet is one of finitely many shapes, slightly distorted, which is why no angle comes out bad.
"""

import logging
from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pbng.mesh import tet_volumes
from pbng.topology import TET_EDGES, TET_FACES, unique_edges

log = logging.getLogger("pbng")

Inside = Callable[[np.ndarray], np.ndarray]

# A vertex is warped if a cut lies within this share of an edge. The paper's values: they keep the dihedral angles
# between 10.7 and 164.8 degrees. Long edges join two corners or two centres, short ones a corner and a centre.
WARP_LONG, WARP_SHORT = 0.24999, 0.41189
HALVINGS = 10  # bisections that locate a cut: to 0.1 % of an edge
CRUMB = 0.01  # a detached part of less than this share of the largest part's volume is dropped


def stuff(inside: Inside, low: np.ndarray, high: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Fill a solid with tets of one size.

    Args:
        inside: Takes points (n, 3) [m] and tells which lie in the solid, (n,) bool.
        low, high: Corners (3,) [m] of a box around the solid.
        cell: Edge [m] of the lattice's cubes, and the longest of the tets'.

    Returns:
        Positions (n_vert, 3) [m] and positively oriented cells (n_elem, 4) int64, whose faces match and whose boundary
        is closed. Both are empty if no point of the lattice lies inside (well enough not to be warped).
    """
    X, sign, centre, tets = _lattice(inside, np.asarray(low, float), np.asarray(high, float), cell)
    X, sign = _warp(X, sign, centre, tets, inside)
    X, tets = _cut(X, sign, centre, tets, inside)
    if len(tets) == 0:
        return np.empty((0, 3)), np.empty((0, 4), np.int64)
    backwards = tet_volumes(X, tets) < 0
    tets[backwards] = tets[backwards][:, [0, 1, 3, 2]]
    tets = _without_crumbs(X, tets)
    used, tets = np.unique(tets, return_inverse=True)
    return X[used], tets.reshape(-1, 4)


def _lattice(inside: Inside, low: np.ndarray, high: np.ndarray, cell: float) -> tuple[np.ndarray, ...]:
    """The tets (m, 4) of the lattice that have a point inside, and their points (n, 3).

    Also returns the sign of each point, -1 inside and 1 outside, and whether it is the centre of a cube, (n,) each. A
    tet joins the centres of two neighbouring cubes to an edge of the square between them. The lattice is centred on
    the box, so that it favours no side; a margin keeps its outermost points outside.
    """
    half = np.ceil((high - low) / (2 * cell)).astype(int) + 1
    shape = 2 * half + 1
    origin = (low + high) / 2 - half * cell
    corners = origin + cell * np.argwhere(np.ones(shape, bool))
    centres = origin + cell * (np.argwhere(np.ones(shape - 1, bool)) + 0.5)
    X = np.concatenate([corners, centres])
    is_inside = inside(X)
    corner = np.arange(len(corners)).reshape(shape)
    centre = len(corners) + np.arange(len(centres)).reshape(shape - 1)
    tets = []
    for axis in range(3):
        a, b = (np.transpose(ids, np.roll(range(3), -axis)) for ids in (corner, centre))
        square = [a[1:-1, :-1, :-1], a[1:-1, 1:, :-1], a[1:-1, 1:, 1:], a[1:-1, :-1, 1:]]
        for i in range(4):
            four = [ids.ravel() for ids in (b[:-1], b[1:], square[i], square[(i + 1) % 4])]
            kept = np.any([is_inside[ids] for ids in four], axis=0)
            tets.append(np.stack([ids[kept] for ids in four], 1))
    used, cells = np.unique(np.concatenate(tets), return_inverse=True)
    return X[used], np.where(is_inside[used], -1, 1), used >= len(corners), cells.reshape(-1, 4)


def _crossings(X: np.ndarray, inner: np.ndarray, outer: np.ndarray, inside: Inside) -> tuple[np.ndarray, np.ndarray]:
    """Where edges from inner to outer points cross the surface: share of the edge (n,) and position (n, 3).

    Bisection asks for nothing but ``inside``: it is as exact on thin parts, and across the holes of an open surface,
    where distances say little about an edge.
    """
    edge = X[outer] - X[inner]
    low, high = np.zeros(len(inner)), np.ones(len(inner))
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        within = inside(X[inner] + middle[:, None] * edge)
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    share = (low + high) / 2
    return share, X[inner] + share[:, None] * edge


def _warp(
    X: np.ndarray, sign: np.ndarray, centre: np.ndarray, tets: np.ndarray, inside: Inside
) -> tuple[np.ndarray, np.ndarray]:
    """Move every vertex that has a cut close by onto the closest one; its sign becomes 0."""
    edges = unique_edges(tets, TET_EDGES)
    edges = edges[sign[edges[:, 0]] != sign[edges[:, 1]]]
    edges = np.take_along_axis(edges, np.argsort(sign[edges], axis=1), 1)
    share, cut = _crossings(X, edges[:, 0], edges[:, 1], inside)
    long = centre[edges[:, 0]] == centre[edges[:, 1]]
    near = np.stack([share, 1 - share], 1)
    edge, end = np.nonzero(near < np.where(long, WARP_LONG, WARP_SHORT)[:, None])
    distance = near[edge, end] * np.where(long, 1.0, np.sqrt(0.75))[edge]
    order = np.argsort(-distance, kind="stable")  # of the cuts a vertex could move to, the closest is written last
    moved = edges[edge, end][order]
    X, sign = X.copy(), sign.copy()
    X[moved] = cut[edge[order]]
    sign[moved] = 0
    return X, sign


def _cut(
    X: np.ndarray, sign: np.ndarray, centre: np.ndarray, tets: np.ndarray, inside: Inside
) -> tuple[np.ndarray, np.ndarray]:
    """Keep the inner part of every tet. Returns X with the cuts appended, and tets (m, 4) of either orientation.

    A vertex on the surface counts as an inner one that is its own cut. Pieces that are flat for that reason have a
    vertex twice and are dropped at the end; this leaves three cases in place of ten.
    """
    tets = tets[(sign[tets] < 0).any(1)]
    tets = np.take_along_axis(tets, np.argsort(sign[tets], axis=1, kind="stable"), 1)  # inner, on the surface, outer
    n_outer = (sign[tets] > 0).sum(1)
    ends = tets[:, TET_EDGES].reshape(-1, 2)
    ends = np.unique(ends[(sign[ends[:, 0]] < 0) & (sign[ends[:, 1]] > 0)], axis=0)
    keys = ends[:, 0] * len(X) + ends[:, 1]
    points = np.concatenate([X, _crossings(X, ends[:, 0], ends[:, 1], inside)[1]])

    def cut(inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
        return np.where(sign[inner] == 0, inner, len(X) + np.searchsorted(keys, inner * len(X) + outer))

    def at_first(a: np.ndarray, b: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Whether the part of face a, b, p inside is split by the diagonal from a to cut(b, p), not b to cut(a, p).

        The face alone decides, so both its tets agree. Starting from the cut on the long edge gives the better angles,
        and around a tet such diagonals never form a cycle, whichever way the faces with two short cut edges go.
        """
        long_a, long_b = centre[a] == centre[p], centre[b] == centre[p]
        return np.where(long_a == long_b, a < b, long_b)

    a, p, q, r = tets[n_outer == 3].T
    kept = [tets[n_outer == 0], np.stack([a, cut(a, p), cut(a, q), cut(a, r)], 1)]

    a, b, c, p = tets[n_outer == 1].T
    bottom, top = np.stack([a, b, c], 1), np.stack([cut(a, p), cut(b, p), cut(c, p)], 1)
    kept.append(_split_prisms(bottom, top, np.stack([at_first(a, b, p), at_first(b, c, p), at_first(c, a, p)], 1)))

    a, b, p, q = tets[n_outer == 2].T
    bottom, top = np.stack([a, cut(a, p), cut(a, q)], 1), np.stack([b, cut(b, p), cut(b, q)], 1)
    on_p, on_q = at_first(a, b, p), at_first(a, b, q)
    # The third side lies on the surface and is free: its shorter diagonal, unless the other two leave no choice.
    one, other = points[bottom[:, 1]] - points[top[:, 2]], points[bottom[:, 2]] - points[top[:, 1]]
    shorter = np.einsum("ni,ni->n", one, one) < np.einsum("ni,ni->n", other, other)
    kept.append(_split_prisms(bottom, top, np.stack([on_p, np.where(on_p == on_q, shorter, on_q), ~on_q], 1)))

    pieces = np.concatenate(kept)
    corners = np.sort(pieces, axis=1)
    return points, pieces[(corners[:, 1:] != corners[:, :-1]).all(1)]


def _split_prisms(bottom: np.ndarray, top: np.ndarray, rising: np.ndarray) -> np.ndarray:
    """Split prisms into three tets each, (3 n, 4) of either orientation.

    ``bottom`` and ``top`` (n, 3) are the triangles. Side i, between columns i and i + 1, is split by the diagonal from
    the bottom of column i if ``rising`` (n, 3), else by the one from its top; the three may not form a cycle.
    """
    # Then 2, 1 and 0 diagonals start at the bottoms of the three columns: take the columns in this order.
    starts = rising.astype(int) + ~np.roll(rising, 1, axis=1)
    order = np.argsort(-starts, axis=1)
    a, b, c = np.take_along_axis(bottom, order, 1).T
    d, e, f = np.take_along_axis(top, order, 1).T
    return np.concatenate([np.stack(four, 1) for four in ((a, b, c, f), (a, b, e, f), (a, d, e, f))])


def _without_crumbs(X: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Drop the parts that share no face with the rest and are negligible; they come loose where the solid is thin."""
    faces = np.sort(tets[:, TET_FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    twice = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(1))
    pairs = order[twice] // 4, order[twice + 1] // 4
    graph = coo_array((np.ones(len(twice), bool), pairs), shape=(len(tets), len(tets)))
    n_part, part = connected_components(graph, directed=False)
    volume = np.bincount(part, tet_volumes(X, tets))
    crumb = volume < CRUMB * volume.max()
    if crumb.any():
        share = volume[crumb].sum() / volume.sum()
        log.warning("dropped %d crumbs, %.2g of the volume, detached where it is thin", crumb.sum(), share)
    if n_part > crumb.sum() + 1:
        log.warning("the tets form %d parts that share no face", n_part - crumb.sum())
    return tets[~crumb[part]]
