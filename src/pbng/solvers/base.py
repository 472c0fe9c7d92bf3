"""What every solver is asked and what it answers: Budget, Status, Result, and the two halves of a solver."""

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.errors import InputError
from pbng.problem import Problem

ITERATION_CAP = 10_000  # where a budget names no other limit


@dataclass(frozen=True, kw_only=True)
class Budget:
    """When to stop: at the first limit that is met. With no argument, ``Budget(rtol=1e-3)``.

    Args:
        iterations: At most so many iterations.
        seconds: At most so many seconds [s], set-up and compilation excluded.
        rtol: Stop when the residual has fallen to this fraction of the first one.
        atol: Stop when the residual norm is below this [N].
        error: Stop when the position error is below this [m], that is when three times its estimate is; only for
            methods that estimate it.
        every: Evaluate the residual every so many iterations; by default as often as suits the method's iterations.
    """

    iterations: int | None = None
    seconds: float | None = None
    rtol: float | None = None
    atol: float | None = None
    error: float | None = None
    every: int | None = None

    def __post_init__(self) -> None:
        for name, low in (("iterations", 0), ("seconds", 0), ("rtol", 0), ("atol", 0), ("error", 0), ("every", 1)):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value >= low):
                raise InputError(f"Budget: {name} must be finite and at least {low}, not {value}")
        for name in ("iterations", "every"):
            value = getattr(self, name)
            if value is not None and int(value) != value:
                raise InputError(f"Budget: {name} must be a whole number, not {value}")
        if self.iterations is None and self.seconds is None and not self.accurate:
            object.__setattr__(self, "rtol", 1e-3)

    @property
    def accurate(self) -> bool:
        """Whether it asks for an accuracy, and not only for an amount of work."""
        return not (self.rtol is None and self.atol is None and self.error is None)

    @property
    def cap(self) -> int:
        """The limit on iterations, a generous one if none was given."""
        return ITERATION_CAP if self.iterations is None else int(self.iterations)

    def tolerance(self, first: float) -> float:
        """The residual [N] at which to stop when the first one was ``first``; -1 if there is none."""
        limits = [-1.0]
        if self.rtol is not None:
            limits.append(self.rtol * first)
        if self.atol is not None:
            limits.append(self.atol)
        return max(limits)


class Status(enum.Enum):
    """Why a solve ended, as a sentence."""

    CONVERGED = "The residual, or the estimated error, met the tolerance."
    ITERATIONS = "The iterations of the budget were used up."
    SECONDS = "The time of the budget was used up."
    PRECISION = "The residual reached the floor that rounding the positions leaves; float64 goes below that of float32."
    CONTACTS = "Each round of contacts changed the equilibrium; the last state is that of the last round."
    DIVERGED = "The state is not finite."
    INTERRUPTED = "Interrupted; the state is the last one computed."

    def __str__(self) -> str:
        return self.value

    @property
    def ok(self) -> bool:
        """Whether the state is finite and the solve ran to the end of its budget or tolerance."""
        return self not in (Status.DIVERGED, Status.INTERRUPTED)


@dataclass(frozen=True, eq=False)
class Result:
    """A state and its certificate; residuals and energies are float64 whatever the solver computed in.

    Attributes:
        x: Positions [m], (n_vert, 3), in the precision of the solver.
        status: Why the solve ended.
        iterations: Iterations done.
        residuals: Norms [N] of the total force on free vertices at the monitored iterations, first and last included.
        energies: Potential energy [J] there.
        monitored: The numbers of those iterations; the first is 0.
        force_scale: Sum of the norms of all element forces [N] at the end; what the residual is small against.
        inverted: Elements with det F < 0 at the end.
        correction: Largest displacement of a vertex in the last iteration [m].
        error: Estimate of the largest distance of a vertex from equilibrium [m]; NaN where the method has none.
        seconds: Time of the solve [s], monitoring included, set-up and compilation excluded.
        monitor_seconds: The part of it that went into evaluating residuals [s].
        setup_seconds: Time to set up [s], compilation excluded; zero where a set-up was reused.
    """

    x: np.ndarray
    status: Status
    iterations: int
    residuals: np.ndarray
    energies: np.ndarray
    monitored: np.ndarray
    force_scale: float
    inverted: int
    correction: float
    error: float
    seconds: float
    monitor_seconds: float = 0.0
    setup_seconds: float = 0.0

    @property
    def residual(self) -> float:
        """The last residual [N]."""
        return float(self.residuals[-1])

    @property
    def energy(self) -> float:
        """The last energy [J]."""
        return float(self.energies[-1])

    @property
    def reduction(self) -> float:
        """The last residual over the first (0 if the first was 0)."""
        return float(self.residuals[-1] / self.residuals[0]) if self.residuals[0] > 0 else 0.0

    @property
    def relative_residual(self) -> float:
        """The last residual over the force scale (0 if that is 0)."""
        return self.residual / self.force_scale if self.force_scale > 0 else 0.0

    @property
    def seconds_per_iteration(self) -> float:
        """Mean time of an iteration [s], monitoring excluded."""
        return (self.seconds - self.monitor_seconds) / max(self.iterations, 1)


@dataclass(frozen=True)
class Certificate:
    """The state of a solve in float64: residual [N], energy [J], force scale [N], inverted elements, and an estimate of
    the largest position error [m], NaN where the method has none."""

    residual: float
    energy: float
    force_scale: float
    inverted: int
    error: float = math.nan


def norm(f: np.ndarray) -> float:
    """Euclidean norm, summed in an order of its own: threads of BLAS would show in the last bits."""
    return math.sqrt(float((f * f).sum()))


@dataclass(frozen=True)
class Progress:
    """What a monitor is told: iteration, residual and energy there, the tolerance [N] (-1: none), seconds so far."""

    iteration: int
    residual: float
    first: float
    energy: float
    tolerance: float
    seconds: float


Monitor = Callable[[Progress], Any]


class Method(Protocol):
    """A solver set up for one problem; reused from frame to frame and pose to pose."""

    problem: Problem
    setup_seconds: float
    every: int  # iterations between evaluations of the residual, unless the budget says otherwise
    estimates_error: bool

    def prepare(self, before: np.ndarray, x: np.ndarray) -> np.ndarray | None:
        """A better state to start from than x (n_vert, 3), which is ``before`` with prescribed vertices moved."""

    def start(
        self,
        x: np.ndarray,
        targets: np.ndarray | None = None,
        contacts: Contacts | None = None,
        resume: bool = False,
    ) -> None:
        """Take x (n_vert, 3) as the state, with the prescribed vertices where they belong.

        ``targets`` (n_target, 3) are those of the problem's weak constraints, by default at the end of every motion;
        ``contacts`` are what touches, by default nothing. No vertex may lie outside their half-spaces.
        With ``resume`` x is where the method is, and it keeps its precision.
        """

    def step(self) -> None:
        """One iteration."""

    def settle(self) -> None:
        """Make the present state one to look at or stop at."""

    def state(self) -> np.ndarray:
        """The present positions [m], (n_vert, 3)."""

    def certify(self) -> Certificate:
        """The present state in float64."""

    def refine(self) -> bool:
        """Go on in a higher precision; False if there is none, or none was asked for."""

    def floor(self, dtype: Any = None) -> float:
        """The residual [N] that rounding the positions to a precision, by default the method's, may leave."""


class Solver(Protocol):
    """What a user configures: frozen, and good for any number of problems."""

    def set_up(self, problem: Problem) -> Method:
        """Everything that does not depend on the state."""


@dataclass
class History:
    """The monitored values of a solve."""

    residuals: list[float] = field(default_factory=list)
    energies: list[float] = field(default_factory=list)
    monitored: list[int] = field(default_factory=list)
    last: Certificate = field(default_factory=lambda: Certificate(math.nan, math.nan, math.nan, 0))

    def add(self, iteration: int, certificate: Certificate) -> None:
        self.residuals.append(certificate.residual)
        self.energies.append(certificate.energy)
        self.monitored.append(iteration)
        self.last = certificate

    def drop(self, iteration: int) -> None:
        """Forget the last values if they are of this iteration."""
        if self.monitored[-1:] == [iteration]:
            for values in (self.residuals, self.energies, self.monitored):
                values.pop()
