"""The stiffness matrix: the Hessian of a problem's energy over its free vertices, in blocks of 3x3.

Its pattern is made once; its values are refilled in the way forces are summed (:mod:`pbng.assembly`): blocks of
elements in lanes, added to the matrix chunk by chunk, chunks that share no vertex in parallel. So there are no atomics,
and the same bits for any number of threads.
"""

from typing import Any

import numpy as np
import scipy.sparse
from numba import uint64

from pbng.assembly import CHUNK, ElementBlocks
from pbng.blocks import BlockMatrix
from pbng.constraints import WeakEnergy
from pbng.dispatch import call, specialised
from pbng.elements.base import W, gather
from pbng.elements.cloth_stiffness import ClothStiffness
from pbng.elements.simplex import PLANE_TRIANGLE, TET
from pbng.elements.stiffness import (
    FULL,
    N_BLOCKS,
    N_CHANGE,
    N_ELEMENT,
    N_FRAME,
    SPECTRAL,
    change_of_stress,
    check_kind,
    decompose,
    full_blocks,
    project,
    save_element,
    scatter,
    spectral_blocks,
    store,
)
from pbng.errors import InputError
from pbng.jit import serial
from pbng.parallel import address, array, body, call_at, rows, run, scratch
from pbng.problem import Problem

PROJECTIONS = ("none", "clamp", "abs")
FLOOR = 1e-6  # of the a of a material's block: the least eigenvalue of what is projected
FULL_WAY, PROJECTED_WAY, SPECTRAL_WAY = range(3)  # see pbng.elements.stiffness
zero = uint64(0)


class StiffnessMatrix(ElementBlocks):
    """∂²E/∂x∂x of a problem over its free vertices.

    Rows are the free vertices by colour, and within a colour in Morton order of their rest positions: rows of one
    colour have no block in common, and neighbours in space are neighbours in memory. Vertices of plane triangles have
    their z decoupled.

    Args:
        problem: What is solved.

    Attributes:
        matrix: The matrix, filled by :meth:`fill`.
        vertex: The vertex of each row, (n,).
        color_start: Where each colour's rows start, (n_color + 1,).

    Raises:
        InputError: There is no Hessian for an element kind of the problem.
    """

    def __init__(self, problem: Problem) -> None:
        color = np.where(problem.fixed, problem.n_vert, problem.color)[problem.order]
        order = problem.order[np.argsort(color, kind="stable")]
        self.vertex = order[: problem.n_vert - problem.fixed.sum()]
        self.color_start = np.concatenate([[0], np.cumsum(np.bincount(problem.color[self.vertex]))])
        self.slot = np.empty(problem.n_vert, np.int64)
        self.slot[order] = np.arange(problem.n_vert)
        solids = [g for g in problem.groups if g.kind.solid]
        super().__init__(solids, problem.X, self.slot)
        for term in self.terms:
            check_kind(term.kind)
        # The first number of a group is a block's, which is of no use here: the floor takes its place.
        self.floor_at = np.cumsum([0] + [1 + len(g.material.parameters()) for g in solids])[:-1]
        self.scale = np.array([g.material.block().a for g in solids])
        self.matrix, self.constant = self._pattern(problem)
        self.cloth = [ClothStiffness(g, problem.X) for g in problem.groups if not g.kind.solid]
        self.cloth_place = [self._numbers(c.cells) for c in self.cloth]

    def _pattern(self, problem: Problem) -> tuple[BlockMatrix, np.ndarray | None]:
        """The matrix, still empty, and the constant values of weak constraints; sets where elements' blocks go."""
        n = len(self.vertex)
        pairs = []
        for k in sorted({g.cells.shape[1] for g in problem.groups}):
            cells = self.slot[np.concatenate([g.cells for g in problem.groups if g.cells.shape[1] == k])]
            pairs.append((np.repeat(cells, k, axis=1).ravel(), np.tile(cells, (1, k)).ravel()))
        weak = None
        if problem.weak:
            weak = WeakEnergy(problem.weak, problem.n_vert, self.slot).hessian()
            weak.sort_indices()
            row = np.repeat(np.arange(problem.n_vert), np.diff(weak.indptr))
            pairs.append((row, weak.indices))
        pairs.append((np.arange(n), np.arange(n)))
        row, column = (np.concatenate(p) for p in zip(*pairs))
        free = (row < n) & (column < n)
        ones = np.ones(int(free.sum()), np.int8)
        graph = scipy.sparse.csr_matrix((ones, (row[free], column[free])), (n, n))
        graph.sum_duplicates()
        matrix = BlockMatrix(graph.indptr.astype(np.int64), graph.indices.astype(np.int32))
        corners = np.array([t.kind.corners for t in self.terms], np.int64)[self.blocks[:, 0]]
        self.place_at = np.concatenate([[0], np.cumsum(W * corners**2)])
        self.place = np.empty(self.place_at[-1], np.int32)
        _places(self.blocks, corners, self.idx, self.place_at, matrix.start, matrix.column, self.place)
        if weak is None:
            return matrix, None
        constant = np.zeros_like(matrix.value)
        row = np.repeat(np.arange(problem.n_vert), np.diff(weak.indptr))
        free = (row < n) & (weak.indices < n)
        key = np.repeat(np.arange(n), np.diff(matrix.start)) * n + matrix.column
        constant[np.searchsorted(key, row[free] * n + weak.indices[free])] = weak.data[free].reshape(-1, 9)
        return matrix, constant

    def _numbers(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n,) of the blocks that cells (m, k) add to, and of the (m k k) pairs of corners that do."""
        n, k = len(self.vertex), cells.shape[1]
        rows = self.slot[cells]
        row, column = np.repeat(rows, k, axis=1).ravel(), np.tile(rows, (1, k)).ravel()
        free = np.flatnonzero((row < n) & (column < n))
        key = np.repeat(np.arange(n), np.diff(self.matrix.start)) * n + self.matrix.column
        return np.searchsorted(key, row[free] * n + column[free]), free

    def fill(self, x: np.ndarray, projection: str = "none", floor: float = FLOOR) -> None:
        """Set the matrix to the Hessian at x (n_vert, 3) [m].

        Args:
            x: Positions, in the order of the problem's vertices.
            projection: "none" for the exact Hessian; "clamp" or "abs" to make each element's positive semidefinite, by
                setting negative eigenvalues of ∂P/∂F to zero or to their absolute value.
            floor: Least eigenvalue after projection, relative to the a of the material's block.
        """
        if projection not in PROJECTIONS:
            raise InputError(f"projection must be one of {', '.join(PROJECTIONS)}, not {projection!r}")
        value = self.matrix.value
        value[:] = 0.0 if self.constant is None else self.constant
        for cloth, (number, free) in zip(self.cloth, self.cloth_place):
            np.add.at(value, number, cloth.evaluate(x, projection, floor).reshape(-1, 9)[free])
        if self.terms:
            self._fill_solids(x, projection, floor)

    def _fill_solids(self, x: np.ndarray, projection: str, floor: float) -> None:
        self.parameters[self.floor_at] = floor * self.scale
        flat = np.zeros((self.n_slot, 4))
        flat[self.slot, :3] = x
        # For each term: how (an isotropic projection is spectral), whether it is plane, and where its body is.
        spectral = [projection != "none" and t.model.isotropic for t in self.terms]
        how = [SPECTRAL_WAY if s else FULL_WAY if projection == "none" else PROJECTED_WAY for s in spectral]
        terms = np.array([[h, t.kind.plane, address(change_of_stress(t.model))] for h, t in zip(how, self.terms)])
        sizes = np.array([len(self.blocks), projection == "abs"], np.int64)
        order, start = self._disjoint
        where, value = (order, self.place, self.place_at), self.matrix.value
        arrays = (flat, self.X, self.blocks, self.idx, self.parameters, *where, value)
        fill = specialised(make_fill, (TET._element(), PLANE_TRIANGLE._element()))
        run(fill, (*arrays, sizes, terms, FULL, SPECTRAL), np.arange(len(start) - 1), start)


def make_fill(key: str) -> Any:
    """Body of :meth:`StiffnessMatrix.fill`: chunks low .. high of the given order."""
    n_position, n_element, n_frame = 16 * W, N_ELEMENT * W, N_FRAME * W
    n_change, n_blocks, n_point = N_CHANGE * W, N_BLOCKS * W, 9 * W

    @body
    def fill(arguments, low, high):
        x, X, blocks = array(arguments, 0, np.float64), array(arguments, 1, np.float64), rows(arguments, 2, 4, np.int64)
        idx, par, order = array(arguments, 3, np.uint32), array(arguments, 4, np.float64), array(arguments, 5, np.int64)
        place, place_at = array(arguments, 6, np.int32), array(arguments, 7, np.int64)
        value, n_block = array(arguments, 8, np.float64), array(arguments, 9, np.int64)[0]
        fold, terms = np.float64(array(arguments, 9, np.int64)[1]), rows(arguments, 10, 3, np.int64)
        full, spectral = array(arguments, 11, np.float64), array(arguments, 12, np.float64)
        gx, gX = scratch(n_position, np.float64), scratch(n_position, np.float64)
        element, frame = scratch(n_element, np.float64), scratch(n_frame, np.float64)
        points, change = scratch(n_point, np.float64), scratch(n_change, np.float64)
        out = scratch(n_blocks, np.float64)
        work = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
        A, B = np.empty((9, 9)), np.empty((9, 9))
        own = np.empty(4, np.int64)
        own[2], own[3] = change.ctypes.data, par.ctypes.data
        for turn in range(low, high):
            chunk = order[turn]
            for b in range(chunk * CHUNK, min(n_block, (chunk + 1) * CHUNK)):
                k, p, i, m = blocks[b]
                way, plane, where = terms[k]
                floor, corners = par[p], 3 if plane else 4
                gather(corners, uint64(i), x, idx, gx, zero)
                gather(corners, uint64(i), X, idx, gX, zero)
                if plane:
                    for l_ in range(W):
                        save_element(element, uint64(l_), call(key, 1, (gx, gX, uint64(4 * l_))), False)
                else:
                    for l_ in range(W):
                        save_element(element, uint64(l_), call(key, 0, (gx, gX, uint64(4 * l_))), True)
                if way == SPECTRAL_WAY:
                    decompose(element, frame, points, work)
                    own[0], own[1] = points.ctypes.data, spectral.ctypes.data
                    call_at(where, own.ctypes.data, 6, p)
                    for l_ in range(W):
                        l = uint64(l_)
                        store(out, l, element, spectral_blocks(element, frame, change, l, floor, fold))
                else:
                    own[0], own[1] = element.ctypes.data, full.ctypes.data
                    call_at(where, own.ctypes.data, 9, p)
                    if way == PROJECTED_WAY:
                        for l_ in range(W):
                            project(change, l_, A, B, floor, fold)
                    for l_ in range(W):
                        l = uint64(l_)
                        store(out, l, element, full_blocks(element, change, l))
                scatter(m, place, uint64(place_at[b]), value, out, corners, plane)

    return fill


@serial
def _places(blocks, corners, idx, place_at, start, column, place):
    """For each pair of corners of each element the number of its block in the matrix, or -1."""
    n = start.size - 1
    for b in range(blocks.shape[0]):
        k, i = corners[b], blocks[b, 2]
        for a in range(k):
            for c in range(k):
                for l in range(W):
                    row, other = idx[i + W * a + l] // 4, idx[i + W * c + l] // 4
                    to = -1
                    if row < n and other < n:
                        low, high = start[row], start[row + 1]
                        while high - low > 1:
                            middle = (low + high) // 2
                            if column[middle] <= other:
                                low = middle
                            else:
                                high = middle
                        to = low
                    place[place_at[b] + W * (k * a + c) + l] = to
