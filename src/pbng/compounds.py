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
from pbng.topology import entries

LINKS = 16  # of a chain of ties that are followed


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
        follows = _follows(problem)
        leader = np.flatnonzero(np.diff(follows.indptr))
        self.n = len(leader)
        ones = np.ones(self.n), (np.arange(self.n), leader)
        self.beta = further = scipy.sparse.csr_matrix(ones, (self.n, problem.n_vert))
        for _ in range(LINKS):  # what hangs on what hangs on it; nothing twice, so that rings of ties end
            further = further @ follows
            further = further - further.multiply(self.beta != 0)
            further.eliminate_zeros()
            if further.nnz == 0:
                break
            self.beta = (self.beta + further).tocsr()

    @cached_property
    def incidences(self) -> list[CompoundIncidences]:
        """For each coupling of the problem what compounds touch of it."""
        member = self.beta.tocoo()
        order = np.lexsort((member.col, member.row))
        compound, vertex, beta = member.row[order], member.col[order], member.data[order]
        found = []
        for c in self.problem.couplings:
            which, at = entries(c.start, vertex)
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


def _follows(problem: Problem) -> scipy.sparse.csr_matrix:
    """How much each vertex (column) has to move with a free one (row) for springs between them to keep their length.

    (n_vert, n_vert) sparse; the mean, where springs differ.
    """
    rows, columns, values = [np.empty(0, int)], [np.empty(0, int)], [np.empty(0)]
    for w in problem.weak:
        if w.anchored or w.corners < 2:
            continue
        follower = _followers(w)
        weights = np.where(follower, w.weights, 0.0)
        share = weights / np.maximum((weights**2).sum(1, keepdims=True), 1e-300)
        movable = ~(follower & problem.fixed[w.vertices]).any(1) & (np.trace(w.K, axis1=1, axis2=2) > 0)
        for a in range(w.corners):
            mine = np.flatnonzero(movable & ~follower[:, a] & ~problem.fixed[w.vertices[:, a]])
            c, corner = np.nonzero(follower[mine])
            rows.append(w.vertices[mine[c], a])
            columns.append(w.vertices[mine[c], corner])
            values.append(-w.weights[mine[c], a] * share[mine[c], corner])
    at, value = (np.concatenate(rows), np.concatenate(columns)), np.concatenate(values)
    shape = problem.n_vert, problem.n_vert
    total, count = (scipy.sparse.csr_matrix((v, at), shape) for v in (value, np.ones(len(value))))
    total.data /= count.data
    return total


def _followers(w: WeakConstraints) -> np.ndarray:
    """Which vertices of each stencil follow the others, (m, s): those of the side that has fewer."""
    positive = w.weights > 0
    more = positive.sum(1) > (~positive).sum(1)
    return np.where(more[:, None], ~positive, positive)
