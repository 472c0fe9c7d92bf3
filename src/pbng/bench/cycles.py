"""Cycles and time of the two-grid method against the size of the mesh, the model and Poisson's ratio."""

from typing import Any

from pbng.bench.convergence import LEVELS, iterations_to, ratios
from pbng.bench.scenes import box, hard_start, model_of
from pbng.bench.timing import peak_memory
from pbng.drivers import solve
from pbng.solvers.base import Budget, Result
from pbng.solvers.loop import run
from pbng.solvers.multigrid import MultigridPBNG

TIMED = (1e-3, 1e-6)
WARM_UP = 4  # cycles before the clock runs


def measure(n: int, model: str, nu: float, dtype: str, threads: int | None) -> dict[str, Any]:
    """A row of the table: the hard start of the block of n³ vertices."""
    material = model_of(model)(E=1e5, nu=nu, density=10.0)
    solver = MultigridPBNG(dtype=dtype, threads=threads)
    solve(hard_start(box(min(n, 8)), material), solver, Budget(iterations=WARM_UP))  # loads what setting up needs
    problem = hard_start(box(n), material)
    method = solver.set_up(problem)
    setup = method.setup_seconds
    x = problem.constrain(problem.X, problem.end)
    run(method, x, Budget(iterations=WARM_UP), before=problem.X)
    result = run(method, x, Budget(rtol=min(LEVELS), iterations=60, every=1), before=problem.X)
    row: dict[str, Any] = {"n": n, "model": model, "nu": nu, "tets": problem.n_elem}
    row |= {f"{level:.0e}": iterations_to(result, level) for level in LEVELS}
    row |= {f"s {level:.0e}": seconds_to(result, level) for level in TIMED}
    row |= {"ms": result.seconds_per_iteration * 1e3, "setup_s": setup, "peak_MB": peak_memory() / 1e6}
    row |= {"last": result.reduction, "inverted": result.inverted, "status": result.status.name}
    return row | {"ratios": ratios(result).tolist()}


def seconds_to(result: Result, level: float) -> float | None:
    """Their share of the time of the solve [s], monitoring excluded."""
    cycles = iterations_to(result, level)
    return None if cycles is None else cycles * result.seconds_per_iteration
