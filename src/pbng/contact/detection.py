"""Everything that may touch in a step: surfaces each other, and colliders."""

import math
from dataclasses import replace

import numpy as np

from pbng.contact.collider import Touches
from pbng.contact.contacts import Contacts
from pbng.contact.pairs import SurfaceDetector
from pbng.contact.spec import CLOSE, NEAR, ContactSpec

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
        self.reach = self.surfaces.radius if self.surfaces else math.inf  # farther off, directions are of no use [m]
        self.since: tuple[np.ndarray, float] | None = None  # where the last step began, and when [s]
        self.borne = np.zeros((len(X), 3))  # with what force [N] colliders bear each vertex

    def check(self, x: np.ndarray) -> None:
        """As :meth:`pbng.contact.pairs.SurfaceDetector.check`."""
        if self.surfaces:
            self.surfaces.check(x)

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
        if t0 < t1 or self.since is None:
            self.since = x0, t0
        found = self.surfaces.find(x0, x1, dt, ahead, hold) if self.surfaces else Contacts()
        before, after, near = x0[self.free], x1[self.free], np.asarray(self.spec.margin + ahead)
        if dt is not None:
            near = CLOSE / NEAR * self.spec.margin + np.linalg.norm(after - before, axis=1)
        touches = [c.touch(before, after, t0, t1, near) for c in self.spec.colliders]
        if touches:
            normal = np.concatenate([t.normal for t in touches])
            vertex = self.free[np.concatenate([t.vertex for t in touches])].astype(np.int32)
            found = replace(
                found,
                vertex=vertex,
                plane=normal,
                level=(normal * np.concatenate([t.point for t in touches])).sum(1),
                friction=self._friction(touches, vertex, normal),
                anchor=self._anchors(touches, vertex, t1),
                creep=CREEP * self.spec.margin,
            )
        return found

    def _friction(self, touches: list[Touches], vertex: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """What friction may bear of each half-space [N]: its coefficient times what was last borne along the normal."""
        coefficient = np.repeat([c.friction for c in self.spec.colliders], [len(t.vertex) for t in touches])
        return coefficient * np.maximum((self.borne[vertex] * normal).sum(1), 0.0)

    def _anchors(self, touches: list[Touches], vertex: np.ndarray, t: float) -> np.ndarray:
        """Where vertices would be at time t had they stuck to the colliders since the step began, (k, 3) [m]."""
        assert self.since is not None
        x, t0 = self.since
        slips = [
            c.carried(q.point, t0, t) if c.friction else np.zeros((len(q.vertex), 3))
            for c, q in zip(self.spec.colliders, touches)
        ]
        return x[vertex] + np.concatenate(slips)
