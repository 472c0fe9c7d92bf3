"""Vertices in contact as red dots on the surface (Fig. 13), laid over the finished picture like springs."""

import numpy as np

from pbng.jit import serial
from pbng.view.camera import VIEW_ANGLE, Camera
from pbng.view.springs import lay

COLOR = (205, 38, 32)
SHARE = 0.2  # radius of a dot in edges of the surface
LEAST, MOST = 1.5, 5.0  # radii [pixels of a picture 720 high]


class Dots:
    """Lays dots over images.

    Args:
        edge: Length [m] of the edges of the surface.
    """

    def __init__(self, edge: float) -> None:
        self.radius = SHARE * edge

    def draw(self, image: np.ndarray, depth: np.ndarray, camera: Camera, dots: np.ndarray) -> None:
        """Draw dots (n, 3) [m] into an image (h, w, 3) uint8 in place; image, depth and camera as for springs."""
        dots = dots[np.isfinite(dots).all(1)]
        height, width = depth.shape
        places = camera.seen(dots, (width, height))
        tangent = np.tan(np.radians(VIEW_ANGLE) / 2)
        distance = np.maximum(places[:, 2], 1e-9)
        half = np.full(len(dots), camera.parallel) if camera.parallel else distance * tangent  # of the picture [m]
        unit = height / 720
        radius = np.clip(self.radius / half * height / 2, LEAST * unit, MOST * unit)
        through = np.ones_like(depth)
        # As thick as they are wide: a dot in the very surface is seen.
        _discs(places, radius, 2 * half / height, depth, through)
        lay(image, through, height // image.shape[0], np.array(COLOR, float), 1.0)


@serial
def _discs(places, radius, sample, depth, through):
    """Of each sample (h, w) within a disc that nothing is before, let nothing through but at its rim."""
    h, w = depth.shape
    for k in range(places.shape[0]):
        x, y, z = places[k]
        r = radius[k]
        if z <= 0.0:
            continue
        for row in range(int(max(0.0, np.floor(y - r))), int(min(h - 1.0, y + r)) + 1):
            for column in range(int(max(0.0, np.floor(x - r))), int(min(w - 1.0, x + r)) + 1):
                cover = min(1.0, r + 0.5 - np.hypot(column + 0.5 - x, row + 0.5 - y))
                if cover > 0.0 and z - r * sample[k] <= depth[row, column]:
                    through[row, column] = min(through[row, column], 1.0 - cover)
