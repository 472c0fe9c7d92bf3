"""The one loop of all methods: budget, monitoring, status."""

import math
import time
from collections.abc import Callable

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.solvers.base import Budget, History, Method, Monitor, Progress, Result, Status

SAFETY = 3.0  # how much too low an estimate of the error may be


def run(
    method: Method,
    x: np.ndarray,
    budget: Budget,
    monitor: Monitor | None = None,
    before: np.ndarray | None = None,
    targets: np.ndarray | None = None,
    contacts: Contacts | None = None,
    resume: bool = False,
    leave: Callable[[np.ndarray], bool] | None = None,
) -> Result:
    """Iterate from x (n_vert, 3), whose prescribed vertices are in place, until the budget says stop.

    The first residual is that of x. If ``before`` is x with the prescribed vertices where they were until now, the
    method may then begin at a better state, which it makes from the movement. The clock leaves out compilation. Ctrl-C
    ends the loop with the last state computed. ``targets`` are those of the problem's weak constraints (n_target, 3),
    ``contacts`` what touches during the solve. With ``resume`` x is where the last solve ended, and the method goes on
    in the precision that it had come to. Where ``leave`` says so of a monitored state the loop ends, as if the
    iterations were used up.
    """
    if budget.error is not None and not method.estimates_error:
        raise InputError(f"Budget(error={budget.error}): this method has no estimate of the error; use MultigridPBNG")
    every = budget.every or method.every
    clock, monitoring = _Clock(), _Clock(running=False)
    method.start(x, targets, contacts, resume)
    history = History()

    def certify(iteration: int) -> None:
        with monitoring:
            method.settle()
            history.add(iteration, method.certify())

    certify(0)
    refined = method.problem.weak and history.last.residual <= method.floor() and method.refine()
    if refined:
        # Rounding the ends of stiff springs makes forces as large as those that are to be balanced.
        history = History()
        certify(0)
    first, floor = history.last.residual, method.floor()
    tolerance = budget.tolerance(first)
    if budget.rtol is not None and not method.problem.weak:
        tolerance = max(tolerance, method.floor(np.float64))  # a fraction of rounding cannot be asked for
    status = _verdict(history, tolerance, floor, budget.error)
    at_all = budget.cap > 0 and budget.seconds != 0
    if status is Status.PRECISION and at_all and method.refine():
        refined, status, floor = True, None, method.floor()
    iteration, correction = 0, 0.0
    seen = -1, x  # an iteration and the state after it
    if status is None and at_all and before is not None and (better := method.prepare(before, x)) is not None:
        method.start(contacts.put_outside(better) if contacts is not None else better, targets, contacts)
        if refined:
            method.refine()
    try:
        while status is None:
            if iteration >= budget.cap:
                status = Status.ITERATIONS
            elif budget.seconds is not None and clock.seconds() >= budget.seconds and (iteration or not budget.seconds):
                status = Status.SECONDS
            else:
                due = (iteration + 1) % every == 0
                watched = due or iteration + 1 == budget.cap
                if watched and seen[0] != iteration:
                    with monitoring:
                        seen = iteration, method.state()
                method.step()
                iteration += 1
                if watched:
                    with monitoring:
                        was, seen = seen[1], (iteration, method.state())
                        correction = float(np.linalg.norm(seen[1] - was, axis=1).max(initial=0.0))
                if due:
                    certify(iteration)
                    status = _verdict(history, tolerance, floor, budget.error)
                    if status is Status.PRECISION and method.refine():
                        status, floor, seen = None, method.floor(), (-1, x)
                    if monitor is not None:
                        monitor(_progress(history, tolerance, clock.seconds()))
                    if status is None and leave is not None and leave(seen[1]):
                        status = Status.ITERATIONS
    except KeyboardInterrupt:
        status = Status.INTERRUPTED
        if iteration == 0:
            method.start(x, targets, contacts)  # of which the certificate is
    if history.monitored[-1] != iteration:
        certify(iteration)
        if status in (Status.ITERATIONS, Status.SECONDS):
            status = _verdict(history, tolerance, floor, budget.error) or status
    return Result(
        x=method.state(),
        status=status,
        iterations=iteration,
        residuals=np.array(history.residuals),
        energies=np.array(history.energies),
        monitored=np.array(history.monitored),
        force_scale=history.last.force_scale,
        inverted=history.last.inverted,
        correction=correction,
        error=history.last.error,
        seconds=clock.seconds(),
        monitor_seconds=monitoring.seconds(),
    )


def _verdict(history: History, tolerance: float, floor: float, error: float | None) -> Status | None:
    """Whether the last monitored state ends the loop."""
    residual = history.last.residual
    if not (math.isfinite(residual) and math.isfinite(history.last.energy)):
        return Status.DIVERGED
    if residual <= tolerance or residual == 0 or (error is not None and SAFETY * history.last.error <= error):
        return Status.CONVERGED
    if (len(history.residuals) == 1 and residual <= floor) or at_floor(history.residuals, floor):
        return Status.PRECISION
    return None


def at_floor(residuals: list[float], floor: float) -> bool:
    """Whether rounding is what is left: the residual is near its floor and has stopped falling."""
    recent, before = residuals[-3:], residuals[:-3]
    return bool(before) and recent[-1] < 4 * floor and min(recent) > 0.9 * min(before)


def _progress(history: History, tolerance: float, seconds: float) -> Progress:
    return Progress(
        history.monitored[-1], history.residuals[-1], history.residuals[0], history.energies[-1], tolerance, seconds
    )


class _Clock:
    """Seconds while it runs, less those spent compiling; a stopped one runs inside ``with``."""

    def __init__(self, running: bool = True) -> None:
        self.total = 0.0
        self.since = self._now() if running else None

    def seconds(self) -> float:
        return self.total + (0.0 if self.since is None else self._now() - self.since)

    def __enter__(self) -> None:
        self.since = self._now()

    def __exit__(self, *_: object) -> None:
        self.total, self.since = self.seconds(), None

    @staticmethod
    def _now() -> float:
        return time.perf_counter() - compile_seconds()
