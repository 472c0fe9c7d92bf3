"""Colliders as pictures and files know them: surfaces that rest, or whose points come with each frame."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pbng.mesh import TriMesh


@dataclass(frozen=True, eq=False)
class ColliderShape:
    """The surface of a collider.

    Attributes:
        name: Its name, or what it is.
        kind: "Plane", "Sphere", "Capsule", "Box", "Kinematic", ...
        moves: Whether it has a motion.
        mesh: Its surface before any motion, triangles outward; of a plane a rectangle, points in order around it.
    """

    name: str
    kind: str
    moves: bool
    mesh: TriMesh


@dataclass(frozen=True, eq=False)
class Part:
    """Something drawn: its mesh and the rows ``x[start:stop]`` of positions that are its vertices'."""

    name: str
    start: int
    stop: int
    mesh: Any


def colliders_of(problem: Any) -> tuple[Any, ...]:
    """The colliders of a problem, which need not know of any."""
    contact = getattr(problem, "contact", None)
    return () if contact is None else contact.colliders


def shapes_of(problem: Any) -> tuple[ColliderShape, ...]:
    """The surfaces of the colliders of a problem."""
    return tuple(
        ColliderShape(str(c.label), type(c).__name__, c.motion is not None, TriMesh(*c.surface(-1.0)))
        for c in colliders_of(problem)
    )


def behind(parts: Sequence[Any], shapes: Sequence[ColliderShape]) -> tuple[Part, ...]:
    """The shapes as further parts: their points follow those of the parts before."""
    start, further = max(part.stop for part in parts), []
    for shape in shapes:
        further.append(Part(shape.name, start, start + shape.mesh.n_vert, shape.mesh))
        start += shape.mesh.n_vert
    return tuple(further)
