"""``pbng compare``: methods side by side on one scene, a table for whoever watches, plots and a record in a folder."""

import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from pbng import cli_options
from pbng.cli_console import blaming, err, out, table, wrote
from pbng.compare.comparison import ERRORS, RATIOS, Comparison
from pbng.compare.contest import contest
from pbng.compare.start import scattered
from pbng.errors import InputError
from pbng.io.store import put
from pbng.solvers.base import Budget, Solver

USUAL = ("pbng", "multigrid", "newton", "xpbd")
SECONDS = 4.0  # for each method, if nothing is said
WIDTH = 120  # of a table that nobody watches
RECORD = "record.json"
DRAWING = ("matplotlib", "pyvista")
ENDS = (  # heading, key of a row, format
    ("iterations", "iterations", "{:,}"),
    ("ms each", "ms", "{:.2f}"),
    ("set-up \\[s]", "setup_s", "{:.2f}"),
    ("compiling \\[s]", "compile_s", "{:.1f}"),
    ("residual", "ratio", "{:.1e}"),
    ("energy gap", "gap", "{:.1e}"),
    ("error", "error", "{:.1e}"),
    ("inverted", "inverted", "{:,}"),
)


def compare(
    scene: str,
    surface: Path | None = None,
    *,
    resolution: int | None = None,
    methods: str | None = None,
    iterations: int | None = None,
    seconds: float | None = None,
    at: float | None = None,
    hard: bool = False,
    seed: int = 0,
    rounds: int = 1,
    threads: int | None = None,
    to: Path | None = None,
    record: Path | None = None,
    overwrite: bool = False,
    pictures: bool = True,
) -> Comparison:
    """Compare methods on a scene, print a table, and write plots, pictures and a record into a folder.

    Raises:
        InputError: Something given cannot be used; nothing is left on the disk.
    """
    solvers = parse_methods(methods or ",".join(USUAL), threads)
    missing = [package for package in DRAWING if find_spec(package) is None]
    if pictures and missing:
        raise InputError(f"pictures need {' and '.join(missing)}: pip install 'pbng[view]', or --no-pictures")
    with blaming(Path(scene)):
        recipe, name, file = cli_options.recipe(scene, surface, resolution)
    with blaming(file):
        problem = recipe.scene.compile()
        start = scattered(problem, seed) if hard else None
        with new_folder(to or Path("comparisons") / name, overwrite) as folder:
            if record is not None:
                record.parent.mkdir(parents=True, exist_ok=True)  # found out before the work, not after
            with _progress() as monitor:
                found = contest(
                    problem,
                    solvers,
                    iterations=iterations,
                    seconds=SECONDS if iterations is None and seconds is None else seconds,
                    start=start,
                    at=at,
                    rounds=rounds,
                    monitor=monitor,
                    leave_out=_left_out if methods is None else None,
                )
            show(found)
            text = json.dumps(found.record(seed if hard else None), indent=1, allow_nan=False).encode()
            put(folder / RECORD, text)
            if pictures:
                _draw(found, folder)
            if record is not None:
                put(record, text)
    return found


def parse_methods(text: str, threads: int | None = None) -> dict[str, Solver]:
    """Label -> solver from a list of the words that ``pbng run --solver`` knows, and "pbng" for its default.

    Raises:
        InputError: A word is unknown, or stands there twice.
    """
    out: dict[str, Solver] = {}
    for word in _words(text):
        if word in out:
            raise InputError(f"--methods: {word} is named twice")
        near = get_close_matches(word.lower(), ["pbng"], n=1, cutoff=0.7)
        known = word.partition(":")[0].lower().replace("_", "-") in (*cli_options.ACCELERATIONS, *cli_options.METHODS)
        if near and word.lower() != "pbng" and not known:
            raise InputError(f"unknown solver {word!r}; did you mean pbng?")
        name = "anderson" if word.lower() == "pbng" else word
        out[word] = cli_options.solver(None, Budget(iterations=1), name, None, threads)
    if not out:
        raise InputError("--methods: name at least one, such as " + ",".join(USUAL))
    return out


def _words(text: str) -> list[str]:
    """The words between commas; numbers belong to the word before: "anderson:5,1.3,newton" are two."""
    words: list[str] = []
    for word in (w.strip() for w in text.split(",")):
        if words and ":" in words[-1] and re.fullmatch(r"[-+.\d][-+.\de]*", word):
            words[-1] += f",{word}"
        elif word:
            words.append(word)
    return words


def _left_out(label: str, why: str) -> None:
    err.print(f"[yellow]left out[/] {escape(label)}: {escape(why)}", soft_wrap=True)


def show(found: Comparison) -> None:
    """Print a comparison: what became of every method, and what it took to reach a residual or an error."""
    problem = found.problem
    limits = [f"{found.seconds:g} s each"] if found.seconds is not None else []
    counts = sorted({n for n in found.iterations.values() if n is not None})
    limits += [" or ".join(map(str, counts)) + " iterations"] if counts else []
    words = f"{problem.name}: {problem.n_vert:,} vertices, {problem.n_elem:,} elements; {', '.join(limits)}"
    ends = table(escape(words), pad_edge=False)
    for heading in ("method", *(heading for heading, _, _ in ENDS), "ended"):
        ends.add_column(heading, justify="left" if heading in ("method", "ended") else "right")
    took = table("Seconds of solving (iterations) to a residual, and to an error", pad_edge=False)
    levels = [f"ratio {level:.0e}" for level in RATIOS] + [f"error {level:.0e}" for level in ERRORS]
    for heading in ("method", *(level.removeprefix("ratio ") for level in levels)):
        took.add_column(heading, justify="left" if heading == "method" else "right")
    for row in found.rows():
        cells = ("-" if row[key] is None else form.format(row[key]) for _, key, form in ENDS)
        ends.add_row(escape(row["method"]), *cells, row["status"].lower())
        spent = ((row[f"s {level}"], row[f"n {level}"]) for level in levels)
        took.add_row(escape(row["method"]), *("-" if s is None else f"{s:.3g} ({n:,})" for s, n in spent))
    console = out if out.is_terminal else Console(highlight=False, width=WIDTH)
    console.print(ends)
    console.print(took)
    console.print(f"[dim]reference: {escape(str(found.reference))}[/]", soft_wrap=True)
    console.print(
        "[dim]residual, energy gap: over those of the start; error: largest distance from the reference over size[/]",
        soft_wrap=True,
    )


@contextmanager
def new_folder(path: Path, overwrite: bool) -> Iterator[Path]:
    """A folder to write into, which becomes ``path`` when all is done; after an error nothing of it is left.

    With ``overwrite`` the new files replace those of the same name, and others in the folder stay.

    Raises:
        InputError: The path holds something and is not to be overwritten, or cannot be written.
    """
    given, path = path, Path(os.path.abspath(path))
    if path.exists() and not path.is_dir():
        raise InputError(f"{given} is a file, not a folder; --out chooses another")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise InputError(f"{given} is not empty; --overwrite writes into it, --out chooses another folder")
    made = [p for p in path.parents if not p.exists()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    except OSError as error:
        raise InputError(f"cannot write {given}: {error.strerror or error}") from error
    try:
        yield folder
        folder.chmod(0o777 & ~_umask())
        names = sorted(file.name for file in folder.iterdir())
        if path.is_dir() and any(path.iterdir()):
            for file in sorted(folder.iterdir()):
                os.replace(file, path / file.name)
        else:
            with suppress(FileNotFoundError):
                path.rmdir()  # an empty one; on some systems a folder cannot replace it
            folder.rename(path)
        wrote([given / name for name in names])
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        for parent in made:
            with suppress(OSError):  # it is not empty
                parent.rmdir()


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _draw(found: Comparison, folder: Path) -> None:
    """Draw; the record is worth keeping even if there is no way to draw here."""
    try:
        found.draw(folder)
    except (InputError, RuntimeError, OSError) as error:
        err.print(f"[yellow]Not everything could be drawn:[/] {escape(str(error))}", soft_wrap=True)


@contextmanager
def _progress() -> Iterator[Callable[[str, float], Any] | None]:
    """Bars for a person, nothing in a pipe."""
    if not err.is_terminal:
        yield None
        return
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(24), TimeElapsedColumn()
    with Progress(*columns, console=err, transient=True) as bars:
        tasks = {"reference": bars.add_task("reference", total=None)}

        def told(label: str, share: float) -> None:
            if label != "reference":
                bars.update(tasks["reference"], total=1.0, completed=1.0)
                if label not in tasks:  # who comes is known when the first has begun: some may be left out
                    tasks[label] = bars.add_task(label, total=1.0)
                bars.update(tasks[label], completed=share)

        yield told
