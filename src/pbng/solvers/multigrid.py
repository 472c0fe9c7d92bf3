"""A nonlinear two-grid cycle for solids: sweeps of PBNG, and a correction from a coarse space (docs/method.md).

One cycle, from the state x::

    g = x; a few forward sweeps with over-relaxation                     removes what oscillates from vertex to vertex
    H = positive definite Hessians at g, summed to the grids             removes what is smooth
    solve UᵀHU y = Uᵀ f(g) roughly, by conjugate gradients with a V-cycle
    z = g + α U y, α = 1 unless the energy says otherwise
    m = Anderson's mixture of the last cycles; x = m if E(m) <= E(z), else z
"""

import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from pbng.coarse.space import CoarseSpace
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.problem import Problem
from pbng.solvers.acceleration import MixingHistory
from pbng.solvers.base import Certificate
from pbng.solvers.pbng import PBNG, PackedMethod

DECREASE = 1e-4  # of f·Uy: what a correction must lower the energy by
BACKTRACKS = 6
SHRINK = 0.5
COARSE_TOLERANCE = 0.1  # rougher solves save nothing and cost cycles below 1e-4


@dataclass(frozen=True)
class MultigridPBNG:
    """PBNG with a coarse space: its number of cycles does not grow with the mesh. For solids.

    Args:
        sweeps: Sweeps a cycle; by default 4, and 8 where a material is nearly incompressible (λ > 10 μ).
        omega: Their relaxation, in (0, 2).
        memory: Cycles that Anderson's mixing looks back on; 0 for none.
        dtype: Precision of the sweeps, "float32" or "float64"; residuals and energies are always float64.
        threads: Threads; by default as many as prove fastest, up to all that Numba has. Results do not depend on it.
    """

    sweeps: int | None = None
    omega: float = 1.5
    memory: int = 5
    dtype: Any = "float32"
    threads: int | None = None

    def __post_init__(self) -> None:
        for name, low in (("sweeps", 1), ("memory", 0)):
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= low) and not (name == "sweeps" and value is None):
                raise InputError(f"MultigridPBNG: {name} must be a whole number of at least {low}, not {value}")
        if not 0 < self.omega < 2:
            raise InputError(f"MultigridPBNG: omega must lie strictly between 0 and 2, not {self.omega}")
        self.smoother()

    def smoother(self) -> PBNG:
        """The method whose sweeps a cycle takes."""
        return PBNG(acceleration=None, dtype=self.dtype, threads=self.threads)

    def set_up(self, problem: Problem) -> "TwoGrid":
        """Colour and pack a problem, and make the grids over it."""
        return TwoGrid(problem, self)


class TwoGrid(PackedMethod):
    """The cycle set up for one problem."""

    every = 1

    def __init__(self, problem: Problem, solver: MultigridPBNG) -> None:
        super().__init__(problem, solver.smoother())
        self.cycle = solver
        start = time.perf_counter() - compile_seconds()
        with self.threads.used():
            self.coarse = CoarseSpace(problem, self.packed)
        self.setup_seconds += time.perf_counter() - compile_seconds() - start
        stiff = any(g.material.lam > 10 * g.material.mu for g in problem.groups)
        self.colors = np.tile(self.colors, solver.sweeps or (8 if stiff else 4))
        self.d = np.zeros(self.n_free)
        self.stiffness = np.maximum(self.packed.stiffness(), 1e-300)
        self.refreshed = False

    def start(self, x: np.ndarray) -> None:
        self.x = self.packed.pack(x)
        self.g, self.z = self.x.copy(), self.x.copy()
        self.history = MixingHistory(self.cycle.memory) if self.cycle.memory else None
        self.E = self.energy(self.x)

    def step(self) -> None:
        with self.threads.timed_step():
            self._sweep_and_correct()
            self._mix()

    def settle(self) -> None:
        pass

    def _sweep_and_correct(self) -> None:
        """z and its energy Ez from x."""
        n, g, z = self.n_free, self.g, self.z
        g[:] = self.x
        self.apply(g, self.cycle.omega)
        self.coarse.refresh(g)
        self.refreshed = True
        slope = self.coarse.direction(self._force(g), self.d, COARSE_TOLERANCE)
        tolerance = self._noise(g)
        np.add(g[:n], self.d, out=z[:n], casting="same_kind")
        self.Ez = self.energy(z)
        if self.Ez <= self.E - DECREASE * slope + tolerance:
            return
        Eg, alpha = self.energy(g), 1.0
        for _ in range(BACKTRACKS):
            # A large rotation, taken along a line, stretches every element; a few sweeps undo that.
            self.apply(z, self.cycle.omega)
            self.Ez = self.energy(z)
            if self.Ez <= Eg - DECREASE * alpha * slope + tolerance:
                return
            alpha *= SHRINK
            np.add(g[:n], alpha * self.d, out=z[:n], casting="same_kind")
        z[:], self.Ez = g, Eg

    def _mix(self) -> None:
        """The next x from the last one and z."""
        n, m = self.n_free, self.g
        if self.history is not None and self.history.push(self.x[:n], self.z[:n]) and self.history.mix(self.z[:n], m[:n]):
            E = self.energy(m)
            if E <= self.Ez + self._noise(m):
                self.x, self.g, self.E = m, self.x, E
                return
            self.history.restart()
        self.x, self.z, self.E = self.z, self.x, self.Ez

    def _force(self, x: np.ndarray) -> np.ndarray:
        self.blocks.forces(x, self.forces)
        return self.forces[: self.n_free] + self.f_ext[: self.n_free]

    def _noise(self, x: np.ndarray) -> float:
        """What rounding may do to an energy [J]."""
        unit = 0.5 * np.finfo(x.dtype).eps * float(np.abs(x).max(initial=0.0))
        return float(self.stiffness.sum()) * unit**2 + 1e-13 * abs(self.E)

    def certify(self) -> Certificate:
        with self.threads.used():
            force_scale, inverted = self.blocks.forces(self.x, self.forces)
            f = self.forces[: self.n_free] + self.f_ext[: self.n_free]
            return Certificate(float(np.linalg.norm(f)), self.E, force_scale, inverted, self._error(f))

    def _error(self, f: np.ndarray) -> float:
        """Estimate of the largest position error [m]: where the forces would move the vertices, on the grid and each
        by itself. Stiffness is that of the last cycle."""
        if not self.refreshed:
            return math.nan
        self.coarse.direction(f, self.d, COARSE_TOLERANCE)
        away = (self.d.reshape(-1, 4) + f.reshape(-1, 4) / self.stiffness[:, None])[:, :3]
        return float(np.linalg.norm(away, axis=1).max(initial=0.0))
