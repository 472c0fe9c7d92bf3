"""Kinematic meshes: triangle surfaces, at rest, moving or deforming as prescribed, that soft bodies collide with.

Closed surfaces have an inside, told by the pseudonormal at the closest point (Bærentzen, Aanæs 2005): of a face its
normal, of an edge the sum of both faces' normals, of a vertex the sum of normals weighted by the faces' angles there.
Open surfaces are sheets with a thickness and two sides; a point stays on the side that it comes from.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from pbng.contact.bvh import BoxTree
from pbng.contact.collider import ON_SURFACE, Collider, Pose, Touches, is_rigid, norms, to_body, to_world, turned
from pbng.contact.crossing import first_crossings
from pbng.contact.queries import closest_triangles
from pbng.errors import InputError
from pbng.mesh import Mesh, triangle_areas
from pbng.topology import TRIANGLE_EDGES, components, edge_sides

PIECES = 16  # straight pieces at most that a step of a deforming mesh is cut into
BEND = 0.1  # of an edge, or the thickness: how far vertices may stray from straight pieces
CORNER = 1e-9  # weight below which a point of a triangle is on its edge
TINY = 1e-9  # of the size: distances that give no direction
FLAT = 1e-12  # of the area to the power of 3/2: a volume that is none
OFF = 1e-6  # of the size of a triangle: how far off it to stand for what a part encloses


class _Shape:
    """A surface at one time: positions x (n, 3) [m], triangles (m, 3), and across each of their edges the neighbour."""

    def __init__(self, x: np.ndarray, triangles: np.ndarray, neighbor: np.ndarray) -> None:
        self.x, self.triangles, self.neighbor = np.ascontiguousarray(x, float), triangles, neighbor

    @cached_property
    def faces(self) -> np.ndarray:
        """Unit normals (m, 3); zero for a triangle without area."""
        return _unit(triangle_areas(self.x, self.triangles))

    @cached_property
    def vertices(self) -> np.ndarray:
        """Angle-weighted normals (n, 3)."""
        corners = self.x[self.triangles]
        to, back = np.roll(corners, -1, 1) - corners, np.roll(corners, 1, 1) - corners
        angle = np.arctan2(np.linalg.norm(np.cross(to, back), axis=2), np.einsum("mki,mki->mk", to, back))
        index, n = self.triangles.ravel(), len(self.x)
        parts = [np.bincount(index, (angle * self.faces[:, i, None]).ravel(), n) for i in range(3)]
        return _unit(np.stack(parts, 1))

    @cached_property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest corner of the box around it."""
        return self.x.min(0), self.x.max(0)

    def points(self, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return np.einsum("kj,kji->ki", weights, self.x[self.triangles[triangle]])

    def normals(self, triangle: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit pseudonormals (k, 3) at points of triangles, and whether each lies within its face."""
        zero = weights <= CORNER
        count = zero.sum(1)
        normal = self.faces[triangle]
        at = np.flatnonzero(count == 1)
        other = self.neighbor[triangle[at], (zero[at].argmax(1) + 1) % 3]  # the edge opposite the corner without weight
        normal[at] = _unit(normal[at] + np.where((other >= 0)[:, None], self.faces[other], 0.0))
        at = np.flatnonzero(count >= 2)
        normal[at] = self.vertices[self.triangles[triangle[at], weights[at].argmax(1)]]
        return normal, count == 0


@dataclass(frozen=True, eq=False)
class _Near:
    """Closest points: triangle (-1 if none is within reach), weights, point, distance, and the distance's gradient.

    ``side`` is 1 on the side that the pseudonormal points to, else -1: it is the sign of a closed surface's distance.
    """

    triangle: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    side: np.ndarray

    def part(self, keep: np.ndarray) -> "_Near":
        return _Near(*(a[keep] for a in vars(self).values()))


@dataclass(frozen=True, eq=False)
class Kinematic(Collider):
    """A surface that moves as prescribed: a :class:`pbng.TriMesh`, or the surface of a :class:`pbng.TetMesh`.

    The motion may be any that a selection may have in :meth:`pbng.Scene.move`: of all vertices of the mesh, about their
    mean. A surface with boundary edges is a sheet with two sides, and needs a thickness.

    Raises:
        InputError: The surface, or a part of it that is no cavity, is inside-out, at rest or at the end of its motion;
            an edge belongs to more than two triangles; neighbours are oriented against each other; it is open and has
            no thickness; the motion does not fit the mesh.
    """

    mesh: Mesh

    def __post_init__(self) -> None:
        if not isinstance(self.mesh, Mesh):
            raise InputError(f"{self.label}: expected a TriMesh or a TetMesh, not {type(self.mesh).__name__}")
        super().__post_init__()
        boundary = self.mesh.surface[:, TRIANGLE_EDGES][self._rest.neighbor < 0]
        if len(boundary) and self.thickness == 0:
            a, b = boundary[0]
            raise InputError(
                f"{self.label}: the surface is open, with {len(boundary)} boundary edges, the first from vertex {a} to"
                f" {b}; a sheet needs a thickness above 0"
            )
        if self.closed:
            self._check_inside(self._rest, "", "reverse its triangles")
        if self.closed and not self._rigid:  # a function of time has no end: it is looked at where it begins
            when = f" at the end of the motion, {self.end:g} s"
            self._check_inside(self._shape(self.end), when, "the motion must not turn it over or flatten it")

    def _check_motion(self) -> None:
        assert self.motion is not None
        try:
            for t in (self.start, self.end):
                self.motion.at(self.mesh.X, self._center, self.share(t), t)
        except InputError as error:
            raise InputError(f"{self.label}: {error}") from error

    def _check_inside(self, shape: _Shape, when: str, remedy: str) -> None:
        """InputError if a closed surface, or a part of it, has its outside where its inside should be."""
        bad = _inside_out(shape)
        if bad is None:
            return
        triangles, volume = bad
        what, why = "the surface", ""
        if len(triangles) < len(shape.triangles):
            vertex = self._used[shape.triangles[triangles[0], 0]]
            what = f"the part of {len(triangles)} triangles that vertex {vertex} belongs to"
            why = ", and it is no cavity of another"
        raise InputError(
            f"{self.label}: {what} is inside-out{when}: its signed volume is {volume:.3g} m³{why}; {remedy}"
        )

    @cached_property
    def closed(self) -> bool:
        """Whether the surface has no boundary, and so an inside."""
        return bool((self._rest.neighbor >= 0).all())

    @property
    def _center(self) -> np.ndarray:
        return self.mesh.X.mean(0)

    @cached_property
    def _used(self) -> np.ndarray:
        """The mesh's vertices that are on the surface."""
        return np.unique(self.mesh.surface)

    @cached_property
    def _rest(self) -> _Shape:
        triangles = np.searchsorted(self._used, self.mesh.surface).astype(np.int32)
        return _Shape(self.mesh.X[self._used], triangles, _neighbors(self.label, self.mesh.surface))

    @cached_property
    def _rigid(self) -> bool:
        """Whether there is a body's frame, in which the surface rests."""
        return self.motion is None or is_rigid(self.motion)

    @cached_property
    def _tree(self) -> BoxTree:
        return BoxTree(self._rest.x, self._rest.triangles)

    @cached_property
    def _recent(self) -> dict[float, _Shape]:
        return {}

    def _pose(self, t: float) -> Pose | None:
        return super()._pose(t) if self._rigid else None

    def _shape(self, t: float) -> _Shape:
        """The surface at time t: in the world, or in the body's frame if there is one."""
        if self._rigid or t < self.start:
            return self._rest
        if t not in self._recent:
            assert self.motion is not None
            x = self.motion.at(self.mesh.X, self._center, self.share(t), t)[self._used]
            while len(self._recent) >= 2 * PIECES:
                del self._recent[next(iter(self._recent))]
            self._recent[t] = _Shape(x, self._rest.triangles, self._rest.neighbor)
        return self._recent[t]

    def _fitted(self, first: _Shape, last: _Shape) -> BoxTree:
        if not self._rigid:  # in the body's frame it fits already
            self._tree.refit(first.x, last.x)
        return self._tree

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        return self._rest.x, self._rest.triangles

    def surface(self, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        shape = self._shape(t)
        return to_world(self._pose(t), shape.x), shape.triangles

    def distance(self, points: np.ndarray, t: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As of other colliders; but of a sheet the distance has no sign, and normals point towards the points."""
        pose = self._pose(t)
        near = self._closest(self._shape(t), to_body(pose, np.asarray(points, float)))
        return near.distance, to_world(pose, near.point), turned(pose, near.normal)

    def _closest(self, shape: _Shape, points: np.ndarray, reach: Any = np.inf) -> _Near:
        """The closest points of a surface; only those within reach."""
        triangle, weights, d = closest_triangles(self._fitted(shape, shape), shape.x, points, reach)
        point = shape.points(triangle, weights)
        off = points - point
        normal, in_face = shape.normals(triangle, weights)
        side = np.where(np.einsum("ki,ki->k", off, normal) >= 0, 1.0, -1.0)
        outward = np.ones(len(side)) if self.closed else side
        clear = ~in_face & (d > TINY * self.mesh.size) & (triangle >= 0)
        normal *= outward[:, None]
        normal[clear] = off[clear] * (side * outward / np.where(d > 0, d, 1.0))[clear, None]
        return _Near(triangle, weights, point, np.where(triangle >= 0, d * side * outward, np.inf), normal, side)

    def touch(self, before: np.ndarray, after: np.ndarray, t0: float, t1: float, reach: Any = 0.0) -> Touches:
        """As of other colliders; what a point is held by goes with the triangle that it was found on until t1."""
        before, after = np.asarray(before, float), np.asarray(after, float)
        margin = np.broadcast_to(np.asarray(reach, float), len(before)) + self.thickness
        shapes = [self._rest] if self._rigid else self._shapes(t0, t1)
        poses = self.poses(t0, t1) if self._rigid else [None] * len(shapes)
        shapes = shapes * len(poses) if self._rigid else shapes
        first, last = shapes[0], shapes[-1]
        rests = first is last and poses[0] is poses[-1]

        path = [to_body(p, (1 - f) * before + f * after) for f, p in zip(np.linspace(0, 1, len(poses)), poses)]
        left = path[0] if rests else to_body(poses[-1], before)
        index = _meeting([*path, left], margin, shapes)
        margin, left, path = margin[index], left[index], [p[index] for p in path]
        moved = np.sum([norms(b - a) for a, b in pairwise(path)], axis=0)
        moved = np.maximum(moved, norms(left - path[0]))
        moved += sum(norms(b.x - a.x).max() for a, b in pairwise(shapes) if a is not b)

        low, high = first.bounds
        maybe_inside = self.closed & ((path[0] >= low) & (path[0] <= high)).all(1)
        old = self._closest(first, path[0], np.where(maybe_inside, np.inf, margin + moved))
        keep = old.triangle >= 0
        index, margin, moved, left, old = index[keep], margin[keep], moved[keep], left[keep], old.part(keep)
        path = [p[keep] for p in path]
        new = self._closest(last, path[-1])
        chosen = (old.distance < margin) | (new.distance < margin)
        if not rests:
            chosen |= self._closest(last, left).distance < margin

        triangle, weights, normal = new.triangle.copy(), new.weights.copy(), new.normal.copy()
        if not self.closed:  # too near to tell the side: it is known from before
            normal[(new.distance <= ON_SURFACE * moved) & (new.side != old.side)] *= -1.0

        # Held where it was: a point that starts inside, or starts on the surface and goes in.
        kept = last.normals(old.triangle, old.weights)[0] * (1.0 if self.closed else old.side[:, None])
        gap = np.einsum("ki,ki->k", path[-1] - last.points(old.triangle, old.weights), kept)
        on = ON_SURFACE * moved
        held = (old.distance < -on) | ((old.distance <= on) & (gap < 0))

        # Held where it runs into the surface; where it was if rounding hides that.
        free = np.flatnonzero(~held & (old.distance <= moved))
        hit, w, side = self._struck(shapes, [p[free] for p in path])
        struck = free[hit >= 0]
        triangle[struck], weights[struck] = hit[hit >= 0], w[hit >= 0]
        normal[struck] = last.normals(triangle[struck], weights[struck])[0] * side[hit >= 0, None]
        hidden = new.distance < -on
        hidden[struck] = False
        held |= hidden
        triangle[held], weights[held], normal[held] = old.triangle[held], old.weights[held], kept[held]

        chosen |= held
        chosen[struck] = True
        triangle, weights, normal = triangle[chosen], weights[chosen], turned(poses[-1], normal[chosen])
        point = to_world(poses[-1], last.points(triangle, weights)) + self.thickness * normal
        return Touches(index[chosen], point, normal)

    def carried(self, points: np.ndarray, t0: float, t1: float) -> np.ndarray:
        """As of other colliders; the material of a mesh that deforms is that of the closest point."""
        if self._rigid:
            return super().carried(points, t0, t1)
        first, last = self._shape(t0), self._shape(t1)
        near = self._closest(last, np.asarray(points, float))
        return near.point - first.points(near.triangle, near.weights)

    def _struck(self, shapes: list[_Shape], path: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The triangle that each path first runs into, or -1, weights there and the side it comes from."""
        k = len(path[0])
        triangle, weights, side, free = np.full(k, -1), np.zeros((k, 3)), np.ones(k), np.arange(k)
        for (a, b), (x, y) in zip(pairwise(shapes), pairwise(path)):
            tree = self._fitted(a, b)
            triangle[free], weights[free], side[free] = first_crossings(tree, a.x, b.x, x[free], y[free], self.closed)
            free = free[triangle[free] < 0]
        return triangle, weights, side

    def _shapes(self, t0: float, t1: float) -> list[_Shape]:
        """The surface at t0, perhaps between, and at t1, so that it moves almost straight from each to the next."""
        first, middle, last = self._shape(t0), self._shape((t0 + t1) / 2), self._shape(t1)
        if np.array_equal(first.x, last.x) and np.array_equal(first.x, middle.x):
            return [first, first]
        bend = norms(middle.x - (first.x + last.x) / 2).max()
        straight = max(self.thickness, BEND * self._spacing)
        n = int(min(math.ceil(math.sqrt(bend / straight)), PIECES))
        return [first, *(self._shape(t0 + (t1 - t0) * j / n) for j in range(1, n)), last]

    @cached_property
    def _spacing(self) -> float:
        """Median length of an edge at rest [m]."""
        edges = self._rest.x[self._rest.triangles[:, TRIANGLE_EDGES]]
        return float(np.median(np.linalg.norm(edges[:, :, 1] - edges[:, :, 0], axis=2)))


def _meeting(path: list[np.ndarray], margin: np.ndarray, shapes: list[_Shape]) -> np.ndarray:
    """Which paths have a box that comes within a margin of the box around all shapes."""
    low, high = np.min([s.bounds[0] for s in shapes], 0), np.max([s.bounds[1] for s in shapes], 0)
    lowest, highest = path[0], path[0]
    for p in path[1:]:
        lowest, highest = np.minimum(lowest, p), np.maximum(highest, p)
    m = margin[:, None]
    return np.flatnonzero(((lowest - m <= high) & (highest + m >= low)).all(1))


def _neighbors(label: str, triangles: np.ndarray) -> np.ndarray:
    """Across each edge of triangles (m, 3) the neighbour, -1 for none, (m, 3); InputError where there is no surface."""
    edges, start, sides = edge_sides(triangles)
    count = np.diff(start)
    if (count > 2).any():
        k = int(np.flatnonzero(count > 2)[0])
        owners = (sides[start[k] : start[k + 1]] // 3).tolist()
        raise InputError(
            f"{label}: edge {edges[k].tolist()} belongs to {count[k]} triangles, {owners}; a surface has one or two"
        )
    first = start[:-1][count == 2]
    i, j = sides[first], sides[first + 1]
    pairs = triangles[:, TRIANGLE_EDGES].reshape(-1, 2)
    against = np.flatnonzero(pairs[i, 0] == pairs[j, 0])
    if len(against):
        k = against[0]
        raise InputError(
            f"{label}: triangles {i[k] // 3} and {j[k] // 3} are oriented against each other at their edge"
            f" {np.sort(pairs[i[k]]).tolist()} ({len(against)} such edges)"
        )
    neighbor = np.full(len(pairs), -1)
    neighbor[i], neighbor[j] = j // 3, i // 3
    return neighbor.reshape(-1, 3)


def _inside_out(shape: _Shape) -> tuple[np.ndarray, float] | None:
    """Of a closed surface a part that hangs together and bounds no inside: its triangles and its signed volume [m³].

    None if there is no such part. Cavities are none: their volume is negative, but the others wind about them.
    """
    n, corners = len(shape.triangles), shape.x[shape.triangles]
    part = components(np.column_stack([np.arange(n), shape.neighbor]).astype(np.int32), n)  # across edges alone
    first = np.unique(part, return_index=True)[1]
    across = triangle_areas(shape.x, shape.triangles)
    size = norms(across)
    a, b, c = (corners - corners[first[part], :1]).transpose(1, 0, 2)
    volume, area = np.bincount(part, np.einsum("mi,mi->m", a, np.cross(b, c))) / 6, np.bincount(part, size)
    least = FLAT * area**1.5
    for k in np.flatnonzero(~(volume > least)):
        mine = part == k
        t = np.where(mine, size, -1.0).argmax()
        inside = corners[t].mean(0) + OFF / math.sqrt(max(size[t], 1e-300)) * across[t]  # of the part, were it a cavity
        if not volume[k] < -least[k] or _winding(corners[~mine] - inside) < 0.5:
            return np.flatnonzero(mine), float(volume[k])
    return None


def _winding(corners: np.ndarray) -> float:
    """How often closed triangles (m, 3, 3) wind about the origin, by the solid angle of each (Van Oosterom, 1983)."""
    a, b, c = corners.transpose(1, 0, 2)
    la, lb, lc = norms(a), norms(b), norms(c)
    ab, bc, ca = ((p * q).sum(1) for p, q in ((a, b), (b, c), (c, a)))
    half = np.arctan2((a * np.cross(b, c)).sum(1), la * lb * lc + ab * lc + bc * la + ca * lb)
    return float(half.sum()) / (2 * math.pi)


def _unit(v: np.ndarray) -> np.ndarray:
    """Rows made unit vectors; zero stays zero."""
    length = np.linalg.norm(v, axis=1, keepdims=True)
    return v / np.where(length > 0, length, 1.0)
