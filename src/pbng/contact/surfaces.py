"""From what a scene says of contact to what may touch (:class:`pbng.contact.spec.ContactSpec`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbng.bodies import Body
from pbng.contact.spec import NEAR, ContactSpec, Surfaces
from pbng.errors import InputError
from pbng.mesh import TetMesh

CLOTH = 0.2  # distance kept from cloth of no thickness, in mean lengths of its edges


@dataclass(frozen=True, eq=False)
class ContactRule:
    """What :meth:`pbng.Scene.contact` was told; without bodies it holds for all."""

    bodies: tuple[Body, ...]
    own: bool | tuple[Body, ...]
    k_n: float | None
    k_tau: float
    radius: float | None
    thickness: float | None
    rings: int


def contact_spec(bodies: Sequence[Body], rule: ContactRule | None, colliders: Sequence[Any]) -> ContactSpec | None:
    """What may touch in a scene of these bodies; None if nothing may.

    Raises:
        InputError: A body that is to collide has no surface.
    """
    if not bodies or (rule is None and not colliders):
        return None
    surfaces = None if rule is None else _surfaces(bodies, rule)
    vertices = [b.start + np.unique(b.faces) for b in bodies] if colliders else [surfaces.vertices]  # type: ignore[union-attr]
    spacing = [_spacing(b) for b in bodies]
    ranges = tuple((b.name, b.start, b.start + b.mesh.n_vert) for b in bodies)
    flat = [np.arange(start, stop) for b, (_, start, stop) in zip(bodies, ranges) if not has_surface(b)]
    return ContactSpec(
        surface=np.unique(np.concatenate(vertices)),
        surfaces=surfaces,
        colliders=tuple(colliders),
        margin=NEAR * float(np.mean(spacing)),
        bodies=ranges,
        plane=np.concatenate(flat) if flat else np.empty(0, np.int64),
    )


def _surfaces(bodies: Sequence[Body], rule: ContactRule) -> Surfaces:
    chosen = rule.bodies or tuple(bodies)
    own = rule.own if isinstance(rule.own, tuple) else (chosen if rule.own else ())
    for b in {*chosen, *own}:
        if not has_surface(b):
            raise InputError(f"contact: body {b.name!r} has no surface: it is plane; contact is for solids and cloth")
        if b.is_cloth and rule.thickness == 0:
            raise InputError(f"contact: thickness must be positive for body {b.name!r}: cloth has no inside")
    if len(set(chosen)) == 1 and not own:
        raise InputError(
            f"contact: body {chosen[0].name!r} is alone, and does not collide with itself; self_collision=True, or"
            " another body?"
        )
    triangles, body, tets, tet_body = [], [], [], []
    for number, b in enumerate(bodies):
        if not any(b is c for c in (*chosen, *own)):
            continue
        triangles.append((b.mesh.surface + b.start).astype(np.int32))
        body.append(np.full(len(b.mesh.surface), number, np.int32))
        if isinstance(b.mesh, TetMesh):
            tets.append((b.mesh.cells + b.start).astype(np.int32))
            tet_body.append(np.full(b.mesh.n_elem, number, np.int32))
    skin = np.array([_skin(b) for b in bodies]) if rule.thickness is None else np.full(len(bodies), rule.thickness / 2)
    return Surfaces(
        triangles=np.concatenate(triangles),
        body=np.concatenate(body),
        tets=np.concatenate(tets) if tets else np.empty((0, 4), np.int32),
        tet_body=np.concatenate(tet_body) if tets else np.empty(0, np.int32),
        names=tuple(b.name for b in bodies),
        others=np.array([any(b is c for c in chosen) for b in bodies]),
        own=np.array([any(b is c for c in own) for b in bodies]),
        skin=skin,
        stiffness=np.array([_stiffness(b) for b in bodies]),
        spacing=np.array([_spacing(b) for b in bodies]),
        k_n=rule.k_n,
        k_tau=rule.k_tau,
        radius=rule.radius,
        rings=rule.rings,
    )


def has_surface(body: Body) -> bool:
    """Whether a body is a solid, or a surface, in space."""
    return isinstance(body.mesh, TetMesh) or body.is_cloth


def _skin(body: Body) -> float:
    """Half the distance [m] that is kept from a body: solids touch, cloth has a thickness."""
    if not body.is_cloth:
        return 0.0
    thickness = max((getattr(m, "thickness", None) or 0.0 for m, _ in body.materials), default=0.0)
    return (thickness or CLOTH * _spacing(body)) / 2


def _stiffness(body: Body) -> float:
    """E h [N/m] of a body, of cloth E alone, which is a force a length."""
    E = float(np.mean([m.mu * 2 * (1 + m.nu) for m, _ in body.materials]))
    return E if body.is_cloth else E * _spacing(body)


def _spacing(body: Body) -> float:
    """Mean length [m] of the edges of a body's surface."""
    X, faces = body.mesh.X, body.faces
    following = np.roll(faces, -1, axis=1)
    return float(np.linalg.norm(X[faces] - X[following], axis=-1).mean())
