"""What reproducing a figure or a table of the paper takes and comes to."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pbng.errors import InputError

SIZES = ("small", "medium", "paper")


@dataclass(frozen=True)
class Settings:
    """How to run an experiment.

    Attributes:
        folder: Where its pictures go; it exists.
        size: "small" for a look and for tests (seconds), "medium" (minutes for all), or "paper" for the paper's sizes.
        threads: Threads of every method; None for as many as prove fastest.
    """

    folder: Path
    size: str = "medium"
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise InputError(f"size must be {', '.join(SIZES)}, not {self.size!r}")

    def by_size(self, small: Any, medium: Any, paper: Any) -> Any:
        """The value for the chosen size."""
        return dict(zip(SIZES, (small, medium, paper)))[self.size]


@dataclass(frozen=True)
class Row:
    """A line of a table: what is measured, the paper's value, ours, and what is to be said about it."""

    what: str
    paper: str
    ours: str
    remark: str = ""


@dataclass(frozen=True)
class Picture:
    """A picture and what it shows."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Section:
    """A figure or table, reproduced.

    Attributes:
        name: As it is called: fig7, table1.
        title: What it is about.
        scene: What was run, with its sizes and budgets, in a sentence or two.
        claim: What the paper says that it shows.
        found: What is found here, and where and why it differs; made from the numbers, not from expectation.
        rows: The table.
        pictures: The pictures.
        record: The numbers behind it, as JSON can hold them.
    """

    name: str
    title: str
    scene: str
    claim: str
    found: str
    rows: tuple[Row, ...]
    pictures: tuple[Picture, ...] = ()
    record: Mapping[str, Any] = field(default_factory=dict)
