"""What one method did: its residual, energy and position error at some moments of its own time."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pbng.solvers.base import Status


class Reached(NamedTuple):
    """When a level was first found met: after how many seconds of stepping [s], and how many iterations."""

    seconds: float
    iterations: int


@dataclass(frozen=True, eq=False)
class Curve:
    """A solve by one method, looked at k times.

    Attributes:
        label: What the method is called.
        iterations: Iterations done at each look, (k,); the first look is at 0, at the state the method begins with:
            that of all, or a better one that it made of the movement of the prescribed vertices.
        seconds: Time [s] that the method had spent, (k,): starting and stepping, but not compiling or being looked at.
        residuals: Norm [N] of the force on the free vertices in float64, (k,).
        energies: Potential energy [J], (k,).
        errors: Largest distance [m] of a vertex from the reference, (k,); NaN without one.
        inverted: Elements with det F < 0, (k,).
        x: The last state [m], (n_vert, 3) float64.
        first: Residual [N] of the start that all methods share.
        status: Why it ended.
        setup_seconds: Time [s] to set up, compilation excluded.
        compile_seconds: Time [s] spent on compiling kernels that no method before it had needed.
    """

    label: str
    iterations: np.ndarray
    seconds: np.ndarray
    residuals: np.ndarray
    energies: np.ndarray
    errors: np.ndarray
    inverted: np.ndarray
    x: np.ndarray
    first: float
    status: Status
    setup_seconds: float = 0.0
    compile_seconds: float = 0.0

    @property
    def ratios(self) -> np.ndarray:
        """Residuals over that of the shared start, (k,)."""
        return self.residuals / self.first if self.first > 0 else np.where(self.residuals > 0, np.inf, 0.0)

    @property
    def ms(self) -> float:
        """Mean time of an iteration [ms]; NaN if there was none."""
        steps = int(self.iterations[-1])
        return float(self.seconds[-1] - self.seconds[0]) / steps * 1e3 if steps else float("nan")

    def to_residual(self, ratio: float) -> Reached | None:
        """When the residual was first found at most this part of the shared start's, if ever."""
        return self._first(self.ratios <= ratio)

    def to_error(self, level: float) -> Reached | None:
        """When the position error was first found at most this [m], if ever."""
        return self._first(self.errors <= level)

    def _first(self, met: np.ndarray) -> Reached | None:
        k = np.flatnonzero(met)
        return Reached(float(self.seconds[k[0]]), int(self.iterations[k[0]])) if len(k) else None
