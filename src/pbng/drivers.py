"""Drivers: one equilibrium, one a frame, or motion."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbng.dynamics import BackwardEuler, steps_of, velocities
from pbng.equilibrium import ContactReport, Equilibria, Toucher, equilibrium
from pbng.errors import InputError
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.solvers.base import Budget, Method, Monitor, Result, Solver, Status
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.pbng import PBNG


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a simulation: its number, time [s], positions (n_vert, 3) [m] of all bodies, and certificate.

    With inertia there are velocities v (n_vert, 3) [m/s] too, and the energy of the result is the incremental potential
    of the last step. Where something may touch, ``contact`` reports what did.
    """

    index: int
    t: float
    x: np.ndarray
    result: Result
    problem: Problem
    v: np.ndarray | None = None
    contact: ContactReport | None = None

    @property
    def potential_energy(self) -> float:
        """Elastic energy and that of weak constraints, less the work of external forces since rest [J]."""
        return self.problem.energy(self.x, self.problem.targets(self.t))

    @property
    def springs(self) -> np.ndarray:
        """The two ends (m, 2, 3) [m] of each weak constraint."""
        weak = self.problem.weak_energy
        return weak.ends(self.x, self.problem.targets(self.t)) if weak else np.empty((0, 2, 3))

    @property
    def kinetic_energy(self) -> float:
        """½ Σ m |v|² [J]; 0 without inertia."""
        return 0.0 if self.v is None else 0.5 * float(self.problem.mass @ (self.v**2).sum(1))

    @property
    def momentum(self) -> np.ndarray:
        """Σ m v [kg m/s], (3,)."""
        return np.zeros(3) if self.v is None else self.problem.mass @ self.v

    @property
    def angular_momentum(self) -> np.ndarray:
        """Σ m x × v about the origin [kg m²/s], (3,)."""
        return np.zeros(3) if self.v is None else self.problem.mass @ np.cross(self.x, self.v)


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
        InputError: The scene or the start is not usable, or what holds the scene has let go by then.
    """
    problem = scene.compile() if isinstance(scene, Scene) else scene
    t = problem.end if at is None else at
    check_held("solve", problem, t)
    problem = problem.at(t)
    x, budget = checked_start(problem, start), budget or Budget()
    method = (solver or default_solver(budget)).set_up(problem)
    toucher = Toucher(problem, method) if problem.contact else None
    return _timed(method, equilibrium(method, toucher, x, 0.0, t, budget, monitor))


def simulate(
    scene: Scene | Problem,
    solver: Solver | None = None,
    budget: Budget | None = None,
    *,
    frames: int,
    fps: float = 30.0,
    start: np.ndarray | None = None,
    monitor: Monitor | None = None,
    inertia: bool = False,
    dt: float | None = None,
    substeps: int | None = None,
    velocity: Any = None,
) -> Iterator[Frame]:
    """Frames of a scene, quasistatic or in motion.

    Quasistatic, frame k is the equilibrium at time k / fps, started from frame k - 1; frame 0 is that at time 0. With
    ``inertia``, frame 0 is the start, and backward Euler goes from frame to frame; bodies may be free. Ctrl-C raises
    KeyboardInterrupt once the frames so far have been handed over; a frame that was interrupted is not.

    Args:
        frames: Number of frames, the one at time 0 included.
        fps: Frames a second [1/s].
        scene, solver, budget, start, monitor: As for :func:`solve`; the budget is that of one frame, or of one step.
        inertia: Whether masses resist acceleration.
        dt: Longest time step [s]; a frame is divided into as few equal steps as that takes. By default one.
        substeps: Instead, how many steps a frame has.
        velocity: At the start [m/s], (3,) for all vertices or (n_vert, 3); by default rest.

    Raises:
        InputError: Something given cannot be used, a free vertex has no mass where there is inertia, or without it what
            holds the scene lets go before the last frame.
    """
    if frames < 1 or not (math.isfinite(fps) and fps > 0):
        raise InputError(f"simulate: frames must be at least 1 and fps positive, not {frames} and {fps}")
    if not inertia and not (dt is None and substeps is None and velocity is None):
        raise InputError("simulate: dt, substeps and velocity are for inertia=True")
    problem = scene.compile(free=inertia) if isinstance(scene, Scene) else scene
    x, budget = checked_start(problem, start), budget or Budget()
    solver = solver or default_solver(budget)
    if inertia:
        steps = steps_of(fps, dt, substeps)
        moving = BackwardEuler(problem, solver, 1 / (fps * steps), x, velocities(problem, velocity))
        return _moving_frames(moving, steps, budget, frames, monitor)
    check_held("simulate", problem, (frames - 1) / fps, "take fewer frames, or inertia=True")
    return _frames(Equilibria(problem, solver, x), budget, frames, fps, monitor)


def default_solver(budget: Budget) -> Solver:
    """What solves if nothing is said: for an accuracy the two-grid method, for an amount of work alone sweeps.

    See ``docs/choosing.md`` for the measurements behind it.
    """
    return MultigridPBNG() if budget.accurate else PBNG()


def _frames(
    equilibria: Equilibria, budget: Budget, frames: int, fps: float, monitor: Monitor | None
) -> Iterator[Frame]:
    for k in range(frames):
        result, report = equilibria.at(k / fps, budget, monitor)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        result = _timed(equilibria.method, result) if k == 0 else result
        yield Frame(k, k / fps, result.x, result, equilibria.problem, contact=report)


def _moving_frames(
    moving: BackwardEuler, steps: int, budget: Budget, frames: int, monitor: Monitor | None
) -> Iterator[Frame]:
    first = _timed(moving.method, moving.look())
    yield Frame(0, 0.0, moving.x, first, moving.problem, moving.v, moving.report())
    for k in range(1, frames):
        result = moving.advance(steps, budget, monitor)
        if result.status is Status.INTERRUPTED:
            raise KeyboardInterrupt
        yield Frame(k, moving.t, result.x, result, moving.problem, moving.v, moving.report())
        if not result.status.ok:
            return  # the state is lost


def check_held(what: str, problem: Problem, t: float, way_out: str = "give a time at= before that") -> None:
    """InputError, which begins with ``what``, if until time t [s] all that holds the problem lets go."""
    let_go = [since for since, phase in problem.phases() if since <= t and not phase.held]
    if problem.held and let_go:  # who compiled a problem with free=True that nothing ever held has asked for it
        raise InputError(
            f"{what}: after t = {let_go[0]:g} s nothing holds scene {problem.name!r}: the equilibrium is not unique;"
            f" {way_out}, or hold a part of each body"
        )


def _timed(method: Method, result: Result) -> Result:
    return replace(result, setup_seconds=method.setup_seconds)


def checked_start(problem: Problem, start: np.ndarray | None) -> np.ndarray:
    """Where to start from, (n_vert, 3) [m]: a copy of ``start``, or the rest state; InputError if it cannot be used."""
    x = problem.X if start is None else np.array(start, float)
    if x.shape != problem.X.shape:
        raise InputError(f"start must have shape {problem.X.shape}, not {x.shape}")
    if not np.isfinite(x).all():
        raise InputError(f"start is not finite at vertex {np.flatnonzero(~np.isfinite(x).all(1))[0]}")
    return x
