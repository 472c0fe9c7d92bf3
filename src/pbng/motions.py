"""Motions of prescribed vertices: affine ones, composed with ``+``, vertex animations and functions of time."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbng.checks import checked_vector
from pbng.errors import InputError


class Motion(ABC):
    """Where prescribed vertices go: ``at(X, center, s, t)`` for the share s in [0, 1] of the motion and time t [s].

    ``end`` is the time [s] at which a motion with a clock of its own has ended.
    """

    end = 0.0

    @abstractmethod
    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        """Positions (n, 3) [m] of vertices whose rest positions are X and whose centroid is ``center``."""

    def __add__(self, other: "Motion") -> "Motion":
        if not isinstance(other, Motion):
            return NotImplemented
        return Sum(self, other)


class Affine(Motion):
    """x = c + L(s) (X - c) + u(s); a sum of affine motions composes the L in order and adds the u.

    A translation is therefore never turned by a rotation that follows: the center moves along.
    """

    def linear(self, s: float) -> np.ndarray:
        """L(s), (3, 3)."""
        return np.eye(3)

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        """u(s), (3,) [m]."""
        return np.zeros(3)

    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        return center + (X - center) @ self.linear(s).T + self.shift(s, center)

    def __add__(self, other: Motion) -> Motion:
        return Composed(self, other) if isinstance(other, Affine) else super().__add__(other)


@dataclass(frozen=True)
class Translate(Affine):
    """Move by ``by`` [m]."""

    by: Sequence[float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "by", checked_vector("Translate", self.by))

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        return s * np.asarray(self.by)


@dataclass(frozen=True)
class Rotate(Affine):
    """Turn by ``turns`` about an axis ("x", "y", "z" or a vector) through the centroid or ``center`` [m]."""

    axis: str | Sequence[float]
    turns: float
    center: Sequence[float] | None = None

    def __post_init__(self) -> None:
        named = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
        if isinstance(self.axis, str) and self.axis not in named:
            raise InputError(f"Rotate: axis must be 'x', 'y', 'z' or a vector, not {self.axis!r}")
        axis = np.array(checked_vector("Rotate", named[self.axis] if isinstance(self.axis, str) else self.axis))
        if not np.linalg.norm(axis) > 0:
            raise InputError("Rotate: the axis has no direction")
        object.__setattr__(self, "axis", tuple(axis / np.linalg.norm(axis)))
        if self.center is not None:
            object.__setattr__(self, "center", checked_vector("Rotate: center", self.center))
        if not math.isfinite(self.turns):
            raise InputError(f"Rotate: turns must be finite, not {self.turns}")

    def linear(self, s: float) -> np.ndarray:
        k, angle = np.asarray(self.axis), 2 * np.pi * self.turns * s
        K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        return _about(self.center, center, self.linear(s))


@dataclass(frozen=True)
class Scale(Affine):
    """Scale by a factor, or one an axis, about the centroid or ``center`` [m]."""

    by: float | Sequence[float]
    center: Sequence[float] | None = None

    def __post_init__(self) -> None:
        factors = (float(self.by),) * 3 if np.isscalar(self.by) else self.by  # type: ignore[arg-type]
        object.__setattr__(self, "by", checked_vector("Scale", factors))
        if self.center is not None:
            object.__setattr__(self, "center", checked_vector("Scale: center", self.center))

    def linear(self, s: float) -> np.ndarray:
        return np.diag(1 + s * (np.asarray(self.by) - 1))

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        return _about(self.center, center, self.linear(s))


@dataclass(frozen=True)
class Composed(Affine):
    """``first``, then ``second``, progressing together."""

    first: Affine
    second: Affine

    def linear(self, s: float) -> np.ndarray:
        return self.second.linear(s) @ self.first.linear(s)

    def shift(self, s: float, center: np.ndarray) -> np.ndarray:
        return self.first.shift(s, center) + self.second.shift(s, center)


@dataclass(frozen=True)
class Sum(Motion):
    """The displacements of two motions added: for animations and functions, which have no linear part to compose."""

    first: Motion
    second: Motion

    @property
    def end(self) -> float:  # type: ignore[override]
        return max(self.first.end, self.second.end)

    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        return self.first.at(X, center, s, t) + self.second.at(X, center, s, t) - X


@dataclass(frozen=True, eq=False)
class Animation(Motion):
    """A vertex animation: positions [m] (n_time, n, 3) at rising times [s] (n_time,), linear between, held outside."""

    times: np.ndarray
    positions: np.ndarray

    def __post_init__(self) -> None:
        times, positions = np.asarray(self.times, float), np.asarray(self.positions, float)
        if times.ndim != 1 or positions.ndim != 3 or positions.shape[0] != len(times) or positions.shape[2] != 3:
            raise InputError(f"Animation: {times.shape} times do not fit positions of shape {positions.shape}")
        if len(times) == 0 or np.any(np.diff(times) <= 0):
            raise InputError("Animation: times must rise, and there must be one at least")
        if not (np.isfinite(times).all() and np.isfinite(positions).all()):
            raise InputError("Animation: times and positions must be finite")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "end", float(times[-1]))
        object.__setattr__(self, "positions", positions)

    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        if self.positions.shape[1] != len(X):
            raise InputError(f"Animation has {self.positions.shape[1]} vertices, the selection {len(X)}")
        k = int(np.clip(np.searchsorted(self.times, t) - 1, 0, max(len(self.times) - 2, 0)))
        if len(self.times) == 1:
            return self.positions[0].copy()
        w = float(np.clip((t - self.times[k]) / (self.times[k + 1] - self.times[k]), 0, 1))
        return (1 - w) * self.positions[k] + w * self.positions[k + 1]


@dataclass(frozen=True, eq=False)
class Function(Motion):
    """Positions as a function ``positions(t, X) -> (n, 3)`` of time [s] and rest positions [m]."""

    positions: Callable[[float, np.ndarray], np.ndarray]

    def at(self, X: np.ndarray, center: np.ndarray, s: float, t: float) -> np.ndarray:
        x = np.asarray(self.positions(t, X.copy()), float)
        if x.shape != X.shape or not np.isfinite(x).all():
            name = getattr(self.positions, "__name__", "function")
            raise InputError(f"motion {name}(t={t:g}) must return finite positions of shape {X.shape}, not {x.shape}")
        return x


def as_motion(motion: Any) -> Motion:
    """A motion, or a callable as a :class:`Function`."""
    if isinstance(motion, Motion):
        return motion
    if callable(motion):
        return Function(motion)
    raise InputError(f"expected a motion (Rotate, Translate, ...) or a function of (t, X), not {motion!r}")


def _about(own: Sequence[float] | None, center: np.ndarray, L: np.ndarray) -> np.ndarray:
    """The shift that makes L act about ``own`` instead of ``center``."""
    return np.zeros(3) if own is None else (np.eye(3) - L) @ (np.asarray(own, float) - center)
