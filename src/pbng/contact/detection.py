"""Everything that may touch in a step: surfaces each other, and colliders."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pbng.contact.collider import Touches, dots, norms
from pbng.contact.colliders import Shape
from pbng.contact.contacts import Contacts
from pbng.contact.halfspaces import HalfSpaces
from pbng.contact.pairs import SurfaceDetector
from pbng.contact.spec import CLOSE, NEAR, ContactSpec
from pbng.contact.touching import Shapes
from pbng.errors import InputError

CREEP = 1e-3  # of the margin: ways shorter than this do not count as sliding


class Beginning(NamedTuple):
    """How a step began that goes on: at positions x (n_vert, 3) [m], at time t [s], with these contacts."""

    x: np.ndarray
    t: float
    contacts: Contacts


class Detector:
    """Finds everything that may touch in a step.

    Args:
        spec: What may touch.
        X: Rest positions [m], (n_vert, 3).
        fixed: Which vertices are prescribed.
    """

    def __init__(self, spec: ContactSpec, X: np.ndarray, fixed: np.ndarray) -> None:
        self.spec = spec
        self.surfaces = SurfaceDetector(spec.surfaces, X, fixed) if spec.surfaces else None
        self.free = spec.surface[~fixed[spec.surface]]
        self.reach = self.surfaces.radius if self.surfaces else spec.margin  # farther off, directions are of no use [m]
        bundled = [type(c).touch is Shape.touch for c in spec.colliders]
        self.shapes = Shapes([c for c, b in zip(spec.colliders, bundled) if b])
        self.bundled = np.flatnonzero(bundled)
        self.alone = np.flatnonzero(np.logical_not(bundled))
        self.friction = np.array([c.friction for c in spec.colliders])
        self.rubs = bool(self.friction.any())

    def check(self, x: np.ndarray, t: float) -> None:
        """InputError if a body lies wholly inside another, or inside a collider at time t [s], at x (n_vert, 3)."""
        if self.surfaces:
            self.surfaces.check(x)
        for name, start, stop in self.spec.bodies:
            mine = self.free[np.searchsorted(self.free, start) : np.searchsorted(self.free, stop)]
            for c in self.spec.colliders if len(mine) else ():
                d = c.distance(x[mine], t)[0]
                if d.max() < 0 and d.min() < -self.spec.margin:
                    raise InputError(
                        f"contact: body {name!r} starts fully inside collider {c.label!r}; move one of them"
                    )

    def find(
        self,
        x0: np.ndarray,
        x1: np.ndarray,
        t0: float,
        t1: float,
        dt: float | None = None,
        ahead: float = 0.0,
        hold: float = 0.0,
        borne: np.ndarray | None = None,
        since: Beginning | None = None,
    ) -> Contacts:
        """Contacts of a step from x0 at time t0 to, it is expected, x1 at t1 (n_vert, 3).

        ``dt`` is for motion and ``hold`` for rest, as of :meth:`pbng.contact.pairs.SurfaceDetector.find`; ``ahead`` [m]
        is how far from x1 vertices may come to lie. ``borne`` (n_vert, 3) is with what force [N] colliders bear
        vertices, by which they rub; in a step that goes on, friction counts ``since`` it began.
        """
        found = self._between_surfaces(x0, x1, dt, ahead, hold, since) if self.surfaces else Contacts()
        if not self.spec.colliders:
            return found
        before, after, near = np.take(x0, self.free, 0), np.take(x1, self.free, 0), np.asarray(self.spec.margin + ahead)
        if dt is not None:
            near = CLOSE / NEAR * self.spec.margin + norms(after - before)
        which, (touching, point, normal) = self._touches(before, after, t0, t1, near)
        vertex = self.free[touching].astype(np.int32)
        level = dots(normal, point)
        self._cut(x0, vertex, normal, level)
        start, earlier = (x0, t0) if since is None else (since.x, since.t)
        return replace(
            found,
            vertex=vertex,
            plane=normal,
            level=level,
            friction=self._friction(which, vertex, normal, borne),
            anchor=start[vertex] + self._slips(which, point, earlier, t1),
            creep=CREEP * self.spec.margin,
        )

    def _between_surfaces(
        self, x0: np.ndarray, x1: np.ndarray, dt: float | None, ahead: float, hold: float, since: Beginning | None
    ) -> Contacts:
        """Contacts between surfaces. What the rule of the scene makes stick does so from where a step began."""
        assert self.surfaces is not None
        k_tau = self.surfaces.surfaces.k_tau
        if dt is not None or k_tau == 0:
            return self.surfaces.find(x0, x1, dt, ahead, hold, k_tau)
        if since is None:
            return self.surfaces.find(x0, x1, dt, ahead, 0.0, k_tau)
        return self.surfaces.find(x0, x1, dt, ahead, hold, 0.0).plus(since.contacts.ties())

    def _touches(
        self, before: np.ndarray, after: np.ndarray, t0: float, t1: float, near: np.ndarray
    ) -> tuple[np.ndarray, Touches]:
        """Which collider each half-space is of, (j,) rising, and the half-spaces."""
        shape, touches = self.shapes.touch(before, after, t0, t1, near)
        which = self.bundled[shape]
        if not len(self.alone):
            return which, touches
        more = [self.spec.colliders[k].touch(before, after, t0, t1, near) for k in self.alone]
        which = np.concatenate([which, np.repeat(self.alone, [len(t.vertex) for t in more])])
        order = np.argsort(which, kind="stable")
        return which[order], Touches(*(np.concatenate(a)[order] for a in zip(touches, *more)))

    def _friction(
        self, which: np.ndarray, vertex: np.ndarray, normal: np.ndarray, borne: np.ndarray | None
    ) -> np.ndarray:
        """What friction may bear of each half-space [N]: its coefficient times what was last borne along the normal."""
        if borne is None or not self.rubs:
            return np.zeros(len(vertex))
        return self.friction[which] * HalfSpaces(vertex, normal).move_in(-borne, np.zeros(len(vertex)), far=np.inf)

    def _cut(self, x: np.ndarray, vertex: np.ndarray, normal: np.ndarray, level: np.ndarray) -> None:
        """Make half-spaces, in place, what vertices of plane bodies see: cut by their plane, in which they stay."""
        flat = np.flatnonzero(np.isin(vertex, self.spec.plane)) if len(self.spec.plane) else self.spec.plane
        if len(flat):
            level[flat] -= normal[flat, 2] * x[vertex[flat], 2]
            normal[flat, 2] = 0.0
            length = norms(normal[flat])
            length[length == 0] = 1.0  # it is parallel to the plane, and nothing can be done
            normal[flat] /= length[:, None]
            level[flat] /= length
            aside = flat[(normal[flat] == 0).all(1)]
            level[aside] = -np.inf

    def _slips(self, which: np.ndarray, points: np.ndarray, t0: float, t1: float) -> np.ndarray:
        """How far what would stick to the colliders is carried from time t0 to t1, where they rub, (k, 3) [m]."""
        slips = np.zeros((len(which), 3))
        for k, c in enumerate(self.spec.colliders):
            if c.friction:
                slips[which == k] = c.carried(points[which == k], t0, t1)
        return slips
