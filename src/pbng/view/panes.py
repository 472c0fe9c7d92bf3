"""Planes that bodies run into, as panes of glass: cut to what is near the bodies, and never in the way of the view.

The level plane that all stands on is the floor of the stage instead.
"""

from typing import Any

import numpy as np

from pbng.view.camera import Camera, Extent
from pbng.view.surface import Motion

TINT = (128, 158, 184)
LINE = (104, 122, 142)
LINE_OPACITY, LINE_WIDTH = 0.6, 1.5  # [pixels of a picture 720 high]
BEFORE, BEHIND = 0.05, 0.15  # opacities of a pane seen through, and of one that the bodies stand before
# Of the size of a scene: how far from it a pane may reach to be drawn whole, and how far others are drawn.
FAR, NEAR = 0.6, 0.22
SHARE = 0.25  # of a pane or of the bodies beside it: less than that, and its place is no hint where to draw it
LEVEL = 0.9995  # least upward part of a floor's normal
SINK, DROP = 0.05, 0.5  # of the size of a scene: how far bodies may be below a floor, or above it
APART = 2e-3  # of the size of a scene: kept between panes and what touches them, or the two would mix


class Panes:
    """Panes of the planes of a motion: ``panes(frame)`` are their corners (k, 4, 3) [m], in order around each.

    Args:
        motion: The run.
        extent: What it sweeps.

    Attributes:
        floor: Height [m] of the level plane that the bodies stand on, or None.
        swept: Corners of the panes over all frames, (n, 3) [m].

    ``len(panes)`` is how many there are.
    """

    def __init__(self, motion: Motion, extent: Extent) -> None:
        self.motion, self.size = motion, extent.bodies.size
        moving = any(motion.colliders[k].moves for k in motion.planes)
        frames = range(len(motion) if moving else 1)
        every = np.array([self._rectangles(motion.frames[i]) for i in frames]).reshape(len(frames), -1, 4, 3)
        self.floor, ground = self._floor(every, extent.bodies)
        self.index, self.cut = [], []
        for k in range(every.shape[1]):
            corners = self._near(every[:, k], extent.points)
            if corners is not None:
                self.index.append(k)
                self.cut.append(corners)
        if ground in self.index and not self._walled(every[0], ground):
            del self.cut[self.index.index(ground)], self.index[self.index.index(ground)]
        self.swept = np.concatenate([self._panes(rectangles).reshape(-1, 3) for rectangles in every])

    def __call__(self, frame: Any) -> np.ndarray:
        return self._panes(self._rectangles(frame)) if self.index else np.empty((0, 4, 3))

    def _rectangles(self, frame: Any) -> np.ndarray:
        points = self.motion.collider_points(frame) if self.motion.planes else ()
        return np.array([points[k] for k in self.motion.planes], np.float64).reshape(-1, 4, 3)

    def _panes(self, rectangles: np.ndarray) -> np.ndarray:
        return np.array([_at(rectangles[k], cut) for k, cut in zip(self.index, self.cut)]).reshape(-1, 4, 3)

    def __len__(self) -> int:
        return len(self.index)

    def glass(self, panes: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """What to draw of panes (k, 4, 3) [m]: these, moved back a little, and colours and opacities (k, 4) uint8."""
        back = camera.frame[2]
        quads, tints = np.empty_like(panes), np.empty((len(panes), 4), np.uint8)
        for k, pane in enumerate(panes):
            n = normal(pane)
            quads[k] = pane - APART * self.size * n
            towards = back if camera.parallel else camera.position - pane.mean(0)
            tints[k] = *TINT, round(255 * (BEFORE if n @ towards < 0 else BEHIND))
        return quads, tints

    def _floor(self, every: np.ndarray, bodies: Extent) -> tuple[float | None, int | None]:
        """Height of the highest level plane at rest that the bodies stand on or fall to, and which it is."""
        best: tuple[float | None, int | None] = None, None
        for k in range(every.shape[1]):
            height, low = float(every[0, k, 0, 1]), float(bodies.low[1])
            rests = np.ptp(every[:, k], axis=0).max() == 0
            if rests and normal(every[0, k])[1] > LEVEL and -DROP < (height - low) / self.size < SINK:
                best = max(best, (height, k), key=lambda found: -np.inf if found[0] is None else found[0])
        return best

    def _walled(self, rectangles: np.ndarray, ground: int) -> bool:
        """Whether another pane has a corner in common with the ground's, which is then part of a container."""
        panes = self._panes(rectangles)
        at = self.index.index(ground)
        others = np.delete(panes, at, axis=0).reshape(-1, 1, 3)
        return bool((np.abs(others - panes[at]).max(2) < 1e-6 * self.size).any())

    def _near(self, rectangles: np.ndarray, points: np.ndarray) -> np.ndarray | None:
        """The part of a rectangle (frames, 4, 3) near the points (n, 3), as corners (4, 2) along its edges, or None if
        it is far from all of them.
        """
        low, high = np.full(2, np.inf), np.full(2, -np.inf)
        height = np.inf
        for corners in rectangles:
            edges = corners[[1, 3]] - corners[0]
            off = points - corners[0]
            along = off @ (edges / (edges**2).sum(1, keepdims=True)).T
            low, high = np.minimum(low, along.min(0)), np.maximum(high, along.max(0))
            height = min(height, float((off @ normal(corners)).min()))
        if height > FAR * self.size:
            return None
        unit = self.size / np.linalg.norm(edges, axis=1)
        start, stop = np.maximum(low - NEAR * unit, 0), np.minimum(high + NEAR * unit, 1)
        aside = np.minimum(high, 1) - np.maximum(low, 0) < SHARE * np.minimum(high - low, 1)
        start, stop = np.where(aside, low - NEAR * unit, start), np.where(aside, high + NEAR * unit, stop)
        if (low - FAR * unit <= 0).all() and (high + FAR * unit >= 1).all() and not aside.any():
            start, stop = np.zeros(2), np.ones(2)
        return np.array([start, [stop[0], start[1]], stop, [start[0], stop[1]]])


def normal(rectangle: np.ndarray) -> np.ndarray:
    """Unit normal (3,) of a rectangle (4, 3), on the side where bodies are."""
    n = np.cross(rectangle[1] - rectangle[0], rectangle[3] - rectangle[0])
    return n / np.linalg.norm(n)


def edges(panes: np.ndarray) -> np.ndarray:
    """The edges (m, 2, 3) of panes (k, 4, 3); where two panes meet there is one."""
    ends = np.stack([panes, np.roll(panes, -1, axis=1)], axis=2).reshape(-1, 2, 3)
    places = np.rint(ends / (1e-6 * np.abs(ends).max(initial=1e-9)))
    lower = np.array([b < a for a, b in places.tolist()], bool)
    places[lower] = places[lower, ::-1]
    return ends[np.unique(places.reshape(-1, 6), axis=0, return_index=True)[1]]


def _at(rectangle: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Points (n, 3) at places (n, 2) along the edges of a rectangle (4, 3)."""
    return rectangle[0] + along @ (rectangle[[1, 3]] - rectangle[0])
