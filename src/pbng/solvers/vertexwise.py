"""What methods share that keep their state as positions (n_vert, 3) in float64: Newton's method and XPBD."""

import time
from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.problem import Problem
from pbng.solvers.base import Certificate, norm
from pbng.solvers.threads import FIRST_PROBE, Threads


class VertexMethod:
    """State, certificate and threads of such a method; a method adds ``step`` and what it sets up.

    Args:
        problem: What is solved.
        threads: Threads; None for as many as prove fastest.
        set_up: What else to set up, timed.

    Raises:
        InputError: The problem has contact.
    """

    every = 1
    estimates_error = False

    def __init__(self, problem: Problem, threads: int | None = None, set_up: Callable[[], None] | None = None) -> None:
        if problem.contact is not None:
            raise InputError(f"scene {problem.name!r}: this method knows nothing of contact; use PBNG or MultigridPBNG")
        self.problem = problem
        self.threads = Threads(threads, FIRST_PROBE)
        self.free = np.flatnonzero(~problem.fixed)
        self.x = problem.X.copy()
        self.targets = np.empty((0, 3))
        start = time.perf_counter() - compile_seconds()
        with self.threads.used():
            problem.evaluate(problem.X, np.zeros((problem.n_target, 3)))  # lays the elements out
            if set_up is not None:
                set_up()
        self.setup_seconds = time.perf_counter() - compile_seconds() - start

    def prepare(self, before: np.ndarray, x: np.ndarray) -> np.ndarray | None:
        return None

    def start(
        self,
        x: np.ndarray,
        targets: np.ndarray | None = None,
        contacts: Contacts | None = None,
        resume: bool = False,
    ) -> None:
        self.x = np.array(x, float)
        self.targets = self.problem.targets(self.problem.end) if targets is None else targets

    def settle(self) -> None:
        pass

    def state(self) -> np.ndarray:
        return self.x.copy()

    def certify(self) -> Certificate:
        with self.threads.used(), np.errstate(all="ignore"):  # what overflows is not finite, and seen
            f, force_scale, inverted = self.total_forces(self.x)
            energy = self.problem.energy(self.x, self.targets)
            return Certificate(norm(f[self.free]), energy, force_scale, inverted)

    def total_forces(self, x: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Internal and external forces (n_vert, 3) [N], the force scale [N] and the number of inverted elements."""
        f, force_scale, inverted = self.problem.evaluate(x, self.targets)
        return f + self.problem.f_ext, force_scale, inverted

    def refine(self) -> bool:
        return False

    def floor(self, dtype: Any = None) -> float:
        """Norm of the forces that moving each vertex by half a unit in the last place of the largest position makes."""
        return self.rounding(dtype) * float(np.linalg.norm(self._stiffness))

    def rounding(self, dtype: Any = None) -> float:
        """Half a unit in the last place of the largest position [m], in a precision, by default float64."""
        return 0.5 * float(np.finfo(dtype or float).eps) * float(np.abs(self.x).max(initial=0.0))

    @cached_property
    def _stiffness(self) -> np.ndarray:
        """Stiffness of the free vertices [N/m], (n_free,), as the blocks of the elements have it at rest."""
        problem = self.problem
        total = np.zeros(problem.n_vert)
        for g in problem.groups:
            X = problem.X[g.cells]
            size2 = (g.kind.gradients(X) ** 2).sum(-1)
            np.add.at(total, g.cells, g.block().a * g.kind.volume(X)[:, None] * size2)
        for w in problem.weak:
            np.add.at(total, w.vertices, w.weights**2 * (np.trace(w.K, axis1=1, axis2=2) / 3)[:, None])
        return total[self.free]
