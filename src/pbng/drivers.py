"""Drivers: one equilibrium, or one a frame."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pbng.errors import InputError
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.solvers.base import Budget, Method, Monitor, Result, Solver, Status
from pbng.solvers.loop import run
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.pbng import PBNG


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a simulation: its number, time [s], positions (n_vert, 3) [m] of all bodies, and certificate."""

    index: int
    t: float
    x: np.ndarray
    result: Result
    problem: Problem


def solve(
    scene: Scene | Problem,
    solver: Solver | None = None,
    budget: Budget | None = None,
    *,
    at: float | None = None,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
) -> Result:
    """The equilibrium of a scene.

    Args:
        scene: A scene, or the problem it compiled to.
        solver: By default :func:`default_solver` of the budget.
        budget: By default ``Budget(rtol=1e-3)``.
        at: Time [s] at which motions are taken; by default when all have ended.
        start: Positions [m] (n_vert, 3) to start from; by default the rest state.
        monitor: Called with a :class:`pbng.solvers.base.Progress` whenever the residual has been evaluated.

    Raises:
        InputError: The scene or the start is not usable.
    """
    problem = scene.compile() if isinstance(scene, Scene) else scene
    x, budget = _start(problem, start), budget or Budget()
    method = (solver or default_solver(budget)).set_up(problem)
    return _timed(method, _equilibrium(method, x, problem.end if at is None else at, budget, monitor))


def simulate(
    scene: Scene | Problem,
    solver: Solver | None = None,
    budget: Budget | None = None,
    *,
    frames: int,
    fps: float = 30.0,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
) -> Iterator[Frame]:
    """Quasistatic frames: frame k is the equilibrium at time k / fps, started from frame k - 1.

    Frame 0 is the equilibrium at time 0. Ctrl-C raises KeyboardInterrupt once the frames so far have been handed over;
    a frame that was interrupted is not.

    Args:
        frames: Number of frames, the one at time 0 included.
        fps: Frames a second [1/s].
        scene, solver, budget, start, monitor: As for :func:`solve`; the budget is that of one frame.
    """
    if frames < 1 or not fps > 0:
        raise InputError(f"simulate: frames must be at least 1 and fps positive, not {frames} and {fps}")
    problem = scene.compile() if isinstance(scene, Scene) else scene
    x, budget = _start(problem, start), budget or Budget()
    return _frames((solver or default_solver(budget)).set_up(problem), x, budget, frames, fps, monitor)


def default_solver(budget: Budget) -> Solver:
    """What solves if nothing is said: for an accuracy the two-grid method, for an amount of work alone sweeps.

    See ``docs/choosing.md`` for the measurements behind it.
    """
    return MultigridPBNG() if budget.accurate else PBNG()


def _frames(
    method: Method, x: np.ndarray, budget: Budget, frames: int, fps: float, monitor: Monitor | None
) -> Iterator[Frame]:
    for k in range(frames):
        t = k / fps
        result = _equilibrium(method, x, t, budget, monitor)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        result = _timed(method, result) if k == 0 else result
        yield Frame(k, t, result.x, result, method.problem)
        x = result.x


def _equilibrium(method: Method, x: np.ndarray, t: float, budget: Budget, monitor: Monitor | None) -> Result:
    """The equilibrium at time t, from the state x before the prescribed vertices moved to where they then belong."""
    problem = method.problem
    return run(method, problem.constrain(x, t), budget, monitor, before=x, targets=problem.targets(t))


def _timed(method: Method, result: Result) -> Result:
    return replace(result, setup_seconds=method.setup_seconds)


def _start(problem: Problem, start: np.ndarray | None) -> np.ndarray:
    x = problem.X if start is None else np.asarray(start, float)
    if x.shape != problem.X.shape:
        raise InputError(f"start must have shape {problem.X.shape}, not {x.shape}")
    if not np.isfinite(x).all():
        raise InputError(f"start is not finite at vertex {np.flatnonzero(~np.isfinite(x).all(1))[0]}")
    return x
