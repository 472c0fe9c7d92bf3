"""Soft shadows on the floor, made by hand: a renderer's own are jagged, slow, or different on every machine.

The surface is projected onto the floor along the light. Where it hides the light, the height of what hides it says how
far the edge of the shadow is blurred. Two such images are laid over each other: the shadow of the main light, and a
wider one of the sky above that grounds what touches the floor.
"""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from pbng.jit import serial

PIXELS = 384  # side of the shadow's image
LAYERS = 6  # distances over which the blur grows


@dataclass(frozen=True)
class _Source:
    direction: tuple[float, float, float]  # from the light, y downwards
    spread: float  # blur of the edge for each metre of height, relative to it
    strength: float


SOURCES = (
    _Source((0.42, -1.0, -0.42), 0.10, 0.34),
    _Source((0.0, -1.0, 0.0), 0.55, 0.30),
)


@serial
def _lowest(points, height, triangles, image):
    """Draw triangles at points (n, 2) [pixels] into the image, keeping the lowest height of each pixel."""
    n = image.shape[0]
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t]
        ax, ay = points[i]
        bx, by = points[j] - points[i]
        cx, cy = points[k] - points[i]
        det = bx * cy - by * cx
        if not abs(det) > 1e-12:
            continue
        low_x = max(0, int(np.ceil(ax + min(0.0, bx, cx))))
        high_x = min(n - 1, int(np.floor(ax + max(0.0, bx, cx))))
        low_y = max(0, int(np.ceil(ay + min(0.0, by, cy))))
        high_y = min(n - 1, int(np.floor(ay + max(0.0, by, cy))))
        for row in range(low_y, high_y + 1):
            for column in range(low_x, high_x + 1):
                px, py = column - ax, row - ay
                u = (px * cy - py * cx) / det
                v = (bx * py - by * px) / det
                if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
                    h = height[i] * (1.0 - u - v) + height[j] * u + height[k] * v
                    image[row, column] = min(image[row, column], h)


class Shadow:
    """Shadows on the square of the floor with the given centre (x, y, z) and half its side [m].

    ``top`` is the greatest height [m] above the floor of whatever will cast them.
    """

    def __init__(self, centre: np.ndarray, half: float, top: float) -> None:
        self.centre, self.half = centre, half
        self.heights = np.linspace(0, 1, LAYERS) ** 2 * max(top, 1e-9)

    def __call__(self, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """How dark (PIXELS, PIXELS), 0 to 1, the floor is under a surface; rows along z, columns along x."""
        light = np.ones((PIXELS, PIXELS))
        for source in SOURCES:
            light *= 1 - source.strength * self._hidden(points, triangles, source)
        return 1 - light

    def _hidden(self, points: np.ndarray, triangles: np.ndarray, source: _Source) -> np.ndarray:
        scale = PIXELS / (2 * self.half)  # pixels a metre
        height = points[:, 1].astype(np.float64) - self.centre[1]
        along = np.array([source.direction[0], source.direction[2]]) / -source.direction[1]
        landed = points[:, [0, 2]] - self.centre[[0, 2]] + height[:, None] * along
        lowest = np.full((PIXELS, PIXELS), np.inf)
        _lowest((landed + self.half) * scale - 0.5, height, triangles, lowest)
        hit = np.isfinite(lowest)
        lowest[~hit] = 0
        hidden = np.zeros_like(lowest)
        # Each hidden pixel is shared between the two layers around its height, so that nothing jumps as it moves.
        for k, height_k in enumerate(self.heights):
            share = hit * np.interp(lowest, self.heights, np.arange(LAYERS) == k)
            if share.any():
                hidden += _blurred(share, 1.0 + source.spread * height_k * scale)
        return np.minimum(hidden, 1.0)


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Two running means, which are close to a Gaussian of standard deviation ``sigma`` [pixels] and far cheaper."""
    width = 2 * round(1.22 * sigma) + 1
    for _ in range(2):
        image = uniform_filter(image, width, mode="constant")
    return image
