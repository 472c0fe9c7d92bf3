"""What is drawn of a run: its surfaces as one mesh, cut along sharp edges so that boxes look crisp, and its motion."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pbng.errors import InputError
from pbng.io.colliders import ColliderShape, Part, behind, colliders_of, shapes_of
from pbng.io.export import drawn
from pbng.io.frames import Run
from pbng.mesh import triangle_areas

CREASE = 35.0  # [degrees] edges sharper than this at rest look sharp


@dataclass(frozen=True, eq=False)
class _Still:
    """Positions with no story, and where colliders are with them."""

    x: np.ndarray
    t: float = 0.0
    colliders: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True, eq=False)
class Motion:
    """Bodies and the frames they go through, among colliders: what every picture is made from."""

    bodies: Sequence[Any]
    frames: Sequence[Any]
    fps: float = 30.0
    colliders: Sequence[ColliderShape] = ()

    @classmethod
    def of(cls, source: Any) -> "Motion":
        """From a run or its folder, a frame or a sequence of frames, a mesh or a sequence of meshes at rest, or a pair
        of a mesh or a problem and positions (n_vert, 3) [m].

        Raises:
            InputError: It is none of these, or empty.
        """
        if isinstance(source, str | os.PathLike):
            source = Run(Path(source))
        if hasattr(source, "bodies") and hasattr(source, "__getitem__"):
            return cls(source.bodies, source, getattr(source, "fps", 30.0), getattr(source, "colliders", ()))
        if isinstance(source, tuple) and len(source) == 2 and isinstance(source[1], np.ndarray):
            return cls._placed(*source)
        items = list(source) if isinstance(source, Iterator | Sequence) else [source]
        if items and all(hasattr(item, "problem") for item in items):
            return cls(items[0].problem.bodies, items, colliders=shapes_of(items[0].problem))
        if items and all(hasattr(item, "cells") for item in items):
            return cls(_bodies(items), [_Still(np.concatenate([mesh.X for mesh in items]))])
        raise InputError(f"nothing to draw in {type(source).__name__}: give a run or its folder, frames, or meshes")

    @classmethod
    def _placed(cls, what: Any, x: np.ndarray) -> "Motion":
        if not (hasattr(what, "bodies") or hasattr(what, "cells")):
            raise InputError(f"nothing to draw in {type(what).__name__}: give a mesh or a problem with the positions")
        bodies = what.bodies if hasattr(what, "bodies") else _bodies([what])
        n_vert = max(body.stop for body in bodies)
        if x.shape != (n_vert, 3):
            raise InputError(f"positions must have shape ({n_vert}, 3), not {x.shape}")
        # Positions without a time are those that solve() gives: the end of all motions.
        t = float(getattr(what, "end", 0.0))
        colliders = tuple(c.surface(t)[0] for c in colliders_of(what))
        return cls(bodies, [_Still(x, t, colliders)], colliders=shapes_of(what))

    def __len__(self) -> int:
        return len(self.frames)

    @cached_property
    def solids(self) -> list[int]:
        """Which colliders are drawn as surfaces."""
        return [k for k, shape in enumerate(self.colliders) if shape.kind != "Plane"]

    @cached_property
    def planes(self) -> list[int]:
        """Which colliders are planes."""
        return [k for k, shape in enumerate(self.colliders) if shape.kind == "Plane"]

    @cached_property
    def parts(self) -> tuple[Any, ...]:
        """All that has a surface: the bodies, then the colliders that do."""
        return (*self.bodies, *behind(self.bodies, [self.colliders[k] for k in self.solids]))

    def rest(self) -> np.ndarray:
        """Rest positions (n, 3) [m] of all parts."""
        rest = np.zeros((max(part.stop for part in self.parts), 3))
        for part in self.parts:
            rest[part.start : part.stop] = part.mesh.X
        return rest

    def placed(self, frame: Any) -> np.ndarray:
        """Positions (n, 3) [m] of all parts in a frame."""
        if not self.solids:
            return frame.x
        at = self.collider_points(frame)
        return np.concatenate([frame.x, *(at[k] for k in self.solids)])

    def collider_points(self, frame: Any) -> tuple[np.ndarray, ...]:
        """Points (n, 3) [m] of each collider in a frame."""
        stored = getattr(frame, "colliders", None)
        return tuple(c.surface(frame.t)[0] for c in colliders_of(frame.problem)) if stored is None else stored

    def is_plane(self) -> bool:
        """Whether all bodies stay in one plane of constant z."""
        if any(body.mesh.cells.shape[1] != 3 or np.ptp(body.mesh.X[:, 2]) > 0 for body in self.bodies):
            return False
        return all(bool(np.ptp(self.frames[k].x[:, 2]) == 0) for k in range(len(self)))


def springs_of(frame: Any) -> np.ndarray:
    """The two ends (m, 2, 3) [m] of each weak constraint of a frame, which need not know of any."""
    springs = getattr(frame, "springs", None)
    return np.empty((0, 2, 3)) if springs is None else np.asarray(springs, np.float64)


def _bodies(meshes: Sequence[Any]) -> list[Part]:
    stops = np.cumsum([len(mesh.X) for mesh in meshes])
    return [Part(f"body {k}", int(e) - len(m.X), int(e), m) for k, (m, e) in enumerate(zip(meshes, stops))]


class Surface:
    """The drawn surfaces of all parts as one mesh whose points are doubled along creases.

    Attributes:
        triangles: (m, 3) indices of its points.
        source: (n,) the drawn point that each point is a copy of.
        owner: (n,) the part of each point; colliders come after the bodies.
        n_bodies: How many bodies there are.
        edge: Median length of its edges at rest [m].
    """

    def __init__(self, motion: Motion) -> None:
        self.parts, self.n_bodies = motion.parts, len(motion.bodies)
        points, triangles, owner = drawn(self.parts, motion.rest())
        self.source, self.triangles = creased(points, triangles)
        self.owner = owner[self.source]
        mine = triangles[owner[triangles[:, 0]] < self.n_bodies]
        self.edge = float(np.median(np.linalg.norm(points[mine] - points[mine[:, [1, 2, 0]]], axis=2)))

    def points(self, x: np.ndarray) -> np.ndarray:
        """Points (n, 3) float32 when the parts are at x (n_vert, 3); what is not finite is drawn at the origin."""
        return np.nan_to_num(self.carried(x), nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)

    def carried(self, values: np.ndarray) -> np.ndarray:
        """Values (n, 3) at the points, of values (n_vert, 3) at the vertices of the parts."""
        return drawn(self.parts, values)[0][self.source]

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Unit normals (n, 3) float32 at points (n, 3), the means of those of the triangles around, by area."""
        face = triangle_areas(points, self.triangles)
        corner = self.triangles.ravel()
        sums = [np.bincount(corner, np.repeat(face[:, i], 3), len(points)) for i in range(3)]
        normal = np.stack(sums, axis=1)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        return (normal / np.where(length > 0, length, 1)).astype(np.float32)


def creased(points: np.ndarray, triangles: np.ndarray, angle: float = CREASE) -> tuple[np.ndarray, np.ndarray]:
    """Cut a surface open along the edges where its normal turns by more than ``angle`` [degrees].

    Returns ``source`` (n,), the point that each new point is a copy of, and the triangles (m, 3) of new points.
    """
    normal = triangle_areas(points, triangles)
    length = np.linalg.norm(normal, axis=1)
    normal /= np.where(length > 0, length, 1)[:, None]
    # Half-edge 3 t + c of triangle t runs from its corner c to the next; the other half has the same pair of points.
    start, end = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    same = (low[order[1:]] == low[order[:-1]]) & (high[order[1:]] == high[order[:-1]])
    a, b = order[:-1][same], order[1:][same]
    # A degenerate triangle has no normal to disagree with.
    flat = (length[a // 3] == 0) | (length[b // 3] == 0)
    turn = np.einsum("ei,ei->e", normal[a // 3], normal[b // 3])
    smooth = flat | (turn > np.cos(np.radians(angle)))
    a, b = a[smooth], b[smooth]
    # Corners at the same point on both sides of a smooth edge are one point.
    turned = start[a] == start[b]  # the triangles run around in opposite directions
    a_next, b_next = a // 3 * 3 + (a + 1) % 3, b // 3 * 3 + (b + 1) % 3
    pairs = np.concatenate(
        [np.stack([a, np.where(turned, b, b_next)], 1), np.stack([a_next, np.where(turned, b_next, b)], 1)]
    )
    n = triangles.size
    links = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    count, label = connected_components(links, directed=False)
    source = np.empty(count, np.int64)
    source[label] = triangles.ravel()
    return source, label.reshape(-1, 3).astype(np.int64)
