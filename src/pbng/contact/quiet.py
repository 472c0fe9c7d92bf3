"""Which vertices of cloth are away from all that they could touch, for longer than a step."""

import numpy as np

from pbng.contact.collider import norms

SERVED, PAUSE = 2, 8  # steps that it has to have lasted to be found out again at once, and every how many otherwise


class Quiet:
    """Remembers who was alone, by as much as all may go from where they were."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Nothing is known."""
        self.x, self.room, self.who, self.radius = np.empty((0, 3)), np.empty(0), np.empty(0, np.int64), -1.0
        self.steps, self.waited = SERVED, 0

    def alone(self, x: np.ndarray, way: np.ndarray, radius: float) -> np.ndarray | None:
        """Vertices (k,) with nothing within ``radius`` [m] at x (n_vert, 3) [m], if all go ``way`` (n_vert,) [m] there.

        None if that is not known any longer.
        """
        if radius > self.radius or not (norms(x - self.x) + way <= self.room).all():
            return None
        self.steps += 1
        return self.who

    def pays(self) -> bool:
        """Whether to find out anew: where all is restless, only once in a while."""
        self.waited = self.waited + 1 if self.steps < SERVED else PAUSE
        return self.waited >= PAUSE

    def note(self, x: np.ndarray, room: np.ndarray, radius: float, who: np.ndarray) -> np.ndarray:
        """Vertices (k,) have nothing within ``radius`` [m] of them until a vertex is farther from x than its ``room``.

        Both are of all vertices, (n_vert, 3) and (n_vert,) [m].
        """
        self.x, self.room, self.radius, self.who, self.steps, self.waited = x.copy(), room, radius, who, 0, 0
        return who
