"""Which vertices and edges of surfaces may touch which others during a step (sections 4.1, 7.2 and 11.2).

Pairs are sought at the start of a step, where surfaces were kept apart by the step before: the side on which a vertex
lies is then known, and pairs that are farther apart than they can come need not be looked at. Of each vertex the
closest triangle of another body is taken, and of its own more than a few rings away; of each sharp edge likewise the
closest edge. A gap that is open costs nothing: contacts act once it closes. So nothing passes through anything else, as
long as in one step it does not pass by the pair that it was found with.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pbng.contact.bvh import BoxTree
from pbng.contact.contacts import Contacts
from pbng.contact.normals import SHARP, SmoothNormals
from pbng.contact.queries import closest_edges, closest_triangles, containing_tets
from pbng.contact.rings import neighbourhoods
from pbng.contact.spec import CLOSE, NEAR, Surfaces
from pbng.errors import InputError
from pbng.mesh import triangle_areas
from pbng.topology import edge_sides, entries

STIFF = 10.0  # default stiffness, in E h of the softer body
PUSH = 5.0  # how many edges a second a stiff contact may push apart what overlaps [1/s]
AHEAD = 4.0  # radii at most from which on surfaces count as close: farther apart, directions soon mean nothing
SLIPPED = 4.0  # how much closer a triangle must be by which a vertex does not face what it is inside of
TOUCHING = 1e-9  # of the radius: closer points have no direction between them
ROOM = 1e-6  # of the distance that is kept, by which surfaces at rest may be too close
SIDE = 1e-6  # weights of an edge's ends from which on a contact is with a vertex


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Candidates: stencils, the two points of each [m], and a unit normal of the second side that points outward."""

    vertices: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    second: np.ndarray
    outward: np.ndarray
    inside: np.ndarray
    bodies: np.ndarray

    def some(self, which: np.ndarray) -> "_Pairs":
        """Those pairs alone."""
        return _Pairs(*(getattr(self, f.name)[which] for f in fields(self)))


class SurfaceDetector:
    """Finds contacts between surfaces.

    Args:
        surfaces: What may touch.
        X: Rest positions [m], (n_vert, 3).
        fixed: Which vertices are prescribed, (n_vert,) bool: two of them are never in contact.
    """

    def __init__(self, surfaces: Surfaces, X: np.ndarray, fixed: np.ndarray) -> None:
        self.surfaces, self.fixed = surfaces, fixed
        s, n_body = surfaces, len(surfaces.names)
        self.vertex = s.vertices
        self.body = np.full(len(X), -1, np.int32)  # of each vertex of the surfaces
        self.body[s.triangles] = s.body[:, None]
        self.solid = np.zeros(n_body, bool)
        self.solid[np.unique(s.tet_body)] = True
        self.edges, self.beside = self._sharp_edges(X)
        edge_body = self.body[self.edges[:, 0]]
        self.normals = SmoothNormals(X, s.triangles)
        self.triangles = BoxTree(X, s.triangles, s.body)
        self.edge_tree = BoxTree(X, self.edges, edge_body)
        self.tets = BoxTree(X, s.tets, s.tet_body) if len(s.tets) else None
        self.meets_others = ~np.eye(n_body, dtype=bool) & s.others & s.others[:, None]
        self.meets_itself = np.diag(s.own)
        present = np.unique(s.body)
        self.several, self.any_own = bool(self.meets_others.any()), bool(s.own.any())
        if self.any_own:
            cells = s.triangles, self.edges, s.tets
            self.near_triangles, self.near_edges, self.near_tets = (neighbourhoods(c, len(X), s.rings) for c in cells)
        self.radius = s.radius if s.radius is not None else NEAR * float(s.spacing[present].mean())
        if self.any_own:
            self._check_room(X)
        self._forget()

    def _forget(self) -> None:
        """Of each vertex, whether it was inside a solid of others, and of its own; at first nobody knows."""
        self.were_inside = [np.ones(len(self.vertex), bool), np.ones(len(self.vertex), bool)]

    def _check_room(self, X: np.ndarray) -> None:
        """InputError if what may touch itself is closer at rest than the distance that is kept: it would swell."""
        s = self.surfaces
        self._forget()
        kept = 2 * s.skin[self.body]
        pairs = self._vertex_triangle(X, kept, self.meets_itself, self.near_triangles)
        distance = np.linalg.norm(pairs.first - pairs.second, axis=1)
        short = kept[pairs.vertices[:, 0]] - distance
        if len(short) and short.max() > ROOM * kept.max():
            k = int(short.argmax())
            v = pairs.vertices[k, 0]
            raise InputError(
                f"contact: body {s.names[self.body[v]]!r} keeps {kept[v]:.4g} m from itself, its thickness, but at rest"
                f" its vertex at {tuple(X[v].round(6).tolist())} is {distance[k]:.4g} m from a triangle more than"
                f" {s.rings} rings away; use a smaller thickness, or more rings"
            )

    def _sharp_edges(self, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Edges that may touch edges, (k, 2), and the two triangles at each.

        Of solids those that are sharp at rest: elsewhere vertices find all there is, and which of many crossing edges
        is closest changes with every movement. Of cloth all, as it folds anywhere.
        """
        edges, start, sides = edge_sides(self.surfaces.triangles)
        beside = np.column_stack([sides[start[:-1]], sides[start[1:] - 1]]) // 3  # twice the same where there is one
        a, b = (triangle_areas(X, self.surfaces.triangles[t]) for t in beside.T)
        cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        used = (cosine < SHARP) | ~self.solid[self.body[edges[:, 0]]]
        return edges[used], beside[used]

    def find(
        self, x0: np.ndarray, x1: np.ndarray, dt: float | None, ahead: float, hold: float, k_tau: float
    ) -> Contacts:
        """Contacts of a step from x0 to, it is expected, x1 (n_vert, 3), give or take ``ahead`` [m].

        With inertia, in a step of dt [s], contacts do not part at once what overlaps, or it would fly apart: their
        offset is one at which they push with the stress E, or as far as they may in a step. Without inertia, dt = None,
        those that resist hold on where they are until they are found anew, by ``hold`` of k_n: nothing else keeps what
        may slide freely from sliding past what it was found with. ``k_tau`` [N/m] is the stiffness of what sticks.
        """
        s = self.surfaces
        x0 = np.ascontiguousarray(x0, float)
        moved = np.linalg.norm(x1 - x0, axis=1)
        radius = self.radius + min(ahead, AHEAD * self.radius)
        if dt is not None and s.radius is None:
            radius, moved = CLOSE / NEAR * self.radius, 2 * moved
        reach = radius + 2 * float(s.skin.max(initial=0.0)) + moved
        self.triangles.refit(x0, margin=moved)
        if len(self.edges):
            self.edge_tree.refit(x0, margin=moved)
        edge_reach = reach[self.edges].max(1)
        pairs = []
        if self.several:
            pairs.append(self._vertex_triangle(x0, reach, self.meets_others, None))
            # Edges of each pair of bodies are sought from one side: vertices look from both.
            pairs.append(self._edge_edge(x0, edge_reach, np.triu(self.meets_others), None))
        if self.any_own:
            pairs.append(self._vertex_triangle(x0, reach, self.meets_itself, self.near_triangles))
            seen = np.zeros(len(x0), bool)  # where a surface comes near itself, vertices tell
            seen[pairs[-1].vertices] = True
            edge_reach[~seen[self.edges].any(1)] = -1.0
            pairs.append(self._edge_edge(x0, edge_reach, self.meets_itself, self.near_edges))
        return self._contacts(pairs, dt, hold, k_tau)

    def _vertex_triangle(self, x: np.ndarray, reach: np.ndarray, meets: np.ndarray, excluded: Any) -> _Pairs:
        s, vertex = self.surfaces, self.vertex
        own = self.body[vertex]
        asked: dict[str, Any] = {"own": own, "meets": meets, "vertex": vertex, "excluded": excluded}
        triangle, weights, _ = closest_triangles(self.triangles, x, x[vertex], reach[vertex], **asked)
        inside, through = self._inside(x, triangle, weights, meets, excluded)
        triangle[through] = -1
        deep = np.flatnonzero(inside >= 0)
        if len(deep):
            triangle[deep], weights[deep] = self._way_out(x, vertex[deep], inside[deep], excluded)
        found = np.flatnonzero(triangle >= 0)
        v, corners = vertex[found], s.triangles[triangle[found]]
        return _Pairs(
            vertices=np.column_stack([v, corners]).astype(np.int32),
            weights=np.column_stack([np.ones(len(found)), -weights[found]]),
            first=x[v],
            second=np.einsum("kj,kji->ki", weights[found], x[corners]),
            outward=self.normals.at(x, triangle[found], weights[found]),
            inside=inside[found] >= 0,
            bodies=np.column_stack([own[found], s.body[triangle[found]]]),
        )

    def _way_out(
        self, x: np.ndarray, vertex: np.ndarray, solid: np.ndarray, excluded: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """By which triangle a vertex leaves the solid that it is inside of, (k,), and weights of its closest point.

        By the closest that it is behind and that it faces, as it came in where surfaces met; but where another that it
        is behind is much closer, it slipped in by that.
        """
        only = solid[:, None] == np.arange(len(self.surfaces.names))
        asked: dict[str, Any] = {"own": np.arange(len(vertex)), "meets": only, "vertex": vertex, "excluded": excluded}
        near, w, d = closest_triangles(self.triangles, x, x[vertex], **asked, behind=True)
        within = SLIPPED * d + CLOSE * self.surfaces.spacing[solid]
        facing, w_facing, d_facing = closest_triangles(
            self.triangles, x, x[vertex], within, **asked, behind=True, against=self._vertex_normals(x, vertex)
        )
        chosen = d_facing <= within
        return np.where(chosen, facing, near), np.where(chosen[:, None], w_facing, w)

    def _inside(
        self, x: np.ndarray, triangle: np.ndarray, weights: np.ndarray, meets: np.ndarray, excluded: Any
    ) -> tuple[np.ndarray, np.ndarray]:
        """The solid that each vertex is inside of, -1 for none, and which see their triangle through the own body.

        ``triangle`` and ``weights`` tell the closest point. Where that is within a triangle of another body, its normal
        tells. Elsewhere it may not, and tets are looked for, as they are where a vertex was inside before; what goes in
        is seen near the surface first.
        """
        s, vertex, own = self.surfaces, self.vertex, excluded is not None
        out, through = np.full(len(vertex), -1, np.int64), np.zeros(len(vertex), bool)
        if self.tets is None or not (meets & self.solid).any():
            return out, through
        found = np.flatnonzero(triangle >= 0)
        corners, body = s.triangles[triangle[found]], s.body[triangle[found]]
        way = x[vertex[found]] - np.einsum("kj,kji->ki", weights[found], x[corners])
        behind = ((triangle_areas(x, corners) * way).sum(1) < 0) & self.solid[body]
        plain = (weights[found].min(1) > SIDE) & (not own)
        out[found[plain & behind]] = body[plain & behind]
        asked = self.were_inside[own].copy()
        asked[found[plain]] = False
        asked[found[~plain & behind]] = True
        q = np.flatnonzero(asked)
        if len(q):
            self.tets.refit(x)
            v, near = vertex[q], self.near_tets if own else None
            tet, _ = containing_tets(self.tets, x, x[v], v, own=self.body[v], meets=meets & self.solid, excluded=near)
            out[q[tet >= 0]] = s.tet_body[tet[tet >= 0]]
        self.were_inside[own] = out >= 0
        if own:
            through[found[behind]] = out[found[behind]] < 0
        return out, through

    def _edge_edge(self, x: np.ndarray, reach: np.ndarray, meets: np.ndarray, excluded: Any) -> _Pairs:
        e = self.edges
        body = self.body[e[:, 0]]
        other, s, t, _ = closest_edges(self.edge_tree, x, e, reach, own=body, meets=meets, excluded=excluded)
        proper = (other >= 0) & (np.minimum(s, 1 - s) > SIDE) & (np.minimum(t, 1 - t) > SIDE)  # else a vertex finds it
        mine = np.flatnonzero(proper)
        theirs = other[mine]
        # Two edges that find each other are one contact.
        twice = (other[theirs] == mine) & proper[theirs] & (theirs < mine)
        mine, theirs = mine[~twice], theirs[~twice]
        s, t = s[mine], t[mine]
        stencil = np.column_stack([e[mine], e[theirs]]).astype(np.int32)
        weights = np.column_stack([1 - s, s, t - 1, -t])
        first = (1 - s)[:, None] * x[e[mine, 0]] + s[:, None] * x[e[mine, 1]]
        second = (1 - t)[:, None] * x[e[theirs, 0]] + t[:, None] * x[e[theirs, 1]]
        across = np.cross(x[e[mine, 1]] - x[e[mine, 0]], x[e[theirs, 1]] - x[e[theirs, 0]])
        bodies = np.column_stack([body[mine], body[theirs]])
        mine_out, theirs_out = self._edge_normals(x, mine), self._edge_normals(x, theirs)
        ahead, back = (normals * (first - second) for normals in (theirs_out, mine_out))
        ahead, back = ahead.sum(1), back.sum(1)
        solid = self.solid[bodies].all(1)
        # Two solids overlap where each has its edge inside the other; two edges of one see each other through it.
        inside = solid & (ahead < 0) & (back > 0)
        across /= np.maximum(np.linalg.norm(across, axis=1), 1e-300)[:, None]
        outward = np.where(((across * theirs_out).sum(1) < 0)[:, None], -across, across)
        pairs = _Pairs(stencil, weights, first, second, outward, inside, bodies)
        # Deep in each other, two edges tell nothing of the way out; vertices do.
        clear = ~inside | (np.linalg.norm(first - second, axis=1) < CLOSE * self.surfaces.spacing[bodies].min(1))
        return pairs.some(clear if excluded is None else ~solid | ((ahead > 0) & (back < 0)))

    def _vertex_normals(self, x: np.ndarray, vertex: np.ndarray) -> np.ndarray:
        """Sum of the area vectors of the triangles around vertices, (k, 3)."""
        start, triangle = self.normals.around
        of, at = entries(start, vertex)
        first = np.searchsorted(of, np.arange(len(vertex)))
        return np.add.reduceat(triangle_areas(x, self.surfaces.triangles[triangle[at]]), first)

    def _edge_normals(self, x: np.ndarray, edge: np.ndarray) -> np.ndarray:
        """Sum of the area vectors of the triangles at edges, (k, 3)."""
        a, b = self.beside[edge].T
        return triangle_areas(x, self.surfaces.triangles[a]) + triangle_areas(x, self.surfaces.triangles[b])

    def _contacts(self, pairs: list[_Pairs], dt: float | None, hold: float, k_tau: float) -> Contacts:
        s = self.surfaces
        p = _Pairs(*(np.concatenate([getattr(q, f.name) for q in pairs]) for f in fields(_Pairs)))
        p = p.some(~self.fixed[p.vertices].all(1))
        apart = p.first - p.second
        distance = np.linalg.norm(apart, axis=1)
        sign = np.where(p.inside, -1.0, 1.0)
        gap = sign * distance
        clear = distance > TOUCHING * self.radius
        direct = np.where(clear[:, None], (sign / np.maximum(distance, 1e-300))[:, None] * apart, p.outward)
        # Where the way to the closest point is nearly along the surface's normal, it is the normal that counts: it does
        # not jump from triangle to triangle. On the far side of cloth it points back.
        along = (direct * p.outward).sum(1)
        share = np.clip((np.abs(along) - SHARP) / (1 - SHARP), 0.0, 1.0)
        normal = (1 - share)[:, None] * direct + (share * np.sign(along))[:, None] * p.outward
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        kept = s.skin[p.bodies].sum(1)
        spacing = s.spacing[p.bodies].min(1)
        softer = s.stiffness[p.bodies].min(1)
        k_n = np.full(len(gap), s.k_n) if s.k_n is not None else STIFF * softer
        if dt is None:
            offset, tangential = kept, np.maximum(k_tau, hold * k_n)
        else:
            push = np.maximum(PUSH * dt, softer / k_n) * spacing
            offset, tangential = np.minimum(kept, gap + push), np.full(len(gap), k_tau)
        return Contacts(
            vertices=p.vertices,
            weights=p.weights,
            normal=normal,
            offset=offset,
            k_n=k_n,
            k_tau=np.where(gap < kept, tangential, 0.0),
            start=apart,
            kept=kept,
        )

    def check(self, x: np.ndarray) -> None:
        """InputError if a body lies wholly inside another at x: no way out is then the shortest."""
        if self.tets is None or not self.several:
            return
        nothing = np.full(len(self.vertex), -1)
        self._forget()
        x = np.ascontiguousarray(x, float)
        self.triangles.refit(x)
        inside, _ = self._inside(x, nothing, np.zeros((len(nothing), 3)), self.meets_others, None)
        body = self.body[self.vertex]
        for b in np.unique(body):
            mine = np.flatnonzero(body == b)
            solid = inside[mine[0]]
            if solid < 0 or (inside[mine] != solid).any():
                continue
            only = (np.arange(len(self.surfaces.names)) == solid)[None]
            asked: dict[str, Any] = {"own": np.zeros(len(mine), np.int32), "meets": only}
            if closest_triangles(self.triangles, x, x[self.vertex[mine]], **asked)[2].max() > CLOSE * self.radius:
                names = self.surfaces.names
                raise InputError(
                    f"contact: body {names[b]!r} starts fully inside body {names[solid]!r} ({len(mine)} vertices);"
                    " move one of them"
                )
