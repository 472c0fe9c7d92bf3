"""Frames of a motion on small budgets, each started from the one before: what a cycle or a sweep buys."""

from typing import Any

import numpy as np

from pbng.compare.frames import contest_frames
from pbng.compare.start import distance
from pbng.drivers import simulate
from pbng.gallery import find
from pbng.solvers.base import Budget, Solver
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.pbng import PBNG

Row = dict[str, Any]


def contestants(threads: int | None) -> dict[str, tuple[Solver, int]]:
    """Label -> solver and iterations a frame."""
    grids, sweeps = MultigridPBNG(threads=threads), PBNG(threads=threads)
    return {"6 sweeps": (sweeps, 6), "40 sweeps": (sweeps, 40), "1 cycle": (grids, 1), "2 cycles": (grids, 2)}


def measure(n: int, frames: int = 30, threads: int | None = None) -> list[Row]:
    """One row a contestant: position errors / size of every frame of the twisting block, and the time a frame took.

    ``errors`` (frames,) are the largest distances of a vertex from a reference, over the largest extent at rest. The
    motion is as fast as in the gallery, so that the last frame is not its end.
    """
    recipe = find("twisting_block")(resolution=n)
    problem = recipe.scene.compile()
    size = float(np.ptp(problem.X, axis=0).max())
    exact = simulate(
        problem, MultigridPBNG(threads=threads), Budget(rtol=1e-9, iterations=60), frames=frames, fps=recipe.fps
    )
    truth = [frame.x for frame in exact]
    # The residual is looked at once a frame, and not counted.
    entries = {name: (solver, Budget(iterations=count)) for name, (solver, count) in contestants(threads).items()}
    curves = contest_frames(problem, entries, frames=frames, fps=recipe.fps, keep=range(frames))
    rows = []
    for name, curve in curves.items():
        errors = [distance(curve.positions[k], x) / size for k, x in enumerate(truth)]
        median = float(np.median(errors[1:]))
        rows.append({"budget": name, "ms": curve.ms, "median": median, "last": errors[-1], "errors": errors})
    return rows
