"""Bindings of a scene: which points are tied to which, and with what stiffness; they become weak constraints."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbng.bodies import Body, Points, Selection
from pbng.closest import closest_on_faces
from pbng.constraints import WeakConstraints
from pbng.errors import InputError
from pbng.mesh import TriMesh


@dataclass(frozen=True, eq=False)
class Binding:
    """Points a tied to points b of a body, or to ``targets``: ``t -> (m, 3)`` [m]; K is (m, 3, 3) [N/m]."""

    a: Points
    b: Points | None
    targets: Callable[[float], np.ndarray] | None
    K: np.ndarray


def bind(a: Points, b: Any, k: Any, k_n: Any, k_tau: Any, normal: Any) -> Binding:
    """Check and complete what :meth:`pbng.Scene.bind` was told; a motion comes as its function of time."""
    if isinstance(b, Body | Selection):
        b, normals = _closest(a, b)
        normal = normals if normal is None else normal
    K = _stiffness(len(a), k, k_n, k_tau, normal)
    if any(isinstance(p, Points) and isinstance(p.body.mesh, TriMesh) for p in (a, b)):
        K[:, 2], K[:, :, 2] = 0, 0  # plane strain: z never moves
    if isinstance(b, Points):
        if len(b) != len(a):
            raise InputError(f"bind: {len(a)} points cannot be tied to {len(b)}")
        return Binding(a, b, None, K)
    if callable(b):
        return Binding(a, None, b, K)
    try:
        fixed = np.array(np.broadcast_to(np.asarray(b, float), (len(a), 3)))
    except (TypeError, ValueError):
        raise InputError(
            f"bind: expected points, a body, a selection, a motion or positions ({len(a)}, 3), not {b!r:.80}"
        ) from None
    if not np.isfinite(fixed).all():
        raise InputError(f"bind: position {np.flatnonzero(~np.isfinite(fixed).all(1))[0]} is not finite")
    return Binding(a, None, lambda t: fixed, K)


def weak_constraints(bindings: list[Binding]) -> tuple[WeakConstraints, ...]:
    """The weak constraints of bindings, with stencils without zeros, as few groups as their sizes allow."""
    between: dict[int, list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = {}
    anchored = []
    for binding in bindings:
        vertices, weights = binding.a.index, binding.a.weights
        if binding.b is not None:
            vertices = np.concatenate([vertices, binding.b.index], axis=1)
            weights = np.concatenate([weights, -binding.b.weights], axis=1)
        order = np.argsort(weights == 0, axis=1, kind="stable")  # zeros last
        vertices, weights = np.take_along_axis(vertices, order, 1), np.take_along_axis(weights, order, 1)
        size = (weights != 0).sum(1)
        for s in np.unique(size):
            mine = np.flatnonzero(size == s)
            part = vertices[mine, :s].astype(np.int32), weights[mine, :s], binding.K[mine]
            if binding.targets is None:
                between.setdefault(int(s), []).append(part)
            else:
                anchored.append(WeakConstraints(*part, _some(binding.targets, mine)))
    groups = []
    for s in sorted(between):
        vertices, weights, K = (np.concatenate(parts) for parts in zip(*between[s]))
        groups.append(WeakConstraints(vertices, weights, K))
    return (*groups, *anchored)


def _some(targets: Callable[[float], np.ndarray], which: np.ndarray) -> Callable[[float], np.ndarray]:
    return lambda t: targets(t)[which]


def _closest(a: Points, b: Body | Selection) -> tuple[Points, np.ndarray | None]:
    """The points of b closest to a at rest, and the normals there (None where only vertices were selected)."""
    body = b if isinstance(b, Body) else b.body
    X, faces, normals = body.mesh.X, b.faces, None
    if len(faces) == 0 and isinstance(b, Selection):
        faces = b.vertices[:, None]
    face, weights = closest_on_faces(a.X, X, faces)
    if faces.shape[1] > 1:
        corner = X[faces[face]]
        edge = corner[:, 1] - corner[:, 0]
        normals = np.cross(edge, corner[:, 2] - corner[:, 0] if faces.shape[1] == 3 else (0.0, 0.0, 1.0))
    points = Points(body, faces[face], weights)
    itself = np.flatnonzero(((points.index[:, :, None] == a.index[:, None]) & (weights[:, :, None] != 0)).any((1, 2)))
    if len(itself):
        raise InputError(f"bind: point {itself[0]} would be tied to itself; select other vertices of {body.name!r}")
    return points, normals


def _stiffness(m: int, k: Any, k_n: Any, k_tau: Any, normal: Any) -> np.ndarray:
    """K (m, 3, 3): k I, or k_n n nᵀ + k_τ (I - n nᵀ)."""
    if (k is None) == (k_n is None):
        raise InputError("bind: give either k, or k_n with k_tau")
    unit = np.eye(3)
    if k is not None:
        return _numbers("k", k, m)[:, None, None] * unit
    if normal is None:
        raise InputError("bind: k_n needs normal=, or faces of a body to take it from")
    try:
        n = np.array(np.broadcast_to(np.asarray(normal, float), (m, 3)))
    except ValueError:
        raise InputError(f"bind: normal must have shape (3,) or {(m, 3)}, not {np.shape(normal)}") from None
    length = np.linalg.norm(n, axis=1, keepdims=True)
    bad = np.flatnonzero(~(length[:, 0] > 0) | ~np.isfinite(length[:, 0]))
    if len(bad):
        raise InputError(f"bind: normal {bad[0]} has no direction")
    n /= length
    along = n[:, :, None] * n[:, None]
    return _numbers("k_n", k_n, m)[:, None, None] * along + _numbers("k_tau", k_tau, m)[:, None, None] * (unit - along)


def _numbers(name: str, value: Any, m: int) -> np.ndarray:
    try:
        numbers = np.broadcast_to(np.asarray(value, float), (m,))
    except (TypeError, ValueError):
        raise InputError(f"bind: {name} must be a number or have shape ({m},), not {value!r:.80}") from None
    bad = np.flatnonzero(~(np.isfinite(numbers) & (numbers >= 0)))
    if len(bad):
        raise InputError(f"bind: {name} must be finite and not negative, not {numbers[bad[0]]}")
    return numbers
