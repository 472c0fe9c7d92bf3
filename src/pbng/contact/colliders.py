"""Colliders with a formula: planes, balls, capsules, boxes; and open containers made of planes."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pbng.checks import checked_number, checked_vector
from pbng.contact.collider import Collider, Touches, is_rigid
from pbng.contact.touching import BOX, NUMBERS, PLANE, ROUND, Shapes, distances
from pbng.errors import InputError
from pbng.motions import Affine


@dataclass(frozen=True, eq=False)
class Shape(Collider):
    """A collider with a formula, by numbers that :mod:`pbng.contact.touching` knows for its ``kind``."""

    kind = -1  # PLANE, ROUND or BOX; no field, for it is not to be chosen

    @abstractmethod
    def _numbers(self) -> list[float]:
        """The numbers, up to ``NUMBERS``, as many as there are."""

    @cached_property
    def numbers(self) -> np.ndarray:
        """The numbers, (NUMBERS,)."""
        numbers = np.zeros(NUMBERS)
        given = self._numbers()
        numbers[: len(given)] = given
        return numbers

    @cached_property
    def _alone(self) -> Shapes:
        return Shapes([self])

    def distance(self, points: np.ndarray, t: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return distances(self.kind, self.numbers, self._pose(t), points)

    def touch(self, before: np.ndarray, after: np.ndarray, t0: float, t1: float, reach: Any = 0.0) -> Touches:
        return self._alone.touch(before, after, t0, t1, reach)[1]


@dataclass(frozen=True, eq=False)
class Plane(Shape):
    """The half-space behind a plane: points are kept on the side that the normal points to.

    Args:
        point: A point of the plane [m], (3,); rotations turn about it.
        normal: Outward normal of any length, (3,).
        size: Edges [m] of the rectangle that is drawn, or one for a square.
    """

    point: Sequence[float]
    normal: Sequence[float]
    size: float | Sequence[float] = 4.0
    kind = PLANE

    def __post_init__(self) -> None:
        self._set("point", checked_vector(f"{self.label}: point", self.point))
        n = np.array(checked_vector(f"{self.label}: normal", self.normal))
        n /= np.abs(n).max() or 1.0  # its square may under- or overflow
        if not n.any():
            raise InputError(f"{self.label}: the normal has no direction: it is zero")
        self._set("normal", tuple((n / np.linalg.norm(n)).tolist()))
        sizes = (self.size, self.size) if np.isscalar(self.size) else tuple(self.size)  # type: ignore[arg-type]
        if len(sizes) != 2:
            raise InputError(f"{self.label}: size must be one or two numbers, not {self.size}")
        self._set("size", tuple(checked_number(f"{self.label}: size", s) for s in sizes))
        super().__post_init__()

    @property
    def _center(self) -> np.ndarray:
        return np.array(self.point)

    def _numbers(self) -> list[float]:
        return [*self.normal, float(self._center @ self.normal)]

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        (u, v), (a, b) = _across(np.array(self.normal)), np.asarray(self.size) / 2
        corners = [self._center + i * a * u + j * b * v for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]], np.int32)


@dataclass(frozen=True, eq=False)
class Sphere(Shape):
    """A ball: ``center`` [m], (3,), and ``radius`` [m]."""

    center: Sequence[float]
    radius: float
    kind = ROUND

    def __post_init__(self) -> None:
        self._set("center", checked_vector(f"{self.label}: center", self.center))
        self._set("radius", checked_number(f"{self.label}: radius", self.radius))
        super().__post_init__()

    @property
    def _center(self) -> np.ndarray:
        return np.array(self.center)

    def _numbers(self) -> list[float]:
        return [*self.center, 0.0, 0.0, 0.0, self.radius, 0.0, 1.0, 0.0]

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        points, triangles = _capsule_mesh(0.0, self.radius)
        return points + self._center, triangles


@dataclass(frozen=True, eq=False)
class Capsule(Shape):
    """All within ``radius`` [m] of the segment from ``a`` to ``b`` [m], (3,) each; rotations turn about its middle."""

    a: Sequence[float]
    b: Sequence[float]
    radius: float
    kind = ROUND

    def __post_init__(self) -> None:
        self._set("a", checked_vector(f"{self.label}: a", self.a))
        self._set("b", checked_vector(f"{self.label}: b", self.b))
        self._set("radius", checked_number(f"{self.label}: radius", self.radius))
        if self.a == self.b:
            raise InputError(f"{self.label}: a and b are the same point {self.a}; use a Sphere")
        super().__post_init__()

    @property
    def _center(self) -> np.ndarray:
        return (np.array(self.a) + np.array(self.b)) / 2

    def _numbers(self) -> list[float]:
        axis = np.array(self.b) - np.array(self.a)
        return [*self.a, *axis, self.radius, *_across(axis / np.linalg.norm(axis))[0]]

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        axis = np.array(self.b) - np.array(self.a)
        length = float(np.linalg.norm(axis))
        points, triangles = _capsule_mesh(length / 2, self.radius)
        u, v = _across(axis / length)
        return self._center + points @ np.array([u, v, axis / length]), triangles


@dataclass(frozen=True, eq=False)
class Box(Shape):
    """A solid box from ``low`` to ``high`` [m], (3,) each, along the axes at rest."""

    low: Sequence[float]
    high: Sequence[float]
    kind = BOX

    def __post_init__(self) -> None:
        low, high = _corners(self.label, self.low, self.high)
        self._set("low", low)
        self._set("high", high)
        super().__post_init__()

    @property
    def _center(self) -> np.ndarray:
        return (np.array(self.low) + np.array(self.high)) / 2

    def _numbers(self) -> list[float]:
        return [*self.low, *self.high]

    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        corner = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
        quads = np.array([[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]], np.int32)
        points = np.where(corner == 1, self.high, self.low)
        return points[quads].reshape(-1, 3), (
            4 * np.arange(6, dtype=np.int32)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        ).reshape(-1, 3)


@dataclass(frozen=True)
class _About(Affine):
    """A motion of a body whose centroid is taken to be ``center``: of the parts of a whole."""

    motion: Affine
    center: tuple[float, ...]

    def linear(self, s: float) -> np.ndarray:
        return self.motion.linear(s)

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        c = np.array(self.center)
        return (np.eye(3) - self.linear(s)) @ (c - center) + self.motion.shift(s, c)


def container(low: Sequence[float], high: Sequence[float], open_top: bool = True, **options: Any) -> list[Plane]:
    """Planes that keep bodies inside the box from low to high [m]: floor, four walls and, unless open, a lid (y is up).

    The options are those of a collider; its motion takes the whole along, about its middle.
    """
    name = str(options.pop("name", None) or "container")
    bounds = _corners(name, low, high)
    middle = tuple(((np.array(bounds[0]) + bounds[1]) / 2).tolist())
    size = np.subtract(bounds[1], bounds[0])
    if options.get("motion") is not None:
        if not is_rigid(options["motion"]):
            raise InputError(f"{name}: its motion must be rigid: Rotate, Translate and sums, not {options['motion']!r}")
        options["motion"] = _About(options["motion"], middle)
    faces = {"floor": (1, 0), "low x": (0, 0), "high x": (0, 1), "low z": (2, 0), "high z": (2, 1), "lid": (1, 1)}
    planes = []
    for face, (axis, side) in faces.items():
        if face == "lid" and open_top:
            continue
        point, normal = list(middle), [0.0, 0.0, 0.0]
        point[axis], normal[axis] = bounds[side][axis], 1.0 - 2.0 * side
        planes.append(Plane(point, normal, tuple(np.delete(size, axis)), name=f"{name}: {face}", **options))
    return planes


def _across(n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that make a right-handed frame with the unit vector n; of a coordinate axis, the others."""
    u = np.eye(3)[int(np.abs(n).argmin())]
    u = u - (u @ n) * n
    u /= np.linalg.norm(u)
    return u, np.cross(n, u)


def _capsule_mesh(half: float, radius: float, around: int = 48, rings: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """A capsule along z about the origin: a quarter circle has ``rings`` rings; without length a sphere."""
    angle = np.linspace(-np.pi / 2, 0, rings + 1)[1:]
    upper = angle[::-1] if half > 0 else angle[-2::-1]  # one equator is enough for a sphere
    z = np.concatenate([radius * np.sin(angle) - half, half - radius * np.sin(upper)])
    r = radius * np.concatenate([np.cos(angle), np.cos(upper)])
    turn = 2 * np.pi * np.arange(around) / around
    wall = np.stack([np.outer(r, np.cos(turn)), np.outer(r, np.sin(turn)), np.tile(z[:, None], around)], -1)
    tip = half + radius
    points = np.concatenate([wall.reshape(-1, 3), [[0, 0, -tip], [0, 0, tip]]])
    i, n = np.arange(around), len(z)
    j = (i + 1) % around
    low, high = np.full(around, n * around), np.full(around, n * around + 1)
    parts = [np.stack([low, j, i], 1), np.stack([high, (n - 1) * around + i, (n - 1) * around + j], 1)]
    for k in range(n - 1):
        a, b, c, d = k * around + i, k * around + j, (k + 1) * around + j, (k + 1) * around + i
        parts += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    return points, np.concatenate(parts).astype(np.int32)


def _corners(label: str, low: Any, high: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    low, high = checked_vector(f"{label}: low", low), checked_vector(f"{label}: high", high)
    for axis, a, b in zip("xyz", low, high):
        if not a < b:
            raise InputError(f"{label}: low must be below high along each axis; along {axis} it is {a} and {b}")
    return low, high
