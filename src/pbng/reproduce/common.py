"""What the experiments share: XPBD-QS in whole steps, states under their names, crossings of curves."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pbng.compare.contest import Comparison, contest
from pbng.problem import Problem
from pbng.reproduce.section import Settings
from pbng.solvers.base import Solver
from pbng.solvers.xpbd import XPBD, ProjectionMethod


@dataclass(frozen=True, kw_only=True)
class WholeSteps(XPBD):
    """XPBD-QS that takes a whole pseudo-time step at a time: within one its state is no attempt at an equilibrium."""

    def set_up(self, problem: Problem) -> ProjectionMethod:
        """As that of :class:`XPBD`."""
        return _WholeSteps(problem, self)


class _WholeSteps(ProjectionMethod):
    def step(self) -> None:
        for _ in range(self.solver.iterations or 1):
            super().step()


def steps_contest(
    problem: Problem, solvers: Mapping[str, Solver], iterations: Mapping[str, int], **options: Any
) -> Comparison:
    """A contest in which XPBD-QS, if it is :class:`WholeSteps`, is looked at after whole steps only.

    Arguments are those of :func:`pbng.compare.contest.contest`, iterations counted singly, as in what it returns.
    """
    own = {k: (s.iterations or 1) if isinstance(s, WholeSteps) else 1 for k, s in solvers.items()}
    found: Comparison = contest(
        problem, solvers, iterations={k: -(-iterations[k] // own[k]) for k in solvers}, **options
    )
    curves = {k: replace(c, iterations=own[k] * c.iterations) for k, c in found.curves.items()}
    return replace(found, curves=curves, iterations=dict(iterations))


@dataclass(frozen=True, eq=False)
class State:
    """A state that pictures are made of: positions x (n_vert, 3) [m] of a problem at time t [s]."""

    problem: Problem
    x: np.ndarray
    t: float = 0.0

    @property
    def springs(self) -> np.ndarray:
        """The two ends (m, 2, 3) [m] of each weak constraint."""
        weak = self.problem.weak_energy
        return weak.ends(self.x, self.problem.targets(self.t)) if weak else np.empty((0, 2, 3))


def side_by_side(states: Mapping[str, State], path: Path, **options: Any) -> Path:
    """Draw states in one picture, each under its name, in one frame and one scale of colours; returns the path.

    Args:
        states: Name -> state, all of the same bodies.
        path: The .png.
        options: As :func:`pbng.view.sheet` takes them.
    """
    from pbng.view import sheet

    return sheet(list(states.values()), path, len(states), captions=list(states), **options)


def need_pictures() -> None:
    """Find out that what draws is missing before the work, not after.

    Raises:
        InputError: A package of ``pbng[view]`` is not installed.
    """
    import pbng.view

    for name in ("plot_residuals", "sheet"):
        getattr(pbng.view, name)


def file_of(settings: Settings, name: str) -> Path:
    """The file of that name in the folder of the experiment."""
    return settings.folder / name


def first_below(at: np.ndarray, values: np.ndarray, level: float) -> int | None:
    """The first of the iterations ``at`` (k,) whose value (k,) is at most a level, or None."""
    met = np.flatnonzero(values <= level)
    return int(at[met[0]]) if len(met) else None


def settled(at: np.ndarray, values: np.ndarray, level: float) -> int | None:
    """The first of the iterations ``at`` (k,) from which on all values (k,) are at most a level, or None."""
    above = np.flatnonzero(~(values <= level))
    first = int(above[-1]) + 1 if len(above) else 0
    return int(at[first]) if first < len(at) else None
