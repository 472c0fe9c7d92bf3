"""The equilibrium that errors are distances from: found by two grids, certified by Newton where that is cheap."""

import logging
import time
from dataclasses import dataclass, replace

import numpy as np

from pbng.compare.start import Judge, Start, distance
from pbng.equilibrium import Toucher, equilibrium
from pbng.problem import Problem
from pbng.solvers.base import Budget, Result, Status
from pbng.solvers.loop import run
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.newton import Newton

FOUND = 1e-10  # of the first residual: where the two-grid method stops
CERTAIN = 1e-9  # of it: what an equilibrium may have left
CYCLES, STEPS, LAST = 300, 60, 5
CHEAP = 200_000  # elements up to which Newton's method is asked, too
PATIENCE = 120.0  # seconds [s] that it is given
SETTLED = 1e-5  # of the first residual: where rounds that find what touches stop

log = logging.getLogger("pbng")


@dataclass(frozen=True, eq=False)
class Reference:
    """A state that others are measured by.

    Attributes:
        x: Positions [m], (n_vert, 3).
        residual: Its own residual [N].
        energy: Its energy [J].
        ratio: Its residual over that of the start.
        by: Who found it, or certified it last: "Newton", "MultigridPBNG" or "given".
        certain: Whether its residual is at most 1e-9 of the start's, or is rounding; true of a given one.
        inverted: Its elements with det F < 0.
        distance: Largest distance [m] of a vertex between the states of the two methods; NaN unless both have one.
        seconds: Time it took [s].
    """

    x: np.ndarray
    residual: float
    energy: float
    ratio: float
    by: str
    certain: bool
    inverted: int = 0
    distance: float = float("nan")
    seconds: float = 0.0

    def __str__(self) -> str:
        if self.by == "given":
            return f"given, residual {self.residual:.1e} N"
        if not self.certain:
            return f"none: {self.by} came to {self.ratio:.0e} of the first residual only"
        agreed = f", {self.distance:.0e} m from that of MultigridPBNG" if np.isfinite(self.distance) else ""
        folded = f", {self.inverted} inverted elements" if self.inverted else ""
        return f"equilibrium by {self.by}, residual {self.ratio:.0e} of the first{agreed}{folded}"


def given(problem: Problem, start: Start, x: np.ndarray) -> Reference:
    """A reference of one's own, x (n_vert, 3) [m]."""
    return _judged(problem, start, x, "given", True)


def touching(problem: Problem, start: Start, threads: int | None = None) -> Start:
    """The start with what touches, for all methods: that of the equilibrium which rounds come to from rest.

    A solve finds contacts anew in each round, at states of its own, so that methods would be given different problems.
    Those of the last round are right for all: with them the equilibrium is that of :func:`pbng.solve`.
    """
    if problem.contact is None:
        return start
    method = MultigridPBNG(dtype="float64", threads=threads).set_up(replace(problem))
    toucher = Toucher(problem, method)
    found = _finished(equilibrium(method, toucher, problem.X, 0.0, start.at, Budget(rtol=SETTLED, iterations=CYCLES)))
    if found.status not in (Status.CONVERGED, Status.PRECISION):
        log.warning(
            "pbng: what touches is not settled: rounds came to %.0e of the first residual only", found.reduction
        )
    contacts = toucher.contacts
    return replace(start, x=contacts.put_outside(start.x), contacts=contacts if len(contacts) else None)


def converged(problem: Problem, start: Start, threads: int | None = None) -> Reference:
    """The equilibrium that lies on the way from a start.

    There may be several, and another method may end in another one. What is not ``certain`` is no equilibrium. Newton's
    method is not asked where things may touch.

    Args:
        problem: What is solved.
        start: From where.
        threads: Threads; by default as many as prove fastest.
    """
    began, problem = time.perf_counter(), problem.at(start.at)
    first = Judge(problem, start).look(start.x).residual
    grids = MultigridPBNG(dtype="float64", threads=threads).set_up(replace(problem))
    budget = Budget(rtol=FOUND, iterations=CYCLES)
    found = _finished(run(grids, start.x, budget, before=start.before, targets=start.targets, contacts=start.contacts))
    out = _judged(problem, start, found.x, "MultigridPBNG", _certain(found, first))
    if problem.n_elem <= CHEAP and problem.contact is None:
        method = Newton(threads=threads).set_up(replace(problem))
        finite = np.isfinite(found.x).all()
        x, before = (np.asarray(found.x, float), None) if finite else (start.x, start.before)
        budget = Budget(atol=max(0.1 * FOUND * first, method.floor()), iterations=STEPS, seconds=PATIENCE)
        newton = _finished(run(method, x, budget, before=before, targets=start.targets))
        if _certain(newton, first):
            # The first residual of a bad start is huge; what Newton's method still gains from there costs little.
            budget = Budget(atol=10 * method.floor(), iterations=LAST)
            last = _finished(run(method, newton.x, budget, targets=start.targets))
            newton = last if last.residual < newton.residual else newton
            apart = distance(newton.x, x) if out.certain else float("nan")
            out = replace(_judged(problem, start, newton.x, "Newton", True), distance=apart)
    return replace(out, seconds=time.perf_counter() - began)


def _finished(result: Result) -> Result:
    """The result; an interrupted one is none."""
    if result.status is Status.INTERRUPTED:
        raise KeyboardInterrupt
    return result


def _certain(result: Result, first: float) -> bool:
    """Whether a result is an equilibrium, as far as float64 can tell."""
    return result.residual <= CERTAIN * first or result.status is Status.PRECISION


def _judged(problem: Problem, start: Start, x: np.ndarray, by: str, certain: bool) -> Reference:
    judge = Judge(problem, start)
    seen, first = judge.look(x), judge.look(start.x).residual
    ratio = seen.residual / first if first > 0 else 0.0
    return Reference(np.asarray(x, float), seen.residual, seen.energy, ratio, by, certain, seen.inverted)
