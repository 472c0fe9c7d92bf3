"""Ambient occlusion from a depth image: hollows, folds and places where bodies touch get less light from around.

In the manner of Bavoil and Sainz, "Image-space horizon-based ambient occlusion" (2008): each pixel looks at a spiral of
others nearby and adds up how steeply they rise above its own tangent plane. Neighbours look along different spirals, in
a pattern of four by four pixels that a blur, which stops at jumps of depth, takes out exactly.
"""

import numpy as np
from numba import prange

from pbng.jit import kernel, leaf

SAMPLES = 16
TURNS = 5.0  # of the spiral
STRENGTH = 6.5
MOST_PIXELS = 60.0  # greatest radius looked at
FLAT = 0.10  # sine of the rise that is overlooked
DEEP = 0.25  # share of the darkness that the deepest hollows are spared, or folds of cloth would be black
GREY = 40.0  # difference between the channels of a colour below which it is more or less grey
BLOCK = 3  # [samples] side of the squares that share one light where they show one surface
BLUR = 4  # [pixels] half the width of the blur, the side of the pattern


def occlude(
    image: np.ndarray,
    depth: np.ndarray,
    coarse: np.ndarray,
    normals: np.ndarray,
    tangent: float,
    radius: float,
    edge: float,
) -> None:
    """Darken an image (h, w, 3) uint8, in place, where little light from around arrives.

    An image that is to be made smaller is given as it was drawn: once a pixel is a mixture of two surfaces, no light
    suits both.

    Args:
        image: The picture.
        depth: Distance (h, w) float32 [m] from the camera along its axis, infinite where there is nothing.
        coarse: The same in a smaller image (m, n) of the same view.
        normals: Unit normals there along the camera's right, up and back, each from 0 for -1 to 255 for 1.
        tangent: Half the height of the picture at a distance of 1.
        radius: How far [m] things hide light from each other.
        edge: Length of the edges of triangles [m]: the facets of a coarse mesh, meant to look smooth, hide no light.
    """
    light, across, both = (np.ones_like(coarse) for _ in range(3))
    _obscurance(coarse, normals, tangent, radius, min(0.3 * edge, 0.1 * radius), light)
    _smooth(light, coarse, 0.1 * radius, 0, 1, across)
    _smooth(across, coarse, 0.1 * radius, 1, 0, both)
    _darken(image, depth, both, coarse, 0.1 * radius)


@kernel
def _obscurance(depth, normals, tangent, radius, overlooked, out):
    h, w = depth.shape
    pixel = 2 * tangent / h  # size of a pixel at a distance of 1
    for i in prange(h):
        for j in range(w):
            z = depth[i, j]
            if not z < np.inf:
                continue
            u, v = (j + 0.5 - w / 2) * pixel, (i + 0.5 - h / 2) * pixel
            # x is right, y down and z ahead.
            nx, ny, nz = normals[i, j, 0] - 127.5, 127.5 - normals[i, j, 1], 127.5 - normals[i, j, 2]
            length = np.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
            nx, ny, nz = nx / length, ny / length, nz / length
            reach = min(radius / (z * pixel), MOST_PIXELS)
            turn = (4 * (i % 4) + (j % 4)) * 7 % 16 / 16.0
            shift = (4 * (j % 4) + (i % 4)) * 5 % 16 / 16.0 + 0.03
            total = 0.0
            for k in range(SAMPLES):
                alpha = (k + shift) / SAMPLES
                angle = 2 * np.pi * (turn + TURNS * alpha)
                p = i + int(np.rint(reach * alpha * np.sin(angle)))
                q = j + int(np.rint(reach * alpha * np.cos(angle)))
                if p < 0 or p >= h or q < 0 or q >= w:
                    continue
                s = depth[p, q]
                if not s < np.inf:
                    continue
                dx = (q + 0.5 - w / 2) * pixel * s - u * z
                dy = (p + 0.5 - h / 2) * pixel * s - v * z
                dz = s - z
                square = dx * dx + dy * dy + dz * dz
                rise = (dx * nx + dy * ny + dz * nz - overlooked) / np.sqrt(square + 1e-30)
                if square < radius * radius and rise > FLAT:
                    total += (rise - FLAT) * (1.0 - square / (radius * radius))
            out[i, j] = max(0.0, 1.0 - STRENGTH * total / SAMPLES)


@kernel
def _smooth(image, depth, jump, di, dj, out):
    h, w = depth.shape
    for i in prange(h):
        for j in range(w):
            z = depth[i, j]
            if not z < np.inf:
                continue
            # A surface seen from the side slopes away: what counts is the distance from its plane.
            after, before = depth[min(i + di, h - 1), min(j + dj, w - 1)] - z, z - depth[max(i - di, 0), max(j - dj, 0)]
            slope = after if abs(after) < abs(before) else before
            slope = slope if abs(slope) < np.inf else 0.0
            total, weights = 0.0, 0.0
            for k in range(1 - BLUR, BLUR):
                p, q = i + k * di, j + k * dj
                if p < 0 or p >= h or q < 0 or q >= w:
                    continue
                if not depth[p, q] < np.inf:
                    continue
                weight = max(0.0, 1.0 - abs(depth[p, q] - z - k * slope) / jump) * (BLUR - abs(k))
                total += weight * image[p, q]
                weights += weight
            out[i, j] = total / weights


@leaf
def _darkness(y, x, z, light, coarse, jump):
    """How dark it is at distance z [m] at a row and column (y, x) of the smaller image, which may be between two."""
    h, w = coarse.shape
    i, j = int(np.floor(y)), int(np.floor(x))
    total, weights = 1e-6, 1e-6
    for p in range(max(i, 0), min(i + 2, h)):
        for q in range(max(j, 0), min(j + 2, w)):
            if coarse[p, q] < np.inf:
                near = (1.0 - abs(p - y)) * (1.0 - abs(q - x))
                weight = max(1e-6, near * (1.0 - abs(coarse[p, q] - z) / jump))
                total += weight * light[p, q]
                weights += weight
    dark = max(0.0, 1.0 - total / weights)
    return dark - DEEP * dark * dark


@kernel
def _darken(image, depth, light, coarse, jump):
    h, w = depth.shape
    m, n = coarse.shape
    for i in prange((h + BLOCK - 1) // BLOCK):
        for j in range((w + BLOCK - 1) // BLOCK):
            rows, columns = range(BLOCK * i, min(h, BLOCK * (i + 1))), range(BLOCK * j, min(w, BLOCK * (j + 1)))
            low, high = np.inf, -np.inf
            for p in rows:
                for q in columns:
                    low, high = min(low, depth[p, q]), max(high, depth[p, q])
            if not low < np.inf:
                continue
            # Most blocks show one surface, and light has no detail as fine as they are.
            alike = high - low < 0.25 * jump
            y, x = (i + 0.5) * BLOCK * m / h - 0.5, (j + 0.5) * BLOCK * n / w - 0.5
            dark = _darkness(y, x, low, light, coarse, jump) if alike else 0.0
            if alike and dark == 0.0:
                continue
            for p in rows:
                for q in columns:
                    if not alike:
                        if not depth[p, q] < np.inf:
                            continue
                        y, x = (p + 0.5) * m / h - 0.5, (q + 0.5) * n / w - 0.5
                        dark = _darkness(y, x, depth[p, q], light, coarse, jump)
                    # Darkened colours keep their warmth: red fades least, as in light thrown to and fro. Grey has none.
                    red, green, blue = float(image[p, q, 0]), float(image[p, q, 1]), float(image[p, q, 2])
                    warm = min(1.0, (max(red, green, blue) - min(red, green, blue)) / GREY)
                    image[p, q, 0] = int(red * (1.0 - (0.78 - 0.06 * warm) * dark) + 0.5)
                    image[p, q, 1] = int(green * (1.0 - 0.78 * dark) + 0.5)
                    image[p, q, 2] = int(blue * (1.0 - 0.78 * dark) + 0.5)
