"""The discrete problem: frozen arrays, and its energy and forces in float64 (Eqs. 11-17)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pbng.assembly import ElementBlocks
from pbng.coloring import color_nodes, morton
from pbng.elements.base import ElementKind, Term
from pbng.errors import InputError
from pbng.materials.base import Block, Material, model_of
from pbng.mesh import Mesh
from pbng.topology import components, incidence


@dataclass(frozen=True, eq=False)
class ElementGroup:
    """Elements of one kind and one material; ``cells`` (n_elem, corners) int32 are numbered through all bodies."""

    kind: ElementKind
    material: Material
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

    @property
    def n_vert(self) -> int:
        return len(self.X)

    @property
    def n_elem(self) -> int:
        return sum(len(g.cells) for g in self.groups)

    def energy(self, x: np.ndarray) -> float:
        """Potential energy [J] at x (n_vert, 3), Eq. (17), zero at rest: elastic, less the work of external forces."""
        return self._blocks.energy(self._flat(x)) - float(np.sum(self.f_ext * (np.asarray(x, float) - self.X)))

    def forces(self, x: np.ndarray) -> np.ndarray:
        """Internal force [N] on every vertex at x, -∂PE/∂x of Eq. (13), (n_vert, 3); external forces not included."""
        f = np.empty(4 * self.n_vert)
        self._blocks.forces(self._flat(x), f)
        return f.reshape(-1, 4)[:, :3]

    def residual(self, x: np.ndarray) -> float:
        """Norm [N] of internal plus external force over the free vertices, Eq. (11), in float64."""
        return float(np.linalg.norm((self.forces(x) + self.f_ext)[~self.fixed]))

    def inverted(self, x: np.ndarray) -> int:
        """Number of elements with det F < 0."""
        return self._blocks.forces(self._flat(x), np.empty(4 * self.n_vert))[1]

    def constrain(self, x: np.ndarray, t: float) -> np.ndarray:
        """A copy of x (n_vert, 3) with the prescribed vertices where they belong at time t [s]."""
        x = np.array(x, float)
        if self.fixed.any():
            x[self.fixed] = self.prescribed(t)
        return x

    @cached_property
    def component(self) -> np.ndarray:
        """Label (n_vert,) of the connected part each vertex belongs to."""
        edges = np.concatenate([g.cells[:, [0, k]] for g in self.groups for k in range(1, g.cells.shape[1])])
        return components(edges, self.n_vert)

    @cached_property
    def incidences(self) -> dict[ElementKind, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """For each element kind: its cells, the group of each, and the vertex-to-cell incidence (start, incident)."""
        out = {}
        for kind in dict.fromkeys(g.kind for g in self.groups):
            mine = [(n, g) for n, g in enumerate(self.groups) if g.kind is kind]
            cells = np.concatenate([g.cells for _, g in mine])
            group = np.concatenate([np.full(len(g.cells), n, np.int32) for n, g in mine])
            out[kind] = (cells, group, *incidence(cells, self.n_vert))
        return out

    @cached_property
    def color(self) -> np.ndarray:
        """Colours (n_vert,) of the free vertices, in Morton order of the rest positions; -1 for prescribed ones."""
        order = self.order
        return color_nodes(
            order[~self.fixed[order]],
            [(s, i, kind.corners, len(c)) for kind, (c, _, s, i) in self.incidences.items()],
        )

    @cached_property
    def order(self) -> np.ndarray:
        """All vertices in Morton order of their rest positions, ties by index, (n_vert,)."""
        return np.argsort(morton(self.X), kind="stable")

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
