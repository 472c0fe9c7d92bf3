"""Position-based nonlinear Gauss-Seidel (section 7): coloured sweeps, accelerated."""

import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pbng.assembly import ElementBlocks
from pbng.constraints import WeakEnergy
from pbng.contact.contacts import ContactEnergy, Contacts
from pbng.contact.nodes import ContactNodes
from pbng.errors import InputError
from pbng.jit import compile_seconds
from pbng.packing import Packed, pack_problem
from pbng.problem import Problem
from pbng.solvers.acceleration import Acceleration, Anderson, Iteration, NodeSOR
from pbng.solvers.base import Certificate, norm
from pbng.solvers.threads import FIRST_PROBE, Threads, check_threads
from pbng.sweep import sweep

SLACK = 4.0  # how many roundings off its half-space a vertex may be that touches it
DOUBT = 16.0  # how many roundings an energy may be off by


@dataclass(frozen=True)
class PBNG:
    """The method of the paper, with robust defaults: nothing to tune.

    Args:
        acceleration: :class:`Anderson` (default), :class:`NodeSOR`, :class:`SOR`, :class:`Chebyshev`, as a class or an
            instance, or None for plain sweeps. See ``docs/choosing.md``.
        block: "majorizer", for which no node update can raise the energy, or "paper" for Eq. (32).
        dtype: Precision of the sweeps, "float32", "float64" or "auto": float32 until rounding keeps the residual from
            falling further, then float64. Residuals and energies are always float64.
        symmetric: Follow each sweep by one in reverse order of the colours (one iteration is then two sweeps).
        threads: Threads; by default as many as prove fastest, up to all that Numba has. Results do not depend on it.
        device: Only "cpu".
    """

    acceleration: Any = field(default_factory=Anderson)
    block: str = "majorizer"
    dtype: Any = "auto"
    symmetric: bool = False
    threads: int | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        chosen = NodeSOR(1.0) if self.acceleration is None else self.acceleration
        chosen = chosen() if isinstance(chosen, type) else chosen
        if not hasattr(chosen, "start"):
            raise InputError(f"PBNG: {self.acceleration!r} is not an acceleration")
        object.__setattr__(self, "acceleration", chosen)
        if self.block not in ("majorizer", "paper"):
            raise InputError(f"PBNG: block must be 'majorizer' or 'paper', not {self.block!r}")
        object.__setattr__(self, "dtype", checked_dtype("PBNG", self.dtype))
        check_threads("PBNG", self.threads)
        if self.device != "cpu":
            raise InputError(f"PBNG: device must be 'cpu', not {self.device!r}")

    def set_up(self, problem: Problem) -> "PackedMethod":
        """Colour and pack a problem."""
        return PackedMethod(problem, self)


def checked_dtype(who: str, dtype: Any) -> str:
    """The name of a precision, or "auto"; InputError if it is neither."""
    if dtype == "auto":
        return "auto"
    try:
        real = np.dtype(dtype)
    except TypeError:
        real = np.dtype(object)
    if real not in (np.float32, np.float64):
        raise InputError(f"{who}: dtype must be 'float32', 'float64' or 'auto', not {dtype!r}")
    return real.name


class PackedMethod:
    """PBNG set up for one problem: the packed layout, the float64 evaluation and an accelerated state."""

    every = 10
    first_trial = FIRST_PROBE  # steps before another number of threads is tried
    estimates_error = False
    times = 1  # sweeps that apply() takes

    def __init__(self, problem: Problem, solver: PBNG) -> None:
        self.problem, self.solver = problem, solver
        self.layouts: dict[str, Packed] = {}
        self.threads = Threads(solver.threads, self.first_trial)
        start = time.perf_counter() - compile_seconds()
        with self.threads.used():
            first = "float32" if solver.dtype == "auto" else solver.dtype
            self.packed = self.layout(first)
            X = problem.X - self.packed.origin
            self.blocks = ElementBlocks(problem.groups, X, self.packed.slot, self.packed.n_slot)
        forward = np.arange(self.packed.n_color)
        self.colors = np.concatenate([forward, forward[::-1]]) if solver.symmetric else forward
        self.n_free = self.packed.n_free
        self.stiffness = self.packed.stiffness + self.packed.weak_stiffness
        self.total_stiffness = float(self.stiffness.sum())
        self.weak = WeakEnergy(problem.weak, self.packed.n_slot, self.packed.slot) if problem.weak else None
        self.f_ext = np.zeros(4 * self.packed.n_slot)
        self.f_ext.reshape(-1, 4)[self.packed.slot, :3] = problem.f_ext
        self.loaded = bool(self.f_ext.any())
        self.forces = np.empty(4 * self.packed.n_slot)
        self.load = float(np.linalg.norm(problem.f_ext, axis=1).sum())
        self.force_scale = 0.0  # of the last certificate [N]
        self.targets = self.ends = np.zeros((problem.n_target, 3))
        self.contacts: Contacts | None = None
        self.touching: ContactEnergy | None = None
        self.contact_nodes: dict[str, ContactNodes] = {}
        self.x = self.packed.pack(problem.X, self.targets)
        self.iteration: Iteration | None = None
        self.known_energy, self.trust = math.inf, 0
        self.setup_seconds = time.perf_counter() - compile_seconds() - start

    def prepare(self, before: np.ndarray, x: np.ndarray) -> np.ndarray | None:
        return None

    def lower(self, y: np.ndarray, x: np.ndarray) -> bool:
        """Whether the energy at y (n_vert, 3) is below that at x, with the targets and contacts of the last start."""
        with self.threads.used():
            return self.energy(self.pack(y)) < self.energy(self.pack(x))

    def start(
        self,
        x: np.ndarray,
        targets: np.ndarray | None = None,
        contacts: Contacts | None = None,
        resume: bool = False,
    ) -> None:
        self.targets = self.problem.targets(self.problem.end) if targets is None else targets
        self.ends = self.targets - self.packed.origin  # relative to it, as positions are kept
        self._touch(contacts if contacts is not None and len(contacts) else None)
        self.prescribed = np.array(x[self.problem.fixed], float)
        if not resume:
            self.packed = self.layout("float32" if self.solver.dtype == "auto" else self.solver.dtype)
        self.begin(x)

    def _touch(self, contacts: Contacts | None) -> None:
        """Take the contacts of a step."""
        if contacts is self.contacts:
            return
        self.contacts, self.touching = contacts, None
        if contacts is not None:
            p = self.packed
            self.touching = ContactEnergy(contacts, p.n_slot, p.slot, p.origin)

    def _nodes_in_contact(self, contacts: Contacts) -> ContactNodes:
        """Their layout, in the present precision."""
        name = self.packed.dtype.name
        if name not in self.contact_nodes:
            self.contact_nodes[name] = ContactNodes(self.problem, self.packed)
        nodes = self.contact_nodes[name]
        if nodes.contacts is not contacts:
            nodes.update(contacts)
        return nodes

    def refine(self) -> bool:
        if self.solver.dtype != "auto" or self.packed.dtype == np.float64:
            return False
        x = np.asarray(self.state(), float)
        x[self.problem.fixed] = self.prescribed  # they too were rounded
        with self.threads.used():
            self.packed = self.layout("float64")
        self.begin(x)
        return True

    def layout(self, dtype: str) -> Packed:
        """The problem packed in a precision; vertices have the same places in both."""
        if dtype not in self.layouts:
            self.layouts[dtype] = pack_problem(self.problem, np.dtype(dtype), self.solver.block == "paper")
        return self.layouts[dtype]

    def begin(self, x: np.ndarray) -> None:
        """Take x (n_vert, 3) as the state, in the present precision, with no history."""
        self.x = self.pack(x)
        self.known_energy = math.inf
        acceleration: Acceleration = self.solver.acceleration
        self.iteration = acceleration.start(self)

    def step(self) -> None:
        assert self.iteration is not None, "start() comes first"
        with self.threads.timed_step():
            self.iteration.step(self.x)

    def settle(self) -> None:
        if self.iteration is not None:
            with self.threads.used():
                self.iteration.settle(self.x)

    def state(self) -> np.ndarray:
        return self.packed.unpack(self.x)

    def apply(self, x: np.ndarray, omega: float = 1.0) -> None:
        if self.contacts is None:
            sweep(self.packed, x, self.colors, omega, self.times)
            return
        nodes = self._nodes_in_contact(self.contacts)
        for _ in range(self.times):
            sweep(nodes.others, x, self.colors, omega)
            nodes.sweep(x, omega, self.solver.symmetric)

    def admit(self, x: np.ndarray, g: np.ndarray) -> None:
        if self.touching:
            self.touching.put_outside(self._places(x), self.touching.held(self._places(g), self.slack(g)))

    def pack(self, x: np.ndarray) -> np.ndarray:
        """Positions (n_vert, 3) in the present precision, out of the colliders: rounding may have moved them in."""
        packed = self.packed.pack(x, self.targets)
        if self.touching:
            self.touching.put_outside(self._places(packed))
        return packed

    def energy(self, x: np.ndarray) -> float:
        energy = self.blocks.energy(x) - self._work(x)
        if self.weak:
            energy += self.weak.energy(self._places(x), self.ends)
        return energy + self.touching.energy(self._places(x)) if self.touching else energy

    def certify(self) -> Certificate:
        with self.threads.used():
            f, force_scale, inverted = self.free_forces(self.x)
            self.known_energy, self.force_scale = self.energy(self.x), force_scale
            return Certificate(norm(f), self.known_energy, force_scale, inverted)

    def free_forces(self, x: np.ndarray) -> tuple[np.ndarray, float, int]:
        """Total forces on the free vertices [N], flat, with the force scale [N] and the number of inverted elements."""
        force_scale, inverted = self.blocks.forces(x, self.forces)
        if self.weak:
            weak, scale = self.weak.forces(self._places(x), self.ends)
            self.forces.reshape(-1, 4)[:, :3] += weak
            force_scale += scale
        if self.touching:
            pushed, scale = self.touching.forces(self._places(x))
            self.forces.reshape(-1, 4)[:, :3] += pushed
            force_scale += scale
        f = self.forces[: self.n_free] + self.f_ext[: self.n_free]
        if self.touching:
            self.touching.balance(self._places(f), self._places(x), self.slack(x))
        return f, force_scale, inverted

    def borne(self) -> np.ndarray:
        """With what force [N] colliders bear each vertex at the state last certified, (n_vert, 3)."""
        out = np.zeros((self.problem.n_vert, 3))
        if self.touching and self.contacts:
            f = self._places(self.forces + self.f_ext)
            force = self.touching.balance(f, self._places(self.x), self.slack(self.x))
            np.add.at(out, self.contacts.vertex, force[:, None] * self.contacts.plane)
        return out

    def slack(self, x: np.ndarray) -> float:
        """How far from a half-space a vertex may be that touches it [m]: roundings."""
        return SLACK * self.rounding(x)

    def floor(self, dtype: Any = None) -> float:
        """Norm of the forces that moving each node by half a unit in the last place of the largest position makes."""
        stiffness = self.stiffness
        if self.touching:
            places = self._places(self.x)
            stiffness = stiffness + self.touching.stiffness(places, len(stiffness))
            held = self.touching.vertex[self.touching.held(places, self.slack(self.x))]
            stiffness[held[held < len(stiffness)]] *= SLACK
        return self.rounding(self.x, dtype) * float(np.linalg.norm(stiffness))

    def noise(self, x: np.ndarray, energy: float) -> float:
        """What rounding may do to an energy [J] at x."""
        return self.total_stiffness * self.rounding(x) ** 2 + 1e-13 * abs(energy)

    def rises(self, energy: float, before: float, x: np.ndarray) -> bool:
        """Whether an energy is above an earlier one, that of x, by more than rounding may explain, or is not finite.

        Energies sum what elements store, and near rest that is a difference of larger numbers: both count, even where
        forces balance.
        """
        largest = float(np.abs(x).max(initial=0.0))
        stored = (self.force_scale + self.load) * self.rounding(x)
        differences = self.total_stiffness * largest * self.rounding(x, np.float64)
        return not energy <= before + self.noise(x, before) + DOUBT * (stored + differences)

    def rounding(self, x: np.ndarray, dtype: Any = None) -> float:
        """Half a unit in the last place of the largest position [m], in a precision, by default that of x."""
        return 0.5 * float(np.finfo(dtype or x.dtype).eps) * float(np.abs(x).max(initial=0.0))

    @staticmethod
    def _places(x: np.ndarray) -> np.ndarray:
        return x.reshape(-1, 4)[:, :3]

    def _work(self, x: np.ndarray) -> float:
        """Work [J] of the external forces since rest."""
        return float((self.f_ext * (x - self.blocks.X)).sum()) if self.loaded else 0.0
