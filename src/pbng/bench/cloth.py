"""Cycles, sweeps and Newton's steps on sheets, each from level or drawn out at once."""

from typing import Any

import numpy as np

from pbng import shapes
from pbng.bench.convergence import LEVELS, iterations_to
from pbng.drivers import solve
from pbng.errors import InputError
from pbng.materials.bending import Bending
from pbng.materials.membrane import Membrane
from pbng.motions import Rotate, Translate
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.solvers.base import Budget, Result
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.newton import Newton
from pbng.solvers.pbng import PBNG

HELD = ("corners", "edge", "rim", "ends")
CLOTHS = ((1e3, 0.0), (1e3, 0.05), (1e4, 0.0))  # E [N/m] and stiffness against bending [N m]
METHODS: dict[str, Any] = {"cycles": MultigridPBNG, "Newton": Newton, "sweeps": PBNG}
WARM_UP = 2  # iterations before the clock runs


def check_held(held: str) -> None:
    """InputError if no sheet is held so."""
    if held not in HELD:
        raise InputError(f"no sheet is held by {held!r}; it may be {', '.join(HELD)}")


def sheet(n: int, held: str, E: float, k: float) -> Problem:
    """A sheet of 1 m by 1 m, n² vertices, 10 kg/m², level: held by two corners, an edge or its rim under gravity, or
    without gravity drawn out by a fifth and turned by a quarter at one end.

    Raises:
        InputError: No sheet is held so.
    """
    check_held(held)
    scene = Scene(gravity=(0.0, 0.0 if held == "ends" else -9.8, 0.0), name=f"sheet held by its {held}")
    mesh = shapes.sheet((1.0, 1.0), n, (0.0, 0.0, -0.5))
    body = scene.add(mesh, Membrane(E=E, nu=0.3, density=10.0), Bending(k))
    x, z = np.abs(2 * mesh.X[:, 0] - 1), np.abs(2 * mesh.X[:, 2])
    near = mesh.X[:, 0] == 0
    scene.pin(body.where({"corners": near & (z == 1), "rim": (x == 1) | (z == 1)}.get(held, near)))
    if held == "ends":
        scene.move(body.where(x=1.0), Rotate("x", 0.25) + Translate((0.2, 0, 0)))
    return scene.compile()


def measure(n: int, held: str, E: float, k: float, seconds: float, threads: int | None) -> list[dict[str, Any]]:
    """A row for each method, which has so many seconds [s]: iterations to residual ratios, and seconds to them."""
    problem, found = sheet(n, held, E, k), []
    for name, make in METHODS.items():
        solve(problem, make(threads=threads), Budget(iterations=WARM_UP))
        budget = Budget(rtol=min(LEVELS), iterations=10_000, seconds=seconds)
        result = solve(problem, make(threads=threads), budget)
        row = {"n": n, "held": held, "E": E, "k": k, "method": name, "energy": result.energy, "last": result.reduction}
        row |= {f"{level:.0e}": iterations_to(result, level) for level in LEVELS}
        row |= {f"s {level:.0e}": _share(result, iterations_to(result, level)) for level in LEVELS}
        found.append(row | {"status": result.status.name})
    return found


def _share(result: Result, iterations: int | None) -> float | None:
    """What so many iterations took [s], monitoring included: the estimate of the error is part of it."""
    return None if iterations is None else iterations * result.seconds / max(result.iterations, 1)
