"""Residual and true error against seconds of solving: what a method buys for its time."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pbng.bench.scenes import MODELS, box, hard_start
from pbng.drivers import solve
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.solvers.acceleration import SOR, Anderson, Chebyshev, NodeSOR
from pbng.solvers.base import Budget, Method, Solver, Status
from pbng.solvers.loop import at_floor
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.pbng import PBNG

ACCELERATIONS: dict[str, Any] = {
    "plain": None,
    "node SOR 1.7": NodeSOR(1.7),
    "SOR as printed": SOR(),
    "Chebyshev as printed": Chebyshev(),
    "Anderson": Anderson(),
}
RATIOS = (1e-2, 1e-3, 1e-4, 1e-6)
ERRORS = (1e-2, 1e-3, 1e-4)
MOMENTS = 40  # at which a solve is looked at, off the clock
DECADES = 3  # that they span
WARM_UP = 4  # steps before the clock runs: mixing begins with the third
HIGHEST = 3.0  # that a figure shows


@dataclass(frozen=True, eq=False)
class Curve:
    """A solve by one method: ``seconds`` of solving [s], ``ratios`` of the residual to that of the start, and largest
    position ``errors`` over the size of the body, each (k,); ``iterations`` done in all."""

    seconds: np.ndarray
    ratios: np.ndarray
    errors: np.ndarray
    iterations: int

    def to_ratio(self, level: float) -> float | None:
        """The first moment [s] at which the ratio was found below a level, or None."""
        return self._first(self.ratios, level)

    def to_error(self, level: float) -> float | None:
        """The first moment [s] at which the error was found below a level, or None."""
        return self._first(self.errors, level)

    def _first(self, values: np.ndarray, level: float) -> float | None:
        met = np.flatnonzero(values <= level)
        return float(self.seconds[met[0]]) if len(met) else None


def solvers(threads: int | None) -> dict[str, Solver]:
    """The methods that are compared, all in float32."""
    out: dict[str, Solver] = {name: PBNG(acceleration=a, threads=threads) for name, a in ACCELERATIONS.items()}
    return out | {"two-grid": MultigridPBNG(dtype="float32", threads=threads)}


def measure(n: int, model: str, nu: float, seconds: float, threads: int | None) -> dict[str, Curve]:
    """Curves of every method on the hard start of the block of n³ vertices, for so many seconds [s] each."""
    problem = hard_start(box(n), MODELS[model](E=1e5, nu=nu, density=10.0))
    reference = solve(problem, MultigridPBNG(dtype="float64", threads=threads), Budget(rtol=1e-11, iterations=300))
    if reference.status is not Status.CONVERGED:
        raise InputError(f"the reference is no equilibrium: {reference.status}")
    curves = {}
    for name, solver in solvers(threads).items():
        method = solver.set_up(problem)
        _start(method)
        for _ in range(WARM_UP):
            method.step()
        curves[name] = _watch(method, reference.x, seconds)
    return curves


def row(curve: Curve) -> dict[str, Any]:
    """What a table says of a curve, and the curve."""
    times = {f"ratio {level:.0e}": curve.to_ratio(level) for level in RATIOS}
    times |= {f"error {level:.0e}": curve.to_error(level) for level in ERRORS}
    arrays = {"seconds": curve.seconds, "ratios": curve.ratios, "errors": curve.errors}
    last = {"last_ratio": float(curve.ratios[-1]), "last_error": float(curve.errors[-1])}
    step = {"ms": float(curve.seconds[-1] / max(curve.iterations, 1) * 1e3)}
    return times | last | step | {k: a.tolist() for k, a in arrays.items()}


def draw(curves: dict[str, Curve], path: Path, title: str) -> Path:
    """Two panels: the residual ratio, and the error, against seconds; returns the path."""
    from pbng.view import plot_residuals

    latest = max(c.seconds[-1] for c in curves.values())
    late = {name: c.seconds >= latest * 10.0**-DECADES for name, c in curves.items()}
    return plot_residuals(
        {name: (c.seconds[late[name]], c.ratios[late[name]], c.errors[late[name]]) for name, c in curves.items()},
        path,
        xlabel="seconds of solving",
        ylabel=("residual / first residual", "largest position error / size"),
        title=title,
        log_x=True,
        top=HIGHEST,
        size=(9.0, 3.6),
    )


def _start(method: Method) -> None:
    """Begin at the rest state with prescribed vertices in place, or at the method's better state, as a solve does."""
    problem = method.problem
    x = problem.constrain(problem.X, problem.end)
    method.start(x)
    better = method.prepare(problem.X, x)
    if better is not None:
        method.start(better)


def _watch(method: Method, reference: np.ndarray, limit: float) -> Curve:
    """The curve of one solve, until time is up or rounding keeps the residual from falling.

    The clock runs while the method starts and steps, compilation left out, and stands while it is looked at.
    """
    problem = method.problem
    size = np.ptp(problem.X, axis=0).max()
    first, floor = problem.residual(problem.constrain(problem.X, problem.end)), method.floor()
    seconds = [_timed(lambda: _start(method))]
    residuals: list[float] = []
    errors: list[float] = []
    moments = np.geomspace(limit * 10.0**-DECADES, limit, MOMENTS)
    iterations = 0
    while True:
        method.settle()
        residuals.append(method.certify().residual)
        errors.append(float(np.linalg.norm(method.state() - reference, axis=1).max() / size))
        now = seconds[-1]
        if now >= limit or not np.isfinite(residuals[-1]) or at_floor(residuals, floor):
            break
        due = moments[moments > now][0]
        while now < due:
            now += _timed(method.step)
            iterations += 1
        seconds.append(now)
    return Curve(np.array(seconds), np.array(residuals) / first, np.array(errors), iterations)


def _timed(call: Callable[[], Any]) -> float:
    """Seconds [s] of a call, compilation left out."""
    start = time.perf_counter() - compile_seconds()
    call()
    return time.perf_counter() - compile_seconds() - start
