"""Constraint-based nonlinear Gauss-Seidel (section 6): PBD, XPBD, XPBD-QS and its flipped form.

These are the baselines of the paper, on PBNG's footing: lanes, colours, certificate.
A time step of backward Euler (20) begins at x̂ = x + Δt v + Δt² f_ext / m with all multipliers zero; every iteration
then projects each constraint once, Eqs. (24)-(26). A quasistatic problem takes *pseudo-time steps* until it is at rest.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.errors import InputError
from pbng.materials.base import Material
from pbng.packing import aligned, origin_of
from pbng.problem import Problem
from pbng.projection.elastic import ElasticPass
from pbng.projection.weak import WeakPass
from pbng.solvers.base import Certificate
from pbng.solvers.pbng import checked_dtype
from pbng.solvers.threads import check_threads
from pbng.solvers.vertexwise import VertexMethod

STEP = 1.0  # the default pseudo-time step, in periods over 2π of a vertex whose neighbours are held
UNMET = 0.5  # part of it for Neo-Hookean, whose error at rest is larger; it falls with the square of the step
ORDERS = ("elastic first", "weak first")


@dataclass(frozen=True, kw_only=True)
class XPBD:
    """XPBD (Macklin et al. 2016); for quasistatic problems XPBD-QS, backward Euler in pseudo-time run to rest.

    Args:
        dt: Pseudo-time step [s] for quasistatic problems; those of backward Euler have their own. By default the median
            over the vertices of sqrt(mass / stiffness), in which a wave crosses about half an element, and half of that
            for constraints that are not met at rest. Longer steps settle sooner, further from equilibrium.
        iterations: Iterations a pseudo-time step, or None for all in one step.
        order: "elastic first" or "weak first", the paper's XPBD-QS (flipped).
        damping: "kinetic" drops the velocity whenever the kinetic energy has fallen, which settles soonest; a number
            drops that part of it after each pseudo-time step: 0 is backward Euler as in Eq. (20).
        dtype: Precision of positions and multipliers, "float32" or "float64"; residuals are always float64.
        threads: Threads; by default as many as prove fastest. Results do not depend on it.

    Raises:
        InputError: An argument is out of range; and by ``set_up``, a material has no constraints (Eq. 21) or a negative
            stiffness, or a free vertex no mass.
    """

    dt: float | None = None
    iterations: int | None = 1
    order: str = "elastic first"
    damping: float | str = "kinetic"
    dtype: Any = "float32"
    threads: int | None = None

    compliant: ClassVar[bool] = True

    def __post_init__(self) -> None:
        name = type(self).__name__
        if self.dt is not None and not (np.isfinite(self.dt) and self.dt > 0):
            raise InputError(f"{name}: dt must be positive and finite, not {self.dt}")
        count = self.iterations
        if count is not None and not (isinstance(count, int) and count >= 1):
            raise InputError(f"{name}: iterations must be a whole number of at least 1, or None, not {count!r}")
        if self.order not in ORDERS:
            raise InputError(f"{name}: order must be {' or '.join(map(repr, ORDERS))}, not {self.order!r}")
        if self.damping != "kinetic" and not (isinstance(self.damping, float | int) and 0 <= self.damping <= 1):
            raise InputError(f"{name}: damping must be 'kinetic' or lie between 0 and 1, not {self.damping!r}")
        dtype = checked_dtype(name, self.dtype)
        if dtype == "auto":
            raise InputError(f"{name}: dtype must be 'float32' or 'float64', not 'auto'")
        object.__setattr__(self, "dtype", dtype)
        check_threads(name, self.threads)

    def set_up(self, problem: Problem) -> "ProjectionMethod":
        """Colour the constraints of a problem and lay them out."""
        return ProjectionMethod(problem, self)


@dataclass(frozen=True, kw_only=True)
class PBD(XPBD):
    """Position-based dynamics (Müller et al. 2007): XPBD without compliance, as if everything were infinitely stiff.

    External forces enter only where a time step begins, and iterations wear them off (section 6.1). By default there is
    one step: everything after the first iteration takes load away. Arguments as for :class:`XPBD`.
    """

    iterations: int | None = None

    compliant: ClassVar[bool] = False


class ProjectionMethod(VertexMethod):
    """XPBD or PBD set up for one problem. Positions are kept flat, with the inverse masses, in Morton order."""

    def __init__(self, problem: Problem, solver: XPBD) -> None:
        self.solver = solver
        whole = solver.iterations or 1
        self.every = whole * max(10 // whole, 1)  # residuals are those of whole time steps
        self.dtype = np.dtype(solver.dtype)
        super().__init__(problem, solver.threads, self._set_up)

    def _set_up(self) -> None:
        problem, solver = self.problem, self.solver
        _check(problem, type(solver).__name__, solver.compliant)
        self.dynamic = problem.dt is not None
        self.dt = problem.dt or solver.dt or self._suitable_dt()
        self.iterations = None if self.dynamic else solver.iterations
        place = np.empty(problem.n_vert, np.int64)
        place[problem.order] = np.arange(problem.n_vert)
        w = np.where(problem.fixed, 0.0, 1 / np.where(problem.fixed, 1.0, problem.mass))
        self.place, self.inverse_mass = place, w
        self.mass = np.where(problem.fixed, 0.0, problem.mass)[problem.order, None]
        self.elastic = ElasticPass(problem, place, self.dt, solver.compliant, self.dtype)
        weak = problem.weak[:-1] if self.dynamic and len(self.free) else problem.weak
        self.weak = WeakPass(weak, place, w, self.dt, solver.compliant, self.dtype) if weak else None
        passes = [self.elastic, *([self.weak] if self.weak else [])]
        self.passes: list[Any] = passes if solver.order == "elastic first" else passes[::-1]
        self.push = self.flat((self.dt**2 * w)[:, None] * problem.f_ext)
        self.origin = origin_of(problem.X)
        self.start(problem.X, np.zeros((problem.n_target, 3)))

    def flat(self, v: np.ndarray) -> np.ndarray:
        """Vectors (n_vert, 3) as the flat array (4 n_vert,) that kernels read, in the method's precision and order."""
        out = aligned(4 * len(v), self.dtype)
        rows = out.reshape(-1, 4)
        rows[self.place, :3] = v
        rows[:, 3] = 0
        return out

    def start(
        self,
        x: np.ndarray,
        targets: np.ndarray | None = None,
        contacts: Contacts | None = None,
        resume: bool = False,
    ) -> None:
        super().start(x, targets)
        self.current = self.flat(x - self.origin if self.origin.any() else x)
        self.current.reshape(-1, 4)[self.place, 3] = self.inverse_mass
        self.before = self.current.copy()
        self.iteration, self.kinetic = 0, 0.0
        if self.weak:
            own = self.targets[: len(self.targets) - len(self.free)] if self.dynamic else self.targets
            self.weak.aim(own - self.origin)

    def step(self) -> None:
        with self.threads.timed_step():
            if self.iteration == 0 or (self.iterations and self.iteration % self.iterations == 0):
                self._begin()
            for constraints in self.passes:
                constraints.run(self.current)
        self.iteration += 1

    def _begin(self) -> None:
        """Begin a time step: go on with the velocity and the external forces, and forget the multipliers."""
        if self.dynamic:
            x, place = self.current.reshape(-1, 4), self.place[self.free]
            x[place, :3] = self.targets[len(self.targets) - len(self.free) :] - self.origin
            self.current += self.push
        else:
            moved = self._damped(self.current - self.before)
            self.before[:] = self.current
            self.current += moved
            self.current += self.push
        for constraints in self.passes:
            constraints.reset()

    def _damped(self, moved: np.ndarray) -> np.ndarray:
        """What is left of the movement in a pseudo-time step for the next, which is called Δt v."""
        damping = self.solver.damping
        if isinstance(damping, str):
            # Sums in float64 and in NumPy's fixed order, or the number of threads would show.
            energy = float(np.sum(self.mass * moved.reshape(-1, 4)[:, :3] ** 2))
            damping = 1.0 if energy < self.kinetic else 0.0
            self.kinetic = (1 - damping) * energy
        return (1 - damping) * moved

    def _suitable_dt(self) -> float:
        """The default pseudo-time step [s]; vertices of weak constraints, which may be very stiff, do not count."""
        problem, free = self.problem, self.free
        if len(free) == 0:
            return 1.0
        bound = np.zeros(problem.n_vert, bool)
        for w in problem.weak:
            bound[w.vertices] = True
        own = ~bound[free] if (~bound[free]).any() else np.ones(len(free), bool)
        forms = [g.material.constraints() for g in problem.groups]
        step = STEP if all(f is not None and f.met_at_rest for f in forms) else STEP * UNMET
        return step * float(np.median(np.sqrt(problem.mass[free] / self._stiffness)[own]))

    def state(self) -> np.ndarray:
        found = self.current.reshape(-1, 4)[self.place, :3]
        return found + self.origin if self.origin.any() else found

    def certify(self) -> Certificate:
        self.x = np.asarray(self.state(), float)
        return super().certify()

    def floor(self, dtype: Any = None) -> float:
        return super().floor(dtype or self.dtype)


def _check(problem: Problem, name: str, compliant: bool) -> None:
    """InputError if a material or a mass rules out constraints."""
    for group in problem.groups:
        material = group.material
        who = type(material).__name__
        if not isinstance(material, Material) or material.surface:
            raise InputError(f"{name}: constraints are for solids, and {who} is for cloth; take PBNG or Newton")
        form = material.constraints()
        if form is None:
            raise InputError(
                f"{name}: {who} has no form as constraints, Ψ = Σ k/2 C²; Corotated and NeoHookean have one"
            )
        if not material.isotropic:
            raise InputError(f"{name}: constraints are for isotropic materials, and {who} is not")
        if min(form.stiffness) < 0:
            raise InputError(f"{name}: {who} with nu={material.nu:g} has a constraint of negative stiffness")
        if not (compliant or form.met_at_rest):
            raise InputError(f"{name}: the constraints of {who} cannot be met at rest; take Corotated, or XPBD")
    light = np.flatnonzero(~problem.fixed & (problem.mass <= 0))
    if len(light):
        raise InputError(f"{name}: vertex {light[0]} has no mass; give its material a density")
