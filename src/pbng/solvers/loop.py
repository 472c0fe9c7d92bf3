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
    solve = _Solve(method, budget, x)
    method.start(x, targets, contacts, resume)
    solve.begin()
    better = method.prepare(before, x) if solve.status is None and before is not None else None
    if better is not None:
        method.start(contacts.put_outside(better) if contacts is not None else better, targets, contacts)
        if solve.refined:
            method.refine()
    try:
        while solve.status is None:
            solve.iterate(monitor, leave)
    except KeyboardInterrupt:
        solve.status = Status.INTERRUPTED
        if solve.iteration == 0:
            method.start(x, targets, contacts, resume=True)  # of which the certificate is
    return solve.result()


class _Solve:
    """A solve on its way: where it is, what was seen of it, and why it ended, once it has.

    Args:
        method: Holds the state.
        budget: Says when to stop.
        x: Where it starts, (n_vert, 3) [m].
    """

    def __init__(self, method: Method, budget: Budget, x: np.ndarray) -> None:
        self.method, self.budget = method, budget
        self.every = budget.every or method.every
        self.at_all = budget.cap > 0 and budget.seconds != 0  # whether there may be iterations
        self.clock, self.monitoring = _Clock(), _Clock(running=False)
        self.history = History()
        self.iteration, self.correction = 0, 0.0
        self.seen = -1, x  # an iteration, and the state after it if it is the present one
        self.status: Status | None = None
        self.refined = False
        self.tolerance, self.floor = -1.0, 0.0

    def begin(self) -> None:
        """Look at the start, in a precision that can tell it from rest, and set the tolerance by it.

        It may end the solve: at rest already, or with a budget of nothing.
        """
        method, budget = self.method, self.budget
        self._certify()
        if method.problem.weak and self.history.last.residual <= method.floor() and method.refine():
            # Rounding the ends of stiff springs makes forces as large as those that are to be balanced.
            self.refined, self.history = True, History()
            self._certify()
        self.tolerance, self.floor = budget.tolerance(self.history.last.residual), method.floor()
        if budget.rtol is not None and not method.problem.weak:
            self.tolerance = max(self.tolerance, method.floor(np.float64))  # a fraction of rounding cannot be asked for
        self._judge()
        self.status = self.status or self._used_up()

    def iterate(self, monitor: Monitor | None, leave: Callable[[np.ndarray], bool] | None) -> None:
        """One more iteration, if the budget has room for one, and a look at the state after it where one is due."""
        self.status = self._used_up()
        if self.status is not None:
            return
        due = (self.iteration + 1) % self.every == 0
        if due or self.iteration + 1 == self.budget.cap:
            self._measured_step()
        else:
            self._step()
        if due:
            self._certify()
            self._judge()
            if monitor is not None:
                monitor(self._progress())
            if self.status is None and leave is not None and leave(self.seen[1]):
                self.status = Status.ITERATIONS

    def result(self) -> Result:
        """The last state and its certificate."""
        history = self.history
        if self.status is Status.INTERRUPTED and self.iteration:
            history.drop(self.iteration)  # the state may be that of half an iteration more
        if history.monitored[-1:] != [self.iteration]:
            self._certify()
            if self.status in (Status.ITERATIONS, Status.SECONDS):
                self.status = self._verdict() or self.status
        assert self.status is not None
        return Result(
            x=self.method.state(),
            status=self.status,
            iterations=self.iteration,
            residuals=np.array(history.residuals),
            energies=np.array(history.energies),
            monitored=np.array(history.monitored),
            force_scale=history.last.force_scale,
            inverted=history.last.inverted,
            correction=self.correction,
            error=history.last.error,
            seconds=self.clock.seconds(),
            monitor_seconds=self.monitoring.seconds(),
        )

    def _certify(self) -> None:
        with self.monitoring:
            self.method.settle()
            self.history.add(self.iteration, self.method.certify())

    def _judge(self) -> None:
        """Whether the state just certified ends the solve; at the floor of one precision it goes on in a higher one."""
        self.status = self._verdict()
        if self.status is Status.PRECISION and self.at_all and self.method.refine():
            self.status, self.refined, self.floor = None, True, self.method.floor()
            self.seen = -1, self.seen[1]  # it put the prescribed vertices anew

    def _used_up(self) -> Status | None:
        """What of the budget is used up, if anything; any time but zero has room for one iteration."""
        budget = self.budget
        if self.iteration >= budget.cap:
            return Status.ITERATIONS
        late = budget.seconds is not None and self.clock.seconds() >= budget.seconds
        return Status.SECONDS if late and (self.iteration or not budget.seconds) else None

    def _step(self) -> None:
        self.method.step()
        self.iteration += 1

    def _measured_step(self) -> None:
        """A step, and how far it moves vertices."""
        if self.seen[0] != self.iteration:
            with self.monitoring:
                self.seen = self.iteration, self.method.state()
        was = self.seen[1]
        self._step()
        with self.monitoring:
            self.seen = self.iteration, self.method.state()
            self.correction = float(np.linalg.norm(self.seen[1] - was, axis=1).max(initial=0.0))

    def _verdict(self) -> Status | None:
        """Whether the last monitored state ends the loop."""
        history, error = self.history, self.budget.error
        residual = history.last.residual
        if not (math.isfinite(residual) and math.isfinite(history.last.energy)):
            return Status.DIVERGED
        if residual <= self.tolerance or residual == 0 or (error is not None and SAFETY * history.last.error <= error):
            return Status.CONVERGED
        if (len(history.residuals) == 1 and residual <= self.floor) or at_floor(history.residuals, self.floor):
            return Status.PRECISION
        return None

    def _progress(self) -> Progress:
        h = self.history
        return Progress(
            h.monitored[-1], h.residuals[-1], h.residuals[0], h.energies[-1], self.tolerance, self.clock.seconds()
        )


def at_floor(residuals: list[float], floor: float) -> bool:
    """Whether rounding is what is left: the residual is near its floor and has stopped falling."""
    recent, before = residuals[-3:], residuals[:-3]
    return bool(before) and recent[-1] < 4 * floor and min(recent) > 0.9 * min(before)


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
