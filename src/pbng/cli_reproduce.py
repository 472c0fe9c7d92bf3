"""``pbng reproduce``: figures and tables of the paper, one after the other, onto one page."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.markup import escape

from pbng.bench.timing import machine
from pbng.cli_console import err, out, table
from pbng.errors import InputError
from pbng.io.store import put
from pbng.reproduce import EXPERIMENTS, Experiment, find, page
from pbng.reproduce.section import Section, Settings

PAGE = "index.html"


def reproduce(names: list[str], folder: Path, size: str, threads: int | None, overwrite: bool) -> None:
    """Run what is named, or all, and write the page after each, so that what is done is never lost.

    Raises:
        InputError: A name or the size is unknown, or the folder holds something else.
    """
    chosen = list(EXPERIMENTS.values()) if names == ["all"] else [find(name) for name in dict.fromkeys(names)]
    Settings(folder, size)
    _claim(folder, overwrite)
    about: dict[str, Any] = {**machine(), "threads": threads or "as many as prove fastest", "size": size}
    sections: list[Section] = []
    for k, experiment in enumerate(chosen):
        with err.status(f"{experiment.name} ({k + 1} of {len(chosen)}): {experiment.summary}"):
            sections.append(_run(experiment, folder, size, threads))
        page.write(sections, folder / PAGE, about)
        _show(sections[-1])
    out.print(f"wrote {len(sections)} sections to {escape(str(folder / PAGE))}", soft_wrap=True)


def _claim(folder: Path, overwrite: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"cannot write to {folder}: it is a file, not a folder")
    if folder.exists() and any(folder.iterdir()):
        if not (folder / PAGE).exists():
            raise InputError(f"cannot write to {folder}: it is not empty, and not a page of pbng reproduce")
        if not overwrite:
            raise InputError(f"{folder} already holds a page; --overwrite replaces it, --out chooses another folder")
    folder.mkdir(parents=True, exist_ok=True)


def _run(experiment: Experiment, folder: Path, size: str, threads: int | None) -> Section:
    own = folder / experiment.name
    own.mkdir(exist_ok=True)
    section = experiment(Settings(own, size, threads))
    told = asdict(section) | {"pictures": [{"path": p.path.name, "caption": p.caption} for p in section.pictures]}
    put(own / "record.json", (json.dumps(told, indent=1) + "\n").encode())
    return section


def _show(section: Section) -> None:
    shown = table(f"{section.name}: {section.title}", pad_edge=False)
    for heading in ("", "paper", "ours", "remark"):
        shown.add_column(heading)
    for row in section.rows:
        shown.add_row(*(escape(cell) for cell in (row.what, row.paper, row.ours, row.remark)))
    out.print(shown)
    out.print(f"{escape(section.found)}\n", soft_wrap=True)
