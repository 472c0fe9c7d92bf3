"""Colliders: bodies that do not deform, or as prescribed, and that soft bodies collide with (section 7.2).

A collider answers where its surface is (:meth:`Collider.distance`) and which half-spaces moving points have to respect
in a step (:meth:`Collider.touch`). Shapes are in ``colliders.py`` and ``touching.py``, meshes in ``kinematic.py``.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from pbng.checks import checked_number
from pbng.errors import InputError
from pbng.motions import Affine, Motion, as_motion

PIECE = 0.1  # largest angle [rad] a body turns by in one straight piece of the paths that points take relative to it
PIECES = 64
ON_SURFACE = 1e-9  # of the length of a path: what counts as having arrived

Pose = tuple[np.ndarray, np.ndarray]  # R (3, 3) and p (3,) of x = R X + p


class Touches(NamedTuple):
    """Half-spaces ``{x: (x - point) · normal >= 0}`` that points have to respect at the end of a step.

    Attributes:
        vertex: Which point, (j,) int64; of one collider rising, and none twice.
        point: A point of the bounding plane at the end of the step [m], (j, 3): on the surface, plus the thickness.
        normal: Unit normals at the end of the step, away from the collider, (j, 3).
    """

    vertex: np.ndarray
    point: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Collider(ABC):
    """What all colliders share.

    Args:
        thickness: How far outside of the surface vertices are kept [m].
        friction: Coefficient of Coulomb friction.
        motion: A :class:`pbng.Motion`; without one the collider rests. Rotations act about its center.
        over: Seconds [s] in which the motion is carried out at a steady rate; 0 at once.
        start: Time [s] at which it begins.
        name: Shown in reports.

    Raises:
        InputError: A value cannot be used, or the motion is not rigid.
    """

    thickness: float = 0.0
    friction: float = 0.0
    motion: Motion | None = None
    over: float = 0.0
    start: float = 0.0
    name: str | None = None

    def __post_init__(self) -> None:
        for what in ("thickness", "friction", "over", "start"):
            self._set(what, checked_number(f"{self.label}: {what}", getattr(self, what), positive=False))
        if self.motion is not None:
            self._set("motion", as_motion(self.motion))
            self._check_motion()

    def _set(self, what: str, value: Any) -> None:
        object.__setattr__(self, what, value)

    def _check_motion(self) -> None:
        if not is_rigid(self.motion):
            raise InputError(
                f"{self.label}: its motion must be rigid: Rotate, Translate and sums of them, not {self.motion!r};"
                " make what deforms a Kinematic mesh"
            )

    @property
    def label(self) -> str:
        """The name, or what it is."""
        return self.name if self.name is not None else type(self).__name__

    @property
    def end(self) -> float:
        """Time [s] at which the motion has ended."""
        return 0.0 if self.motion is None else max(self.start + self.over, self.motion.end)

    @property
    @abstractmethod
    def _center(self) -> np.ndarray:
        """What rotations turn about, at rest [m], (3,)."""

    @abstractmethod
    def _drawn(self) -> tuple[np.ndarray, np.ndarray]:
        """Points and outward triangles of the surface at rest."""

    def share(self, t: float) -> float:
        """How much of the motion is done at time t [s], in [0, 1]."""
        if self.motion is None or t < self.start:
            return 0.0
        return 1.0 if self.over == 0 else min((t - self.start) / self.over, 1.0)

    def _pose(self, t: float) -> Pose | None:
        return None if self.motion is None or t < self.start else self._pose_at(self.share(t))

    def _pose_at(self, s: float) -> Pose:
        assert isinstance(self.motion, Affine)
        R, c = self.motion.linear(s), self._center
        return R, c - R @ c + self.motion.shift(s, c)

    @abstractmethod
    def distance(self, points: np.ndarray, t: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Where points (k, 3) [m] are at time t [s]; the thickness does not count.

        Returns the signed distance [m] (k,), negative inside, the closest point of the surface (k, 3) and the unit
        outward normal there (k, 3), which is the gradient of the distance.
        """

    @abstractmethod
    def touch(self, before: np.ndarray, after: np.ndarray, t0: float, t1: float, reach: Any = 0.0) -> Touches:
        """What points have to respect at t1 that move from ``before`` at t0 to ``after`` (predicted) at t1 [s].

        Each point's path is looked at from the collider, where it is straight but for rotations, which cut it in
        pieces. A point that

        - starts inside is held by the closest point of the surface: it is projected out;
        - runs into the surface is held where it first does, on the side that it comes from, however thin the collider;
        - ends or starts near, is held by the point that is closest in the end.

        Args:
            before, after: Positions [m], (k, 3).
            t0, t1: Beginning and end of the step [s].
            reach: How near to the thickened surface counts as near [m], one for all or (k,).
        """

    def carried(self, points: np.ndarray, t0: float, t1: float) -> np.ndarray:
        """How far the collider's material at points (k, 3) at time t1 has moved since t0 [m], (k, 3)."""
        return points - to_world(self._pose(t0), to_body(self._pose(t1), points))

    def poses(self, t0: float, t1: float) -> list[Pose | None]:
        """Poses at t0, perhaps between, and at t1: at even shares of the motion; the same one twice if it rests."""
        if self.motion is None:
            return [None, None]
        first, last = self._pose(t0), self._pose(t1)
        s0, s1 = self.share(t0), self.share(t1)
        if last is None or (first is not None and s0 == s1):
            return [first, first]
        angle = abs(s1 - s0) * turn_rate(self.motion, s0, s1)
        n = int(min(max(math.ceil(angle / PIECE), 1), PIECES))
        between: list[Pose | None] = [self._pose_at(s0 + (s1 - s0) * j / n) for j in range(1, n)]
        return [first, *between, last]

    @cached_property
    def _at_rest(self) -> tuple[np.ndarray, np.ndarray]:
        return self._drawn()

    def surface(self, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Points (n, 3) [m] and outward triangles (m, 3) for pictures at time t [s]."""
        points, triangles = self._at_rest
        return to_world(self._pose(t), points), triangles


def is_rigid(motion: Any) -> bool:
    """Whether a motion is affine and turns and shifts only."""
    if not isinstance(motion, Affine):
        return False
    turns = [motion.linear(s) for s in (0.0, 0.3, 0.7, 1.0)]
    return all(np.abs(R @ R.T - np.eye(3)).max() < 1e-9 and np.linalg.det(R) > 0 for R in turns)


def turn_rate(motion: Any, s0: float, s1: float) -> float:
    """Upper end [rad] of the rates at which a rigid motion turns between shares s0 and s1 of it, from differences."""
    h = 1e-4
    starts = [min(max(s, 0.0), 1.0 - h) for s in (s0, (s0 + s1) / 2, s1)]
    change = [motion.linear(s + h) @ motion.linear(s).T - np.eye(3) for s in starts]
    return max(float(np.linalg.norm(R)) for R in change) / (math.sqrt(2) * h)


def to_body(pose: Pose | None, x: np.ndarray) -> np.ndarray:
    """World to body frame; no pose is that of rest."""
    return x if pose is None else (x - pose[1]) @ pose[0]


def to_world(pose: Pose | None, X: np.ndarray) -> np.ndarray:
    """Body frame to world."""
    return X if pose is None else X @ pose[0].T + pose[1]


def turned(pose: Pose | None, N: np.ndarray) -> np.ndarray:
    """Directions of the body frame in the world."""
    return N if pose is None else N @ pose[0].T


def dots(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dot products (k,) of vectors (k, 3)."""
    products = a * b
    return products[:, 0] + products[:, 1] + products[:, 2]  # a fraction of the time of a sum over the axis


def norms(v: np.ndarray) -> np.ndarray:
    """Lengths (k,) of vectors (k, 3)."""
    return np.sqrt(dots(v, v))
