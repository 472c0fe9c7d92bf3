"""Methods side by side over the frames of a motion, each on a budget of its own."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pbng.drivers import simulate
from pbng.errors import InputError
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.solvers.base import Budget, Solver, Status

SELDOM = 10**9  # iterations between looks at the residual: at the start and the end of a frame only
WARM_UP = 3  # frames before those that count

Monitor = Callable[[str, int], Any]


@dataclass(frozen=True, eq=False)
class FrameCurve:
    """What one method did with every frame; n frames, the one at time 0 included.

    Attributes:
        label: What the method is called.
        t: Times [s], (n,).
        residuals: Residual [N] at the end of each frame, (n,); NaN from the frame on in which the method diverged.
        ratios: The same over the residual that the frame began with, (n,).
        energies: Energy [J] at the end of each, (n,): potential, or with inertia that of the last step.
        seconds: Time [s] spent on each, (n,): set-up, compilation and looking at residuals excluded.
        iterations: Iterations of each, (n,).
        inverted: Elements with det F < 0 at the end of each, (n,).
        statuses: Why each ended, n of them.
        positions: Frame -> positions [m], (n_vert, 3) float64, of those that were to be kept and did not diverge.
        setup_seconds: Time [s] to set up, compilation excluded.
    """

    label: str
    t: np.ndarray
    residuals: np.ndarray
    ratios: np.ndarray
    energies: np.ndarray
    seconds: np.ndarray
    iterations: np.ndarray
    inverted: np.ndarray
    statuses: tuple[Status, ...]
    positions: dict[int, np.ndarray] = field(default_factory=dict)
    setup_seconds: float = 0.0

    @property
    def diverged(self) -> int | None:
        """The frame in which the state ceased to be finite, if any."""
        return self.statuses.index(Status.DIVERGED) if Status.DIVERGED in self.statuses else None

    @property
    def ms(self) -> float:
        """Median time of a frame [ms], of those after the first; NaN if there are none."""
        done = self.seconds[1:][np.isfinite(self.seconds[1:])]
        return float(np.median(done)) * 1e3 if len(done) else float("nan")


def contest_frames(
    problem: Scene | Problem,
    entries: Mapping[str, tuple[Solver, Budget]],
    *,
    frames: int,
    fps: float,
    inertia: bool = False,
    dt: float | None = None,
    substeps: int | None = None,
    keep: Iterable[int] = (-1,),
    monitor: Monitor | None = None,
) -> dict[str, FrameCurve]:
    """Run the same frames by every method, each frame from the method's own last one.

    A budget that names no accuracy is spent whole, and the residual is looked at before and after only. The look before
    counts against ``Budget(seconds=...)``, which is the loop's clock, but not in :attr:`FrameCurve.seconds`.

    Args:
        problem: A scene, or the problem it compiled to.
        entries: Label -> solver and its budget for a frame, or with inertia for a step.
        frames: Number of frames, the one at time 0 included.
        fps: Frames a second [1/s].
        inertia, dt, substeps: As for :func:`pbng.simulate`.
        keep: Frames whose positions are kept; negative ones count from the end.
        monitor: Called with a label and a frame that is done.

    Raises:
        InputError: Something given cannot be used, or a solver cannot do the problem. A method that diverges does not
            raise: its frames from there on are NaN.
    """
    if not entries:
        raise InputError("contest_frames: no methods to compare")
    problem = problem.compile(free=inertia) if isinstance(problem, Scene) else problem
    kept = {k + frames if k < 0 else k for k in keep}
    if not kept <= set(range(frames)):
        raise InputError(f"contest_frames: there are {frames} frames; cannot keep {sorted(kept - set(range(frames)))}")
    options: dict[str, Any] = {"fps": fps, "inertia": inertia, "dt": dt, "substeps": substeps}
    curves = {}
    for label, (solver, limits) in entries.items():
        budget = limits if limits.accurate or limits.every is not None else replace(limits, every=SELDOM)
        try:
            # Kernels are compiled and loaded by a few frames that do not count.
            for _ in simulate(replace(problem), solver, budget, frames=min(frames, WARM_UP), **options):
                pass
            curves[label] = _run(label, replace(problem), solver, budget, frames, options, kept, monitor)
        except InputError as error:
            raise InputError(f"{label} cannot do these frames: {error}") from error
    return curves


def _run(
    label: str,
    problem: Problem,
    solver: Solver,
    budget: Budget,
    frames: int,
    options: dict[str, Any],
    kept: set[int],
    monitor: Monitor | None,
) -> FrameCurve:
    numbers = np.full((4, frames), np.nan)
    counts = np.zeros((2, frames), np.int64)
    statuses = [Status.DIVERGED] * frames
    positions, setup_seconds = {}, 0.0
    for frame in simulate(problem, solver, budget, frames=frames, **options):
        k, r = frame.index, frame.result
        setup_seconds = setup_seconds or r.setup_seconds
        if r.status is Status.DIVERGED:
            break
        numbers[:, k] = r.residual, r.reduction, r.energy, r.seconds - r.monitor_seconds
        counts[:, k] = r.iterations, r.inverted
        statuses[k] = r.status
        if k in kept:
            positions[k] = np.array(frame.x, float)
        if monitor is not None:
            monitor(label, k)
    residuals, ratios, energies, seconds = numbers
    return FrameCurve(
        label=label,
        t=np.arange(frames) / options["fps"],
        residuals=residuals,
        ratios=ratios,
        energies=energies,
        seconds=seconds,
        iterations=counts[0],
        inverted=counts[1],
        statuses=tuple(statuses),
        positions=positions,
        setup_seconds=setup_seconds,
    )
