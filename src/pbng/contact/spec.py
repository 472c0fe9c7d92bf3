"""What of a scene may touch, and how: the part of a problem that contact needs."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

NEAR = 0.5  # at which distance surfaces count as close, in mean lengths of their edges
CLOSE = 0.1  # the same in a step of a motion, to which comes what the step is expected to move


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Surfaces of bodies that collide with each other, or with themselves.

    Attributes:
        triangles: Their triangles, outward where they bound a solid, by vertices of the scene, (m, 3) int32.
        body: Body of each triangle, (m,) int32.
        tets: Tets of the solids among them, (k, 4) int32.
        tet_body: Body of each tet, (k,) int32.
        names: Names of all bodies of the scene.
        others: Which bodies collide with each other, (n_body,) bool.
        own: Which collide with themselves, (n_body,) bool.
        skin: Half the distance [m] that is kept from each body, (n_body,).
        stiffness: E h [N/m] of each body, (n_body,).
        spacing: Mean length of each body's edges on the surface [m], (n_body,).
        k_n, k_tau: Stiffness of contacts [N/m]; a k_n of None is a multiple of the softer body's E h.
        radius: Distance [m] below which surfaces are in contact; None for a share of the spacing.
        rings: How many rings of triangles around a vertex it does not collide with.
    """

    triangles: np.ndarray
    body: np.ndarray
    tets: np.ndarray
    tet_body: np.ndarray
    names: tuple[str, ...]
    others: np.ndarray
    own: np.ndarray
    skin: np.ndarray
    stiffness: np.ndarray
    spacing: np.ndarray
    k_n: float | None
    k_tau: float
    radius: float | None
    rings: int

    @cached_property
    def vertices(self) -> np.ndarray:
        """Vertices on the surfaces, ascending, (n,)."""
        return np.unique(self.triangles)


@dataclass(frozen=True, eq=False)
class ContactSpec:
    """What may touch.

    Attributes:
        surface: Vertices that may come into contact, ascending, (n,).
        surfaces: Bodies that collide with each other, or None.
        colliders: Kinematic bodies (:mod:`pbng.contact.colliders`).
        margin: Distance [m] at which a vertex that does not move counts as close to a collider.
        bodies: For each body its name, and its first vertex and that past its last.
        plane: Vertices of plane bodies, which stay in their plane, ascending, (k,).
    """

    surface: np.ndarray
    surfaces: Surfaces | None
    colliders: tuple[Any, ...]
    margin: float
    bodies: tuple[tuple[str, int, int], ...]
    plane: np.ndarray
