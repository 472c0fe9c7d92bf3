"""Soft shadows on the floor, made by hand: a renderer's own are jagged, slow, or different on every machine.

The surface is projected onto the floor along the light. Where it hides the light, the height of what hides it says how
far the edge of the shadow is blurred. Two such images are laid over each other: the shadow of the main light, and a
wider one of the sky above that grounds what touches the floor.
"""

from dataclasses import dataclass

import numpy as np

from pbng.jit import serial

PIXELS = 384  # side of the shadow's image
LAYERS = 6  # distances over which the blur grows
ASIDE = 0.25  # of the width of all that casts shadows: no shadow falls farther aside than that


@dataclass(frozen=True)
class _Source:
    aside: tuple[float, float]  # how far along x and z a shadow falls for each metre of height
    spread: float  # blur of the edge for each metre of height, relative to it
    strength: float


SOURCES = (
    _Source((0.42, -0.42), 0.10, 0.34),
    _Source((0.0, 0.0), 0.55, 0.30),
)


def leaning(points: np.ndarray, floor: float) -> float:
    """How much of its slant the main light keeps, 0 to 1, when points (n, 3) [m] cast shadows on a floor of a height
    [m]: it stands the steeper the higher they are, or a picture of them with their shadows would show both small.
    """
    width = np.hypot(*np.ptp(points[:, [0, 2]], axis=0))
    farthest = np.hypot(*SOURCES[0].aside) * (points[:, 1].max() - floor)
    return float(ASIDE * width / max(farthest, ASIDE * width, 1e-9))


def landed(points: np.ndarray, floor: float, lean: float) -> np.ndarray:
    """Where the main light casts the shadows of points (n, 3) [m], their soft rims included: (4 n, 3) on the floor."""
    main, height = SOURCES[0], points[:, 1:2] - floor
    middle = points[:, [0, 2]] + lean * height * main.aside
    rims = [middle + main.spread * height * corner for corner in ((-1, -1), (-1, 1), (1, -1), (1, 1))]
    return np.insert(np.concatenate(rims), 1, floor, axis=1)


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

    ``top`` is the greatest height [m] above the floor of whatever will cast them, ``lean`` as :func:`leaning` says.
    """

    def __init__(self, centre: np.ndarray, half: float, top: float, lean: float = 1.0) -> None:
        self.centre, self.half, self.lean = centre, half, lean
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
        place = points[:, [0, 2]] - self.centre[[0, 2]] + self.lean * height[:, None] * source.aside
        lowest = np.full((PIXELS, PIXELS), np.inf)
        _lowest((place + self.half) * scale - 0.5, height, triangles, lowest)
        hit = np.isfinite(lowest)
        lowest[~hit] = 0
        light, below = np.ones_like(lowest), np.zeros_like(lowest)
        # Each hidden pixel is shared between the two layers around its height, so that nothing jumps as it moves.
        for k, height_k in enumerate(self.heights):
            share = hit * np.interp(lowest, self.heights, np.arange(LAYERS) == k)
            if share.any():
                sigma = 1.0 + source.spread * height_k * scale
                # What is below a layer hides part of it, where it is taken to be as around: a hole there would let
                # light in around what is below.
                seen = 1 - _blurred(below, sigma) if below.any() else 1.0
                light *= 1 - np.clip(_blurred(share, sigma) / np.maximum(seen, 1e-3), 0, 1)
                below += share
        return 1 - light


def _blurred(image: np.ndarray, sigma: float) -> np.ndarray:
    """Two running means, which are close to a Gaussian of standard deviation ``sigma`` [pixels] and far cheaper."""
    half = round(1.22 * sigma)
    for _ in range(2):  # along either axis
        image = np.ascontiguousarray(_mean(_mean(image, half), half).T)
    return image


@serial
def _mean(image, half):
    """Means (h, w) of 2 half + 1 pixels along the first axis, with 0 around the image."""
    h, w = image.shape
    out, total = np.empty_like(image), np.zeros(w)
    for i in range(-half, h):
        if i + half < h:
            total += image[i + half]
        if i - half - 1 >= 0:
            total -= image[i - half - 1]
        if i >= 0:
            out[i] = total / (2 * half + 1)
    return out
