"""Backward Euler: each step minimises the incremental potential ½ Σ m/Δt² |x - x̂|² + PE(x), x̂ = x + Δt v."""

import math
from dataclasses import replace

import numpy as np

from pbng.equilibrium import ContactReport, Toucher
from pbng.errors import InputError
from pbng.problem import Problem
from pbng.solvers.base import Budget, Monitor, Result, Solver, Status
from pbng.solvers.loop import run

WORST = (
    Status.CONVERGED, Status.PRECISION, Status.ITERATIONS, Status.SECONDS, Status.CONTACTS, Status.INTERRUPTED,
    Status.DIVERGED,
)  # fmt: skip


def steps_of(fps: float, dt: float | None, substeps: int | None) -> int:
    """Steps a frame: ``substeps``, or as few equal ones as are no longer than dt [s]; by default one.

    Raises:
        InputError: Both are given, or one is not positive.
    """
    if dt is not None and substeps is not None:
        raise InputError(f"give dt or substeps, not both ({dt} and {substeps})")
    if dt is not None:
        if not (math.isfinite(dt) and dt > 0):
            raise InputError(f"dt must be positive and finite, not {dt}")
        return max(1, math.ceil(1 / (fps * dt) - 1e-9))
    if substeps is not None and not (int(substeps) == substeps and substeps >= 1):
        raise InputError(f"substeps must be a whole number of at least 1, not {substeps}")
    return int(substeps or 1)


def velocities(problem: Problem, velocity: object) -> np.ndarray:
    """Velocities (n_vert, 3) [m/s] from one for all (3,), one for each, or None for rest.

    Raises:
        InputError: The shape is neither, or a number is not finite.
    """
    given = np.zeros(3) if velocity is None else np.asarray(velocity, float)
    if given.shape not in ((3,), problem.X.shape):
        raise InputError(f"velocity must have shape (3,) or {problem.X.shape}, not {given.shape}")
    if not np.isfinite(given).all():
        raise InputError("velocity is not finite")
    return np.array(np.broadcast_to(given, problem.X.shape))


class BackwardEuler:
    """A state that moves: positions x [m] and velocities v [m/s], both (n_vert, 3), at time t [s].

    Args:
        problem: What moves.
        solver: What solves each step.
        dt: Time step [s].
        x, v: The state at time 0; prescribed vertices are put in place.

    Raises:
        InputError: dt is not positive, or a free vertex has no mass.
    """

    def __init__(self, problem: Problem, solver: Solver, dt: float, x: np.ndarray, v: np.ndarray) -> None:
        self.solver, self.dt, self.step_number = solver, dt, 0
        self.toucher: Toucher | None = None
        self._take(problem)
        self.x, self.v = problem.constrain(x, 0.0), v
        held = problem.fixed
        if held.any():  # they have the velocity of their motion, not the one that was given
            self.v = np.array(v)
            self.v[held] = (problem.prescribed(dt) - problem.prescribed(0.0)) / dt

    def _take(self, problem: Problem) -> None:
        self.problem, self.free = problem, np.flatnonzero(~problem.fixed)
        self.method = self.solver.set_up(problem.dynamic(self.dt))
        self.toucher = Toucher(problem, self.method, self.toucher) if problem.contact else None

    @property
    def t(self) -> float:
        return self.step_number * self.dt

    def look(self) -> Result:
        """The certificate of the state as it is, once it is outside of the colliders."""
        result = self._run(self.x, self.x, self.t, Budget(iterations=0), None)
        if self.toucher:
            self.x = self.toucher.contacts.put_outside(self.x)
        return result

    def step(self, budget: Budget, monitor: Monitor | None = None) -> Result:
        """Take one step; a result that is not finite or was interrupted leaves the state as it was."""
        if (problem := self.problem.at(self.t + 1e-6 * self.dt)) is not self.problem:
            self._take(problem)
        ahead, t = self.x + self.dt * self.v, (self.step_number + 1) * self.dt
        result = self._run(self.problem.constrain(ahead, t), ahead, t, budget, monitor)
        if result.status.ok:
            x = np.asarray(result.x, float)
            self.v, self.x = (x - self.x) / self.dt, x
            self.step_number += 1
        return result

    def advance(self, steps: int, budget: Budget, monitor: Monitor | None = None) -> Result:
        """Take some steps: the last one's result, with the iterations and seconds of all and the worst status."""
        results: list[Result] = []
        if self.toucher:
            self.toucher.began()
        for _ in range(steps):
            results.append(self.step(budget, monitor))
            if not results[-1].status.ok:
                break
        return replace(
            results[-1],
            status=max((r.status for r in results), key=WORST.index),
            iterations=sum(r.iterations for r in results),
            seconds=sum(r.seconds for r in results),
            monitor_seconds=sum(r.monitor_seconds for r in results),
        )

    def report(self) -> ContactReport | None:
        """What touched in the steps since the last :meth:`advance` began."""
        return self.toucher.report(self.x) if self.toucher else None

    def _run(self, x: np.ndarray, ahead: np.ndarray, t: float, budget: Budget, monitor: Monitor | None) -> Result:
        """Solve for x (n_vert, 3) at time t [s], beginning there, with inertia that draws to ``ahead``."""
        targets = np.concatenate([self.problem.targets(t), ahead[self.free]])
        if self.toucher is None:
            return run(self.method, x, budget, monitor, targets=targets)
        contacts = self.toucher.find(self.x, x, max(t - self.dt, 0.0), t, dt=self.dt)
        x = self.toucher.start_of(contacts, x, targets) if budget.cap else contacts.put_outside(x)
        return run(self.method, x, budget, monitor, targets=targets, contacts=contacts)
