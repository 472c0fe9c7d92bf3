"""What every driver shares: the problem it is given, its clock, and checkpoints that the caller judges. NumPy alone.

A driver runs as ``python DRIVER PROBLEM.npz SECONDS``. At a checkpoint it writes its positions, prints a line of JSON
and waits for an answer, its clock standing still, while the caller evaluates the residual; so only one of the two
computes at a time, and no driver knows how well it is doing.
"""

import json
import resource
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

MARK = "@peer "  # before lines meant for the caller; libraries may print others
GROWTH = 1.05  # of the CPU time from one checkpoint to the next, at least
LEAST = 1e-3  # CPU time between checkpoints [s], at least


class Record:
    """The clock and the checkpoints of one run: ``with record: ...`` runs the clock."""

    def __init__(self, path: Path, seconds: float) -> None:
        self.path, self.limit = path, seconds
        self.wall = self.cpu = 0.0
        self.next = 0.0
        self.stopped = False
        self.phases: dict[str, list[float]] = {}

    def __enter__(self) -> None:
        self.since = _now()

    def __exit__(self, *_: object) -> None:
        wall, cpu = _now()
        self.wall += wall - self.since[0]
        self.cpu += cpu - self.since[1]

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time "set-up" or "compilation", which the clock leaves out."""
        start = _now()
        yield
        self.phases[name] = [b - a + c for a, b, c in zip(start, _now(), self.phases.get(name, (0, 0)))]

    @property
    def over(self) -> bool:
        """Whether the caller has seen enough, or the time [s of CPU] is used up."""
        return self.stopped or self.cpu >= self.limit

    def add(self, iteration: int, x: Callable[[], Any], always: bool = False) -> None:
        """Offer the positions x() (n, 3) [m] after so many iterations; they are looked at if a checkpoint is due."""
        if always or self.cpu >= self.next or self.over:
            self.next = max(self.cpu * GROWTH, self.cpu + LEAST)
            np.save(self.path, np.asarray(x(), float))
            _say({"iteration": iteration, "wall": self.wall, "cpu": self.cpu})
            self.stopped = sys.stdin.readline().strip() != "go"

    def close(self, versions: dict[str, str], **more: Any) -> None:
        """Say what the run took besides."""
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        seconds = {k: {"wall": v[0], "cpu": v[1]} for k, v in self.phases.items()}
        _say({"versions": versions, **seconds, "peak_MB": peak / 1e6, **more})


def arguments() -> tuple[SimpleNamespace, Record]:
    """The problem (see ``scene.save``) and the record of a run, from the command line."""
    path = Path(sys.argv[1])
    with np.load(path) as arrays:
        problem = SimpleNamespace(**{k: v[()] if v.ndim == 0 else v for k, v in arrays.items()})
    return problem, Record(path.with_name("x.npy"), float(sys.argv[2]))


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _say(what: dict[str, Any]) -> None:
    print(MARK + json.dumps(what), flush=True)
