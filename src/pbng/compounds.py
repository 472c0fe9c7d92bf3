"""Compound nodes: vertices that stiff weak constraints tie together, moved as one.

Where a spring is much stiffer than what it ties, neither of its ends can move by itself, and sweeps over single nodes
stall. A *compound* of a vertex j moves by d, and what is tied to j moves along by β d, such that no spring of j changes
its length. Every element's F then changes by a matrix d ⊗ g of rank one, g = Σ β_v ∂N_v/∂X, in which J is affine: the
block of a node holds for a compound with its g, and its update lowers the energy like that of a node.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse

from pbng.coloring import color_nodes
from pbng.constraints import WeakConstraints
from pbng.elements.base import ElementKind
from pbng.problem import Problem


@dataclass(frozen=True, eq=False)
class CompoundIncidences:
    """Cells of a coupling of the problem that compounds touch, once for each compound.

    Attributes:
        source: The element kind, or the weak constraints.
        cells: Vertices, and the target if there is one, (m, k).
        beta: How much each vertex moves with the compound, (m, corners).
        group: Group of each, (m,).
        cell: Which of the coupling's cells it is, (m,).
        compound: The compound, (m,), ascending.
    """

    source: ElementKind | WeakConstraints
    cells: np.ndarray
    beta: np.ndarray
    group: np.ndarray
    cell: np.ndarray
    compound: np.ndarray


class Compounds:
    """The compounds of a problem: one for each free vertex that another is tied to.

    Attributes:
        beta: Which share of a compound's movement each vertex takes part in, (n, n_vert) sparse.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        rows, columns, values = [], [], []
        for w in problem.weak:
            if w.anchored or w.corners < 2:
                continue
            follower = _followers(w)
            weights = np.where(follower, w.weights, 0.0)
            share = weights / np.maximum((weights**2).sum(1, keepdims=True), 1e-300)
            movable = ~(follower & problem.fixed[w.vertices]).any(1)
            for a in range(w.corners):
                mine = np.flatnonzero(movable & ~follower[:, a] & ~problem.fixed[w.vertices[:, a]])
                rows.append(np.repeat(w.vertices[mine, a], w.corners))
                columns.append(w.vertices[mine].ravel())
                values.append((-w.weights[mine, a, None] * share[mine]).ravel())
        leader = np.unique(np.concatenate([np.empty(0, np.int64), *rows]))
        self.n = len(leader)
        number = np.full(problem.n_vert, -1)
        number[leader] = np.arange(self.n)
        row, column = number[np.concatenate([*rows, leader])], np.concatenate([*columns, leader])
        value = np.concatenate([*values, np.ones(self.n)])
        self.beta = scipy.sparse.csr_matrix((value, (row, column)), (self.n, problem.n_vert))
        self.beta.sum_duplicates()
        self.beta.eliminate_zeros()

    @cached_property
    def incidences(self) -> list[CompoundIncidences]:
        """For each coupling of the problem what compounds touch of it."""
        member = self.beta.tocoo()
        order = np.lexsort((member.col, member.row))
        compound, vertex, beta = member.row[order], member.col[order], member.data[order]
        found = []
        for c in self.problem.couplings:
            first, count = c.start[vertex], np.diff(c.start)[vertex]
            which = np.repeat(np.arange(len(vertex)), count)
            at = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count) + first[which]
            cell, corner = c.incident[at] // c.corners, c.incident[at] % c.corners
            key, inverse = np.unique(compound[which] * len(c.cells) + cell, return_inverse=True)
            shares = np.zeros((len(key), c.corners))
            np.add.at(shares, (inverse, corner), beta[which])
            e = key % len(c.cells)
            found.append(CompoundIncidences(c.source, c.cells[e], shares, c.group[e], e, key // len(c.cells)))
        return found

    @cached_property
    def color(self) -> np.ndarray:
        """Colours (n,): compounds of one colour share no cell."""
        first = np.cumsum([0] + [len(c.cells) for c in self.problem.couplings])
        compound = np.concatenate([i.compound for i in self.incidences])
        cell = np.concatenate([i.cell + f for i, f in zip(self.incidences, first)])
        order = np.argsort(compound, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(compound, minlength=self.n))])
        return color_nodes(np.arange(self.n), [(start, cell[order], 1, int(first[-1]))])


def _followers(w: WeakConstraints) -> np.ndarray:
    """Which vertices of each stencil follow the others, (m, s): those of the side that has fewer."""
    positive = w.weights > 0
    more = positive.sum(1) > (~positive).sum(1)
    return np.where(more[:, None], ~positive, positive)
