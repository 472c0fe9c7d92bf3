"""Newton's method (section 11.1): the whole Hessian, a linear solver, and a line search where one is wanted.

One iteration, from the state x::

    f = -∂E/∂x at x;  K = ∂²E/∂x∂x at x, exact or with each element's made positive semidefinite
    solve K d = f, roughly while x is far from equilibrium
    x = x + α d;  α = 1, or the largest tried that lowers the energy enough
"""

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.problem import Problem
from pbng.solvers.linear import CG, NAMES, Solution
from pbng.solvers.system import System
from pbng.solvers.threads import check_threads
from pbng.solvers.vertexwise import VertexMethod
from pbng.stiffness import PROJECTIONS, StiffnessMatrix

DECREASE = 1e-4  # of α f·d: what a step must lower the energy by
BACKTRACKS = 20
FAR, FARTHEST = 1.5, 4.0  # where a parabola must put the minimum for a step to be lengthened, and at most to what
LARGEST_FORCING, LEAST_FORCING = 0.1, 1e-10
MOVEMENT = 1e-7  # of the problem's size: how far prescribed vertices move in a difference of forces
FALLS = 0.5  # what the residual must fall to in a full step for the next to try the exact Hessian


@dataclass(frozen=True)
class Newton:
    """Newton's method with robust defaults.

    The paper's, for comparison, is ``Newton(linear=..., projection="none", line_search=False)``: it may diverge.

    Args:
        linear: What solves the linear systems: :class:`CG` (default), :class:`BiCGSTAB`, :class:`Direct`,
            :class:`GaussSeidel` or :class:`AMG`, as an instance, a class, or by name: "cg", "bicgstab", "direct",
            "gauss-seidel", "amg".
        projection: "none" for the exact Hessian; "clamp" or "abs" to set the negative eigenvalues of each element's to
            zero or to their absolute value; "auto" (default) for the exact one near equilibrium, if it is found to be
            positive definite, which converges quadratically, and else "abs", which takes the fewest iterations.
        line_search: Whether a step is shortened until it lowers the energy. With it the energy never rises.
        start: "extend" to begin with a step that takes the movement of the prescribed vertices along, if that lowers
            the energy, or "previous" to leave the free vertices where they are.
        threads: Threads; by default as many as prove fastest, up to all that Numba has. Results do not depend on it.
    """

    linear: Any = field(default_factory=CG)
    projection: str = "auto"
    line_search: bool = True
    start: str = "extend"
    threads: int | None = None

    def __post_init__(self) -> None:
        chosen = self.linear
        if isinstance(chosen, str):
            if chosen not in NAMES:
                raise InputError(f"Newton: linear must be one of {', '.join(NAMES)}, not {chosen!r}")
            chosen = NAMES[chosen]
        chosen = chosen() if isinstance(chosen, type) else chosen
        if not hasattr(chosen, "start"):
            raise InputError(f"Newton: {self.linear!r} is not a linear solver")
        object.__setattr__(self, "linear", chosen)
        choices = ("auto", *PROJECTIONS)
        if self.projection not in choices:
            raise InputError(f"Newton: projection must be one of {', '.join(choices)}, not {self.projection!r}")
        if self.start not in ("extend", "previous"):
            raise InputError(f"Newton: start must be 'extend' or 'previous', not {self.start!r}")
        check_threads("Newton", self.threads)

    def set_up(self, problem: Problem) -> "NewtonMethod":
        """Make the pattern of the Hessian."""
        return NewtonMethod(problem, self)


class NewtonMethod(VertexMethod):
    """Newton's method set up for one problem.

    Attributes:
        seconds: Time spent since the start [s], by what it went into: "forces", "assembly", "linear", "search".
        linear_iterations: Iterations of the linear solver since the start.
        exact_steps: Steps since the start that were taken with the exact Hessian.
    """

    def __init__(self, problem: Problem, solver: Newton) -> None:
        self.solver = solver
        super().__init__(problem, solver.threads, self._set_up)
        self._reset()

    def _set_up(self) -> None:
        self.better: np.ndarray | None = None  # what prepare() has handed over
        self.stiffness = StiffnessMatrix(self.problem)
        self.vertex = self.stiffness.vertex
        system = System(self.stiffness.matrix, self.stiffness.color_start, self.problem.X[self.vertex])
        self.linear = self.solver.linear.start(system)

    def start(
        self,
        x: np.ndarray,
        targets: np.ndarray | None = None,
        contacts: Contacts | None = None,
        resume: bool = False,
    ) -> None:
        super().start(x, targets)
        if x is not self.better:
            self._reset()
        self.better = None

    def prepare(self, before: np.ndarray, x: np.ndarray) -> np.ndarray | None:
        """The step of Newton's method from ``before`` that takes the movement of the prescribed vertices along.

        The forces that the movement makes to first order are differences of forces.
        """
        increment = x - before
        longest = float(np.abs(increment).max(initial=0.0))
        if self.solver.start == "previous" or longest == 0.0 or len(self.vertex) == 0:
            return None
        with self.threads.used(), np.errstate(all="ignore"):
            with self._timed("forces"):
                h = MOVEMENT * float(np.ptp(self.problem.X, axis=0).max()) / longest
                forward, backward = (self.total_forces(before + t * increment)[0] for t in (h, -h))
                f = ((forward + backward) / 2 + (forward - backward) / (2 * h))[self.vertex]
            if not np.isfinite(f).all():
                return None
            d = self._solve("abs", f, LARGEST_FORCING, before).x
            better = x.copy()
            better[self.vertex] += d
            with self._timed("search"):
                lower = self.problem.energy(better, self.targets) < self.problem.energy(x, self.targets)
        self.better = better if lower else None
        return self.better

    def _reset(self) -> None:
        self.seconds = dict.fromkeys(("forces", "assembly", "linear", "search"), 0.0)
        self.linear_iterations = self.exact_steps = 0
        self.last = math.nan  # the residual before the last step [N]
        self.full = False  # whether that step was not shortened
        self.wait = self.patience = 0  # steps before the exact Hessian is tried again

    def step(self) -> None:
        if len(self.vertex):
            with self.threads.timed_step():
                self._step()

    def _step(self) -> None:
        with self._timed("forces"), np.errstate(all="ignore"):
            f = self.total_forces(self.x)[0][self.vertex]
            size = float(np.linalg.norm(f))
        if not math.isfinite(size) or size == 0.0:
            return
        d = self._direction(f, size)
        self.last = size
        if not self.solver.line_search:
            with np.errstate(all="ignore"):
                self.x[self.vertex] += d
            return
        with self._timed("search"):
            slope = float(np.vdot(f, d))
            if slope < 0:  # along negative curvature: its opposite lowers the energy
                d, slope = -d, -slope
            alpha = self._search(d, slope)
        self.full = alpha == 1.0

    def _direction(self, f: np.ndarray, size: float) -> np.ndarray:
        """The step d (n, 3) for the forces f, of norm ``size``."""
        forcing = LARGEST_FORCING
        if math.isfinite(self.last) and self.last > 0:
            # The second choice of Eisenstat and Walker (1996), without the safeguard that keeps it from falling fast.
            forcing = min(LARGEST_FORCING, max(0.9 * (size / self.last) ** 2, LEAST_FORCING))
        projection = self.solver.projection
        if projection != "auto":
            solution = self._solve(projection, f, forcing)
            self.exact_steps += projection == "none"
            return solution.x
        self.wait -= 1
        if self.wait < 0 and self.full and size < FALLS * self.last:
            solution = self._solve("none", f, forcing)
            if not solution.indefinite and float(np.vdot(f, solution.x)) > 0:
                self.patience = 0
                self.exact_steps += 1
                return solution.x
            self.patience = 2 * self.patience + 1
            self.wait = self.patience
        return self._solve("abs", f, forcing).x

    def _solve(self, projection: str, f: np.ndarray, forcing: float, x: np.ndarray | None = None) -> Solution:
        with self._timed("assembly"):
            self.stiffness.fill(self.x if x is None else x, projection)
        with self._timed("linear"):
            solution: Solution = self.linear.solve(f, forcing)
        self.linear_iterations += solution.iterations
        return solution

    def _search(self, d: np.ndarray, slope: float) -> float:
        """Move by α d with an α that lowers the energy, and return it; 0 if none does."""
        before = self.problem.energy(self.x, self.targets)
        noise = float(self._stiffness.sum()) * self.rounding() ** 2 + 1e-13 * abs(before)
        alpha = 1.0
        for _ in range(BACKTRACKS):
            trial, energy = self._moved(alpha, d)
            bend = energy - before + alpha * slope  # from the parabola through both energies and the slope
            best = 0.5 * alpha**2 * slope / bend if math.isfinite(bend) and bend > 0 else math.inf
            if energy <= before - DECREASE * alpha * slope + noise:
                if alpha == 1.0 and best > FAR:  # a projected Hessian may be much too stiff
                    further, lower = self._moved(min(best, FARTHEST), d)
                    trial = further if lower < energy else trial
                self.x = trial
                return alpha
            alpha *= min(max(best / alpha, 0.1), 0.5) if math.isfinite(best) else 0.1
        return 0.0

    def _moved(self, alpha: float, d: np.ndarray) -> tuple[np.ndarray, float]:
        """The state moved by α d, and its energy [J]."""
        x = self.x.copy()
        with np.errstate(all="ignore"):
            x[self.vertex] += alpha * d
        return x, self.problem.energy(x, self.targets)

    @contextmanager
    def _timed(self, what: str) -> Iterator[None]:
        start = time.perf_counter() - compile_seconds()
        yield
        self.seconds[what] += time.perf_counter() - compile_seconds() - start
