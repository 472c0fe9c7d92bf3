"""Where all methods begin, and who judges the states they come to."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pbng.contact.contacts import ContactEnergy, Contacts
from pbng.drivers import check_held, checked_start
from pbng.errors import InputError
from pbng.packing import origin_of
from pbng.problem import Problem
from pbng.solvers.base import Method
from pbng.solvers.pbng import SLACK


@dataclass(frozen=True, eq=False)
class Start:
    """The state all methods begin with.

    Attributes:
        before: Positions [m], (n_vert, 3), before the prescribed vertices move.
        x: The same with these in their places.
        targets: Points in space that weak constraints end at [m], (n_target, 3).
        at: Time [s] at which motions are taken.
        contacts: What touches, found beforehand for all of them (:func:`pbng.compare.reference.touching`), or None.
    """

    before: np.ndarray
    x: np.ndarray
    targets: np.ndarray
    at: float
    contacts: Contacts | None = None

    @classmethod
    def of(cls, problem: Problem, start: np.ndarray | None = None, at: float | None = None) -> "Start":
        """From rest, or ``start`` (n_vert, 3) [m], to the time ``at`` [s], by default when every motion has ended.

        What is let go before that time is free: the start is that of ``problem.at(at)``.

        Raises:
            InputError: The positions have another shape or are not finite, nothing holds the problem any longer, or it
                is a step of backward Euler.
        """
        if problem.dt is not None:
            raise InputError(
                "a step of backward Euler has no equilibrium to compare methods on; give the problem itself"
            )
        before = checked_start(problem, start)
        time = problem.end if at is None else float(at)
        if not np.isfinite(time):
            raise InputError(f"at must be finite, not {at}")
        check_held("compare", problem, time)
        problem = problem.at(time)
        return cls(before, problem.constrain(before, time), problem.targets(time), time)

    def begin(self, method: Method) -> None:
        """Hand the start to a method, which may make a better one of it, as in a solve."""
        method.start(self.x, self.targets, self.contacts)
        better = method.prepare(self.before, self.x)
        if better is not None:
            better = better if self.contacts is None else self.contacts.put_outside(better)
            method.start(better, self.targets, self.contacts)


class Seen(NamedTuple):
    """A state: residual [N], energy [J], largest distance from the reference [m], and elements with det F < 0."""

    residual: float
    energy: float
    error: float
    inverted: int


class Judge:
    """One measure for all methods: the problem's own forces and energy in float64, at the positions handed over.

    Args:
        problem: What is solved.
        start: Where all begin: with the targets of weak constraints, and what touches.
        reference: The equilibrium (n_vert, 3) [m] that errors are distances from, or None.
    """

    def __init__(self, problem: Problem, start: Start, reference: np.ndarray | None = None) -> None:
        self.problem, self.targets, self.reference = problem, start.targets, reference
        self.free, n = ~problem.fixed, problem.n_vert
        self.origin = origin_of(problem.X)
        self.touching = ContactEnergy(start.contacts, n, np.arange(n), self.origin) if start.contacts else None

    def look(self, x: np.ndarray) -> Seen:
        """The state x (n_vert, 3) [m]."""
        x = np.asarray(x, float)
        with np.errstate(all="ignore"):
            forces, _, inverted = self.problem.evaluate(x, self.targets)
            f, energy = forces + self.problem.f_ext, self.problem.energy(x, self.targets)
            if self.touching:
                near = x - self.origin
                f += self.touching.forces(near)[0]
                self.touching.balance(f, near, SLACK * 0.5 * float(np.finfo(np.float32).eps * np.abs(near).max()))
                energy += self.touching.energy(near)
            return Seen(float(np.linalg.norm(f[self.free])), energy, distance(x, self.reference), inverted)


def distance(x: np.ndarray, y: np.ndarray | None) -> float:
    """Largest distance [m] between the vertices of two states (n_vert, 3); NaN without the second."""
    return float("nan") if y is None else float(np.linalg.norm(x - y, axis=1).max(initial=0.0))


def scattered(problem: Problem, seed: int = 0) -> np.ndarray:
    """Every free vertex anywhere in the bounding box of the rest state, (n_vert, 3) [m]: as bad a start as there is."""
    low, size = problem.X.min(0), np.ptp(problem.X, axis=0)
    x = low + np.random.default_rng(seed).random(problem.X.shape) * size
    return np.where(problem.fixed[:, None], problem.X, x)
