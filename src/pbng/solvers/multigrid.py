"""A nonlinear two-grid cycle: sweeps of PBNG, and a correction from a coarse space (docs/method.md).

One cycle, from the state x::

    g = x; a few forward sweeps with over-relaxation                     removes what oscillates from vertex to vertex
    H = positive definite Hessians at g, summed to the grids             removes what is smooth
    solve UᵀHU y = Uᵀ f(g) roughly, by conjugate gradients with a V-cycle
    z = g + α U y, α = 1 unless the energy says otherwise
    m = Anderson's mixture of the last cycles; x = m if E(m) <= E(z), else z

Of cloth the coarse space holds every vertex: there U = 1, and a correction is a step of Newton's method that the grids
precondition.
"""

import math
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from pbng.coarse.space import CoarseSpace
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.materials.base import Material
from pbng.problem import Problem
from pbng.solvers.acceleration import MixingHistory, Softness
from pbng.solvers.base import Certificate, norm
from pbng.solvers.pbng import PBNG, PackedMethod, checked_dtype
from pbng.solvers.threads import check_threads

DECREASE = 1e-4  # of f·Uy: what a correction must lower the energy by
BACKTRACKS, BACKTRACKS_CLOTH = 6, 10  # cloth that lies flat does not resist at first, and then all the more
SHRINK = 0.5
CLOSINGS = 3  # how often a correction is sought anew for the contacts that it would run into
SLOWEST = 0.9  # rate of convergence that an estimate of the error supposes at most
TOO_LITTLE = 10  # how much larger than a Newton step it supposes the error to be, at most
NEAR_SADDLES = 0.98, 50  # the same two where the Hessian of cloth is found indefinite, as while it buckles
CLOTH_SWEEPS = 10  # a cycle of cloth: they cost little beside the rest
COARSE_TOLERANCE = 0.1  # rougher solves save nothing and cost cycles below 1e-4


@dataclass(frozen=True)
class MultigridPBNG:
    """PBNG with a coarse space: its number of cycles does not grow with the mesh.

    Cloth takes Newton's steps on all its vertices; without stiffness against bending it may take more of them on finer
    meshes, as ever finer folds come and go.

    Args:
        sweeps: Sweeps a cycle; by default 4, 8 where a material is nearly incompressible (λ > 10 μ), 10 with cloth.
        omega: Their relaxation, in (0, 2).
        memory: Cycles that Anderson's mixing looks back on; 0 for none.
        start: "extend" to begin with the movement of the prescribed vertices extended over the grid, if that lowers the
            energy, or "previous" to leave the free vertices where they are.
        dtype: Precision of the sweeps, "float32", "float64" or "auto": float32 until rounding keeps the residual from
            falling further, then float64 (for cloth alone, from the start). Residuals and energies are always float64.
        threads: Threads; by default as many as prove fastest, up to all that Numba has. Results do not depend on it.
    """

    sweeps: int | None = None
    omega: float = 1.5
    memory: int = 5
    start: str = "extend"
    dtype: Any = "auto"
    threads: int | None = None

    def __post_init__(self) -> None:
        for name, low in (("sweeps", 1), ("memory", 0)):
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= low) and not (name == "sweeps" and value is None):
                raise InputError(f"MultigridPBNG: {name} must be a whole number of at least {low}, not {value}")
        if not 0 < self.omega < 2:
            raise InputError(f"MultigridPBNG: omega must lie strictly between 0 and 2, not {self.omega}")
        if self.start not in ("extend", "previous"):
            raise InputError(f"MultigridPBNG: start must be 'extend' or 'previous', not {self.start!r}")
        object.__setattr__(self, "dtype", checked_dtype("MultigridPBNG", self.dtype))
        check_threads("MultigridPBNG", self.threads)

    def smoother(self) -> PBNG:
        """The method whose sweeps a cycle takes."""
        return PBNG(acceleration=None, dtype=self.dtype, threads=self.threads)

    def set_up(self, problem: Problem) -> "TwoGrid":
        """Colour and pack a problem, and make the grids over it."""
        return TwoGrid(problem, self)


class TwoGrid(PackedMethod):
    """The cycle set up for one problem."""

    every = 1
    first_trial = 3
    estimates_error = True

    def __init__(self, problem: Problem, solver: MultigridPBNG) -> None:
        cloth = [not g.kind.solid for g in problem.groups]
        if all(cloth) and solver.dtype == "auto":  # float32 saves little where sweeps are the least part of a cycle
            solver = replace(solver, dtype="float64")
        super().__init__(problem, solver.smoother())
        self.cycle = solver
        start = time.perf_counter() - compile_seconds()
        with self.threads.used():
            self.coarse = CoarseSpace(problem, self.packed)
        self.setup_seconds += time.perf_counter() - compile_seconds() - start
        stiff = any(m.lam > 10 * m.mu for m in (g.material for g in problem.groups) if isinstance(m, Material))
        self.backtracks = BACKTRACKS_CLOTH if any(cloth) else BACKTRACKS
        self.times = solver.sweeps or (CLOTH_SWEEPS if any(cloth) else 8 if stiff else 4)
        self.d = np.zeros(self.n_free)
        stiffness = self.stiffness
        self.compliance = np.divide(1.0, stiffness, out=np.zeros_like(stiffness), where=stiffness > 0)

    def prepare(self, before: np.ndarray, x: np.ndarray) -> np.ndarray | None:
        fixed = self.problem.fixed
        increment = x[fixed] - before[fixed]
        if self.cycle.start == "previous" or not increment.any():
            return None
        with self.threads.used():
            extended = x + self.coarse.extend(increment)
            extended[fixed] = x[fixed]
        return extended if self.lower(extended, x) else None

    def begin(self, x: np.ndarray) -> None:
        self.x = self.pack(x)
        self.g, self.z = self.x.copy(), self.x.copy()
        self.history = MixingHistory(self.cycle.memory) if self.cycle.memory else None
        self.E = self.energy(self.x)
        self.softness = Softness(self.cycle.omega)
        self.refreshed = False
        self.coarse.restart()
        self.moved: list[float] = []  # largest movement of a vertex in each of the last three cycles [m]

    def step(self) -> None:
        with self.threads.timed_step():
            self._sweep_and_correct()
            before = self.x
            self._mix()
            self.moved = [*self.moved[-2:], _longest(self.x[: self.n_free] - before[: self.n_free])]

    def settle(self) -> None:
        pass

    def _sweep_and_correct(self) -> None:
        """z and its energy Ez from x."""
        n, g, z = self.n_free, self.g, self.z
        g[:] = self.x
        self.apply(g, self.softness.omega)
        f, _, _ = self.free_forces(g)
        if not np.isfinite(f).all():
            self._tread_softly()
            return
        tolerance = self.noise(self.x, self.E)
        touching, at = self.touching, self._places(g)
        active = touching.active(at, self.slack(g)) if touching else None
        self.refreshed, pull = True, f
        for closing in range(CLOSINGS + 1):
            self.coarse.touch(touching, at, active)
            self.coarse.refresh(g)
            slope = self.coarse.direction(pull, self.d, COARSE_TOLERANCE)
            slope = slope if not closing else max(float((f * self.d).sum()), 0.0)
            np.add(g[:n], self.d, out=z[:n], casting="same_kind")
            self.admit(z, g)
            self.Ez = self.energy(z)
            if self.Ez <= self.E - DECREASE * slope + tolerance:
                if self.softness.succeed() and self.history is not None:
                    self.history.restart()  # it was that of another map
                return
            if touching is None:
                break
            closed = active | touching.active(self._places(z), self.slack(z))
            if (closed == active).all():
                break
            # What the correction runs into is to be closed by it, and to resist.
            active = closed
            pull = f.copy()
            self._places(pull)[:] += touching.closing(at, active, self.coarse.bearing)[: n // 4]
        Eg, alpha = self.energy(g), 1.0
        if self.rises(Eg, self.E, self.x):
            self._tread_softly()
            return
        for _ in range(self.backtracks):
            # A large rotation, taken along a line, stretches every element; a few sweeps undo that.
            self.apply(z, self.softness.omega)
            self.Ez = self.energy(z)
            if self.Ez <= Eg - DECREASE * alpha * slope + tolerance:
                return
            alpha *= SHRINK
            np.add(g[:n], alpha * self.d, out=z[:n], casting="same_kind")
            self.admit(z, g)
        z[:], self.Ez = g, Eg

    def _tread_softly(self) -> None:
        """After sweeps that have raised the energy, as they may where a material's block does not bound it."""
        self.softness.fail()
        self.z[:], self.Ez = self.x, self.E

    def _mix(self) -> None:
        """The next x from the last one and z."""
        n, m, history = self.n_free, self.g, self.history
        if history is not None and history.push(self.x[:n], self.z[:n]) and history.mix(self.z[:n], m[:n]):
            self.admit(m, self.z)
            energy = self.energy(m)
            if energy <= self.Ez + self.noise(self.x, self.E):
                self.x, self.g, self.E = m, self.x, energy
                return
            history.restart()
        self.x, self.z, self.E = self.z, self.x, self.Ez

    def certify(self) -> Certificate:
        with self.threads.used():
            f, force_scale, inverted = self.free_forces(self.x)
            self.force_scale = force_scale
            return Certificate(norm(f), self.E, force_scale, inverted, self._error(f))

    def _error(self, f: np.ndarray) -> float:
        """Estimate of the largest position error [m].

        A Newton step tells where the forces would move the vertices, on the grid and each by itself. With Hessians made
        positive definite that may be too little by a factor of a few; what the last movements add up to, if they go on
        to shrink as they lately did, tells how much.
        """
        if not self.refreshed:
            return math.nan
        self.coarse.direction(f, self.d, COARSE_TOLERANCE)
        newton = _longest(self.d + f * np.repeat(self.compliance, 4))
        rates = [b / a for a, b in pairwise(self.moved) if a > 0]
        slowest, too_little = (SLOWEST, TOO_LITTLE) if self.coarse.definite else NEAR_SADDLES
        rate = min(max(rates, default=0.5), slowest)
        to_come = self.moved[-1] * rate / (1 - rate) if self.moved else 0.0
        return max(newton, min(to_come, too_little * newton))


def _longest(x: np.ndarray) -> float:
    """Largest norm of the vectors of a flat array of four components each."""
    x = x.reshape(-1, 4)
    return math.sqrt(np.einsum("ij,ij->i", x, x).max(initial=0.0))
