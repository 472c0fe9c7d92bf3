"""Which vertices and edges of surfaces may touch which others during a step (sections 4.1, 7.2 and 11.2).

Pairs are sought at the start of a step, where surfaces were kept apart by the step before: the side on which a vertex
lies is then known, and pairs that are farther apart than they can come need not be looked at. Of each vertex the
closest triangle of another body is taken, and of its own more than a few rings away; of each sharp edge likewise the
closest edge. A gap that is open costs nothing: contacts act once it closes. So nothing passes through anything else, as
long as in one step it does not pass by the pair that it was found with.
"""

from typing import Any

import numpy as np

from pbng.contact.bvh import BoxTree
from pbng.contact.collider import norms
from pbng.contact.contacts import Contacts
from pbng.contact.inside import Insides
from pbng.contact.normals import SHARP, SmoothNormals
from pbng.contact.queries import closest_edges, closest_triangles
from pbng.contact.quiet import Quiet
from pbng.contact.resistance import Pairs, resist
from pbng.contact.rings import Spans, neighbourhoods, spans
from pbng.contact.sides import Sides
from pbng.contact.spec import CLOSE, NEAR, Surfaces
from pbng.errors import InputError
from pbng.jit import inline
from pbng.linalg import add, combine, cross, dot, point, scale, sub, unit
from pbng.parallel import array, body, each, rows
from pbng.topology import edge_sides

STRAY = 0.5  # of its way may a vertex stray in a step with inertia: if one of two that go together stops, both do
BRISK = 0.25  # of how far is looked must vertices go for it to pay to look how they go relative to each other
LULL, REST = 2.5, 0.25  # of what it may go in a step, and of how far it looks, may cloth go before all ask again
AHEAD = 4.0  # radii at most from which on surfaces count as close: farther apart, directions soon mean nothing
ASIDE = 0.5  # cosine of the angle between two smooth parts of a solid's surface below which they may face each other
ROOM = 1e-6  # of the distance that is kept, by which surfaces at rest may be too close
SIDE = 1e-6  # weights of an edge's ends from which on a contact is with a vertex
GRAIN = 256  # pairs of edges that a thread takes at a time
NONE = Pairs(np.empty((0, 4), np.int32), np.empty((0, 4)), np.empty((0, 3)), np.empty(0, bool))


class SurfaceDetector:
    """Finds contacts between surfaces.

    Args:
        surfaces: What may touch.
        X: Rest positions [m], (n_vert, 3).
        fixed: Which vertices are prescribed, (n_vert,) bool: two of them are never in contact.
    """

    def __init__(self, surfaces: Surfaces, X: np.ndarray, fixed: np.ndarray) -> None:
        self.surfaces, self.fixed, self.any_fixed = surfaces, fixed, bool(fixed.any())
        s, n_body = surfaces, len(surfaces.names)
        self.body = np.full(len(X), -1, np.int32)  # of each vertex of the surfaces
        self.body[s.triangles] = s.body[:, None]
        self.normals = SmoothNormals(X, s.triangles)
        self.triangles = BoxTree(X, s.triangles, s.body)
        vertex, first = np.unique(self.triangles.sorted_cells, return_index=True)
        self.vertex = vertex[np.argsort(first)]  # as they are met in the tree: near ones are then asked together
        edges, start, sides = edge_sides(s.triangles)
        tell = Sides(self.normals, start, sides)
        self.insides = Insides(s, X, self.vertex, self.body, self.triangles, self.normals, tell)
        self.solid = self.insides.solid
        self.edges, self.beside = self._sharp_edges(edges, start, sides)
        # Which vertices face one way: cloth faces both, and a sharp edge of a solid many.
        self.smooth = self.solid[self.insides.own] & ~np.isin(self.vertex, self.edges)
        self.edge_ends = np.ascontiguousarray(self.edges.T)
        self.edge_body = self.body[self.edge_ends[0]]
        self.edge_tree = BoxTree(X, self.edges, self.edge_body)
        self.meets_others = ~np.eye(n_body, dtype=bool) & s.others & s.others[:, None]
        self.meets_later = np.triu(self.meets_others)  # edges of two bodies are sought from one side
        self.meets_itself = np.diag(s.own)
        present = np.unique(s.body)
        self.several, self.any_own = bool(self.meets_others.any()), bool(s.own.any())
        if self.any_own:
            self.near_triangles, self.near_edges = (
                spans(t.order, *neighbourhoods(t.cells, len(X), s.rings)) for t in (self.triangles, self.edge_tree)
            )
        self.radius = s.radius if s.radius is not None else NEAR * float(s.spacing[present].mean())
        if self.any_own:
            self._check_room(X)
            self.insides.forget()
        self.own_sheets, self.quiet = self.any_own and not (s.own & self.solid).any(), Quiet()

    def _check_room(self, X: np.ndarray) -> None:
        """InputError if what may touch itself is closer at rest than the distance that is kept: it would swell."""
        s = self.surfaces
        kept = 2 * s.skin[self.body]
        pairs = self._vertex_triangle(X, kept, self.meets_itself, self.near_triangles)
        distance = np.linalg.norm(np.einsum("mj,mji->mi", pairs.weights, X[pairs.vertices]), axis=1)
        short = kept[pairs.vertices[:, 0]] - distance
        if len(short) and short.max() > ROOM * kept.max():
            k = int(short.argmax())
            v = pairs.vertices[k, 0]
            raise InputError(
                f"contact: body {s.names[self.body[v]]!r} keeps {kept[v]:.4g} m from itself, its thickness, but at rest"
                f" its vertex at {tuple(X[v].round(6).tolist())} is {distance[k]:.4g} m from a triangle more than"
                f" {s.rings} rings away; use a smaller thickness, or more rings"
            )

    def _sharp_edges(self, edges: np.ndarray, start: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Edges that may touch edges, (k, 2), and the two triangles at each.

        Of solids those that are sharp at rest: elsewhere vertices find all there is, and which of many crossing edges
        is closest changes with every movement. Of cloth all, as it folds anywhere.
        """
        beside = np.column_stack([sides[start[:-1]], sides[start[1:] - 1]]) // 3  # twice the same where there is one
        a, b = (self.normals.areas[t] for t in beside.T)  # which are fitted to the rest state as yet
        cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        used = (cosine < SHARP) | ~self.solid[self.body[edges[:, 0]]]
        return edges[used], beside[used].astype(np.int32)

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
        margin, way, skin = norms(x1 - x0), None, 2 * float(s.skin.max(initial=0.0))
        radius = self.radius + min(ahead, AHEAD * self.radius) + skin
        if dt is not None and s.radius is None:
            radius = CLOSE / NEAR * self.radius + skin
            brisk = margin.mean() > BRISK * radius
            margin, way = (STRAY * margin, x1 - x0) if brisk else ((1 + STRAY) * margin, None)
        reach = radius + margin
        self.normals.fit(x0)
        alone = self._alone(x0, radius, margin) if self.own_sheets and way is None else self.vertex[:0]
        self.triangles.refit(x0, margin=margin, way=way)
        pairs, own_edges = [NONE], np.empty(0, np.int64)
        if self.several:
            pairs.append(self._vertex_triangle(x0, reach, self.meets_others, None))
        if self.any_own and len(alone) < len(self.vertex):
            near = reach.copy()
            near[alone] = -1.0
            pairs.append(self._vertex_triangle(x0, near, self.meets_itself, self.near_triangles))
            seen = np.zeros(len(x0), bool)  # where a surface comes near itself, vertices tell
            seen[pairs[-1].vertices] = True
            own_edges = np.flatnonzero(seen[self.edge_ends[0]] | seen[self.edge_ends[1]])
        if self.several or len(own_edges):
            self.edge_tree.refit(x0, margin=margin, way=way)
        if self.several:
            pairs.append(self._edge_edge(x0, slice(None), reach, self.meets_later, None))
        if len(own_edges):
            pairs.append(self._edge_edge(x0, own_edges, reach, self.meets_itself, self.near_edges))
        found = Pairs(*(np.concatenate(a) for a in zip(*pairs)))
        if self.any_fixed:
            found = found.some(~self.fixed[found.vertices].all(1))
        return resist(found, x0, self.body, s, self.radius, dt, hold, k_tau)

    def _alone(self, x: np.ndarray, radius: float, margin: np.ndarray) -> np.ndarray:
        """Vertices (k,) of cloth that are known to be away from all that they could touch of it: they need not ask.

        They are asked once for several steps: within ``radius`` [m], and as far as all may go in these; ``margin``
        (n_vert,) [m] is how far they may go in one.
        """
        alone = self.quiet.alone(x, margin, radius)
        if alone is None and self.quiet.pays():
            room = LULL * margin + REST * radius
            self.triangles.refit(x, margin=room)
            asked: dict[str, Any] = {"own": self.insides.own, "meets": self.meets_itself, "vertex": self.vertex}
            asked["excluded"] = self.near_triangles
            found, *_ = closest_triangles(self.triangles, x, x[self.vertex], radius + room[self.vertex], **asked)
            alone = self.quiet.note(x, room, radius, self.vertex[found < 0])
        return self.vertex[:0] if alone is None else alone

    def _vertex_triangle(self, x: np.ndarray, reach: np.ndarray, meets: np.ndarray, excluded: Spans | None) -> Pairs:
        vertex, reach = self.vertex, reach[self.vertex]
        asked: dict[str, Any] = {"own": self.insides.own, "meets": meets, "vertex": vertex, "excluded": excluded}
        if excluded is not None and self.smooth.any():
            asked |= {"against": self.normals.around_vertices(vertex) * self.smooth[:, None], "limit": ASIDE}
        closest = closest_triangles(self.triangles, x, x[vertex], reach, **asked)
        triangle, weights, inside = self.insides.touched(x, closest, reach, meets, excluded)
        found = np.flatnonzero(triangle >= 0)
        found = found[np.argsort(vertex[found])]
        triangle, weights = triangle[found], weights[found]
        stencil, w = np.empty((len(found), 4), np.int32), np.ones((len(found), 4))
        stencil[:, 0], stencil[:, 1:] = vertex[found], self.surfaces.triangles[triangle]
        np.negative(weights, w[:, 1:])
        return Pairs(stencil, w, self.normals.at(triangle, weights), inside[found])

    def _edge_edge(
        self, x: np.ndarray, edges: slice | np.ndarray, reach: np.ndarray, meets: np.ndarray, excluded: Spans | None
    ) -> Pairs:
        """What some of the edges make pairs with."""
        asked: dict[str, Any] = {"own": self.edge_body[edges], "meets": meets, "excluded": excluded}
        one, two = self.edge_ends[:, edges]
        reaches = np.maximum(reach[one], reach[two])
        other, s, t, _ = closest_edges(self.edge_tree, x, self.edges[edges], reaches, **asked)
        if len(other) < len(self.edges):
            other, s, t = (_spread(a, edges, len(self.edges)) for a in (other, s, t))
        mine = np.flatnonzero(other >= 0)
        m = len(mine)
        stencil, weights, outward = np.empty((m, 4), np.int32), np.empty((m, 4)), np.empty((m, 3))
        inside, used = np.empty(m, np.bool_), np.empty(m, np.bool_)
        arrays = (
            x, self.edges, self.beside, self.edge_body, self.normals.areas, self.solid, self.surfaces.spacing,
            np.array([excluded is not None]), mine, other, s, t, stencil, weights, outward, inside, used,
        )  # fmt: skip
        each(_edge_pairs, arrays, m, GRAIN)
        return Pairs(stencil, weights, outward, inside).some(used)

    def check(self, x: np.ndarray) -> None:
        """InputError if a body lies wholly inside another at x, where all begins: no way out is then the shortest."""
        self.quiet.forget()
        self.insides.forget()
        if not self.solid.any() or not self.several:
            return
        x = np.ascontiguousarray(x, float)
        self.triangles.refit(x)
        inside = self.insides.solids(x, self.meets_others)
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


def _spread(a: np.ndarray, at: Any, n: int) -> np.ndarray:
    """Numbers as those ``at`` some places of n, -1 elsewhere."""
    out = np.full(n, -1, a.dtype)
    out[at] = a
    return out


@body
def _edge_pairs(arguments, low, high):
    """Body of :meth:`SurfaceDetector._edge_edge` for edges mine[low .. high]: what pairs they make, if they do."""
    x, edges, beside = (
        rows(arguments, 0, 3, np.float64),
        rows(arguments, 1, 2, np.int32),
        rows(arguments, 2, 2, np.int32),
    )
    body, areas = array(arguments, 3, np.int32), rows(arguments, 4, 3, np.float64)
    solid, spacing = array(arguments, 5, np.bool_), array(arguments, 6, np.float64)
    own, mine, other = array(arguments, 7, np.bool_)[0], array(arguments, 8, np.int64), array(arguments, 9, np.int32)
    s, t = array(arguments, 10, np.float64), array(arguments, 11, np.float64)
    stencil, weights = rows(arguments, 12, 4, np.int32), rows(arguments, 13, 4, np.float64)
    outward, inside = rows(arguments, 14, 3, np.float64), array(arguments, 15, np.bool_)
    used = array(arguments, 16, np.bool_)
    for k in range(low, high):
        e = mine[k]
        f = other[e]
        # At its end a vertex finds it; and two edges that find each other are one contact.
        used[k] = _proper(s[e], t[e]) and not (f < e and other[f] == e and _proper(s[f], t[f]))
        if not used[k]:
            continue
        stencil[k, 0], stencil[k, 1], stencil[k, 2], stencil[k, 3] = edges[e, 0], edges[e, 1], edges[f, 0], edges[f, 1]
        weights[k, 0], weights[k, 1], weights[k, 2], weights[k, 3] = 1.0 - s[e], s[e], t[e] - 1.0, -t[e]
        a, b, c, d = point(x, edges[e, 0]), point(x, edges[e, 1]), point(x, edges[f, 0]), point(x, edges[f, 1])
        apart = sub(combine(1.0 - s[e], a, s[e], b), combine(1.0 - t[e], c, t[e], d))
        mine_out = add(point(areas, beside[e, 0]), point(areas, beside[e, 1]))
        theirs_out = add(point(areas, beside[f, 0]), point(areas, beside[f, 1]))
        ahead, back = dot(theirs_out, apart), dot(mine_out, apart)
        solids = solid[body[e]] and solid[body[f]]
        # Two solids overlap where each has its edge inside the other; two edges of one see each other through it.
        inside[k] = solids and ahead < 0.0 and back > 0.0
        across = unit(cross(sub(b, a), sub(d, c)))
        sign = -1.0 if dot(across, theirs_out) < 0.0 else 1.0
        outward[k, 0], outward[k, 1], outward[k, 2] = scale(sign, across)
        if own:
            used[k] = not solids or (ahead > 0.0 and back < 0.0)
        elif inside[k]:  # deep in each other, two edges tell nothing of the way out; vertices do
            clear = CLOSE * min(spacing[body[e]], spacing[body[f]])
            used[k] = dot(apart, apart) < clear * clear


@inline
def _proper(s, t):
    """Whether the closest points of two edges are away from their ends."""
    return min(s, 1.0 - s) > SIDE and min(t, 1.0 - t) > SIDE
