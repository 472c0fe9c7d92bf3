"""All methods on one problem, from one start, by one residual and one clock."""

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from pbng.compare.comparison import Comparison
from pbng.compare.curve import Curve, Reached
from pbng.compare.reference import Reference, converged, given, touching
from pbng.compare.runner import Limits, Runner
from pbng.compare.start import Judge, Start
from pbng.errors import InputError
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.solvers.base import Solver

__all__ = ["Comparison", "Curve", "Reached", "contest"]

log = logging.getLogger("pbng")

Monitor = Callable[[str, float], Any]


def contest(
    problem: Scene | Problem,
    solvers: Mapping[str, Solver],
    *,
    iterations: int | Mapping[str, int] | None = None,
    seconds: float | None = None,
    start: np.ndarray | None = None,
    at: float | None = None,
    reference: np.ndarray | Reference | str | None = "converged",
    looks: int = 40,
    rounds: int = 1,
    monitor: Monitor | None = None,
    leave_out: Callable[[str, str], Any] | None = None,
) -> Comparison:
    """Run every solver from the same start, for equal iterations, equal seconds or both, whichever ends first.

    A method is set up for itself and warmed up, neither on its clock, which runs only while it starts and steps. It
    ends before its limit when rounding keeps its residual from falling (``PRECISION``) or its state is not finite
    (``DIVERGED``). Where things may touch, all are given the contacts of the equilibrium
    (:func:`pbng.compare.reference.touching`), which takes a solve.

    Args:
        problem: A scene, or the problem it compiled to.
        solvers: Label -> solver.
        iterations: At most so many for all, or for each by its label.
        seconds: At most so many seconds [s] of stepping for each; the iteration under way is finished.
        start: Positions [m] (n_vert, 3) before the prescribed vertices move; by default the rest state.
        at: Time [s] at which motions are taken; by default when all have ended.
        reference: What position errors are distances from: "converged" for the equilibrium, computed before, which
            takes a while; positions (n_vert, 3) [m]; a :class:`Reference`; or None for no errors.
        looks: At about how many moments to look at each method, denser at first; at every iteration if that is less.
        rounds: How often to measure. States are the same in every round; times are medians, the methods taking turns.
        monitor: Called with a label and the share of its limits that is used up, whenever a method has been looked at;
            with "reference" while that is computed.
        leave_out: Called with the label of a solver that cannot do the problem, and why; it is then left out. Without
            this it is an error.

    Raises:
        InputError: Something given cannot be used, or a solver cannot do the problem; it names those that can. Or no
            solver can.
    """
    problem = problem.compile() if isinstance(problem, Scene) else problem
    limits = _limits(solvers, iterations, seconds, looks)
    if rounds < 1:
        raise InputError(f"contest: rounds must be at least 1, not {rounds}")
    begin = Start.of(problem, start, at)
    problem = problem.at(begin.at)
    runners = set_up(problem, solvers, leave_out)
    if monitor is not None and (isinstance(reference, str) or problem.contact is not None):
        monitor("reference", 0.0)
    begin = touching(problem, begin)
    known = _reference(problem, begin, reference)
    judge = Judge(problem, begin, known.x if known is not None and known.certain else None)
    curves = {}
    for label, runner in runners.items():
        runner.warm_up(begin)
        curves[label] = runner.watch(judge, limits[label], _told(monitor, label, rounds))
    for k in range(1, rounds):
        for label, runner in runners.items():
            curves[label] = replace(curves[label], seconds=runner.replay())
            if monitor is not None:
                monitor(label, (k + 1) / rounds)
    return Comparison(
        problem=problem,
        solvers={label: solvers[label] for label in runners},
        curves=curves,
        start=begin,
        energy=judge.look(begin.x).energy,
        first=judge.look(begin.x).residual,
        reference=known,
        iterations={label: limits[label].iterations for label in runners},
        seconds=seconds,
        looks=looks,
        rounds=rounds,
    )


def set_up(
    problem: Problem, solvers: Mapping[str, Solver], leave_out: Callable[[str, str], Any] | None = None
) -> dict[str, Runner]:
    """All solvers set up for a problem, before any work is done; without those that cannot do it, if ``leave_out`` is
    there to be told.

    Raises:
        InputError: Some cannot do it; all are named, with the reason, and those that can.
    """
    runners, refused = {}, {}
    for label, solver in solvers.items():
        try:
            runners[label] = Runner(label, solver, problem)
        except InputError as error:
            refused[label] = str(error)
    if runners and leave_out is not None:
        for label, why in refused.items():
            leave_out(label, why)
    elif refused:
        able = f"{', '.join(runners)} can" if runners else "nor can any other that was named"
        raise InputError(
            "; ".join(f"{label} cannot do this scene: {why}" for label, why in refused.items()) + f"; {able}"
        )
    return runners


def _limits(
    solvers: Mapping[str, Solver], iterations: int | Mapping[str, int] | None, seconds: float | None, looks: int
) -> dict[str, Limits]:
    if not solvers:
        raise InputError("contest: no solvers to compare")
    if iterations is None and seconds is None:
        raise InputError("contest: give iterations or seconds")
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0):
        raise InputError(f"contest: seconds must be positive and finite, not {seconds}")
    if looks < 2:
        raise InputError(f"contest: looks must be at least 2, not {looks}")
    if isinstance(iterations, Mapping):
        missing, extra = [k for k in solvers if k not in iterations], [k for k in iterations if k not in solvers]
        if missing or extra:
            raise InputError(f"contest: iterations for {missing or extra}, but the solvers are {list(solvers)}")
        counts: dict[str, int | None] = {label: iterations[label] for label in solvers}
    else:
        counts = dict.fromkeys(solvers, iterations)
    for label, count in counts.items():
        if count is not None and not (int(count) == count and count >= 1):
            raise InputError(f"contest: iterations must be a whole number of at least 1, not {count} ({label})")
    return {k: Limits(None if count is None else int(count), seconds, looks) for k, count in counts.items()}


def _reference(problem: Problem, start: Start, wanted: np.ndarray | Reference | str | None) -> Reference | None:
    if wanted is None or isinstance(wanted, Reference):
        return wanted
    if isinstance(wanted, str):
        if wanted != "converged":
            raise InputError(f"contest: reference must be 'converged', positions or None, not {wanted!r}")
        found = converged(problem, start)
        if not found.certain:
            log.warning("pbng: no reference: %s", found)
        return found
    x = np.asarray(wanted, float)
    if x.shape != problem.X.shape or not np.isfinite(x).all():
        raise InputError(f"contest: reference must be finite and have shape {problem.X.shape}, not {x.shape}")
    return given(problem, start, x)


def _told(monitor: Monitor | None, label: str, rounds: int) -> Callable[[float], Any]:
    return lambda share: monitor(label, share / rounds) if monitor is not None else None
