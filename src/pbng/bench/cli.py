"""The ``pbng bench`` commands."""

import json
import os
import sys
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

app = typer.Typer(
    help="Measure: time of a sweep, convergence, accuracy, cycles, poses, frames, contact, cloth.", no_args_is_help=True
)
console = Console(width=None if sys.stdout.isatty() or "COLUMNS" in os.environ else 170)  # tables are wide


def _known(models: Any) -> Any:
    """One model or several, all of them known: found out before the work, not in the midst of it."""
    from pbng.bench.scenes import model_of

    for name in [models] if isinstance(models, str) else models:
        model_of(name)
    return models


def _held(names: list[str] | None) -> list[str] | None:
    from pbng.bench.cloth import check_held

    for name in names or ():
        check_held(name)
    return names


def _writable(path: Path | None) -> Path | None:
    """A file that can be written, its folder made if need be: found out before the work, not after."""
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
    return path


class Real(StrEnum):
    """Precisions that there are kernels for."""

    FLOAT32 = "float32"
    FLOAT64 = "float64"


_MODEL = typer.Option("--model", help="Model to measure.", callback=_known)
_SIZE = typer.Option("--n", help="Vertices along an edge of the block.", min=3)  # of 2 none is free
_THREADS = typer.Option("--threads", help="Number of threads.", min=1)
Model = Annotated[str, _MODEL]
Models = Annotated[list[str], _MODEL]
Size = Annotated[int, _SIZE]
Sizes = Annotated[list[int], _SIZE]
Threads = Annotated[int, _THREADS]
Numbers = Annotated[list[int], _THREADS]
Rounds = Annotated[int, typer.Option("--rounds", help="Times are medians over so many rounds.", min=1)]
Ratio = Annotated[float, typer.Option("--nu", help="Poisson's ratio.")]
Ratios = Annotated[list[float], typer.Option("--nu", help="Poisson's ratios.")]
Precision = Annotated[Real, typer.Option("--dtype", help="Precision of the sweeps.")]
Seed = Annotated[int, typer.Option("--seed", help="Of what is random.", min=0)]
Folder = Annotated[Path | None, typer.Option("--out", help="Folder for figures.", file_okay=False)]
Record = Annotated[
    Path | None,
    typer.Option("--record", help="Write the figures to this JSON file.", dir_okay=False, callback=_writable),
]


@app.command("sweep")
def sweep_command(
    n: Sizes = [32, 64],  # noqa: B006
    delaunay: Annotated[
        int, typer.Option(help="Vertices along an edge of the random-order mesh; 0 for none.", min=0)
    ] = 33,
    model: Models = ["corotated", "neo-hookean"],  # noqa: B006
    threads: Numbers = [1, 2],  # noqa: B006
    dtype: Precision = Real.FLOAT32,
    rounds: Rounds = 15,
    reference: Annotated[Path | None, typer.Option(help="Folder of an implementation to compare with.")] = None,
    record: Record = None,
) -> None:
    """Time a sweep of PBNG, in one run with a reference implementation if one is given."""
    from pbng.bench import sweep

    cases = [("box", m) for m in n] + ([("delaunay", delaunay)] if delaunay else [])
    rows = sweep.measure(cases, model, threads, dtype, rounds, reference)
    show(
        f"One sweep, {dtype}, median of {rounds} rounds",
        [
            Column("mesh", "mesh"),
            Column("tets", "tets", "{:,}"),
            Column("model", "model"),
            Column("threads", "threads"),
            Column("ms", "ms", "{:.2f}"),
            Column("best", "best_ms", "{:.2f}"),
            Column("ns/tet", "ns_per_tet", "{:.1f}"),
            Column("paper, 8 threads", "paper_ns"),
            Column("/ reference", "ratio", "{:.2f}"),
            Column("best / best", "best_ratio", "{:.2f}"),
            Column("set-up [s]", "setup_s", "{:.2f}"),
            Column("layout [MB]", "layout_MB", "{:.0f}"),
            Column("peak [MB]", "peak_MB", "{:.0f}"),
        ],
        rows,
    )
    write(record, "sweep", rows)


@app.command("convergence")
def convergence_command(
    n: Sizes = [32],  # noqa: B006
    model: Models = [  # noqa: B006
        "corotated",
        "neo-hookean",
        "stable-neo-hookean",
    ],
    nu: Ratios = [0.3],  # noqa: B006
    sweeps: Annotated[int, typer.Option(help="Sweeps of each.", min=1)] = 200,
    every: Annotated[int, typer.Option(help="Sweeps between looks at the residual.", min=1)] = 10,
    dtype: Precision = Real.FLOAT64,
    out: Folder = None,
    record: Record = None,
) -> None:
    """Residual against sweeps: a block turned by 90° and stretched by half in one step, from rest."""
    from pbng.bench import convergence

    rows = []
    for m in n:
        for name in model:
            for v in nu:
                results = convergence.measure(m, name, v, sweeps, every, dtype)
                for acceleration, r in results.items():
                    row: dict[str, Any] = {"n": m, "model": name, "nu": v, "acceleration": acceleration}
                    row |= {f"{level:.0e}": convergence.iterations_to(r, level) for level in convergence.LEVELS}
                    row |= {"last": r.reduction, "ms": r.seconds_per_iteration * 1e3, "status": r.status.name}
                    row["ratios"] = convergence.ratios(r).tolist()
                    rows.append(row)
                if out is not None:
                    from pbng.view import plot_residuals

                    out.mkdir(parents=True, exist_ok=True)
                    plot_residuals(
                        {k: (r.monitored, convergence.ratios(r)) for k, r in results.items()},
                        out / f"convergence_{m}_{name}_{v}.png",
                        xlabel="sweeps",
                        ylabel="residual / first residual",
                        title=f"{m}³ vertices, {name}, ν = {v}",
                    )
    levels = [Column(f"{level:.0e}", f"{level:.0e}") for level in convergence.LEVELS]
    show(
        f"Sweeps to a residual ratio, {dtype}",
        [Column(c, c) for c in ("n", "model", "nu", "acceleration")]
        + levels
        + [Column(f"after {sweeps}", "last", "{:.1e}"), Column("ms/sweep", "ms", "{:.2f}")],
        rows,
    )
    write(record, "convergence", rows)


@app.command("accuracy")
def accuracy_command(
    n: Size = 32,
    model: Model = "corotated",
    nu: Ratio = 0.3,
    seconds: Annotated[float, typer.Option(help="Seconds of solving by each method.", min=0.001)] = 4.0,
    threads: Threads = 2,
    out: Folder = None,
    record: Record = None,
) -> None:
    """Residual and true position error against seconds, by method: the block of ``convergence``."""
    from pbng.bench import accuracy

    found = accuracy.measure(n, model, nu, seconds, threads)
    about = f"{n}³ vertices, {model}, ν = {nu}"
    if out is not None:
        accuracy.draw(found, out / f"accuracy_{n}_{model}_{nu}.png", about)
    rows = [{"n": n, "model": model, "nu": nu} | row for row in accuracy.rows(found)]
    ratios = [Column(f"{level:.0e}", f"ratio {level:.0e}", "{:.3f}") for level in accuracy.RATIOS]
    errors = [Column(f"error {level:.0e}", f"error {level:.0e}", "{:.3f}") for level in accuracy.ERRORS]
    show(
        f"Seconds to a residual ratio and to a position error / size, {about}, {threads} threads, float32",
        [
            Column("method", "method"),
            *ratios,
            *errors,
            Column("last ratio", "last_ratio", "{:.1e}"),
            Column("last error", "last_error", "{:.1e}"),
            Column("ms/iteration", "ms", "{:.2f}"),
        ],
        rows,
    )
    write(record, "accuracy", rows)


@app.command("cycles")
def cycles_command(
    n: Sizes = [16, 32, 64],  # noqa: B006
    model: Models = [  # noqa: B006
        "corotated",
        "neo-hookean",
        "stable-neo-hookean",
    ],
    nu: Ratios = [0.3, 0.45, 0.49],  # noqa: B006
    dtype: Precision = Real.FLOAT32,
    threads: Threads = 2,
    record: Record = None,
) -> None:
    """Cycles of the two-grid method to a residual ratio: the block of ``convergence``."""
    from pbng.bench import cycles

    rows = [cycles.measure(m, name, v, dtype, threads) for m in n for name in model for v in nu]
    show(
        f"Cycles to a residual ratio, {dtype}, {threads} threads",
        [Column("n", "n"), Column("tets", "tets", "{:,}"), Column("model", "model"), Column("ν", "nu")]
        + [Column(f"{level:.0e}", f"{level:.0e}") for level in cycles.LEVELS]
        + [Column("ms/cycle", "ms", "{:.1f}")]
        + [Column(f"s to {level:.0e}", f"s {level:.0e}", "{:.3f}") for level in cycles.TIMED]
        + [
            Column("set-up [s]", "setup_s", "{:.2f}"),
            Column("peak [MB]", "peak_MB", "{:.0f}"),
            Column("last", "last", "{:.1e}"),
            Column("inverted", "inverted"),
            Column("status", "status"),
        ],
        rows,
    )
    write(record, "cycles", rows)


@app.command("frames")
def frames_command(
    n: Size = 32,
    frames: Annotated[int, typer.Option(help="Frames of the twisting block.", min=2)] = 30,
    threads: Threads = 2,
    out: Folder = None,
    record: Record = None,
) -> None:
    """Frames of the twisting block on small budgets: position error against cost."""
    from pbng.bench import frames as bench

    rows = bench.measure(n, frames, threads)
    show(
        f"Position error / size over {frames} frames, {n}³ vertices, corotated, {threads} threads, float32",
        [
            Column("a frame", "budget"),
            Column("ms a frame", "ms", "{:.1f}"),
            Column("median error", "median", "{:.1e}"),
            Column("last error", "last", "{:.1e}"),
        ],
        rows,
    )
    write(record, "frames", rows)
    if out is not None:
        from pbng.view import plot_residuals

        out.mkdir(parents=True, exist_ok=True)
        plot_residuals(
            {f"{r['budget']} ({r['ms']:.0f} ms)": (np.arange(1, frames), r["errors"][1:]) for r in rows},
            out / f"frames_{n}.png",
            xlabel="frame",
            ylabel="largest position error / size",
            title=f"Twisting block, {n}³ vertices",
        )


@app.command("poses")
def poses_command(
    count: Annotated[int, typer.Option(help="Number of random poses.", min=1)] = 100,
    n: Annotated[int, typer.Option("--n", help="Vertices across the bar.", min=3)] = 16,
    error: Annotated[float, typer.Option(help="Largest position error / length of the bar to ask for.", min=0)] = 1e-4,
    model: Model = "corotated",
    nu: Ratio = 0.3,
    threads: Threads = 2,
    seed: Seed = 0,
    amount: Annotated[float, typer.Option(help="How wild the poses are; 1 folds elements over in most.")] = 0.5,
    record: Record = None,
) -> None:
    """Random poses of a bar, each solved to a position error: is the estimate to be trusted?"""
    from pbng.bench import poses

    rows = poses.measure(count, n, error, model, nu, threads, seed, amount)
    total = poses.summary(rows)
    show(
        f"A bar 2 x 1 x 1, {n} vertices across, {model}, ν = {nu}, error / length {error:g}, {threads} threads",
        [
            Column("poses", "poses"),
            Column("certified", "certified"),
            Column("falsely", "falsely"),
            Column("no reference", "unknown"),
            Column("true / estimate", "true/estimate", "{:.2f}"),
            Column("worst", "worst true/estimate", "{:.2f}"),
            Column("cycles", "cycles", "{:g}"),
            Column("most", "most cycles"),
            Column("ms", "ms", "{:.1f}"),
            Column("most", "most ms", "{:.1f}"),
            Column("set-up [s]", "setup_s", "{:.2f}"),
            Column("with inverted tets", "inverted"),
        ],
        [total],
    )
    write(record, "poses", [total | {"each": rows}])


@app.command("contact")
def contact_command(
    n: Annotated[int, typer.Option("--n", help="Vertices across the body: 46 for 24,300 triangles.", min=2)] = 46,
    points: Annotated[int, typer.Option(help="Points close to its surface.", min=1)] = 100_000,
    tets: Annotated[
        int, typer.Option("--tets", help="Vertices across each of six solid balls; 0 for none.", min=0)
    ] = 27,
    threads: Numbers = [1, 2],  # noqa: B006
    rounds: Rounds = 7,
    record: Record = None,
) -> None:
    """Time trees and closest points for contact, in one run with libigl if it is there."""
    from pbng.bench import contact

    rows = contact.measure(n, points, tets, threads, rounds)
    show(
        f"Queries for contact, median of {rounds} rounds; libigl does not choose its threads",
        [
            Column("query", "query"),
            Column("primitives", "primitives", "{:,}"),
            Column("points", "points", "{:,}"),
            Column("threads", "threads"),
            Column("build [ms]", "build_ms", "{:.1f}"),
            Column("refit [ms]", "refit_ms", "{:.2f}"),
            Column("M points/s", "near", "{:.2f}"),
            Column("within 20 mm", "cut", "{:.2f}"),
            Column("libigl, M points/s", "igl", "{:.2f}"),
            Column("ratio", "ratio", "{:.1f}"),
        ],
        rows,
    )
    write(record, "contact", rows)


@app.command("cloth")
def cloth_command(
    n: Annotated[list[int], typer.Option("--n", help="Vertices along an edge of the sheet.", min=3)] = [16, 32, 64],  # noqa: B006
    held: Annotated[
        list[str] | None,
        typer.Option(help="What holds it: corners, edge, rim or ends; by default each.", callback=_held),
    ] = None,
    seconds: Annotated[float, typer.Option(help="Seconds of solving by each method.", min=0.001)] = 10.0,
    threads: Threads = 1,
    record: Record = None,
) -> None:
    """Cycles, Newton's steps and sweeps to a residual ratio: sheets let go at once, or drawn out and turned."""
    from pbng.bench import cloth

    rows = [
        row
        for by in held or cloth.HELD
        for m in n
        for E, k in cloth.CLOTHS
        for row in cloth.measure(m, by, E, k, seconds, threads)
    ]
    show(
        f"Iterations and seconds to a residual ratio, {seconds:g} s at most, {threads} threads",
        [Column("held by", "held"), Column("n", "n"), Column("E [N/m]", "E", "{:g}"), Column("k [N m]", "k", "{:g}")]
        + [Column("method", "method")]
        + [Column(f"{level:.0e}", f"{level:.0e}") for level in cloth.LEVELS]
        + [Column(f"s to {level:.0e}", f"s {level:.0e}", "{:.2f}") for level in cloth.LEVELS]
        + [Column("last", "last", "{:.1e}"), Column("energy [J]", "energy", "{:.6g}"), Column("status", "status")],
        rows,
    )
    write(record, "cloth", rows)


@dataclass(frozen=True)
class Column:
    """A column of a table: heading, key of the row, format."""

    heading: str
    key: str
    form: str = "{}"


def show(title: str, columns: list[Column], rows: list[dict[str, Any]]) -> None:
    """Print rows as a table; columns that no row has are left out."""
    columns = [c for c in columns if any(r.get(c.key) is not None for r in rows)]
    table = Table(title=title)
    for c in columns:
        table.add_column(c.heading, justify="left" if isinstance(rows[0].get(c.key), str) else "right")
    for r in rows:
        table.add_row(*("-" if r.get(c.key) is None else c.form.format(r[c.key]) for c in columns))
    console.print(table)


def write(path: Path | None, name: str, rows: list[dict[str, Any]]) -> None:
    """Write a record with the machine it was measured on."""
    if path is not None:
        from pbng.bench.timing import machine

        path.write_text(json.dumps({"benchmark": name, "machine": machine(), "rows": rows}, indent=1))
