"""Running a recipe: frames to disk, progress for whoever watches, a summary at the end."""

import math
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.markup import escape
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from pbng.cli_console import FAILED, INTERRUPTED, blaming, err, out, table
from pbng.drivers import Frame, simulate
from pbng.equilibrium import ContactReport
from pbng.errors import InputError
from pbng.gallery.recipe import Recipe
from pbng.io.frames import FrameWriter, solved
from pbng.problem import Problem
from pbng.solvers import base
from pbng.solvers.base import Budget, Result, Solver, Status

SWINGING = 1.0  # how long [s] to look on after the last motion has ended, where there is inertia


@dataclass(eq=False)
class Report:
    """What a run came to: the result of each frame (without its positions), what touched in it where anything may, and
    why it stopped if before the end.
    """

    path: Path
    problem: Problem
    frames: int
    fps: float
    results: list[Result] = field(default_factory=list)
    contacts: list[ContactReport] = field(default_factory=list)
    last: Frame | None = None
    written: int = 0
    stopped: str = ""
    exit_code: int = 0


def run(
    recipe: Recipe,
    path: Path,
    *,
    solver: Solver,
    budget: Budget,
    frames: int | None = None,
    fps: float | None = None,
    overwrite: bool = False,
    file: Path | None = None,
    label: str = "",
) -> Report:
    """Run a recipe into a folder.

    Ctrl-C and a state that is not finite end the run with the frames before intact; the report says so.

    Args:
        recipe: What to run.
        path: The folder of the run.
        solver, budget: In place of the recipe's.
        frames, fps: In place of the recipe's, if given.
        overwrite: Replace a run that is there.
        file: The user's file that the scene comes from, for errors that arise in it.
        label: What the progress bar says.

    Raises:
        InputError: Something given cannot be used; nothing is left on the disk.
    """
    if not overwrite and (path / "run.json").exists() and any(path.glob("frame_*.npz")):
        raise InputError(f"{path} already holds a run; --overwrite replaces it, --out chooses another folder")
    with blaming(file):
        problem = recipe.scene.compile(free=recipe.inertia)
        fps = recipe.fps if fps is None else fps
        frames = (recipe.frames or _until_the_end(problem, fps, recipe.inertia)) if frames is None else frames
        report = Report(path, problem, frames, fps)
        with _progress(label or problem.name, frames, budget) as watch, _folder(path):
            writer = FrameWriter(path, fps=fps, overwrite=overwrite, info={"solver": repr(solver)})
            coming = simulate(
                problem, solver, budget, frames=frames, fps=fps, monitor=watch.monitor,
                inertia=recipe.inertia, dt=recipe.dt, substeps=recipe.substeps,
            )  # fmt: skip
            _write(coming, writer, watch, report)
    return report


def _until_the_end(problem: Problem, fps: float, inertia: bool) -> int:
    if not (math.isfinite(fps) and fps > 0):
        raise InputError(f"fps must be positive, not {fps}")
    end = problem.end + SWINGING if inertia else problem.end
    return 1 + math.ceil(end * fps - 1e-9)


def _write(coming: Iterator[Any], writer: FrameWriter, watch: "_Watch", report: Report) -> None:
    try:
        for frame in coming:
            if frame.result.status is Status.DIVERGED:
                report.stopped = f"Frame {frame.index} diverged: its positions are not finite."
                report.exit_code = FAILED
                return
            writer.write(frame)
            report.results.append(replace(frame.result, x=np.empty((0, 3))))  # they are on the disk
            if frame.contact is not None:
                report.contacts.append(replace(frame.contact, vertices=np.empty(0, int)))
            report.last = frame
            watch.done(frame)
    except KeyboardInterrupt:
        report.stopped, report.exit_code = "Interrupted.", INTERRUPTED
    except Exception as error:
        if writer.n_written:
            error.add_note(f"the {writer.n_written} frames before it are intact in {report.path}")
        raise
    finally:
        report.written = writer.n_written


@contextmanager
def _folder(path: Path) -> Iterator[None]:
    """Takes an empty folder away again, if it was made for a run that left nothing in it."""
    made = [p for p in (path, *path.parents) if not p.exists()]
    try:
        yield
    finally:
        for folder in made:
            with suppress(OSError):  # it is not empty
                folder.rmdir()


class _Watch:
    """Progress in a pipe: a line for each tenth of the frames."""

    def __init__(self, label: str, frames: int) -> None:
        self.label, self.frames, self.k = label, frames, 0

    def monitor(self, now: base.Progress) -> None:
        """Called within a frame."""

    def done(self, frame: Any) -> None:
        """Called after each frame."""
        before, self.k = self.k, self.k + 1
        if self.k * 10 // self.frames > before * 10 // self.frames or before == 0:
            err.print(
                f"{self.label}: frame {self.k} of {self.frames}, {frame.result.iterations} iterations,"
                f" residual {frame.result.residuals[0]:.2e} -> {frame.result.residual:.2e} N",
                soft_wrap=True,
            )


class _Bar(_Watch):
    """Progress for a person: a bar with iterations, residual ratio and time to go."""

    def __init__(self, label: str, frames: int, budget: Budget, bar: Progress) -> None:
        super().__init__(label, frames)
        self.budget, self.bar = budget, bar
        self.task = bar.add_task(label, total=frames, detail=f"1/{frames}")
        self.touching = ""

    def monitor(self, now: base.Progress) -> None:
        ratio = now.residual / now.first if now.first > 0 else 0.0
        detail = f"{self.k + 1}/{self.frames} · {now.iteration:>4} iterations · ratio {ratio:.0e}{self.touching}"
        self.bar.update(self.task, completed=self.k + self._share(now), detail=detail)

    def _share(self, now: base.Progress) -> float:
        """How much of the frame is done, by the iterations or by the residual, which falls about geometrically."""
        shares = [0.0]
        if self.budget.iterations:
            shares.append(now.iteration / self.budget.iterations)
        if 0 < now.tolerance < now.residual < now.first:
            shares.append(math.log(now.residual / now.first) / math.log(now.tolerance / now.first))
        return min(max(shares), 0.99)

    def done(self, frame: Any) -> None:
        self.k += 1
        if frame.contact is not None:
            self.touching = f" · contacts {frame.contact.pairs + frame.contact.walls:,}"
        self.bar.update(self.task, completed=self.k)


@contextmanager
def _progress(label: str, frames: int, budget: Budget) -> Iterator[_Watch]:
    if not err.is_terminal:
        yield _Watch(label, frames)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(20),
        TextColumn("{task.fields[detail]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=err, transient=True) as bar:
        yield _Bar(label, frames, budget, bar)


def summarize(report: Report, compiled: float) -> None:
    """Print what a run came to; ``compiled`` is the time [s] that went into compiling kernels."""
    results, problem = report.results, report.problem
    if results:
        shown = table(f"{problem.name}: {len(results)} of {report.frames} frames", show_header=False, pad_edge=False)
        for name, value in _rows(report, results, compiled):
            shown.add_row(name, value)
        out.print(shown)
    if report.stopped:
        err.print(f"[yellow]{escape(report.stopped)}[/] {_kept(report)}", soft_wrap=True)


def _kept(report: Report) -> str:
    if not report.written:
        return "No frame was finished; nothing was written."
    return f"{report.written} of {report.frames} frames are intact in {escape(str(report.path))}."


def _rows(report: Report, results: list[Result], compiled: float) -> Iterator[tuple[str, str]]:
    problem, setup_seconds = report.problem, results[0].setup_seconds
    results = list(solved(results, report.last is not None and report.last.v is not None))
    iterations = sum(r.iterations for r in results)
    seconds = sum(r.seconds for r in results)
    # A frame that begins at rounding level, as one at rest does, has nothing to reduce.
    reductions = [r.reduction for r in results if r.iterations and r.status is not Status.PRECISION]
    yield "mesh", f"{problem.n_vert:,} vertices, {problem.n_elem:,} elements, {int(problem.fixed.sum()):,} prescribed"
    statuses = Counter(r.status for r in results)
    yield "frames", ", ".join(f"{count} {status.name.lower()}" for status, count in statuses.items())
    yield "iterations", f"{iterations:,}, {iterations / len(results):.0f} a frame"
    if reductions:
        yield "residual, end / start", f"median {np.median(reductions):.1e}, worst {max(reductions):.1e}"
    ends = [r.residual for r in results]
    yield "residual, end", f"median {np.median(ends):.2e} N, worst {max(ends):.2e} N"
    errors = [r.error for r in results if math.isfinite(r.error)]
    if errors:
        yield "position error", f"estimated, median {np.median(errors):.1e} m, worst {max(errors):.1e} m"
    if report.last is not None and report.last.v is not None:
        frame = report.last
        speed = " ".join(f"{p:.3g}" for p in frame.momentum)
        yield "at the end", f"potential {frame.potential_energy:.4g} J, kinetic {frame.kinetic_energy:.4g} J"
        yield "momentum", f"{speed} kg m/s"
    yield "inverted elements", f"{results[-1].inverted:,} at the end, at most {max(r.inverted for r in results):,}"
    yield "solving", f"{seconds:.2f} s, {1e3 * seconds / max(iterations, 1):.2f} ms an iteration"
    yield "set-up, compiling", f"{setup_seconds:.2f} s, {compiled:.2f} s"
    yield from _contact_rows(report.contacts)
    memory = _peak_memory()
    if memory is not None:
        yield "memory", f"{memory / 2**20:,.0f} MiB at most"


def _contact_rows(contacts: list[ContactReport]) -> Iterator[tuple[str, str]]:
    if not contacts:
        return
    last, deepest = contacts[-1], max(contacts, key=lambda c: c.deepest)
    yield "contacts of bodies", f"{last.pairs:,} at the end, at most {max(c.pairs for c in contacts):,}"
    yield "contacts with colliders", f"{last.walls:,} at the end, at most {max(c.walls for c in contacts):,}"
    if deepest.deepest > 0:
        share = deepest.deepest / deepest.size
        yield "penetration", f"at most {deepest.deepest:.1e} m, {share:.1e} of the scene's size"
    total = sum(c.seconds for c in contacts) or 1.0
    finding, packing = sum(c.detect_seconds for c in contacts), sum(c.pack_seconds for c in contacts)
    yield "finding contacts, packing", f"{finding / total:.1%}, {packing / total:.1%} of the time"


def _peak_memory() -> float | None:
    """Largest memory [bytes] that this process has used, where the system tells."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def finish(report: Report) -> None:
    """Leave with the exit code of a run that was stopped."""
    if report.exit_code:
        raise typer.Exit(report.exit_code)
