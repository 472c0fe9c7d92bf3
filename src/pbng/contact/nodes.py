"""Nodes in contact: a layout of their own, that grows where contacts change, swept after the others (section 10.1).

A node in contact sees, besides its elements, one-sided terms: the springs of contacts and the half-spaces of colliders.
With u = A⁻¹f its step without them, its local problem is convex,

    min ½ |d - ω u|²_A + Σ_c ½ ω k_c min(g_c + w_c n_c·d, 0)²     with  g_c + n_c·d >= 0 for half-spaces,

and its dual has one multiplier a contact, the force in it over ω. Each is set in turn to the value that is best given
the others, exact at once for a single contact, starting from the last sweep's. As for a node without contact, the
energy falls for any 0 < ω < 2: ωu - d is ω times a subgradient of the contacts' energy, and that is convex.

For the time of its contact a node is held in the static layout by a Hessian as good as infinite, and has a lane in
blocks of its own, with a colour of its own: contacts couple nodes that elements do not.
"""

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
import scipy.sparse
from numba import uint64

from pbng.coloring import recolor
from pbng.contact.contacts import Contacts
from pbng.dispatch import call, specialised
from pbng.elements.base import AHEAD, W
from pbng.jit import compile_seconds, inline, serial
from pbng.linalg import dot, scale, solve_spd, sub
from pbng.packing import NODAL, Packed, Rows, aligned
from pbng.parallel import array, body, rows, run, scratch
from pbng.problem import Problem
from pbng.sweep import aligned_part
from pbng.topology import entries

HELD = 1e30  # diagonal of the Hessian of a node that is swept elsewhere: it does not move
ROOM = 1.25  # of what is laid out at once: so much comes later
ROUNDS, SETTLED = 64, 16  # of multipliers of a node: at most, and what change [units in the last place] ends them
# Numbers of an incidence: own weight, sum of all, 3 others, normal, offset, compliance, tangential stiffness, friction,
# and what slips from where: C₀, or the anchor.
ROW = 15
_1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11 = (uint64(W * j) for j in range(1, 12))


class ContactNodes:
    """Layout and sweep of the nodes in contact of a packed problem.

    Nodes that come into contact are laid out in blocks behind those that are there, with neighbours of theirs in lanes
    that would be left over; the lanes of nodes that are not in contact, or got another colour, are passed over. When
    there is no room left all are laid out anew.

    Args:
        problem: What is solved.
        packed: Its layout.
    """

    def __init__(self, problem: Problem, packed: Packed) -> None:
        assert problem.contact is not None
        self.problem, self.packed = problem, packed
        self.neighbours = _neighbours(problem, problem.contact.surface)
        self.color = problem.color.copy()  # of nodes that have a lane perhaps another
        self.contacts: Contacts | None = None  # of this step
        self.node = np.empty(0, np.int64)  # in contact, ascending
        self.recolored = self.repacked = 0  # nodes so far
        self.seconds = 0.0  # that all this took
        self.others = replace(packed, nodal=packed.nodal.copy())  # what is swept of the rest
        self.held = np.empty(0, np.int64)  # where in it nodes are that are not
        self.rank = np.empty(problem.n_vert, np.int64)
        self.rank[problem.order] = np.arange(problem.n_vert)
        self.blocks = Blocks(packed.dtype)
        self.owner = np.empty(0, np.int64)  # node of each lane; of padding lanes, one of the block
        self.lane = np.full(problem.n_vert, -1)  # of each node that has one

    def update(self, contacts: Contacts) -> None:
        """Take the contacts of a new step."""
        self.contacts = contacts
        start = time.perf_counter() - compile_seconds()
        found = np.zeros(self.problem.n_vert, bool)
        found[contacts.vertices] = True
        found[contacts.vertex] = True
        found &= ~self.problem.fixed
        node = np.flatnonzero(found)
        before = self.color[node]
        recolor(node, self.color, *self.neighbours, contacts.vertices, found)
        recolored = node[self.color[node] != before]
        self.lane[recolored] = -1
        if len(recolored) or not np.array_equal(node, self.node):
            self.node = node
            self._lay_out()
            self._hold()
        self.recolored += len(recolored)
        self._incidences(contacts)
        self.seconds += time.perf_counter() - compile_seconds() - start

    def _lay_out(self) -> None:
        """Give nodes that have none a lane, or where there is no room for them all that are in contact."""
        new = self.node[self.lane[self.node] < 0]
        idle = len(self.owner) > 2 * W * self._n_block(self.node)
        fits = self._n_block(new) <= self.blocks.room and not idle
        if len(new) and fits:
            fits = self._append(new)
        if not fits:
            outside = np.ones(self.problem.n_vert, bool)
            outside[self.node] = False
            self.color[outside] = self.problem.color[outside]
            self.blocks, self.owner = Blocks(self.packed.dtype), np.empty(0, np.int64)
            self.lane[:] = -1
            self._append(self.node)

    def _n_block(self, node: np.ndarray) -> int:
        """How many blocks nodes need."""
        return int((-(-np.bincount(self.color[node]) // W)).sum())

    def _append(self, node: np.ndarray) -> bool:
        """Lay out nodes in blocks behind those that there are. Whether there is room."""
        node = np.concatenate([node, self._next(node)])
        layout, order = self.packed.layout, node[np.argsort(self.rank[node])]
        color_start, owner = layout.numbering(order, self.color[order])
        if not self.blocks.append(color_start, layout.rows(owner, self.packed.places, len(owner) // W)):
            return False
        real = owner >= 0
        self.lane[owner[real]] = len(self.owner) + np.flatnonzero(real)
        self.owner = np.concatenate([self.owner, np.where(real, owner, np.repeat(owner[::W], W))])
        self.repacked += len(node)
        return True

    def _next(self, node: np.ndarray) -> np.ndarray:
        """Neighbours of nodes for lanes that would be idle in their blocks: they are likely to be in contact next."""
        start, neighbour = self.neighbours
        beside = np.zeros(self.problem.n_vert, bool)
        beside[neighbour[entries(start, node)[1]]] = True
        beside[node] = False
        near = np.flatnonzero(beside & (self.lane < 0) & ~self.problem.fixed)
        near = near[np.argsort(self.color[near], kind="stable")]
        color = self.color[near]
        room = -np.bincount(self.color[node], minlength=int(color.max(initial=0)) + 1) % W
        return near[np.arange(len(near)) - np.searchsorted(color, color) < room[color]]

    def _hold(self) -> None:
        """Hold the nodes in contact in the static layout, and no others."""
        packed, slot = self.packed, self.packed.slot[self.node]
        for to, source, _ in packed.carried:  # nor do compounds move that would carry them along
            slot = np.concatenate([slot, source[np.isin(to, slot)]])
        at = NODAL * W * (slot // W) + slot % W
        for k in (3, 6, 8):
            self.others.nodal[self.held + W * k] = packed.nodal[self.held + W * k]
            self.others.nodal[at + W * k] = HELD
        self.held = at

    def _incidences(self, contacts: Contacts) -> None:
        """What each lane sees of the contacts, and which lanes move."""
        c, packed, dtype = contacts, self.packed, self.packed.dtype
        lane = np.full(self.problem.n_vert, -1)
        lane[self.node] = self.lane[self.node]
        place = 4 * packed.slot[self.owner]
        self.place = -1 - place
        self.place[lane[self.node]] = place[lane[self.node]]
        most = 4 * len(c.vertices) + len(c.vertex)
        self.first = np.zeros(len(self.owner) + 1, np.int64)
        other, row = np.zeros((most, 3), np.uint32), np.zeros((most, ROW), dtype)
        _list_incidences(
            lane, packed.slot, packed.origin, c.vertices, c.weights, c.normal, c.offset, c.k_n, c.k_tau, c.start,
            c.vertex, c.plane, c.level, c.friction, c.anchor, self.first, other, row,
        )  # fmt: skip
        self.other, self.row = other[: self.first[-1]], row[: self.first[-1]]
        self.force, self.creep = np.zeros(self.first[-1], dtype), c.creep

    def sweep(self, x: np.ndarray, omega: float, symmetric: bool = False) -> None:
        """Update every node in contact once, in place, or back in reverse order of the colours besides."""
        p, b = self.packed, self.blocks
        numbers = np.array([omega, self.creep, SETTLED * np.finfo(p.dtype).eps], p.dtype)
        arrays = (
            x, b.seg_start, b.seg, b.idx, b.coef, b.nodal, p.parameters, numbers,
            self.place, self.first, self.other, self.row, self.force,
        )  # fmt: skip
        blocks = specialised(make_contact_sweep, p.functions, p.dtype)
        forward = np.arange(len(b.color_start) - 1)
        colors = np.concatenate([forward, forward[::-1]]) if symmetric else forward
        run(blocks, arrays, colors, b.color_start, 4)


class Blocks:
    """Rows of blocks, as of :class:`pbng.packing.Packed`; what is laid out first makes room for more behind it.

    Attributes:
        color_start: First block of each set that is swept at once, the first past the last included.
        room: How many blocks more there is room for.
    """

    def __init__(self, dtype: Any) -> None:
        self.color_start, self.seg_start = np.zeros(1, np.int64), np.zeros(1, np.int64)
        self.seg = np.empty((0, 5), np.int64)
        self.idx, self.coef, self.nodal = np.empty(0, np.uint32), np.empty(0, dtype), np.empty(0, dtype)
        self.used: np.ndarray = np.zeros(3, np.int64)  # of these three

    @property
    def room(self) -> int:
        return (len(self.nodal) - int(self.used[2])) // (NODAL * W)

    def append(self, color_start: np.ndarray, rows: Rows) -> bool:
        """Add blocks, as sets of their own. Whether there was room for them."""
        new = rows.idx, rows.coef, rows.nodal
        if not self.used.any():
            self.idx, self.coef, self.nodal = (aligned(int(ROOM * len(a)), a.dtype) for a in new)
        end = self.used + [len(a) for a in new]
        if (end > [len(self.idx), len(self.coef), len(self.nodal)]).any():
            return False
        for a, first, last, more in zip((self.idx, self.coef, self.nodal), self.used, end, new):
            a[first:last] = more
        self.seg_start = np.concatenate([self.seg_start, len(self.seg) + rows.seg_start[1:]])
        self.seg = np.concatenate([self.seg, rows.seg + np.array([0, 0, 0, *self.used[:2]])])
        more = color_start[1:][np.diff(color_start) > 0]  # a set of no blocks would cost as much as a small one
        self.color_start = np.concatenate([self.color_start, self.color_start[-1] + more])
        self.used = end
        return True


@serial
def _list_incidences(
    lane, slot, origin, vertices, weights, normal, offset, k_n, k_tau, start, vertex, plane, level, friction, anchor,
    first, other, row,
):  # fmt: skip
    """List what each lane sees, contacts in their order and then half-spaces: ``first``, ``other`` and ``row``.

    Args:
        lane: The lane of each vertex, (n_vert,), -1 for those that do not move.
        slot, origin: As of :class:`pbng.packing.Packed`.
        vertices, ..., anchor: As of :class:`pbng.contact.contacts.Contacts`.
        first: Of each lane the first incidence, (n_lane + 1,), zero when given.
        other, row: Of each incidence the places of the other corners, (n, 3), and its numbers (n, ROW).
    """
    m, k = len(vertices), len(vertex)
    for c in range(m):
        for a in range(4):
            if weights[c, a] != 0 and lane[vertices[c, a]] >= 0:
                first[lane[vertices[c, a]] + 1] += 1
    for c in range(k):
        if lane[vertex[c]] >= 0:
            first[lane[vertex[c]] + 1] += 1
    for l in range(len(first) - 1):
        first[l + 1] += first[l]
    position = first[:-1].copy()
    for c in range(m):
        for a in range(4):
            l = lane[vertices[c, a]]
            if weights[c, a] == 0 or l < 0:
                continue
            i = position[l]
            position[l] += 1
            row[i, 0] = weights[c, a]
            for j in range(3):
                b = (a + 1 + j) % 4
                other[i, j] = 4 * slot[vertices[c, b]]
                row[i, 2 + j] = weights[c, b]
                row[i, 5 + j] = normal[c, j]
                row[i, 12 + j] = start[c, j]
            row[i, 8] = offset[c]
            row[i, 9] = 1 / k_n[c]
            row[i, 10] = k_tau[c]
    for c in range(k):
        l = lane[vertex[c]]
        if l < 0:
            continue
        i = position[l]
        position[l] += 1
        row[i, 0] = row[i, 1] = 1.0
        at = level[c]  # of contacts, weights sum to zero, and it does not matter what positions are relative to
        for j in range(3):
            other[i, j] = 4 * slot[vertex[c]]
            row[i, 5 + j] = plane[c, j]
            row[i, 12 + j] = anchor[c, j] - origin[j]
            at -= plane[c, j] * origin[j]
        row[i, 8] = at
        row[i, 11] = friction[c]


def _neighbours(problem: Problem, surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each vertex the others of ``surface`` with which it shares a cell, in compressed rows (start, vertex)."""
    graph = scipy.sparse.csr_matrix((problem.n_vert, problem.n_vert), dtype=bool)
    chosen = np.zeros(problem.n_vert, bool)
    chosen[surface] = True
    for c in problem.couplings:
        vertices = c.cells[:, : c.corners]
        at, corner = np.nonzero(chosen[vertices])
        ones = np.ones(len(at), np.int32)  # of which there is room for as many as two vertices share cells
        shape = len(vertices), problem.n_vert
        incidence = scipy.sparse.csr_matrix((ones, (at, vertices[at, corner])), shape)
        graph = graph + (incidence.T @ incidence).astype(bool)
    graph = graph.tocsr()
    graph.setdiag(0)
    graph.eliminate_zeros()
    graph.sort_indices()
    return graph.indptr.astype(np.int64), graph.indices.astype(np.int64)


def make_contact_sweep(key: str, dtype: np.dtype) -> Any:
    """Body of :meth:`ContactNodes.sweep` for blocks low .. high of one colour."""
    real = dtype.type
    size = 12 * W

    @body
    def blocks(arguments, low, high):
        x, seg_start, seg = array(arguments, 0, real), array(arguments, 1, np.int64), rows(arguments, 2, 5, np.int64)
        idx, coef, nodal = array(arguments, 3, np.uint32), array(arguments, 4, real), array(arguments, 5, real)
        par, numbers = array(arguments, 6, real), array(arguments, 7, real)
        omega, creep, settled = numbers[0], numbers[1], numbers[2]
        place, first = array(arguments, 8, np.int64), array(arguments, 9, np.int64)
        other, row = rows(arguments, 10, 3, np.uint32), rows(arguments, 11, ROW, real)
        force = array(arguments, 12, real)
        acc = scratch(size, real)
        g = aligned_part(np.empty(12 * W * AHEAD + W, real))
        for b in range(low, high):
            for l_ in range(W):
                l = uint64(l_)
                at = place[W * b + l_]
                p = uint64(at if at >= 0 else -1 - at)
                for k in range(NODAL):
                    acc[uint64(W * k) + l] = nodal[uint64((NODAL * b + k) * W) + l]
                acc[_9 + l] = x[p]
                acc[_10 + l] = x[p + uint64(1)]
                acc[_11 + l] = x[p + uint64(2)]
            for s in range(seg_start[b], seg_start[b + 1]):
                k, p, n, i, c = seg[s]
                call(key, k, (n, uint64(i), uint64(c), x, idx, coef, par, uint64(p), g, acc))
            for l_ in range(W):
                at = place[W * b + l_]
                if at >= 0:
                    low_c, high_c = first[W * b + l_], first[W * b + l_ + 1]
                    _step(uint64(at), x, acc, uint64(l_), omega, creep, settled, low_c, high_c, other, row, force)

    return blocks


@inline
def _step(at, x, acc, l, omega, creep, settled, low, high, other, row, force):
    """Solve the local problem of the node in lane l, whose position is at x[at], and move it."""
    real = type(omega)
    a0, a1, a2 = acc[_3 + l], acc[_4 + l], acc[_5 + l]
    a3, a4, a5 = acc[_6 + l], acc[_7 + l], acc[_8 + l]
    f0, f1, f2 = acc[l], acc[_1 + l], acc[_2 + l]
    for c in range(low, high):
        # What sticks or rubs is a spring across the normal; that of friction bounds its energy, as it is concave in u².
        k, w, F = row[c, 10], row[c, 0], row[c, 11]
        if max(k, F) > real(0):
            n = row[c, 5], row[c, 6], row[c, 7]
            C = sub(_gap_vector(c, at, x, other, row), (row[c, 12], row[c, 13], row[c, 14]))
            along = dot(n, C)
            u = sub(C, scale(along, n))
            if real(0) < F:
                k = F / math.sqrt(dot(u, u) + creep * creep)
            f0 -= w * k * u[0]
            f1 -= w * k * u[1]
            f2 -= w * k * u[2]
            s = w * w * k
            a0 += s * (real(1) - n[0] * n[0])
            a1 -= s * n[0] * n[1]
            a2 -= s * n[0] * n[2]
            a3 += s * (real(1) - n[1] * n[1])
            a4 -= s * n[1] * n[2]
            a5 += s * (real(1) - n[2] * n[2])
    d0, d1, d2 = solve_spd(a0, a1, a2, a3, a4, a5, f0, f1, f2)
    d0, d1, d2 = omega * d0, omega * d1, omega * d2
    for c in range(low, high):
        w, p = row[c, 0], force[c]
        if real(0) < p < real(np.inf):
            y0, y1, y2 = solve_spd(a0, a1, a2, a3, a4, a5, w * row[c, 5], w * row[c, 6], w * row[c, 7])
            d0 += p * y0
            d1 += p * y1
            d2 += p * y2
        else:  # what is not a number is forgotten
            force[c] = real(0)
    for _ in range(ROUNDS if high - low > 1 else 1):
        largest, most = real(0), real(0)
        for c in range(low, high):
            w = row[c, 0]
            m = scale(w, (row[c, 5], row[c, 6], row[c, 7]))
            y0, y1, y2 = solve_spd(a0, a1, a2, a3, a4, a5, m[0], m[1], m[2])
            C = _gap_vector(c, at, x, other, row)
            gap = row[c, 5] * C[0] + row[c, 6] * C[1] + row[c, 7] * C[2] - row[c, 8]
            soft = row[c, 9] / omega
            q = m[0] * y0 + m[1] * y1 + m[2] * y2 + soft
            left = gap + m[0] * d0 + m[1] * d1 + m[2] * d2 + force[c] * soft
            p = max(force[c] - left / q, real(0))
            change = p - force[c]
            force[c] = p
            largest, most = max(largest, p), max(most, abs(change))
            d0 += change * y0
            d1 += change * y1
            d2 += change * y2
        if most <= settled * largest:
            break
    x[at] = acc[_9 + l] + d0
    x[at + uint64(1)] = acc[_10 + l] + d1
    x[at + uint64(2)] = acc[_11 + l] + d2


@inline
def _gap_vector(c, at, x, other, row):
    """C = Σ_j w_j x_j of a contact, from differences to the node's own position."""
    a, b, e = uint64(other[c, 0]), uint64(other[c, 1]), uint64(other[c, 2])
    s, u, v, w = row[c, 1], row[c, 2], row[c, 3], row[c, 4]
    x0, x1, x2 = x[at], x[at + uint64(1)], x[at + uint64(2)]
    return (
        s * x0 + u * (x[a] - x0) + v * (x[b] - x0) + w * (x[e] - x0),
        s * x1 + u * (x[a + uint64(1)] - x1) + v * (x[b + uint64(1)] - x1) + w * (x[e + uint64(1)] - x1),
        s * x2 + u * (x[a + uint64(2)] - x2) + v * (x[b + uint64(2)] - x2) + w * (x[e + uint64(2)] - x2),
    )
