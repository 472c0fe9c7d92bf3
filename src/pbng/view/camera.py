"""Where the camera stands: once for a whole motion, so that all of it is in the picture and nothing jumps."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pbng.view.surface import Motion, Surface, springs_of

VIEW_ANGLE = 18.0  # [degrees] from the bottom to the top of the picture: a long lens, for calm perspective
# Of the size of what the bodies sweep: a collider that reaches no farther from them is in the picture, and of others,
# such as a large ground, what is that near.
FAR, NEAR = 1.5, 0.5


@dataclass(frozen=True, eq=False)
class Extent:
    """What a motion sweeps: the outermost points (n, 3) [m] of it over all frames.

    Attributes:
        points: Those of the bodies, followed by those of colliders, the ends of weak constraints, and others.
        n_bodies, n_surface: How many are of the bodies, and of these and colliders; None for all.
    """

    points: np.ndarray
    n_bodies: int | None = None
    n_surface: int | None = None

    @classmethod
    def of(cls, motion: Motion, surface: Surface) -> "Extent":
        """Looks through all frames once. Of colliders, what is far from the bodies does not count."""
        directions = _directions(96)
        own = surface.owner < surface.n_bodies
        places = [np.flatnonzero(own), *(np.flatnonzero(surface.owner == k) for k in np.unique(surface.owner[~own]))]
        swept: list[list[np.ndarray]] = [[] for _ in places]  # of the bodies, and of each collider
        ends = [np.empty((0, 3))]
        for k in range(len(motion)):
            frame = motion.frames[k]
            points = surface.points(motion.placed(frame))
            for part, index in zip(swept, places):
                part.append(_outermost(points[index], directions))
            springs = springs_of(frame).astype(np.float32)
            springs = springs[np.isfinite(springs).all((1, 2))].reshape(-1, 3)
            if len(springs):
                ends.append(_outermost(springs, directions))
        bodies, *solids = (np.concatenate(part).astype(np.float64) for part in swept)
        extent = cls(bodies)
        solids = [extent.around(points) for points in solids]
        n_surface = len(bodies) + sum(len(points) for points in solids)
        return cls(np.concatenate([bodies, *solids, *ends]).astype(np.float64), len(bodies), n_surface)

    def around(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) of a collider: as they are if none is far, else moved to what is near."""
        off = np.maximum(self.low - points, points - self.high).max()
        room = (FAR if off <= FAR * self.size else NEAR) * self.size
        return np.clip(points, self.low - room, self.high + room)

    @property
    def bodies(self) -> "Extent":
        """What the bodies alone sweep."""
        return Extent(self.points[: self.n_bodies])

    @property
    def surface(self) -> "Extent":
        """What bodies and colliders sweep."""
        return Extent(self.points[: self.n_surface])

    def joined(self, points: np.ndarray) -> "Extent":
        """With further points (k, 3) [m]."""
        return replace(self, points=np.concatenate([self.points, points]))

    @property
    def low(self) -> np.ndarray:
        return self.points.min(0)

    @property
    def high(self) -> np.ndarray:
        return self.points.max(0)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box [m], never zero."""
        return float(np.linalg.norm(self.high - self.low)) or 1.0


@dataclass(frozen=True)
class Camera:
    """A camera at ``position`` that looks at ``focus``, up being ``up``; ``parallel`` is half the height [m] of what
    it sees if it has no perspective, else None.
    """

    position: np.ndarray
    focus: np.ndarray
    up: np.ndarray
    parallel: float | None = None

    @property
    def frame(self) -> np.ndarray:
        """Its right, up and back as rows (3, 3)."""
        back = self.position - self.focus
        back = back / np.linalg.norm(back)
        return np.stack([np.cross(self.up, back), self.up, back])

    def seen(self, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Column and row [pixels] in a picture of the size, and depth [m] along the camera's axis, of points (n, 3)."""
        right, up, back = ((points - self.position) @ self.frame.T).T
        half = np.full_like(back, self.parallel) if self.parallel else -back * np.tan(np.radians(VIEW_ANGLE) / 2)
        with np.errstate(divide="ignore", invalid="ignore"):  # of what is beside the camera
            column, row = size[0] + size[1] * right / half, size[1] - size[1] * up / half
        return np.stack([column / 2, row / 2, -back], axis=1)


def framed(
    extent: Extent,
    aspect: float,
    *,
    azimuth: float = 28.0,
    elevation: float = 20.0,
    margins: tuple[float, float, float, float] = (0.08, 0.08, 0.08, 0.08),
) -> Camera:
    """A camera that sees all of an extent, as near as the margins allow.

    Args:
        extent: What to see.
        aspect: Width of the picture over its height.
        azimuth: Angle [degrees] from the z axis, towards x, at which the camera stands.
        elevation: Angle [degrees] at which it looks down.
        margins: Left, right, bottom and top, as shares of the picture's width or height.
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    up = np.cross(back, right)
    half = np.tan(np.radians(VIEW_ANGLE) / 2)
    left_m, right_m, bottom_m, top_m = margins
    side, depth, height = extent.points @ right, extent.points @ -back, extent.points @ up
    # The picture is a window in the plane one metre ahead; each edge of it gives a plane that all points lie within.
    x, near_x = _between(side, depth, half * aspect * (1 - 2 * left_m), half * aspect * (1 - 2 * right_m))
    y, near_y = _between(height, depth, half * (1 - 2 * bottom_m), half * (1 - 2 * top_m))
    z = min(near_x, near_y, float(depth.min()) - 0.5 * extent.size)
    position = x(z) * right + y(z) * up - z * back
    return Camera(position, position - back * extent.size, up)


def facing(extent: Extent, aspect: float, margins: tuple[float, float, float, float]) -> Camera:
    """A camera without perspective that looks at the x-y plane, for plane meshes."""
    left, right, bottom, top = margins
    size = np.maximum((extent.high - extent.low)[:2], 1e-9 * extent.size)
    scale = max(size[0] / aspect / (1 - left - right), size[1] / (1 - bottom - top))  # height of the picture
    centre = (extent.low + extent.high) / 2
    centre[0] += (right - left) / 2 * scale * aspect
    centre[1] += (top - bottom) / 2 * scale
    return Camera(centre + np.array([0.0, 0.0, 3 * extent.size]), centre, np.array([0.0, 1.0, 0.0]), scale / 2)


def projected_aspect(extent: Extent, azimuth: float, elevation: float) -> float:
    """Width over height of what a motion covers in a picture by :func:`framed`."""
    camera = framed(extent, 1.0, azimuth=azimuth, elevation=elevation)
    back = (camera.position - camera.focus) / extent.size
    ray = extent.points - camera.position
    depth = ray @ -back
    across, upward = ray @ np.cross(camera.up, back) / depth, ray @ camera.up / depth
    return float(np.ptp(across) / max(np.ptp(upward), 1e-9))


def _between(across: np.ndarray, depth: np.ndarray, low: float, high: float) -> tuple[Callable[[float], float], float]:
    """The greatest depth from which all points are within slopes -low and high, and the middle place at a depth."""
    beyond_high, beyond_low = (across - high * depth).max(), (-across - low * depth).max()
    nearest = -(beyond_high + beyond_low) / (high + low)
    return lambda z: (beyond_high + high * z - beyond_low - low * z) / 2, float(nearest)


def _outermost(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Those of the points (n, 3) that lie farthest in one of the directions."""
    return points[np.unique((points @ directions.T).argmax(0))]


def _directions(n: int) -> np.ndarray:
    """n unit vectors (n, 3), evenly spread (a Fibonacci spiral), and the six axes."""
    k = np.arange(n) + 0.5
    polar, turn = np.arccos(1 - 2 * k / n), np.pi * (1 + 5**0.5) * k
    spiral = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    return np.concatenate([spiral, np.eye(3), -np.eye(3)]).astype(np.float32)
