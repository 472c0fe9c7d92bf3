"""Where the command line speaks, and the one place where bad input becomes a clear line and an exit code."""

import errno
import logging
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import typer
from rich.console import Console
from rich.markup import escape
from typer.core import TyperGroup

from pbng.errors import InputError

FAILED, INTERRUPTED = 1, 130  # exit codes; that of wrong usage is 2

out = Console(highlight=False)
err = Console(stderr=True, highlight=False)


class Commands(TyperGroup):
    """The commands; ``--debug`` may stand anywhere among their options."""

    debug = False

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        options = args[: args.index("--")] if "--" in args else args
        if "--debug" in options:
            options, rest = [a for a in options if a != "--debug"], args[len(options) :]
            args = ["--debug", *options, *rest]
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except InputError as error:
            fail(str(error), ctx.params.get("debug", False))
        except OSError as error:
            if error.errno == errno.EPIPE:  # the reader has gone: no error of ours
                raise
            where = f"{error.filename}: " if error.filename else ""
            fail(f"{where}{error.strerror or error}", ctx.params.get("debug", False))
        except KeyboardInterrupt:
            err.print("[yellow]Interrupted.[/]")
            raise typer.Exit(INTERRUPTED) from None


def fail(message: str, debug: bool = False) -> NoReturn:
    """Print a red line and leave; with ``debug``, the traceback of the error in hand first."""
    if debug and sys.exc_info()[0] is not None:
        err.print(escape(traceback.format_exc()), soft_wrap=True)
    err.print(f"[bold red]Error:[/] {escape(message)}", soft_wrap=True)
    raise typer.Exit(FAILED) from None


def show_log(debug: bool) -> None:
    """Let the logger of the library speak through the console, so that it does not break a progress bar."""
    from rich.highlighter import NullHighlighter
    from rich.logging import RichHandler

    log = logging.getLogger("pbng")
    for handler in [h for h in log.handlers if isinstance(h, RichHandler)]:
        log.removeHandler(handler)
    plain = NullHighlighter()
    log.addHandler(RichHandler(console=err, show_time=False, show_path=False, show_level=False, highlighter=plain))
    log.setLevel(logging.DEBUG if debug else logging.WARNING)


@contextmanager
def blaming(file: Path | None) -> Iterator[None]:
    """What goes wrong in a user's file is told with the line of it."""
    try:
        yield
    except (Exception, SystemExit) as error:
        line = None if file is None else _line_in(file, error)
        if line is None:
            raise
        said = error.msg if isinstance(error, SyntaxError) else str(error)
        what = said if isinstance(error, InputError) else f"{type(error).__name__}: {said}"
        notes = "".join(f"; {note}" for note in getattr(error, "__notes__", ()))
        raise InputError(f"{file}, line {line}: {what}{notes}") from error


def _line_in(file: Path, error: BaseException) -> int | None:
    """The line of the file in which the error arose, or from which what raised it was called."""
    path = os.path.abspath(file)  # which is how Python names the files it imports
    if isinstance(error, SyntaxError) and error.filename == path:
        return error.lineno
    lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if f.filename == path]
    return lines[-1] if lines else None


def table(title: str = "", **options: Any) -> Any:
    """A table in the one style there is."""
    from rich import box
    from rich.table import Table

    return Table(title=title or None, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, **options)


def wrote(paths: list[Path]) -> None:
    """List the files written."""
    for path in paths:
        out.print(f"wrote {escape(str(path))}", soft_wrap=True)
