"""Which vertices are inside of solids, and by which triangle they leave."""

from typing import Any

import numpy as np

from pbng.contact.bvh import BoxTree
from pbng.contact.normals import SmoothNormals
from pbng.contact.queries import closest_triangles, containing_tets
from pbng.contact.rings import Spans, neighbourhoods, spans
from pbng.contact.sides import Sides
from pbng.contact.spec import CLOSE, Surfaces

NOTHING, UNKNOWN, SEVERAL = -1, -2, -3  # solids that a vertex was inside of
SLIPPED = 4.0  # how much closer a triangle must be by which a vertex does not face what it is inside of


class Insides:
    """Tells which vertices of surfaces are inside of solids.

    Args:
        surfaces: What may touch.
        X: Rest positions [m], (n_vert, 3).
        vertex: The vertices, (k,).
        body: Body of each vertex of the scene, (n_vert,).
        triangles: Tree over the triangles of the surfaces, fitted by its owner.
        normals: Their normals, likewise.
        sides: Tells which side points are on.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        X: np.ndarray,
        vertex: np.ndarray,
        body: np.ndarray,
        triangles: BoxTree,
        normals: SmoothNormals,
        sides: Sides,
    ) -> None:
        s = self.surfaces = surfaces
        self.vertex, self.own = vertex, body[vertex]
        self.triangles, self.normals, self.sides = triangles, normals, sides
        self.solid = np.zeros(len(s.names), bool)
        self.solid[np.unique(s.tet_body)] = True
        self.each_alone = np.eye(len(s.names), dtype=bool)
        self.tets = BoxTree(X, s.tets, s.tet_body) if len(s.tets) else None
        self.near_tets = None
        if self.tets and s.own.any():
            self.near_tets = spans(self.tets.order, *neighbourhoods(s.tets, len(X), s.rings))
        self.forget()

    def forget(self) -> None:
        """Of each vertex, which solid of others it was inside of, and whether of its own; at first nobody knows."""
        self.inside_of = [np.full(len(self.vertex), UNKNOWN) for _ in range(2)]

    def solids(self, x: np.ndarray, meets: np.ndarray) -> np.ndarray:
        """The solid of others, by ``meets``, whose tets each vertex is in at x (n_vert, 3) [m], (k,); -1 for none.

        All are looked for: nothing may be known of them yet.
        """
        nothing = np.full(len(self.vertex), -1, np.int32)
        return self._solid(x, nothing, np.zeros((len(nothing), 3)), nothing > 0, meets, own=False)[0]

    def touched(
        self,
        x: np.ndarray,
        closest: tuple[np.ndarray, np.ndarray, np.ndarray],
        reach: np.ndarray,
        meets: np.ndarray,
        excluded: Spans | None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What each vertex touches, if anything.

        Args:
            x: Positions (n_vert, 3) [m], to which trees and normals are fitted.
            closest: Triangle closest to each vertex, of the own body of those that it may face, (k,) int32, its weights
                (k, 3) and distances (k,) [m], as :func:`pbng.contact.queries.closest_triangles` finds them.
            reach: How far these were looked for [m], (k,).
            meets: Which bodies were looked at by which, (n_body, n_body) bool.
            excluded: Triangles that were left out because the vertices look at their own bodies, or None.

        Returns:
            Triangles (k,) int32, -1 for none, their weights (k, 3), and whether each vertex is inside a solid, (k,).
        """
        triangle, weights, distance = closest
        solid, known, through = self._solid(x, triangle, weights, distance > reach, meets, excluded is not None)
        triangle[through] = -1
        deep = np.flatnonzero(solid >= 0)
        if len(deep):
            near = triangle[deep], weights[deep], distance[deep]
            triangle[deep], weights[deep] = self._way_out(x, deep, solid[deep], near, known[deep], excluded)
        return triangle, weights, solid >= 0

    def _solid(
        self, x: np.ndarray, triangle: np.ndarray, weights: np.ndarray, far: np.ndarray, meets: np.ndarray, own: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The solid that each vertex is inside of, -1 for none; which vertices are known to be behind the plane of
        their triangle, with no triangle closer; and which see their triangle through the own body.

        What the closest point of a whole surface is tells the side. Tets are looked for where it is not known: of the
        own body a part is left out, and of triangles ``far`` out of reach only those are seen that move much. Where
        none is found, they are looked for if the vertex was inside before; what goes in is seen near the surface first.
        Nor does the closest point tell whether a vertex is still inside of what else it was inside of.
        """
        s, solid = self.surfaces, np.full(len(triangle), NOTHING)
        known, through = np.zeros(len(triangle), bool), np.zeros(len(triangle), bool)
        if self.tets is None or not (meets & self.solid).any():
            return solid, known, through
        found = np.flatnonzero(triangle >= 0)
        body, far = s.body[triangle[found]], far[found]
        behind, sure, below = self.sides.behind(x, x[self.vertex[found]], triangle[found], weights[found])
        behind &= self.solid[body]
        was = self.inside_of[own]
        asked = was != NOTHING
        if own:
            asked[found[behind]] = True
        else:
            sure &= ~(behind & far)
            told = sure & self.solid[body]
            solid[found[told & behind]] = body[told & behind]
            left = (was[found] == UNKNOWN) | ((was[found] == body) & ~far)
            asked[found[told & (behind | left)]] = False
            asked[found[~sure & self.solid[body]]] = True
        q = np.flatnonzero(asked)
        if len(q):
            self.tets.refit(x)
            only = {"own": self.own[q], "meets": meets & self.solid, "excluded": self.near_tets if own else None}
            tet, _ = containing_tets(self.tets, x, x[self.vertex[q]], self.vertex[q], **only)
            solid[q[tet >= 0]] = s.tet_body[tet[tet >= 0]]
        another = (solid != NOTHING) & (was != solid) & (was != NOTHING) & (was != UNKNOWN)
        self.inside_of[own] = np.where(another, SEVERAL, solid)
        if own:
            through[found[behind]] = solid[found[behind]] < 0
        else:
            known[found] = below & ~far & (solid[found] == body)
        return solid, known, through

    def _way_out(
        self,
        x: np.ndarray,
        deep: np.ndarray,
        solid: np.ndarray,
        near: tuple[np.ndarray, np.ndarray, np.ndarray],
        known: np.ndarray,
        excluded: Spans | None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """By which triangle vertices leave the solids that they are inside of, (k,), and weights of the closest points.

        By the closest that a vertex is behind and that it faces, as it came in where surfaces met; but where another
        that it is behind is much closer, it slipped in by that. Where it is ``known``, ``near`` is that already.
        """
        vertex = self.vertex[deep]
        triangle, weights, distance = near

        def ask(k: np.ndarray, **more: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            only = {"own": solid[k], "meets": self.each_alone, "vertex": vertex[k], "excluded": excluded}
            return closest_triangles(self.triangles, x, x[vertex[k]], **only, behind=True, **more)

        k = np.flatnonzero(~known)
        if len(k):
            triangle[k], weights[k], distance[k] = ask(k)
        against = self.normals.around_vertices(vertex)
        k = np.flatnonzero(~((self.normals.areas[triangle] * against).sum(1) <= 0))
        if len(k):
            within = SLIPPED * distance[k] + CLOSE * self.surfaces.spacing[solid[k]]
            facing, w, d = ask(k, reach=within, against=against[k])
            chosen = d <= within
            triangle[k[chosen]], weights[k[chosen]] = facing[chosen], w[chosen]
        return triangle, weights
