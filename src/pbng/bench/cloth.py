"""Cycles, sweeps and Newton's steps on sheets, each from level or drawn out at once; ``python -m pbng.bench.cloth``."""

import sys
from typing import Any

import numpy as np
from rich.console import Console

from pbng import shapes
from pbng.bench.convergence import LEVELS, iterations_to
from pbng.drivers import solve
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
METHODS: dict[str, Any] = {
    "cycles": lambda: MultigridPBNG(threads=1),
    "Newton": lambda: Newton(threads=1),
    "sweeps": lambda: PBNG(threads=1),
}
LONGEST = 10.0  # s
WARM_UP = 2  # iterations before the clock runs


def sheet(n: int, held: str, E: float, k: float) -> Problem:
    """A sheet of 1 m by 1 m, n² vertices, 10 kg/m², level: held by two corners, an edge or its rim under gravity, or
    without gravity drawn out by a fifth and turned by a quarter at one end."""
    scene = Scene(gravity=(0.0, 0.0 if held == "ends" else -9.8, 0.0), name=f"sheet held by its {held}")
    mesh = shapes.sheet((1.0, 1.0), n, (0.0, 0.0, -0.5))
    body = scene.add(mesh, Membrane(E=E, nu=0.3, density=10.0), Bending(k))
    x, z = np.abs(2 * mesh.X[:, 0] - 1), np.abs(2 * mesh.X[:, 2])
    near = mesh.X[:, 0] == 0
    scene.pin(body.where({"corners": near & (z == 1), "rim": (x == 1) | (z == 1)}.get(held, near)))
    if held == "ends":
        scene.move(body.where(x=1.0), Rotate("x", 0.25) + Translate((0.2, 0, 0)))
    return scene.compile()


def measure(n: int, held: str, E: float, k: float) -> list[dict[str, Any]]:
    """A row for each method: iterations to residual ratios, and seconds to them."""
    problem, found = sheet(n, held, E, k), []
    for name, make in METHODS.items():
        solve(problem, make(), Budget(iterations=WARM_UP))
        result = solve(problem, make(), Budget(rtol=min(LEVELS), iterations=10_000, seconds=LONGEST))
        row = {"n": n, "held": held, "E": E, "k": k, "method": name, "energy": result.energy, "last": result.reduction}
        row |= {f"{level:.0e}": iterations_to(result, level) for level in LEVELS}
        row |= {f"s {level:.0e}": _share(result, iterations_to(result, level)) for level in LEVELS}
        found.append(row)
    return found


def _share(result: Result, iterations: int | None) -> float | None:
    """What so many iterations took [s], monitoring included: the estimate of the error is part of it."""
    return None if iterations is None else iterations * result.seconds / max(result.iterations, 1)


def main(sizes: list[int]) -> None:
    """Print the table."""
    console = Console(width=170)
    for held in HELD:
        for n in sizes:
            for E, k in CLOTHS:
                for row in measure(n, held, E, k):
                    counts = " / ".join("-" if row[f"{v:.0e}"] is None else f"{row[f'{v:.0e}']}" for v in LEVELS)
                    times = " / ".join("-" if row[f"s {v:.0e}"] is None else f"{row[f's {v:.0e}']:.2f}" for v in LEVELS)
                    what = f"{held} {n}² E={E:g} k={k:g} {row['method']}"
                    console.print(f"{what}: {counts}   {times} s   last {row['last']:.1e}  {row['energy']:.6g} J")


if __name__ == "__main__":
    main([int(n) for n in sys.argv[1:]] or [16, 32, 64])
