"""The coarse space of a problem: trilinear displacements of the free vertices on grids of cells four elements wide.

Of cloth it holds the displacement of every free vertex (:mod:`pbng.coarse.cloth`): on a level of its own above the
grids, beside the nodes of the finest grid that solids follow.
"""

from functools import cached_property

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from numba import uint64

from pbng.coarse.cloth import ClothHessian
from pbng.coarse.grid import CORNERS, Grid, coarser, make_grid
from pbng.coarse.linear import DENSE, GridSolver, Level, interpolation, weight_matrix
from pbng.coarse.stiffness import Cubature
from pbng.contact.contacts import ContactEnergy
from pbng.elements.membrane import SurfaceTriangle
from pbng.packing import Packed
from pbng.parallel import array, body, each, rows
from pbng.problem import ElementGroup, Problem

WIDTH = 4  # edge of a cell in mean distances of vertices
LEAST = 2e-3  # of the stiffness of the vertices that a node moves: a node that the cubature missed is no weaker
LEAST_CLOTH = 1e-6  # the same of nodes of cloth
PATIENCE = 4  # refreshes at most for which cloth's exact Hessian is not tried after it was found indefinite
WALL = 10.0  # stiffness of what keeps a vertex out of a collider, relative to the vertex's own
TIE = 100.0  # stiffness of the ties of the extension, relative to its Laplacian
EXTENSION = 6000  # nodes of the finest grid on which constraints are extended


class CoarseSpace:
    """Grids over the rest shape, from fine to coarse, and what the two-grid cycle asks of them.

    Args:
        problem: What is solved.
        packed: Its layout.
    """

    def __init__(self, problem: Problem, packed: Packed) -> None:
        self.problem = problem
        self.grids, pieces = _grids(problem)
        n = sum(len(g.cells) for g in _solids(problem))
        self.cubature = Cubature(problem, self.grids, [p[:n] for p in pieces], packed.slot) if n else None
        free = np.flatnonzero(~problem.fixed)
        parents, weights, self.cloth, top = self._finest(packed.slot)
        self.solver = GridSolver(self.grids, top)
        self.n_node = self.solver.matrices[0].n_node
        self.tied = self._weak_hessian(weight_matrix(parents, weights, self.n_node))
        if self.tied is not None:
            self.solver.add(self.tied)
        n, place = packed.n_free // 4, packed.slot[free]
        self.parents, self.weights = np.zeros((n, 8), np.int32), np.zeros((n, 8))  # U, in the order of the blocks
        self.parents[place], self.weights[place] = parents[free], weights[free]
        up = weight_matrix(self.parents, self.weights, self.n_node)
        self.up = up
        self.touched: tuple[ContactEnergy, bytes] | None = None
        self.bearing = WALL * packed.stiffness
        down = up.T.tocsr()
        self.restriction = down.indptr.astype(np.int64), down.indices.astype(np.int32), down.data
        self.least = self._least(up, packed.stiffness, place)
        self.blank = np.zeros((0 if self.cubature else sum(len(g.node) for g in self.grids), 576))
        self.restart()
        plane = np.array([b.mesh.cells.shape[1] == 3 for b in problem.bodies])
        self.moves_z = np.ones(self.n_node, bool)  # also of cloth, which has no nodes of grids on the finest level
        self.moves_z[: len(self.kept)] = ~plane[self.grids[0].body[self.kept]]

    def _finest(self, slot: np.ndarray) -> tuple[np.ndarray, np.ndarray, ClothHessian | None, Level | None]:
        """Nodes and weights (n_vert, 8) of all vertices on the finest level, and what there is of cloth.

        Without cloth that level is the finest grid. With it, its nodes are those of that grid that solids follow, and
        then the free vertices of cloth.
        """
        problem, grid = self.problem, self.grids[0]
        parents, weights = grid.parents.copy(), grid.weights.copy()
        vertex = np.flatnonzero(_is_cloth(problem) & ~problem.fixed)
        self.kept = np.arange(grid.n_node)
        if len(vertex) == 0:
            return parents, weights, None, None
        piece = np.unique(grid.piece[: sum(len(g.cells) for g in _solids(problem))])
        self.kept = kept = np.unique(grid.node[piece])
        number = np.zeros(grid.n_node, np.int64)
        number[kept] = np.arange(len(kept))
        n = len(kept) + len(vertex)
        own = np.full(problem.n_vert, -1)
        own[vertex] = np.arange(len(kept), n)
        of_solids = np.eye(1, 8)
        rows = np.concatenate([np.pad(kept[:, None], ((0, 0), (0, 7))), grid.parents[vertex]])
        up = weight_matrix(
            rows, np.concatenate([np.tile(of_solids, (len(kept), 1)), grid.weights[vertex]]), grid.n_node
        )
        parents = number[parents]
        parents[vertex], weights[vertex] = 0, of_solids
        parents[vertex, 0] = own[vertex]
        cloth = ClothHessian(problem, slot, own, n)
        return parents, weights, cloth, Level(up, piece, number[grid.node[piece]], cloth.keys)

    def _weak_hessian(self, up: scipy.sparse.csr_matrix) -> scipy.sparse.bsr_matrix | None:
        """UᵀHU of the weak constraints on the finest level: bodies that are tied are so there too."""
        if self.problem.weak_energy is None:
            return None
        free = scipy.sparse.diags(1.0 * ~self.problem.fixed)
        return self.problem.weak_energy.hessian(free @ up)

    def _least(self, up: scipy.sparse.csr_matrix, stiffness: np.ndarray, place: np.ndarray) -> list[np.ndarray]:
        """For each level the least stiffness of its nodes (n_node,) [N/m], from that of the vertices that they move."""
        least = []
        nothing = 1e-6 * float(stiffness.mean()) if len(stiffness) else 1.0  # for nodes that move no free vertex
        share = np.full(len(stiffness), LEAST)
        share[place[_is_cloth(self.problem)[~self.problem.fixed]]] = LEAST_CLOTH
        for level in range(len(self.solver.matrices)):
            least.append(np.maximum(up.multiply(up).T @ (share * stiffness), nothing))
            if level < len(self.solver.up):
                up = up @ self.solver.up[level]
        return least

    def restart(self) -> None:
        """Forget what the last solve has found."""
        self.wait, self.patience = 0, 1  # refreshes before cloth's exact Hessian is tried again
        self.definite = True  # whether it was found positive definite, or there is no cloth

    def touch(self, touching: ContactEnergy | None, x: np.ndarray, active: np.ndarray | None) -> None:
        """Take what touches at positions x (n, 3): the contacts and half-spaces that are ``active``."""
        key = None if touching is None or active is None else (touching, active.tobytes())
        if key == self.touched:
            return
        self.touched, total = key, self.tied
        if touching is not None and active is not None and active.any():
            found = touching.hessian(x, active, self.bearing, self.up)
            total = found if total is None else (total + found).tobsr((3, 3))
        self.solver.add(total)

    def refresh(self, x: np.ndarray) -> None:
        """Take the stiffness at a flat position array."""
        stiffness = self.cubature.evaluate(x) if self.cubature else self.blank
        self.solver.factorise(stiffness, self.least, *(self.cloth.evaluate(x) if self.cloth else ()))
        self.wait -= 1

    def direction(self, f: np.ndarray, d: np.ndarray, tolerance: float) -> float:
        """Write d = U y with UᵀHU y = Uᵀf, solved to a tolerance, and return f·d [J]; f and d are flat."""
        b = np.empty((self.n_node, 3))
        each(_restrict, (*self.restriction, f, b), len(b), grain=64)
        b[:, 2] *= self.moves_z
        y = self.solver.solve_exact(b, tolerance) if self.cloth and self.wait <= 0 else None
        self.definite = self.cloth is None or y is not None
        if y is not None:
            self.patience = 1
        else:
            if self.cloth and self.wait <= 0:
                self.patience = self.wait = min(2 * self.patience, PATIENCE)
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
            level += 1
            up = up @ interpolation(self.grids[level])
        grid = self.grids[level]
        laplacian = _laplacian(grid)
        at_fixed = up[np.flatnonzero(self.problem.fixed)]
        scale = laplacian.diagonal().mean()
        tied = laplacian + 1e-9 * scale * scipy.sparse.identity(grid.n_node) + TIE * scale * (at_fixed.T @ at_fixed)
        return up, scipy.sparse.linalg.splu(tied.tocsc()), at_fixed * (TIE * scale)


def _solids(problem: Problem) -> list[ElementGroup]:
    return [g for g in problem.groups if g.kind.solid]


def _is_cloth(problem: Problem) -> np.ndarray:
    """Which vertices are cloth's, (n_vert,) bool."""
    found = np.zeros(problem.n_vert, bool)
    for g in problem.groups:
        if not g.kind.solid:
            found[g.cells] = True
    return found


def _grids(problem: Problem) -> tuple[list[Grid], list[np.ndarray]]:
    """Grids from fine to coarse, and for each the piece of every element, in the order of the groups of solids.

    Triangles of cloth follow the solids.
    """
    groups = [*_solids(problem), *(g for g in problem.groups if isinstance(g.kind, SurfaceTriangle))]
    corners = max(g.cells.shape[1] for g in groups)
    cells = [np.concatenate([c, np.repeat(c[:, :1], corners - c.shape[1], 1)], 1) for c in (g.cells for g in groups)]
    body = np.repeat(np.arange(len(problem.bodies)), [b.stop - b.start for b in problem.bodies])
    low, size = _cells(problem)
    grid = make_grid(problem.X, np.concatenate(cells), body, low, size)
    grids = [grid]
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
    low, size, cloth = [], [], _is_cloth(problem)
    for b in problem.bodies:
        extent = np.ptp(b.mesh.X, axis=0)
        flat = b.mesh.cells.shape[1] == 3
        spacing = (b.mesh.volume.sum() / b.mesh.n_vert) ** (1 / (2 if flat else 3))
        number = np.maximum(np.rint(extent / (WIDTH * spacing)), 1)
        low.append(problem.X[b.start : b.stop].min(0))
        thin = spacing if cloth[b.start] else 0.0  # a sheet may be flat but for rounding
        edge = np.where(extent > thin, extent / number, thin or 1.0)
        size.append(edge * (1 + 1e-9))  # the far side lies in the last cell
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
