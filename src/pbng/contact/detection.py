"""Everything that may touch in a step: surfaces each other, and colliders."""

from dataclasses import replace

import numpy as np

from pbng.contact.collider import Touches
from pbng.contact.contacts import Contacts, move_in
from pbng.contact.pairs import SurfaceDetector
from pbng.contact.spec import CLOSE, NEAR, ContactSpec
from pbng.errors import InputError

CREEP = 1e-3  # of the margin: ways shorter than this do not count as sliding


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
        self.rubs = any(c.friction for c in spec.colliders)
        self.ties = Contacts()  # between surfaces, since the last step began
        self.since: tuple[np.ndarray, float] | None = None  # where the last step began, and when [s]
        self.borne = np.zeros((len(X), 3))  # with what force [N] colliders bear each vertex, as far as it rubs

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
    ) -> Contacts:
        """Contacts of a step from x0 at time t0 to, it is expected, x1 at t1 (n_vert, 3).

        ``dt`` is for motion and ``hold`` for rest, as of :meth:`pbng.contact.pairs.SurfaceDetector.find`; ``ahead`` [m]
        is how far from x1 vertices may come to lie. With t0 = t1 the step goes on in which contacts were sought last:
        friction counts from where that began.
        """
        begins = t0 < t1 or self.since is None
        if begins:
            self.since = x0, t0
        found = self._between_surfaces(x0, x1, dt, ahead, hold, begins) if self.surfaces else Contacts()
        before, after, near = x0[self.free], x1[self.free], np.asarray(self.spec.margin + ahead)
        if dt is not None:
            near = CLOSE / NEAR * self.spec.margin + np.linalg.norm(after - before, axis=1)
        touches = [c.touch(before, after, t0, t1, near) for c in self.spec.colliders]
        if touches:
            normal = np.concatenate([t.normal for t in touches])
            vertex = self.free[np.concatenate([t.vertex for t in touches])].astype(np.int32)
            level = (normal * np.concatenate([t.point for t in touches])).sum(1)
            normal, level = self._cut(x0, vertex, normal, level)
            found = replace(
                found,
                vertex=vertex,
                plane=normal,
                level=level,
                friction=self._friction(touches, vertex, normal),
                anchor=self._anchors(touches, vertex, t1),
                creep=CREEP * self.spec.margin,
            )
        return found

    def _between_surfaces(
        self, x0: np.ndarray, x1: np.ndarray, dt: float | None, ahead: float, hold: float, begins: bool
    ) -> Contacts:
        """Contacts between surfaces. What the rule of the scene makes stick does so from where a step began."""
        assert self.surfaces is not None
        k_tau = self.surfaces.surfaces.k_tau
        if dt is not None or k_tau == 0:
            return self.surfaces.find(x0, x1, dt, ahead, hold, k_tau)
        if begins:
            found = self.surfaces.find(x0, x1, dt, ahead, 0.0, k_tau)
            self.ties = found.ties()
            return found
        return self.surfaces.find(x0, x1, dt, ahead, hold, 0.0).plus(self.ties)

    def _friction(self, touches: list[Touches], vertex: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """What friction may bear of each half-space [N]: its coefficient times what was last borne along the normal."""
        coefficient = np.repeat([c.friction for c in self.spec.colliders], [len(t.vertex) for t in touches])
        if not coefficient.any():
            return coefficient
        which, local = np.unique(vertex, return_inverse=True)
        return coefficient * move_in(-self.borne[which], local, normal, np.zeros(len(local)))

    def _cut(
        self, x: np.ndarray, vertex: np.ndarray, normal: np.ndarray, level: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Half-spaces as vertices of plane bodies see them: cut by their plane, in which they stay."""
        flat = np.flatnonzero(np.isin(vertex, self.spec.plane))
        if len(flat):
            level[flat] -= normal[flat, 2] * x[vertex[flat], 2]
            normal[flat, 2] = 0.0
            length = np.linalg.norm(normal[flat], axis=1)
            length[length == 0] = 1.0  # it is parallel to the plane, and nothing can be done
            normal[flat] /= length[:, None]
            level[flat] /= length
            aside = flat[(normal[flat] == 0).all(1)]
            level[aside] = -np.inf
        return normal, level

    def _anchors(self, touches: list[Touches], vertex: np.ndarray, t: float) -> np.ndarray:
        """Where vertices would be at time t had they stuck to the colliders since the step began, (k, 3) [m]."""
        assert self.since is not None
        x, t0 = self.since
        slips = [
            c.carried(q.point, t0, t) if c.friction else np.zeros((len(q.vertex), 3))
            for c, q in zip(self.spec.colliders, touches)
        ]
        return x[vertex] + np.concatenate(slips)
