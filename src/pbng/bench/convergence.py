"""Residual against sweeps for each acceleration and model: what the default was chosen by."""

from typing import Any

import numpy as np

from pbng.bench.scenes import box, hard_start, model_of
from pbng.drivers import solve
from pbng.solvers.acceleration import SOR, Anderson, Chebyshev, NodeSOR
from pbng.solvers.base import Budget, Result
from pbng.solvers.pbng import PBNG

ACCELERATIONS: dict[str, Any] = {
    "plain": None,
    "node SOR 1.7": NodeSOR(1.7),
    "node SOR 1.9": NodeSOR(1.9),
    "SOR as printed": SOR(),
    "Chebyshev as printed": Chebyshev(),
    "Anderson(5), ω = 1": Anderson(5, 1.0),
    "Anderson(10), ω = 1": Anderson(10, 1.0),
    "Anderson(10), ω = 1.3": Anderson(10, 1.3),
}
LEVELS = (1e-2, 1e-3, 1e-4, 1e-6)


def measure(n: int, model: str, nu: float, sweeps: int, every: int, dtype: str) -> dict[str, Result]:
    """Results of every acceleration on the hard start of the block of n³ vertices."""
    problem = hard_start(box(n), model_of(model)(E=1e5, nu=nu, density=10.0))
    budget = Budget(iterations=sweeps, every=every)
    return {name: solve(problem, PBNG(acceleration=a, dtype=dtype), budget) for name, a in ACCELERATIONS.items()}


def ratios(result: Result) -> np.ndarray:
    """Residual over the first one at the monitored iterations."""
    return result.residuals / result.residuals[0]


def iterations_to(result: Result, level: float) -> int | None:
    """The first monitored iteration at which the ratio is below a level, or None."""
    met = np.flatnonzero(ratios(result) <= level)
    return int(result.monitored[met[0]]) if len(met) else None
