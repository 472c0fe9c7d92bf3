"""One method on the clock: it runs while the method starts and steps, and stands while its state is looked at."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from pbng.compare.curve import Curve
from pbng.compare.start import Judge, Seen, Start
from pbng.jit import compile_seconds
from pbng.problem import Problem
from pbng.solvers.base import Solver, Status
from pbng.solvers.loop import at_floor

T = TypeVar("T")

WARM_UP = 4  # steps before the clock runs: mixing begins with the third
DECADES = 3  # of seconds that the looks are spread over


@dataclass(frozen=True)
class Limits:
    """When a method has to stop, and at which moments before it is looked at: about ``looks``, spread geometrically."""

    iterations: int | None
    seconds: float | None
    looks: int

    def marks(self) -> set[int]:
        """Iterations after which to look, whatever the time."""
        if not self.iterations:
            return set()
        if self.iterations <= self.looks:
            return set(range(1, self.iterations + 1))
        return set(np.geomspace(1, self.iterations, self.looks).round().astype(int).tolist())

    def moments(self) -> np.ndarray:
        """Times [s] to look at as soon as they have passed."""
        if self.seconds is None:
            return np.empty(0)
        return np.geomspace(self.seconds * 10.0**-DECADES, self.seconds, self.looks)

    def met(self, iteration: int, seconds: float) -> Status | None:
        """Why there is no further iteration, if there is none; a limit of seconds allows one at least."""
        if self.iterations is not None and iteration >= self.iterations:
            return Status.ITERATIONS
        if self.seconds is not None and seconds >= self.seconds and iteration:
            return Status.SECONDS
        return None

    def share(self, iteration: int, seconds: float) -> float:
        """How much of it is used up, 0 to 1."""
        shares = [
            iteration / self.iterations if self.iterations else 0.0,
            seconds / self.seconds if self.seconds else 0,
        ]
        return min(1.0, max(shares))


class Runner:
    """A method, set up for a problem of its own, so that it finds nothing that another has prepared.

    Args:
        label: What it is called.
        solver: The method.
        problem: What it solves.

    Raises:
        InputError: The solver cannot do the problem.
    """

    def __init__(self, label: str, solver: Solver, problem: Problem) -> None:
        self.label = label
        before = compile_seconds()
        self.method, self.setup_seconds = timed(lambda: solver.set_up(replace(problem)))
        self.compile_seconds = compile_seconds() - before

    def warm_up(self, start: Start) -> None:
        """Compile and load what the first steps need; from now on it begins there."""
        before, self.begin_at = compile_seconds(), start
        start.begin(self.method)
        for _ in range(WARM_UP):
            self.method.step()
        self.method.settle()
        self.method.state()
        self.compile_seconds += compile_seconds() - before

    def watch(self, judge: Judge, limits: Limits, monitor: Callable[[float], Any] = lambda share: None) -> Curve:
        """Run within the limits, or until rounding keeps the residual from falling, or the state is not finite."""
        method, before = self.method, compile_seconds()
        marks, moments = limits.marks(), limits.moments()
        first = judge.look(self.begin_at.x).residual
        spent = [self._begin()]  # seconds of stepping before each look and after the one before
        at, self.refined_after = [0], set[int]()
        seen = [self._look(judge)]
        floor = method.floor()
        while True:
            iteration, now, extra = at[-1], sum(spent), 0.0
            status = _verdict(seen, floor) or limits.met(iteration, now)
            if status is Status.PRECISION and limits.met(iteration, now) is None:
                refined, extra = timed(method.refine)
                if refined:
                    status, floor = None, method.floor()
                    self.refined_after.add(len(at) - 1)
            monitor(limits.share(iteration, now))
            if status is not None:
                break
            due = next((m for m in moments if m > now), np.inf)
            used = extra
            while True:
                used += timed(method.step)[1]
                iteration += 1
                if iteration in marks or now + used >= due or limits.met(iteration, now + used):
                    break
            spent.append(used)
            at.append(iteration)
            seen.append(self._look(judge))
        self.at, self.spent = at, [spent]
        residuals, energies, errors, inverted = (np.array(v) for v in zip(*seen))
        return Curve(
            label=self.label,
            iterations=np.array(at),
            seconds=np.cumsum(spent),
            residuals=residuals,
            energies=energies,
            errors=errors,
            inverted=inverted,
            x=np.asarray(method.state(), float),
            first=first,
            status=status,
            setup_seconds=self.setup_seconds,
            compile_seconds=self.compile_seconds + compile_seconds() - before,
        )

    def replay(self) -> np.ndarray:
        """Do the same once more and return the seconds [s] at each look: each stretch is the median of all rounds."""
        spent = [self._begin()]
        self.method.settle()  # it belongs to the path: what is looked at may be undone
        for k, steps in enumerate(np.diff(self.at)):
            used = timed(self.method.refine)[1] if k in self.refined_after else 0.0
            for _ in range(steps):
                used += timed(self.method.step)[1]
            spent.append(used)
            self.method.settle()
        self.spent.append(spent)
        return np.cumsum(np.median(self.spent, axis=0))

    def _begin(self) -> float:
        return timed(lambda: self.begin_at.begin(self.method))[1]

    def _look(self, judge: Judge) -> Seen:
        self.method.settle()
        return judge.look(self.method.state())


def timed(call: Callable[[], T]) -> tuple[T, float]:
    """What a call returns, and the seconds [s] it took, compilation left out."""
    start = time.perf_counter() - compile_seconds()
    out = call()
    return out, time.perf_counter() - compile_seconds() - start


def _verdict(seen: list[Seen], floor: float) -> Status | None:
    """Whether the last state ends the run, whatever the limits."""
    residual, energy, _, _ = seen[-1]
    if not (np.isfinite(residual) and np.isfinite(energy)):
        return Status.DIVERGED
    if residual == 0:
        return Status.CONVERGED
    if (len(seen) == 1 and residual <= floor) or at_floor([s.residual for s in seen], floor):
        return Status.PRECISION
    return None
