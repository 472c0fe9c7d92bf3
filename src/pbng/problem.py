"""The discrete problem: frozen arrays, and its energy and forces in float64 (Eqs. 11-17)."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from pbng.assembly import ElementBlocks
from pbng.coloring import color_nodes, morton
from pbng.constraints import WeakConstraints, WeakEnergy
from pbng.contact.spec import ContactSpec
from pbng.elements.base import ElementKind, Term
from pbng.errors import InputError
from pbng.materials.base import Block, Material, model_of
from pbng.materials.bending import Bending
from pbng.mesh import Mesh
from pbng.topology import components, incidence


@dataclass(frozen=True, eq=False)
class ElementGroup:
    """Elements of one kind and one material; ``cells`` (n_elem, corners) int32 are numbered through all bodies."""

    kind: ElementKind
    material: Material | Bending
    cells: np.ndarray

    @cached_property
    def term(self) -> Term:
        """The element kind with the material's model."""
        material: Any = type(self.material)
        return Term(self.kind, model_of(material, len(self.material.parameters())))

    def block(self, paper: bool = False) -> Block:
        """The material's majorising block, or the paper's (Eq. 32)."""
        return self.material.paper_block() if paper else self.material.block()


@dataclass(frozen=True, eq=False)
class BodyRange:
    """A body of the scene: its mesh, whose vertices are ``start`` .. ``stop`` of the problem's."""

    name: str
    start: int
    stop: int
    mesh: Mesh


@dataclass(frozen=True, eq=False)
class Coupling:
    """Elements of one kind, or weak constraints with stencils of one size, and at which vertices they meet.

    Attributes:
        source: The element kind, or the weak constraints.
        cells: The vertices of each, (m, k); those of weak constraints are followed by the number of their target, if
            they have one: targets are numbered on from the vertices.
        group: Group of each, (m,): element groups first, then ``weak``.
        start, incident: As of :func:`pbng.topology.incidence`, over the vertices alone.
    """

    source: ElementKind | WeakConstraints
    cells: np.ndarray
    group: np.ndarray
    start: np.ndarray
    incident: np.ndarray

    @property
    def corners(self) -> int:
        """Vertices of each."""
        return self.source.corners


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything a solver needs, and nothing of the scene it came from.

    Attributes:
        name: Name of the scene.
        X: Rest positions [m], (n_vert, 3) float64.
        groups: The elements, by kind and material.
        bodies: Which vertices belong to which body.
        fixed: Which vertices are prescribed, (n_vert,) bool.
        prescribed: Their positions [m] at a time [s]: ``prescribed(t) -> (n_fixed, 3)``, in order of index.
        f_ext: External forces [N], (n_vert, 3).
        mass: Lumped masses [kg], (n_vert,).
        end: Time [s] at which every motion has ended.
        weak: Weak constraints, by size of their stencils.
        dt: Time step [s] of a problem of backward Euler (:meth:`dynamic`), else None.
        contact: What may touch, if anything may; where it does is no part of the problem.
        until: Time [s] at which some vertices are let go; from then on the problem is ``after``.

    What evaluates something takes ``targets`` (n_target, 3) [m], the points in space that weak constraints end at,
    by default those at the end of every motion.
    """

    name: str
    X: np.ndarray
    groups: tuple[ElementGroup, ...]
    bodies: tuple[BodyRange, ...]
    fixed: np.ndarray
    prescribed: Callable[[float], np.ndarray]
    f_ext: np.ndarray
    mass: np.ndarray
    end: float = 0.0
    weak: tuple[WeakConstraints, ...] = ()
    dt: float | None = None
    contact: ContactSpec | None = None
    until: float = math.inf
    after: "Problem | None" = None

    def at(self, t: float) -> "Problem":
        """The problem that holds at time t [s]."""
        return self if self.after is None or t < self.until else self.after.at(t)

    def phases(self) -> Iterator[tuple[float, "Problem"]]:
        """This problem and those that come after it, each with the time [s] from which it holds."""
        since, phase = 0.0, self
        while phase.after is not None:
            yield since, phase
            since, phase = phase.until, phase.after
        yield since, phase

    @property
    def held(self) -> bool:
        """Whether anything in space holds it: prescribed vertices, targets of weak constraints, or colliders."""
        walls = self.contact is not None and bool(self.contact.colliders)
        return walls or bool(self.fixed.any()) or any(w.anchored for w in self.weak)

    @property
    def n_vert(self) -> int:
        return len(self.X)

    @property
    def n_elem(self) -> int:
        return sum(len(g.cells) for g in self.groups)

    @property
    def n_target(self) -> int:
        """Number of points in space that weak constraints, inertia included, end at."""
        return sum(len(w.vertices) for w in self.weak if w.anchored)

    def targets(self, t: float) -> np.ndarray:
        """Those of the weak constraints at time t [s], (k, 3) [m]; the targets of inertia are not functions of time."""
        places = [w.targets(t) for w in self.weak if w.targets and w.targets is not _passed]
        return np.concatenate([np.empty((0, 3)), *places])

    def dynamic(self, dt: float) -> "Problem":
        """The problem of one step of backward Euler: the incremental potential adds ½ m/Δt² |x - x̂|² for each vertex.

        Its targets are those of this problem followed by the x̂ of the free vertices, (n_free, 3).

        Raises:
            InputError: dt is not positive and finite, or a free vertex has no mass.
        """
        if not (np.isfinite(dt) and dt > 0):
            raise InputError(f"dt must be positive and finite, not {dt}")
        free = np.flatnonzero(~self.fixed)
        if len(free) == 0:
            return replace(self, dt=float(dt))
        light = free[self.mass[free] <= 0]
        if len(light):
            raise InputError(f"inertia: vertex {light[0]} has no mass; give its material a density")
        K = (self.mass[free] / dt**2)[:, None, None] * np.eye(3)
        inertia = WeakConstraints(free[:, None].astype(np.int32), np.ones((len(free), 1)), K, _passed)
        return replace(self, dt=float(dt), weak=(*self.weak, inertia))

    def energy(self, x: np.ndarray, targets: np.ndarray | None = None) -> float:
        """Potential energy [J] at x (n_vert, 3), Eq. (17), zero at rest: elastic, less the work of external forces."""
        energy = self._blocks.energy(self._flat(x)) - float(np.sum(self.f_ext * (np.asarray(x, float) - self.X)))
        return energy + self.weak_energy.energy(x, self._targets(targets)) if self.weak_energy else energy

    def forces(self, x: np.ndarray, targets: np.ndarray | None = None) -> np.ndarray:
        """Internal force [N] on every vertex at x, -∂PE/∂x of Eq. (13), (n_vert, 3); external forces not included."""
        return self.evaluate(x, targets)[0]

    def evaluate(self, x: np.ndarray, targets: np.ndarray | None = None) -> tuple[np.ndarray, float, int]:
        """Internal forces as :meth:`forces`, the sum of the norms of all elements' [N], and inverted elements."""
        f = np.empty(4 * self.n_vert)
        force_scale, inverted = self._blocks.forces(self._flat(x), f)
        f = f.reshape(-1, 4)[:, :3]
        if self.weak_energy:
            weak, scale = self.weak_energy.forces(np.asarray(x, float), self._targets(targets))
            return f + weak, force_scale + scale, inverted
        return f, force_scale, inverted

    def residual(self, x: np.ndarray, targets: np.ndarray | None = None) -> float:
        """Norm [N] of internal plus external force over the free vertices, Eq. (11), in float64."""
        return float(np.linalg.norm((self.forces(x, targets) + self.f_ext)[~self.fixed]))

    def inverted(self, x: np.ndarray) -> int:
        """Number of elements with det F < 0."""
        return self._blocks.forces(self._flat(x), np.empty(4 * self.n_vert))[1]

    def _targets(self, targets: np.ndarray | None) -> np.ndarray:
        found = self.targets(self.end) if targets is None else np.asarray(targets, float)
        if found.shape != (self.n_target, 3):
            raise InputError(f"targets must have shape {(self.n_target, 3)}, not {found.shape}")
        return found

    def constrain(self, x: np.ndarray, t: float) -> np.ndarray:
        """A copy of x (n_vert, 3) with the prescribed vertices where they belong at time t [s]."""
        x = np.array(x, float)
        if self.fixed.any():
            x[self.fixed] = self.prescribed(t)
        return x

    @cached_property
    def component(self) -> np.ndarray:
        """Label (n_vert,) of the part that each vertex belongs to, connected by elements or weak constraints."""
        cells = [g.cells for g in self.groups] + [w.vertices for w in self.weak]
        edges = np.concatenate([c[:, [0, k]] for c in cells for k in range(1, c.shape[1])])
        return components(edges, self.n_vert)

    @cached_property
    def couplings(self) -> tuple["Coupling", ...]:
        """What couples vertices: first the elements, by kind, then the weak constraints, by size of their stencils."""
        out = []
        for kind in dict.fromkeys(g.kind for g in self.groups):
            mine = [(n, g) for n, g in enumerate(self.groups) if g.kind is kind]
            cells = np.concatenate([g.cells for _, g in mine])
            group = np.concatenate([np.full(len(g.cells), n, np.int32) for n, g in mine])
            out.append(Coupling(kind, cells, group, *incidence(cells, self.n_vert)))
        target = self.n_vert
        for n, w in enumerate(self.weak, len(self.groups)):
            start, incident = incidence(w.vertices, self.n_vert)
            cells = w.vertices
            if w.anchored:
                cells = np.column_stack([cells, np.arange(target, target + len(cells), dtype=np.int32)])
                target += len(cells)
            out.append(Coupling(w, cells, np.full(len(cells), n, np.int32), start, incident))
        return tuple(out)

    @cached_property
    def color(self) -> np.ndarray:
        """Colours (n_vert,) of the free vertices, in Morton order of the rest positions; -1 for prescribed ones."""
        order = self.order
        return color_nodes(
            order[~self.fixed[order]],
            [(c.start, c.incident, c.corners, len(c.cells)) for c in self.couplings if c.corners > 1],
        )

    @cached_property
    def order(self) -> np.ndarray:
        """All vertices in Morton order of their rest positions, ties by index, (n_vert,)."""
        return np.argsort(morton(self.X), kind="stable")

    @cached_property
    def weak_energy(self) -> WeakEnergy | None:
        """Energy and forces of the weak constraints, if there are any."""
        return WeakEnergy(self.weak, self.n_vert) if self.weak else None

    @cached_property
    def _blocks(self) -> ElementBlocks:
        return ElementBlocks(self.groups, self.X)

    def _flat(self, x: np.ndarray) -> np.ndarray:
        x = np.asarray(x)
        if x.shape != self.X.shape:
            raise InputError(f"positions must have shape {self.X.shape}, not {x.shape}")
        flat = np.zeros((self.n_vert, 4))
        flat[:, :3] = x
        return flat.ravel()


def _passed(t: float) -> np.ndarray:
    raise InputError("the targets of inertia are not functions of time: pass them")
