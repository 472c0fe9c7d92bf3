"""``pbng demo``: the shortest way from an installation to something to look at."""

import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from rich.markup import escape

from pbng import cli_run
from pbng.cli_console import err, out, table
from pbng.drivers import default_solver, solve
from pbng.errors import InputError
from pbng.gallery import find
from pbng.jit import compile_seconds
from pbng.solvers.acceleration import Anderson, NodeSOR
from pbng.solvers.base import Budget, Result
from pbng.solvers.pbng import PBNG

NEEDED = {"pyvista": "view", "imageio_ffmpeg": "view", "matplotlib": "view", "igl": "mesh"}
SCENES = {
    "twisting_block": "the block that the paper twists (Fig. 7)",
    "bent_surface": "a little dragon, held by its snout",
}
ROWS = 7  # of a table of frames


def demo(path: Path, resolution: int) -> None:
    """Run the twisting block and the hanging dragon, draw them, compare accelerations, and say what to look at.

    Raises:
        InputError: An optional package is missing, or the folder cannot be written.
    """
    from pbng.view import view

    missing = {package: extra for package, extra in NEEDED.items() if find_spec(package) is None}
    if missing:
        extras = ",".join(sorted(set(missing.values())))
        raise InputError(f"the demo needs {', '.join(missing)}: pip install 'pbng[{extras}]'")
    start = time.perf_counter()
    look: list[tuple[Path, str]] = []
    for name, what in SCENES.items():
        recipe = find(name)(resolution=resolution)
        report = cli_run.run(
            recipe,
            path / name,
            solver=recipe.solver or default_solver(recipe.budget),
            budget=recipe.budget,
            overwrite=True,
            label=name,
        )
        cli_run.summarize(report, compile_seconds())
        cli_run.finish(report)
        out.print(_frames(report.results, report.fps))
        err.print(f"{name}: drawing ...")
        pictures = {file.stem: file for file in view(report.path, path / f"{name}_view")}
        look += [
            (pictures["film"], f"{what}, as a film"),
            (pictures["strip"], "the same in one picture, coloured by its stretch"),
            (pictures["residuals"], "how far each frame was from equilibrium, before and after"),
        ]
    look.append((_compare(path / "accelerations.png"), "why PBNG mixes its sweeps: residuals of one hard equilibrium"))
    out.print(f"[bold]Look at[/] (made in {time.perf_counter() - start:.0f} s):")
    for file, words in look:
        out.print(f"  {escape(str(file))}  [dim]{words}[/]", soft_wrap=True)
    out.print("[dim]and then try:[/] pbng list")


def _frames(results: list[Result], fps: float) -> object:
    """The certificates of a few frames."""
    shown = table(pad_edge=False)
    for heading in ("t [s]", "iterations", "residual \\[N]", "at the end", "ratio", "inverted", "ended"):
        shown.add_column(heading, justify="left" if heading == "ended" else "right")
    for k in np.unique(np.linspace(0, len(results) - 1, ROWS).round().astype(int)):
        r = results[k]
        shown.add_row(
            f"{k / fps:.2f}",
            str(r.iterations),
            f"{r.residuals[0]:.2e}",
            f"{r.residual:.2e}",
            f"{r.reduction:.1e}" if r.iterations else "-",
            str(r.inverted),
            r.status.name.lower(),
        )
    return shown


def _compare(file: Path) -> Path:
    """Solve the fully twisted block in one step, from rest, by three accelerations, and plot their residuals."""
    from pbng.view import plot_residuals

    problem = find("twisting_block")(resolution=12).scene.compile()
    budget = Budget(iterations=300, every=5)
    solvers = {
        "plain": PBNG(acceleration=None),
        "node SOR": PBNG(acceleration=NodeSOR()),
        "Anderson": PBNG(acceleration=Anderson()),
    }
    curves = {}
    for name, solver in solvers.items():
        result = solve(problem, solver, budget)
        curves[name] = result.monitored, result.residuals
    return plot_residuals(curves, file, title="Twisted and stretched in one step")
