"""The command line: ``pbng run``, ``compare``, ``demo``, ``reproduce``, ``list``, ``info``, ``view``, ``export``,
``bench``.

What is heavy is imported inside the commands, so that ``pbng --help`` answers at once.
"""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from pbng import __version__
from pbng.cli_console import Commands, out, show_log, table, wrote
from pbng.errors import InputError

app = typer.Typer(
    cls=Commands,
    help="Equilibria of soft bodies by position-based nonlinear Gauss-Seidel.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the run that the folder holds.")]


def _version(wanted: bool) -> None:
    if wanted:
        out.print(f"pbng {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error, and all that is logged.")
    ] = False,
) -> None:
    """Equilibria of soft bodies by position-based nonlinear Gauss-Seidel."""
    show_log(debug)


@app.command()
def run(
    scene: Annotated[
        str, typer.Argument(metavar="NAME|FILE.py", help="A scene of `pbng list`, or a file with scene().")
    ],
    surface: Annotated[
        Path | None, typer.Argument(metavar="MESH", help="A file for scenes that take one, such as bent_surface.")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(help="What it counts depends on the scene.", show_default=False)
    ] = None,
    solver: Annotated[
        str | None,
        typer.Option(
            help="auto, multigrid, anderson, plain, node-sor, sor, chebyshev, newton, xpbd, pbd;"
            " parameters after a colon: anderson:5."
        ),
    ] = None,
    iterations: Annotated[int | None, typer.Option(help="At most so many iterations a frame.")] = None,
    rtol: Annotated[float | None, typer.Option(help="Until the residual of a frame is this part of its first.")] = None,
    atol: Annotated[float | None, typer.Option(help="Until the residual is below this \\[N].")] = None,
    error: Annotated[float | None, typer.Option(help="Until the estimated position error is below this \\[m].")] = None,
    seconds: Annotated[float | None, typer.Option(help="At most so many seconds a frame.")] = None,
    dtype: Annotated[str | None, typer.Option(help="Precision of the sweeps: float32, float64 or auto.")] = None,
    threads: Annotated[int | None, typer.Option(help="Threads to use; by default all.")] = None,
    frames: Annotated[int | None, typer.Option(help="Frames, the one at time 0 included.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames a second.")] = None,
    inertia: Annotated[
        bool | None,
        typer.Option("--inertia/--quasistatic", help="Backward Euler, or equilibria; by default as the scene says."),
    ] = None,
    dt: Annotated[float | None, typer.Option(help="With inertia: longest time step \\[s].")] = None,
    substeps: Annotated[int | None, typer.Option(help="With inertia: steps a frame.")] = None,
    to: Annotated[Path | None, typer.Option("--out", help="Folder of the run; by default runs/NAME.")] = None,
    overwrite: Overwrite = False,
    view: Annotated[bool, typer.Option("--view/--no-view", help="Draw pictures and a film when it is done.")] = False,
) -> None:
    """Run a scene, frame by frame.

    Limits of the budget that are given replace all of the scene's own.
    """
    from pbng import cli_options, cli_run
    from pbng.cli_console import blaming
    from pbng.jit import compile_seconds

    with blaming(Path(scene)):
        recipe, name, file = cli_options.recipe(scene, surface, resolution)
    budget = cli_options.budget(
        recipe.budget, iterations=iterations, seconds=seconds, rtol=rtol, atol=atol, error=error
    )
    report = cli_run.run(
        cli_options.in_motion(recipe, inertia, dt, substeps),
        to or Path("runs") / name,
        solver=cli_options.solver(recipe.solver, budget, solver, dtype, threads),
        budget=budget,
        frames=frames,
        fps=fps,
        overwrite=overwrite,
        file=file,
        label=name,
    )
    cli_run.summarize(report, compile_seconds())
    if report.results and not report.stopped:
        out.print(f"wrote {len(report.results)} frames to {escape(str(report.path))}", soft_wrap=True)
        if view:
            _draw(report.path, None)
        else:
            out.print(f"[dim]look at it with:[/] pbng view {escape(str(report.path))}", soft_wrap=True)
    cli_run.finish(report)


@app.command()
def compare(
    scene: Annotated[
        str, typer.Argument(metavar="NAME|FILE.py", help="A scene of `pbng list`, or a file with scene().")
    ],
    surface: Annotated[
        Path | None, typer.Argument(metavar="MESH", help="A file for scenes that take one, such as bent_surface.")
    ] = None,
    resolution: Annotated[
        int | None, typer.Option(help="What it counts depends on the scene.", show_default=False)
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(help="Separated by commas: pbng, and the words of `pbng run --solver`.", show_default=False),
    ] = None,
    iterations: Annotated[int | None, typer.Option(help="At most so many iterations of each.", min=1)] = None,
    seconds: Annotated[float | None, typer.Option(help="At most so many seconds of solving by each; or 4.")] = None,
    at: Annotated[float | None, typer.Option(help="Time of the motions \\[s]; by default their end.")] = None,
    hard: Annotated[bool, typer.Option("--hard", help="Start with free vertices scattered at random.")] = False,
    seed: Annotated[int, typer.Option(help="Of --hard.")] = 0,
    rounds: Annotated[int, typer.Option(help="Times are medians over so many rounds.", min=1)] = 1,
    threads: Annotated[int | None, typer.Option(help="Threads to use; by default all.")] = None,
    to: Annotated[Path | None, typer.Option("--out", help="Folder to write; by default comparisons/NAME.")] = None,
    record: Annotated[Path | None, typer.Option(help="Write the record to this JSON file, too.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Write into a folder that is not empty.")] = False,
    pictures: Annotated[bool, typer.Option("--pictures/--no-pictures", help="Draw plots and final states.")] = True,
) -> None:
    """Compare methods on one scene: one start, one residual, one clock. See docs/comparing.md."""
    from pbng.cli_compare import compare

    compare(
        scene, surface, resolution=resolution, methods=methods, iterations=iterations, seconds=seconds, at=at,
        hard=hard, seed=seed, rounds=rounds, threads=threads, to=to, record=record, overwrite=overwrite,
        pictures=pictures,
    )  # fmt: skip


@app.command()
def demo(
    to: Annotated[Path, typer.Option("--out", help="Folder for runs and pictures.")] = Path("runs/demo"),
    resolution: Annotated[int, typer.Option(help="Vertices along an edge of the twisting block.")] = 24,
) -> None:
    """Twist a block and hang up a little dragon: runs, pictures, films and tables of residuals, in two minutes."""
    from pbng.cli_demo import demo

    demo(to, resolution)


@app.command("reproduce")
def reproduce(
    names: Annotated[
        list[str], typer.Argument(metavar="NAME...|all", help="Figures and tables of the paper, such as fig7 table1.")
    ],
    size: Annotated[
        str, typer.Option(help="small: seconds each; medium: minutes; paper: the paper's sizes, hours in all.")
    ] = "medium",
    to: Annotated[Path, typer.Option("--out", help="Folder of the page.")] = Path("runs/reproduce"),
    threads: Annotated[int | None, typer.Option(help="Threads of every method; by default as many as help.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Run the paper's figures and tables again: pictures, and the paper's numbers beside ours, on one page."""
    from pbng.cli_reproduce import reproduce

    reproduce(names, to, size, threads, overwrite)


@app.command("list")
def list_scenes() -> None:
    """List the scenes of the gallery."""
    from pbng.gallery import SCENES

    shown = table(pad_edge=False)
    for heading in ("scene", "paper", "what happens"):
        shown.add_column(heading)
    for entry in SCENES.values():
        name = f"{entry.name} \\[MESH]" if entry.takes_surface else entry.name
        shown.add_row(name, entry.figure, f"{entry.summary}\n[dim]--resolution: {entry.resolution}[/]")
    out.print(shown)
    out.print("[dim]run one with:[/] pbng run twisting_block --resolution 16")


@app.command()
def info(
    what: Annotated[Path, typer.Argument(metavar="MESH|RUN", help="A file of a mesh, or the folder of a run.")],
) -> None:
    """Say what a mesh or a run is, and how good."""
    from pbng.cli_info import mesh_rows, run_rows

    shown = table(escape(str(what)), show_header=False, pad_edge=False)
    for name, value in run_rows(what) if what.is_dir() else mesh_rows(what):
        shown.add_row(escape(name), escape(value))
    out.print(shown)


@app.command()
def view(
    path: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run.")],
    to: Annotated[Path | None, typer.Option("--out", help="Folder for the pictures; by default RUN_view.")] = None,
    color: Annotated[str, typer.Option("--color", help="stretch, body, contact or the name of a colour.")] = "stretch",
) -> None:
    """Draw a run: its last frame, a strip, a film and its residuals."""
    _draw(path, to, color)


@app.command()
def export(
    path: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run.")],
    format: Annotated[str, typer.Option("--format", "-f", help="vtu, vtp, obj, ply or pc2.")] = "vtu",
    to: Annotated[Path | None, typer.Option("--out", help="Folder for the files; by default RUN_FORMAT.")] = None,
    split: Annotated[bool, typer.Option("--split", help="Each body into files of its own.")] = False,
    colliders: Annotated[bool, typer.Option("--colliders", help="Colliders too, as further bodies.")] = False,
) -> None:
    """Write a run in the format of another program (ParaView, Blender, Houdini)."""
    from pbng.io.export import export

    files = export(path, to or path.parent / f"{path.name}_{format}", format, split=split, colliders=colliders)
    out.print(f"wrote {len(files)} files to {escape(str(files[-1].parent))}", soft_wrap=True)
    out.print(f"[dim]open:[/] {escape(str(files[-1]))}", soft_wrap=True)


@app.command(
    add_help_option=False,
    context_settings={"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []},
)
def bench(context: typer.Context) -> None:
    """Measure sweeps, convergence, accuracy, cycles, poses, frames, contact, cloth. See `pbng bench --help`."""
    try:
        from pbng.bench import app as benchmarks
    except ModuleNotFoundError as error:
        if error.name != "pbng.bench":
            raise
        raise InputError("this installation has no benchmarks (pbng.bench)") from None
    benchmarks(args=context.args, prog_name="pbng bench", standalone_mode=False)


def _draw(path: Path, to: Path | None, color: str = "stretch") -> None:
    from pbng.view import view

    wrote(view(path, to, color))


if __name__ == "__main__":
    app()
