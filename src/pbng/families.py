"""What the nodes of a problem see, family by family, in the one form that :mod:`pbng.packing` lays out.

A family is elements of one kind or weak constraints with stencils of one size, seen by vertices or by compound nodes.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from pbng.assembly import group_parameters
from pbng.compounds import CompoundIncidences, Compounds
from pbng.constraints import WeakConstraints
from pbng.elements import weak
from pbng.elements.base import W
from pbng.problem import Problem


@dataclass(frozen=True, eq=False)
class Family:
    """Cells of one size and the nodes that see them.

    Attributes:
        corners: Nodes a cell that see it.
        cells: Vertices, or targets numbered on from them, (m, k) int32.
        group: Row of each cell in the table of groups, (m,) int32.
        start, incident: Incidence as of :func:`pbng.topology.incidence`, for vertices and then compounds.
        opposite: For each corner the columns of ``cells`` that it refers to, (corners, others).
        data: Numbers of each cell that its packer reads, (m, width).
        packers: What writes the coefficients, one or more functions.
        packer: Which of them, by group.
    """

    corners: int
    cells: np.ndarray
    group: np.ndarray
    start: np.ndarray
    incident: np.ndarray
    opposite: np.ndarray
    data: np.ndarray
    packers: tuple
    packer: np.ndarray

    @property
    def elastic(self) -> bool:
        """Whether it consists of elements."""
        return self.packers != (weak.pack,)


class Groups:
    """All groups, weak constraints and what compounds see included, as tables of numbers for the kernels.

    Attributes:
        table: For each group its term, the place of its parameters, indices a row and coefficients a row, (n, 4).
        parameters: Numbers of the groups, flat.
        numbers: For each group (a, b, b if the block is taken at rest else 0), (n, 3).
        functions: What sweeps the segments of each term.
    """

    def __init__(self, problem: Problem, dtype: Any, paper_block: bool, with_compounds: bool) -> None:
        self.table: Any = []
        self.functions: tuple = ()
        elements, weakly = problem.groups, problem.weak
        numbers, first = group_parameters(elements, dtype, paper_block)
        parameters = numbers.tolist()
        blocks = [(b.a, b.b, b.b if b.at_rest else 0.0) for b in (g.block(paper_block) for g in elements)]
        self.numbers: Any = []
        for compounds in (False, True)[: 1 + with_compounds]:
            for g, p, block in zip(elements, first, blocks):
                kind, model = g.term
                if compounds:
                    self._add(kind.compound_sweep(model), p, kind.corners, kind.compound_width, block)
                else:
                    sweep = kind.paper_sweep(model) if paper_block else kind.sweep(model)
                    self._add(sweep, p, kind.others, kind.width(model.isotropic), block)
            for w in weakly:
                others = w.corners - (not compounds) + w.anchored
                parameters.append(others)
                self._add(weak.sweep, len(parameters) - 1, others, weak.width(others), (0.0, 0.0, 0.0))
        self.table, self.numbers = np.array(self.table), np.array(self.numbers)
        self.parameters = np.array(parameters, dtype)

    def _add(self, function: Any, place: int, others: int, width: int, block: tuple[float, float, float]) -> None:
        if function not in self.functions:
            self.functions = (*self.functions, function)
        self.table.append((self.functions.index(function), place, W * others, W * width))
        self.numbers.append(block)


def families(problem: Problem, compounds: Compounds | None) -> list[Family]:
    """What vertices see and, behind it, what compounds see."""
    n_compound = compounds.n if compounds else 0
    n_group = len(problem.groups) + len(problem.weak)
    found = []
    for c in problem.couplings:
        start = np.concatenate([c.start, np.full(n_compound, c.start[-1])])
        found.append(Family(c.corners, c.cells, c.group, start, c.incident, *_of_vertices(problem, c.source)))
    for i in compounds.incidences if compounds else []:
        if len(i.cells):
            counts = np.bincount(problem.n_vert + i.compound, minlength=problem.n_vert + n_compound)
            start, incident = np.concatenate([[0], np.cumsum(counts)]), np.arange(len(i.cells), dtype=np.int32)
            group = (i.group + n_group).astype(np.int32)
            cells, opposite, data, packer = _of_compounds(i)
            only = np.zeros(2 * n_group, np.int64)
            found.append(Family(1, cells, group, start, incident, opposite, data, (packer,), only))
    return found


def _of_vertices(problem: Problem, source: Any) -> tuple[np.ndarray, np.ndarray, tuple, np.ndarray]:
    """Opposite, data, packers and packer of a family of vertices."""
    n_group = len(problem.groups) + len(problem.weak)
    if isinstance(source, WeakConstraints):
        data = weak.weak_data(source.weights, source.K, source.anchored)
        return weak.opposite(source.corners, source.anchored), data, (weak.pack,), np.zeros(2 * n_group, np.int64)
    own = [source.pack(g.term.model.isotropic) for g in problem.groups]
    packers = tuple(dict.fromkeys(p for p, g in zip(own, problem.groups) if g.kind is source))
    packer = np.zeros(2 * n_group, np.int64)
    packer[: len(own)] = [packers.index(p) if p in packers else 0 for p in own]
    return source.opposite, np.zeros((1, 1)), packers, packer


def _of_compounds(i: CompoundIncidences) -> tuple[np.ndarray, np.ndarray, np.ndarray, Any]:
    """Cells, opposite, data and packer of a family of compounds."""
    w: Any = i.source
    if not isinstance(w, WeakConstraints):
        return i.cells, np.array([w.order], np.int64), i.beta, w.compound_pack()
    seen = weak.weak_data(w.weights[i.cell], w.K[i.cell], w.anchored)
    own = (w.weights[i.cell] * i.beta).sum(1)  # how much C changes when the compound moves
    cells = np.column_stack([i.cells[:, :1], i.cells])  # the first place stands for the compound, which is nowhere
    return cells, np.arange(1, cells.shape[1])[None], np.column_stack([own, seen]), weak.pack
