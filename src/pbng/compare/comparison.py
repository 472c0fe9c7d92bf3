"""What a contest came to: curves, a table, a record, pictures."""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np

from pbng.compare.curve import Curve, Reached
from pbng.compare.machine import machine, versions
from pbng.compare.reference import Reference
from pbng.compare.start import Start
from pbng.problem import Problem
from pbng.solvers.base import Solver

RATIOS = (1e-2, 1e-3, 1e-4, 1e-6)  # of the residual, that a table says when they were reached
ERRORS = (1e-2, 1e-3, 1e-4)  # of position, over the size
RECORD = "pbng comparison"
VERSION = 1

Row = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Several methods on one problem.

    Attributes:
        problem: What was solved.
        solvers: Label -> solver.
        curves: Label -> what it did.
        start: Where all began.
        energy: Energy [J] there.
        first: Residual [N] there.
        reference: What errors are distances from; None if none was asked for.
        iterations: Label -> at most so many, or None.
        seconds: At most so many [s] for each, or None.
        looks, rounds: As given to the contest.
    """

    problem: Problem
    solvers: dict[str, Solver]
    curves: dict[str, Curve]
    start: Start
    energy: float
    first: float
    reference: Reference | None
    iterations: dict[str, int | None]
    seconds: float | None
    looks: int
    rounds: int

    @property
    def size(self) -> float:
        """Largest extent [m] at rest."""
        return float(np.ptp(self.problem.X, axis=0).max())

    @property
    def known(self) -> bool:
        """Whether there is a reference that errors can be told from."""
        return self.reference is not None and self.reference.certain

    @property
    def lowest(self) -> float:
        """Energy [J] of the reference; without one, the lowest that any method was seen at."""
        if self.reference is not None and self.reference.certain:
            return self.reference.energy
        energies = np.concatenate([c.energies for c in self.curves.values()])
        return float(energies[np.isfinite(energies)].min(initial=self.energy))

    def gaps(self, label: str) -> np.ndarray:
        """(E - E*) / (E₀ - E*) of a method, (k,): E* as of :attr:`lowest`, E₀ the energy of the start; NaN if E₀ ≤ E*.

        It is negative for a state that lies lower than the reference: another equilibrium, or rounding.
        """
        fall = self.energy - self.lowest
        energies = self.curves[label].energies
        return (energies - self.lowest) / fall if fall > 0 else np.full(len(energies), np.nan)

    def errors(self, label: str) -> np.ndarray:
        """Position errors of a method over the size, (k,)."""
        return self.curves[label].errors / self.size

    def rows(self) -> list[Row]:
        """One row a method.

        Keys: ``method``, ``iterations``, ``seconds`` of stepping [s], ``ms`` an iteration, ``setup_s`` and
        ``compile_s`` [s]; at the end ``ratio`` of the residual, energy ``gap``, ``error`` over size, ``inverted``
        elements and ``status``; and for each of ``RATIOS`` and ``ERRORS`` what the method took to reach it, as
        ``s ratio 1e-02`` [s], ``n ratio 1e-02`` iterations, and ``s error 1e-02``. What does not exist is None.
        """
        return [self._row(label, curve) for label, curve in self.curves.items()]

    def record(self, seed: int | None = None) -> dict[str, Any]:
        """Everything but positions, fit for JSON: numbers that are not finite are None.

        Args:
            seed: What the start or the scene was made by, if anything was random; methods use none.
        """
        problem, reference = self.problem, self.reference
        materials = sorted({repr(g.material) for g in problem.groups})
        found = {
            "format": RECORD,
            "version": VERSION,
            "problem": {
                "name": problem.name,
                "vertices": problem.n_vert,
                "elements": problem.n_elem,
                "prescribed": int(problem.fixed.sum()),
                "weak_constraints": sum(len(w.vertices) for w in problem.weak),
                "contacts": 0 if self.start.contacts is None else len(self.start.contacts),
                "materials": materials,
                "size": self.size,
                "at": self.start.at,
            },
            "budget": {
                "iterations": self.iterations,
                "seconds": self.seconds,
                "rounds": self.rounds,
                "looks": self.looks,
            },
            "seed": seed,
            "machine": machine() | {"threads": numba.get_num_threads()},
            "versions": versions(),
            "first_residual": self.first,
            "start_energy": self.energy,
            "reference": None if reference is None else _plain(reference),
            "methods": [
                row | {"solver": repr(self.solvers[row["method"]])} | self._arrays(row["method"]) for row in self.rows()
            ],
        }
        out: dict[str, Any] = _json(found)
        return out

    def draw(self, folder: str | os.PathLike[str], *, states: bool = True) -> list[Path]:
        """Plots against iterations and against seconds, and the final ``states`` side by side; returns the files.

        Raises:
            InputError: A package for drawing is missing, or a file cannot be written.
        """
        from pbng.compare.drawing import draw

        return draw(self, Path(folder), states)

    def _row(self, label: str, c: Curve) -> Row:
        row = {
            "method": label,
            "iterations": int(c.iterations[-1]),
            "seconds": float(c.seconds[-1]),
            "ms": c.ms,
            "setup_s": c.setup_seconds,
            "compile_s": c.compile_seconds,
            "ratio": float(c.ratios[-1]),
            "gap": float(self.gaps(label)[-1]),
            "error": float(self.errors(label)[-1]),
            "inverted": int(c.inverted[-1]),
            "status": c.status.name,
        }
        for level in RATIOS:
            row |= _took(f"ratio {level:.0e}", c.to_residual(level))
        for level in ERRORS:
            row |= _took(f"error {level:.0e}", c.to_error(level * self.size))
        return {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in row.items()}

    def _arrays(self, label: str) -> dict[str, Any]:
        c = self.curves[label]
        return {
            "curve": {
                "iterations": c.iterations,
                "seconds": c.seconds,
                "residuals": c.residuals,
                "energies": c.energies,
                "errors": c.errors,
                "inverted": c.inverted,
            }
        }


def _took(what: str, reached: Reached | None) -> Row:
    seconds, iterations = reached or (None, None)
    return {f"s {what}": seconds, f"n {what}": iterations}


def _plain(reference: Reference) -> dict[str, Any]:
    names = ("by", "certain", "residual", "ratio", "energy", "inverted", "distance", "seconds")
    return {name: getattr(reference, name) for name in names} | {"words": str(reference)}


def _json(value: Any) -> Any:
    """The value with arrays as lists, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {str(k): _json(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_json(v) for v in value]
    if isinstance(value, np.ndarray | np.generic):
        return _json(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
