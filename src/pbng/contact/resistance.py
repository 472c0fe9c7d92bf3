"""How pairs of surfaces that may touch resist: their normals, and the offsets and stiffnesses of the contacts."""

from math import copysign, sqrt
from typing import NamedTuple

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.contact.normals import SHARP
from pbng.contact.spec import Surfaces
from pbng.linalg import add, combine, dot, point, scale, unit
from pbng.parallel import array, body, each, rows

STIFF = 10.0  # default stiffness, in E h of the softer body
PUSH = 5.0  # how many edges a second a stiff contact may push apart what overlaps [1/s]
TOUCHING = 1e-9  # of the radius: closer points have no direction between them
GRAIN = 256  # pairs that a thread takes at a time


class Pairs(NamedTuple):
    """What may touch.

    Attributes:
        vertices: Stencils, (m, 4) int32: a vertex and those of a triangle, or of two edges.
        weights: Of the two closest points, those of the second negative, (m, 4).
        outward: Unit normals of the second side that point outward, (m, 3).
        inside: Whether the two sides overlap, (m,) bool.
    """

    vertices: np.ndarray
    weights: np.ndarray
    outward: np.ndarray
    inside: np.ndarray

    def some(self, which: np.ndarray) -> "Pairs":
        """Those pairs alone."""
        return Pairs(*(a[which] for a in self))


def resist(
    pairs: Pairs,
    x: np.ndarray,
    body: np.ndarray,
    surfaces: Surfaces,
    radius: float,
    dt: float | None,
    hold: float,
    k_tau: float,
) -> Contacts:
    """Contacts of pairs at x (n_vert, 3) [m].

    Args:
        pairs: What may touch.
        x: Positions.
        body: Body of each vertex, (n_vert,) int32.
        surfaces: What these bodies keep off from, and how stiff they are.
        radius: At which distance surfaces are close [m].
        dt, hold, k_tau: As of :meth:`pbng.contact.pairs.SurfaceDetector.find`.
    """
    s, m = surfaces, len(pairs.vertices)
    push, hold = (np.inf, hold) if dt is None else (PUSH * dt, 0.0)
    numbers = np.array([TOUCHING * radius, push, hold, k_tau, -1.0 if s.k_n is None else s.k_n])
    bodies = np.column_stack([s.skin, s.spacing, s.stiffness])
    normal, start = np.empty((m, 3)), np.empty((m, 3))
    offset, k_n, tangential, kept = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    each(_resist, (*pairs, x, body, bodies, numbers, normal, start, offset, k_n, tangential, kept), m, GRAIN)
    return Contacts(pairs.vertices, pairs.weights, normal, offset, k_n, tangential, start, kept)


@body
def _resist(arguments, low, high):
    """Body of :func:`resist` for pairs low .. high."""
    vertices, weights = rows(arguments, 0, 4, np.int32), rows(arguments, 1, 4, np.float64)
    outward, inside = rows(arguments, 2, 3, np.float64), array(arguments, 3, np.bool_)
    x, body, bodies = (
        rows(arguments, 4, 3, np.float64),
        array(arguments, 5, np.int32),
        rows(arguments, 6, 3, np.float64),
    )
    numbers, normal, start = (
        array(arguments, 7, np.float64),
        rows(arguments, 8, 3, np.float64),
        rows(arguments, 9, 3, np.float64),
    )
    offset, k_n = array(arguments, 10, np.float64), array(arguments, 11, np.float64)
    k_tau, kept = array(arguments, 12, np.float64), array(arguments, 13, np.float64)
    touching, push, hold, tangential, stiffness = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    for k in range(low, high):
        apart = 0.0, 0.0, 0.0
        for j in range(4):
            apart = add(apart, scale(weights[k, j], point(x, vertices[k, j])))
        start[k, 0], start[k, 1], start[k, 2] = apart
        distance = sqrt(dot(apart, apart))
        sign = -1.0 if inside[k] else 1.0
        out = point(outward, k)
        direct = scale(sign / distance, apart) if distance > touching else out
        # Where the way to the closest point is nearly along the surface's normal, it is the normal that counts: it does
        # not jump from triangle to triangle. On the far side of cloth it points back.
        along = dot(direct, out)
        share = min(max((abs(along) - SHARP) / (1.0 - SHARP), 0.0), 1.0)
        n = unit(combine(1.0 - share, direct, copysign(share, along), out))
        normal[k, 0], normal[k, 1], normal[k, 2] = n
        a, b = body[vertices[k, 0]], body[vertices[k, 3]]
        kept[k] = bodies[a, 0] + bodies[b, 0]
        spacing, softer = min(bodies[a, 1], bodies[b, 1]), min(bodies[a, 2], bodies[b, 2])
        k_n[k] = stiffness if stiffness >= 0.0 else STIFF * softer
        gap = sign * distance
        offset[k] = min(kept[k], gap + max(push, softer / k_n[k]) * spacing)
        k_tau[k] = max(tangential, hold * k_n[k]) if gap < kept[k] else 0.0
