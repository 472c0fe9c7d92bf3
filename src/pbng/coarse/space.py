"""The coarse space of a problem: trilinear displacements of the free vertices on grids of cells four elements wide.

It moves solids only; vertices of cloth have no weight in it and are left to the sweeps.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numba import uint64

from pbng.coarse.grid import CORNERS, Grid, coarser, make_grid
from pbng.coarse.linear import DENSE, GridSolver, interpolation, weight_matrix
from pbng.coarse.stiffness import Cubature
from pbng.contact.contacts import ContactEnergy
from pbng.packing import Packed
from pbng.parallel import array, body, each, rows
from pbng.problem import ElementGroup, Problem

WIDTH = 4  # edge of a cell in mean distances of vertices
LEAST = 2e-3  # of the stiffness of the vertices that a node moves: a node that the cubature missed is no weaker
WALL = 10.0  # stiffness of what keeps a vertex out of a collider, relative to the vertex's own
TIE = 100.0  # stiffness of the ties of the extension, relative to its Laplacian
EXTENSION = 6000  # nodes of the finest grid on which constraints are extended


def coarse_space(problem: Problem, packed: Packed) -> "CoarseSpace | EmptySpace":
    """The coarse space of a problem, empty if it has no solid."""
    return CoarseSpace(problem, packed) if _solids(problem) else EmptySpace(problem)


class EmptySpace:
    """What stands in for a coarse space where there is none: nothing is corrected."""

    def __init__(self, problem: Problem) -> None:
        self.n_vert = problem.n_vert

    def touch(self, touching: ContactEnergy | None, x: np.ndarray, slack: float) -> None:
        """As :meth:`CoarseSpace.touch`."""

    def refresh(self, x: np.ndarray) -> None:
        """As :meth:`CoarseSpace.refresh`."""

    def direction(self, f: np.ndarray, d: np.ndarray, tolerance: float) -> float:
        """As :meth:`CoarseSpace.direction`; d = 0."""
        d[:] = 0.0
        return 0.0

    def extend(self, increment: np.ndarray) -> np.ndarray:
        """As :meth:`CoarseSpace.extend`; zero."""
        return np.zeros((self.n_vert, 3))


class CoarseSpace:
    """Grids over the rest shape, from fine to coarse, and what the two-grid cycle asks of them.

    Args:
        problem: What is solved.
        packed: Its layout.
    """

    def __init__(self, problem: Problem, packed: Packed) -> None:
        self.problem = problem
        self.grids, pieces = _grids(problem)
        self.cubature = Cubature(problem, self.grids, pieces, packed.slot)
        free = np.flatnonzero(~problem.fixed)
        self.solver = GridSolver(self.grids)
        self.tied = self._weak_hessian()
        if self.tied is not None:
            self.solver.add(self.tied)
        n, place = packed.n_free // 4, packed.slot[free]
        self.parents, self.weights = np.zeros((n, 8), np.int32), np.zeros((n, 8))  # U, in the order of the blocks
        self.parents[place], self.weights[place] = self.grids[0].parents[free], self.grids[0].weights[free]
        up = weight_matrix(self.parents, self.weights, self.grids[0].n_node)
        self.up, self.touched = up, b""
        self.bearing = WALL * packed.stiffness
        down = up.T.tocsr()
        self.restriction = down.indptr.astype(np.int64), down.indices.astype(np.int32), down.data
        self.least = self._least(up, packed.stiffness)
        plane = np.array([b.mesh.cells.shape[1] == 3 for b in problem.bodies])  # cloth has no nodes
        self.moves_z = ~plane[self.grids[0].body]

    def _weak_hessian(self) -> scipy.sparse.bsr_matrix | None:
        """UᵀHU of the weak constraints on the finest grid: bodies that are tied are so on the grid too."""
        if self.problem.weak_energy is None:
            return None
        free = scipy.sparse.diags(1.0 * ~self.problem.fixed)
        return self.problem.weak_energy.hessian(free @ interpolation(self.grids[0]))

    def _least(self, up: scipy.sparse.csr_matrix, stiffness: np.ndarray) -> list[np.ndarray]:
        """For each grid the least stiffness of its nodes (n_node,) [N/m], from that of the vertices that they move."""
        least = []
        nothing = 1e-6 * float(stiffness.mean()) if len(stiffness) else 1.0  # for nodes that move no free vertex
        for level in range(len(self.grids)):
            least.append(np.maximum(LEAST * (up.multiply(up).T @ stiffness), nothing))
            if level < len(self.grids) - 1:
                up = up @ self.solver.up[level]
        return least

    def touch(self, touching: ContactEnergy | None, x: np.ndarray, slack: float) -> None:
        """Take what resists at positions x (n, 3) of contacts and of half-spaces touched to within ``slack`` [m]."""
        key, total = b"", self.tied
        if touching is not None:
            active = touching.active(x, slack)
            key = touching.name + active.tobytes()
        if key == self.touched:
            return
        self.touched = key
        if touching is not None and active.any():
            found = touching.hessian(x, active, self.bearing, self.up)
            total = found if total is None else (total + found).tobsr((3, 3))
        self.solver.add(total)

    def refresh(self, x: np.ndarray) -> None:
        """Take the stiffness at a flat position array."""
        self.solver.factorise(self.cubature.evaluate(x), self.least)

    def direction(self, f: np.ndarray, d: np.ndarray, tolerance: float) -> float:
        """Write d = U y with UᵀHU y = Uᵀf, solved to a tolerance, and return f·d [J]; f and d are flat."""
        b = np.empty((self.grids[0].n_node, 3))
        each(_restrict, (*self.restriction, f, b), len(b), grain=64)
        b[:, 2] *= self.moves_z
        y = self.solver.solve(b, tolerance)
        y[:, 2] *= self.moves_z
        each(_prolong, (self.parents, self.weights, y, d), len(self.parents), grain=512)
        return float((b * y).sum())

    def extend(self, increment: np.ndarray) -> np.ndarray:
        """Displacements (n_vert, 3) that extend those of the prescribed vertices (n_fixed, 3) over the grid."""
        up, factor, tied = self._extension
        return up @ factor.solve(tied.T @ increment)

    @cached_property
    def _extension(self):
        """A grid and its scalar Laplacian, factorised, with the prescribed vertices tied to their displacements."""
        level, up = 0, interpolation(self.grids[0])
        while self.grids[level].n_node > EXTENSION and level + 1 < len(self.grids):
            up = up @ self.solver.up[level]
            level += 1
        grid = self.grids[level]
        laplacian = _laplacian(grid)
        at_fixed = up[np.flatnonzero(self.problem.fixed)]
        scale = laplacian.diagonal().mean()
        tied = laplacian + 1e-9 * scale * scipy.sparse.identity(grid.n_node) + TIE * scale * (at_fixed.T @ at_fixed)
        return up, scipy.sparse.linalg.splu(tied.tocsc()), at_fixed * (TIE * scale)


def _solids(problem: Problem) -> list[ElementGroup]:
    return [g for g in problem.groups if g.kind.solid]


def _grids(problem: Problem) -> tuple[list[Grid], list[np.ndarray]]:
    """Grids from fine to coarse, and for each the piece of every element, in the order of the groups of solids."""
    groups = _solids(problem)
    corners = max(g.cells.shape[1] for g in groups)
    cells = [np.concatenate([c, np.repeat(c[:, :1], corners - c.shape[1], 1)], 1) for c in (g.cells for g in groups)]
    body = np.repeat(np.arange(len(problem.bodies)), [b.stop - b.start for b in problem.bodies])
    low, size = _cells(problem)
    grid = make_grid(problem.X, np.concatenate(cells), body, low, size)
    covered = np.zeros((problem.n_vert, 1))
    for c in cells:
        covered[c] = 1.0
    grids = [replace(grid, weights=grid.weights * covered)]
    pieces = [grids[0].piece]
    while 3 * grids[-1].n_node > DENSE:
        grid = coarser(grids[-1], low, size)
        if grid.n_node > 0.7 * grids[-1].n_node:  # many small bodies
            break
        size = 2 * size
        pieces.append(grid.piece[pieces[-1]])
        grids.append(grid)
    return grids, pieces


def _cells(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Low corner and cell size of each body, (n_body, 3): cells fill its box and hold WIDTH³ vertices or so."""
    low, size = [], []
    for b in problem.bodies:
        extent = np.ptp(b.mesh.X, axis=0)
        flat = b.mesh.cells.shape[1] == 3
        spacing = (b.mesh.volume.sum() / b.mesh.n_vert) ** (1 / (2 if flat else 3))
        number = np.maximum(np.rint(extent / (WIDTH * spacing)), 1)
        low.append(problem.X[b.start : b.stop].min(0))
        size.append(np.where(extent > 0, extent / number, 1.0) * (1 + 1e-9))  # the far side lies in the last cell
    return np.array(low), np.array(size)


def _laplacian(grid: Grid) -> scipy.sparse.csr_matrix:
    """∫ ∇N_a · ∇N_b over the cells of all pieces, (n_node, n_node)."""
    same = (CORNERS[:, None] == CORNERS[None]).astype(float)  # (8, 8, 3)
    stiffness, mass = 2 * same - 1, (1 + same) / 6
    total = np.zeros((len(grid.node), 8, 8))
    volume = grid.size.prod(1)
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        shape = stiffness[..., k] * mass[..., i] * mass[..., j]
        total += (volume / grid.size[:, k] ** 2)[:, None, None] * shape
    row, column = np.repeat(grid.node, 8, axis=1), np.tile(grid.node, (1, 8))
    return scipy.sparse.csr_matrix((total.ravel(), (row.ravel(), column.ravel())), (grid.n_node, grid.n_node))


@body
def _restrict(arguments, low, high):
    """Body of b = Uᵀ f for nodes low .. high."""
    start, place, weight = array(arguments, 0, np.int64), array(arguments, 1, np.int32), array(arguments, 2, np.float64)
    f, b = array(arguments, 3, np.float64), rows(arguments, 4, 3, np.float64)
    for c in range(low, high):
        b0, b1, b2 = 0.0, 0.0, 0.0
        for k in range(start[c], start[c + 1]):
            i, w = uint64(4) * uint64(place[k]), weight[k]
            b0 += w * f[i]
            b1 += w * f[i + uint64(1)]
            b2 += w * f[i + uint64(2)]
        b[c, 0], b[c, 1], b[c, 2] = b0, b1, b2


@body
def _prolong(arguments, low, high):
    """Body of d = U y for vertices low .. high."""
    parents, weights = rows(arguments, 0, 8, np.int32), rows(arguments, 1, 8, np.float64)
    y, d = rows(arguments, 2, 3, np.float64), rows(arguments, 3, 4, np.float64)
    for v in range(low, high):
        d0, d1, d2 = 0.0, 0.0, 0.0
        for k in range(8):
            w, p = weights[v, k], parents[v, k]
            d0 += w * y[p, 0]
            d1 += w * y[p, 1]
            d2 += w * y[p, 2]
        d[v, 0], d[v, 1], d[v, 2], d[v, 3] = d0, d1, d2, 0.0
