"""Residual and true error against seconds of solving: what a method buys for its time."""

from pathlib import Path
from typing import Any

from pbng.bench.scenes import box, hard_start, model_of
from pbng.compare.comparison import ERRORS, RATIOS, Comparison
from pbng.compare.contest import Curve, contest
from pbng.compare.reference import converged
from pbng.compare.start import Start
from pbng.errors import InputError
from pbng.solvers.acceleration import SOR, Anderson, Chebyshev, NodeSOR
from pbng.solvers.base import Solver
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.newton import Newton
from pbng.solvers.pbng import PBNG

ACCELERATIONS: dict[str, Any] = {
    "plain": None,
    "node SOR 1.7": NodeSOR(1.7),
    "SOR as printed": SOR(),
    "Chebyshev as printed": Chebyshev(),
    "Anderson": Anderson(),
}
MOMENTS = 40  # at which a solve is looked at, off the clock
DECADES = 3  # that a figure shows
HIGHEST = 3.0  # that it shows


def solvers(threads: int | None) -> dict[str, Solver]:
    """The methods that are compared, all in float32 but Newton's, which is float64."""
    out: dict[str, Solver] = {
        name: PBNG(acceleration=a, dtype="float32", threads=threads) for name, a in ACCELERATIONS.items()
    }
    return out | {"two-grid": MultigridPBNG(dtype="float32", threads=threads), "Newton": Newton(threads=threads)}


def measure(n: int, model: str, nu: float, seconds: float, threads: int | None) -> Comparison:
    """Every method on the hard start of the block of n³ vertices, for so many seconds [s] each.

    Raises:
        InputError: The equilibrium that errors are distances from was not found.
    """
    problem = hard_start(box(n), model_of(model)(E=1e5, nu=nu, density=10.0))
    reference = converged(problem, Start.of(problem), threads)
    if not reference.certain:
        raise InputError(f"the reference is no equilibrium: {reference}")
    return contest(problem, solvers(threads), seconds=seconds, reference=reference, looks=MOMENTS)


def rows(comparison: Comparison) -> list[dict[str, Any]]:
    """What a table says of every curve, and the curve: seconds [s], ratios, and errors over the size of the body."""
    return [_row(comparison, name, curve) for name, curve in comparison.curves.items()]


def _row(comparison: Comparison, name: str, curve: Curve) -> dict[str, Any]:
    reached = {f"ratio {level:.0e}": curve.to_residual(level) for level in RATIOS}
    reached |= {f"error {level:.0e}": curve.to_error(level * comparison.size) for level in ERRORS}
    errors = comparison.errors(name)
    last = {"last_ratio": float(curve.ratios[-1]), "last_error": float(errors[-1]), "ms": curve.ms}
    arrays = {"seconds": curve.seconds, "ratios": curve.ratios, "errors": errors}
    times = {level: None if r is None else r.seconds for level, r in reached.items()}
    return {"method": name} | times | last | {k: a.tolist() for k, a in arrays.items()}


def draw(comparison: Comparison, path: Path, title: str) -> Path:
    """Two panels: the residual ratio, and the error, against seconds; returns the path."""
    from pbng.view import plot_residuals

    latest = max(c.seconds[-1] for c in comparison.curves.values())
    series = {}
    for name, c in comparison.curves.items():
        late = c.seconds >= latest * 10.0**-DECADES
        series[name] = c.seconds[late], c.ratios[late], comparison.errors(name)[late]
    return plot_residuals(
        series,
        path,
        xlabel="seconds of solving",
        ylabel=("residual / first residual", "largest position error / size"),
        title=title,
        log_x=True,
        top=HIGHEST,
        size=(9.0, 3.6),
    )
