"""Solids of about the same count of vertices, about the origin, that fall into boxes."""

from math import pi

import numpy as np

from pbng.mesh import TetMesh
from pbng.shapes import box, cylinder, sphere


def brick(n: int) -> TetMesh:
    """A cube of 0.4 m, n³ vertices."""
    return box((0.4, 0.4, 0.4), n, (-0.2, -0.2, -0.2))


def ball(n: int) -> TetMesh:
    """A ball of 0.6 m across, n³ vertices."""
    return sphere(0.3, n)


def plank(n: int) -> TetMesh:
    """A plank, 0.66 m long."""
    return box((0.66, 0.25, 0.12), _counts((0.66, 0.25, 0.12), n), (-0.33, -0.125, -0.06))


def rod(n: int) -> TetMesh:
    """A cylinder, 0.66 m long and 0.2 m across."""
    along, across, _ = _counts((0.66, 0.2, 0.2), n)
    mesh = cylinder(0.1, 0.66, (along, across))
    return mesh.moved(mesh.X - (0.33, 0.0, 0.0))


def ring(n: int) -> TetMesh:
    """A torus, 0.68 m across and 0.18 m thick: a cylinder bent until its ends meet."""
    R, r = 0.25, 0.09  # m
    around, across, _ = _counts((2 * pi * R, 2 * r, 2 * r), n)
    around += around % 2  # cells alternate between two kinds, all the way round
    mesh = cylinder(r, 2 * pi * R, (around + 1, across))
    kept = around * across**2
    x, y, z = mesh.X[:kept].T
    bent = np.column_stack([(R + y) * np.sin(x / R), (R + y) * np.cos(x / R), z])
    return TetMesh(bent, mesh.cells % kept)


def _counts(size: tuple[float, float, float], n: int) -> tuple[int, int, int]:
    """Vertices along edges of a size [m], about n³ in all and about as far apart along each, 3 at least."""
    spacing = float(np.prod(size)) ** (1 / 3) / n
    a, b, c = (max(3, round(s / spacing)) for s in size)
    return a, b, c
