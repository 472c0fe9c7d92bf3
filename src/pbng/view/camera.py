"""Where the camera stands: once for a whole motion, so that all of it is in the picture and nothing jumps."""

from dataclasses import dataclass, field, replace

import numpy as np

from pbng.checks import checked_vector
from pbng.errors import InputError
from pbng.view.surface import Motion, Surface, springs_of

VIEW_ANGLE = 18.0  # [degrees] from the bottom to the top of the picture: a long lens, for calm perspective
# Of the size of what the bodies sweep: a collider that reaches no farther from them is in the picture, and of others,
# such as a large ground, what is that near.
FAR, NEAR = 1.5, 0.5

Margins = tuple[float, float, float, float]  # left, right, bottom, top


@dataclass(frozen=True, eq=False)
class Extent:
    """What a motion sweeps: the outermost points (n, 3) [m] of it over all frames.

    Attributes:
        points: Those of the bodies, followed by those of colliders, the ends of weak constraints, and others.
        n_bodies, n_surface: How many are of the bodies, and of these and colliders; None for all.
        shadows: Where shadows fall, (k, 3) [m]: in the picture too, but nearer to its edge than the points.
    """

    points: np.ndarray
    n_bodies: int | None = None
    n_surface: int | None = None
    shadows: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

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


def checked_angles(azimuth: float, elevation: float) -> tuple[float, float]:
    """The two angles [degrees] of a camera; InputError if they are none."""
    azimuth, elevation = checked_vector("azimuth and elevation", (azimuth, elevation), 2)
    if abs(elevation) > 90:
        raise InputError(f"elevation must lie between -90 and 90 degrees, not {elevation:g}")
    return azimuth, elevation


def framed(
    extent: Extent,
    aspect: float,
    *,
    azimuth: float = 28.0,
    elevation: float = 20.0,
    margins: Margins = (0.08, 0.08, 0.08, 0.08),
    shadow_margins: Margins = (0.08, 0.08, 0.08, 0.08),
) -> Camera:
    """A camera that sees all of an extent, as near as the margins allow.

    Args:
        extent: What to see.
        aspect: Width of the picture over its height.
        azimuth: Angle [degrees] from the z axis, towards x, at which the camera stands.
        elevation: Angle [degrees] at which it looks down.
        margins: Left, right, bottom and top, as shares of the picture's width or height.
        shadow_margins: The same for shadows.
    """
    a, e = np.radians(azimuth), np.radians(elevation)
    back = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
    right = np.array([np.cos(a), 0.0, -np.sin(a)])
    up = np.cross(back, right)
    half = np.tan(np.radians(VIEW_ANGLE) / 2)
    # The picture is a window in the plane one metre ahead; each edge of it gives a plane that all points lie within.
    across, upward, nearest = [], [], float((extent.points @ -back).min()) - 0.5 * extent.size
    for points, (left_m, right_m, bottom_m, top_m) in ((extent.points, margins), (extent.shadows, shadow_margins)):
        if len(points):
            depth = points @ -back
            across.append(_Between.of(points @ right, depth, *(half * aspect * (1 - 2 * m) for m in (left_m, right_m))))
            upward.append(_Between.of(points @ up, depth, *(half * (1 - 2 * m) for m in (bottom_m, top_m))))
    z = min(_nearest(across), _nearest(upward), nearest)
    position = _place(across, z) * right + _place(upward, z) * up - z * back
    return Camera(position, position - back * extent.size, up)


def facing(extent: Extent, aspect: float, margins: Margins) -> Camera:
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
    ray = np.concatenate([extent.points, extent.shadows]) - camera.position
    depth = ray @ -back
    across, upward = ray @ np.cross(camera.up, back) / depth, ray @ camera.up / depth
    return float(np.ptp(across) / max(np.ptp(upward), 1e-9))


@dataclass(frozen=True)
class _Between:
    """Points between two edges of the picture: they are if the camera, at depth z, is not below ``high z + least``
    nor above ``-low z - most``.
    """

    low: float
    high: float
    least: float
    most: float

    @classmethod
    def of(cls, across: np.ndarray, depth: np.ndarray, low: float, high: float) -> "_Between":
        """Of points at such places and depths (n,), those that are to be seen within slopes -low and high."""
        return cls(low, high, float((across - high * depth).max()), float((-across - low * depth).max()))


def _nearest(groups: list[_Between]) -> float:
    """The greatest depth from which all points of all groups are between their edges."""
    return min(-(a.least + b.most) / (a.high + b.low) for a in groups for b in groups)


def _place(groups: list[_Between], z: float) -> float:
    """From where they are so at a depth: where the first group is in the middle, or as near to it as the others let."""
    least, most = [g.high * z + g.least for g in groups], [-g.low * z - g.most for g in groups]
    return min(max((least[0] + most[0]) / 2, *least), *most)


def _outermost(points: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Those of the points (n, 3) that lie farthest in one of the directions."""
    return points[np.unique((points @ directions.T).argmax(0))]


def _directions(n: int) -> np.ndarray:
    """n unit vectors (n, 3), evenly spread (a Fibonacci spiral), and the six axes."""
    k = np.arange(n) + 0.5
    polar, turn = np.arccos(1 - 2 * k / n), np.pi * (1 + 5**0.5) * k
    spiral = np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
    return np.concatenate([spiral, np.eye(3), -np.eye(3)]).astype(np.float32)
