"""Plots and pictures of a comparison."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pbng.problem import Problem
from pbng.solvers.base import Status

if TYPE_CHECKING:
    from pbng.compare.comparison import Comparison

DECADES = 3  # of seconds that a plot shows
FEW = 60  # iterations that a linear axis shows well
HIGHEST = 3.0  # that the axes of ratios show
ROOM = 0.5  # of the size: how far from the rest state and the reference a picture reaches
PANEL = (4.3, 3.6)  # width and height [inches]


def draw(comparison: "Comparison", folder: Path, states: bool = True) -> list[Path]:
    """Plots against iterations and seconds, and a picture of the final states; returns the files."""
    title = f"{comparison.problem.name}: {comparison.problem.n_vert:,} vertices, {comparison.problem.n_elem:,} elements"
    written = [
        plot_iterations(comparison, folder / "iterations.png", title),
        plot_seconds(comparison, folder / "seconds.png", title),
    ]
    return [*written, picture_states(comparison, folder / "states.png")] if states else written


def plot_iterations(comparison: "Comparison", path: Path, title: str = "") -> Path:
    """Residual ratio, energy gap and, with a reference, position error against iterations."""
    from pbng.view import plot_residuals

    most = max(int(c.iterations[-1]) for c in comparison.curves.values())
    series = {label: (c.iterations, *_ratios(comparison, label)) for label, c in comparison.curves.items()}
    words = _words(comparison)
    return plot_residuals(
        series, path, "iterations", words, title, log_x=most > FEW, top=HIGHEST, size=(len(words) * PANEL[0], PANEL[1])
    )


def plot_seconds(comparison: "Comparison", path: Path, title: str = "") -> Path:
    """The same against the seconds that a method spent starting and stepping."""
    from pbng.view import plot_residuals

    latest = max(float(c.seconds[-1]) for c in comparison.curves.values())
    series = {}
    for label, c in comparison.curves.items():
        late = c.seconds >= latest * 10.0**-DECADES
        series[label] = (c.seconds[late], *(y[late] for y in _ratios(comparison, label)))
    words = _words(comparison)
    return plot_residuals(
        series,
        path,
        "seconds of solving",
        words,
        title,
        log_x=True,
        top=HIGHEST,
        size=(len(words) * PANEL[0], PANEL[1]),
    )


@dataclass(frozen=True, eq=False)
class _State:
    """A state as pictures take it."""

    problem: Problem
    x: np.ndarray
    t: float

    @property
    def springs(self) -> np.ndarray:
        """The two ends (m, 2, 3) [m] of each weak constraint."""
        weak = self.problem.weak_energy
        return weak.ends(self.x, self.problem.targets(self.t)) if weak else np.empty((0, 2, 3))


def picture_states(comparison: "Comparison", path: Path) -> Path:
    """The last state of every method, and the reference, side by side under their names; coloured by stretch.

    What has flown off is cut at the frame of the picture.
    """
    from pbng.view import sheet

    shown = {}
    if comparison.reference is not None and comparison.known:
        shown[f"converged ({comparison.reference.by})"] = comparison.reference.x
    for label, c in comparison.curves.items():
        error = f", error {comparison.errors(label)[-1]:.0e}" if comparison.known else ""
        diverged = c.status is Status.DIVERGED
        shown[f"{label}: " + ("diverged" if diverged else f"residual {c.ratios[-1]:.0e}{error}")] = c.x
    settled = [comparison.problem.X, comparison.start.x]
    if comparison.reference is not None and comparison.known:
        settled.append(comparison.reference.x)
    low, high = np.min(settled, axis=(0, 1)), np.max(settled, axis=(0, 1))
    room = ROOM * float((high - low).max())
    states = [
        _State(comparison.problem, np.clip(_finite(x, settled[-1]), low - room, high + room), comparison.start.at)
        for x in shown.values()
    ]
    return sheet(states, path, len(states), captions=list(shown))


def _finite(x: np.ndarray, instead: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(x), x, instead)


def _ratios(comparison: "Comparison", label: str) -> tuple[np.ndarray, ...]:
    ratios = comparison.curves[label].ratios, comparison.gaps(label)
    return (*ratios, comparison.errors(label)) if comparison.known else ratios


def _words(comparison: "Comparison") -> tuple[str, ...]:
    words = "residual / first residual", "(energy - lowest) / (first - lowest)"
    return (*words, "largest position error / size") if comparison.known else words
