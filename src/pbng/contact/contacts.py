"""What touches during one step: contacts between surfaces, and half-spaces that colliders leave.

A *contact* is a weak constraint between two interpolated points, one-sided: with C = Σ_j w_j x_j, weights of one side
positive and of the other negative, and the gap g = n·C - offset, its energy is ½ k_n min(g, 0)². If it resisted when it
was found it has ½ k_tau |(I - n nᵀ)(C - C₀)|² too, C₀ being what C was then, for as long as it stands. A *half-space*
is where one vertex has to stay: n·x >= offset, exactly.

Stencils, normals and offsets are those of the start of the step: energies are convex in what a node sees of them.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse

from pbng.constraints import stencil_hessian
from pbng.contact.collider import dots, norms
from pbng.contact.halfspaces import HalfSpaces
from pbng.jit import serial

CORNERS = 4  # vertices of a stencil: a vertex and a triangle, or two edges
NEVER = -1e30  # offset [m] of a contact that does not resist
PARTINGS = 4  # rounds in which what overlaps is moved apart


def _none(*shape: int, dtype: type = float) -> np.ndarray:
    return np.empty((0, *shape), dtype)


@dataclass(frozen=True, eq=False)
class Contacts:
    """Contacts (m) and half-spaces (k) of one step; by default none.

    Attributes:
        vertices: Vertices of each stencil, (m, 4) int32, none twice.
        weights: Their weights, (m, 4), positive on the first side; each row sums to zero.
        normal: Unit vectors from the second side to the first, (m, 3).
        offset: What n·C must not be less than [m], (m,).
        k_n: Stiffness [N/m], (m,).
        k_tau: Tangential stiffness [N/m], (m,); zero where nothing resisted yet.
        start: C₀ [m], (m, 3).
        kept: Distance that is to be kept [m], (m,): the offset, unless that gives way for now.
        vertex: Vertex of each half-space, (k,) int32.
        plane: Its normal, (k, 3).
        level: Its offset n·p of a point p on it [m], (k,).
        friction: F [N], (k,).
        anchor: Where the vertex would be now had it stuck to the collider [m], (k, 3).
        creep: ε [m].
    """

    vertices: np.ndarray = field(default_factory=lambda: _none(CORNERS, dtype=np.int32))
    weights: np.ndarray = field(default_factory=lambda: _none(CORNERS))
    normal: np.ndarray = field(default_factory=lambda: _none(3))
    offset: np.ndarray = field(default_factory=_none)
    k_n: np.ndarray = field(default_factory=_none)
    k_tau: np.ndarray = field(default_factory=_none)
    start: np.ndarray = field(default_factory=lambda: _none(3))
    kept: np.ndarray = field(default_factory=_none)
    vertex: np.ndarray = field(default_factory=lambda: _none(dtype=np.int32))
    plane: np.ndarray = field(default_factory=lambda: _none(3))
    level: np.ndarray = field(default_factory=_none)
    friction: np.ndarray = field(default_factory=_none)
    anchor: np.ndarray = field(default_factory=lambda: _none(3))
    creep: float = 1.0

    def __len__(self) -> int:
        return len(self.vertices) + len(self.vertex)

    def ties(self) -> "Contacts":
        """What remains of contacts once others are found in their place: their tangential springs."""
        k = np.flatnonzero(self.k_tau > 0)
        open_ = np.full(len(k), NEVER)
        return Contacts(
            self.vertices[k], self.weights[k], self.normal[k], open_, self.k_n[k], self.k_tau[k], self.start[k], open_
        )

    def plus(self, other: "Contacts") -> "Contacts":
        """These and the contacts between surfaces of another."""
        names = ("vertices", "weights", "normal", "offset", "k_n", "k_tau", "start", "kept")
        joined: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return replace(self, **joined)

    def clearance(self, x: np.ndarray) -> np.ndarray:
        """How much farther apart each contact is at x (n_vert, 3) than it is to be kept [m], (m,)."""
        return self._along(x) - self.kept

    def height(self, x: np.ndarray) -> np.ndarray:
        """How far inside of each half-space its vertex is at x (n_vert, 3) [m], (k,)."""
        return dots(self.plane, x[self.vertex]) - self.level

    def put_outside(self, x: np.ndarray) -> np.ndarray:
        """A copy of x (n_vert, 3) with every vertex in its half-spaces."""
        x = np.array(x, float)
        HalfSpaces(self.vertex, self.plane).move_in(x, self.level)
        return x

    def parted(self, x: np.ndarray, fixed: np.ndarray) -> np.ndarray | None:
        """A copy of x (n_vert, 3) in its half-spaces and with less overlap: a state to begin at. None if none resists.

        Each contact that resists moves its vertices until it does not, but for those that are ``fixed`` (n_vert,); a
        vertex of several is moved by their mean. Where contacts are stiffer than a node's mass over Δt², sweeps alone
        would take long to stop what moves into them.
        """
        x, none = np.array(x, float), True
        w = np.where(fixed[self.vertices], 0.0, self.weights)
        weight2 = (w * w).sum(1)
        for _ in range(PARTINGS):
            gap = self._along(x) - self.offset
            c = np.flatnonzero((gap < 0) & (weight2 > 0))
            if len(c) == 0:
                break
            none = False
            push = (-gap[c] / weight2[c])[:, None] * self.normal[c]
            moved, count = np.zeros_like(x), np.zeros((len(x), 1))
            _spread(w[c], self.vertices[c], push, moved)
            _spread((w[c] != 0).astype(float), self.vertices[c], np.ones((len(c), 1)), count)
            some = np.flatnonzero(count)
            x[some] += moved[some] / count[some]
        return None if none else self.put_outside(x)

    def _along(self, x: np.ndarray) -> np.ndarray:
        """n·C at x (n_vert, 3) [m], (m,)."""
        return dots(self.normal, _between(self.weights, self.vertices, x))


class ContactEnergy:
    """Energy, forces and Hessian of contacts in float64, for any numbering of the vertices.

    Args:
        contacts: What touches.
        n: Length of the position arrays.
        slot: Number in them of each vertex.
        origin: What positions are relative to [m], (3,).
    """

    def __init__(self, contacts: Contacts, n: int, slot: np.ndarray, origin: np.ndarray) -> None:
        c, self.n = contacts, n
        self.vertices, self.weights = slot[c.vertices], c.weights
        self.reach = np.sqrt((c.weights**2).sum(1))  # norm of each contact's weights
        self.normal, self.offset, self.k_n, self.k_tau, self.start = c.normal, c.offset, c.k_n, c.k_tau, c.start
        self.sticks = bool(c.k_tau.any())
        self.walls = HalfSpaces(slot[c.vertex], c.plane)
        self.vertex, self.plane = self.walls.vertex, self.walls.plane
        self.level = c.level - c.plane @ origin
        self.friction, self.anchor, self.creep = c.friction, c.anchor - origin, c.creep
        self.rubs = bool(c.friction.any())

    def energy(self, x: np.ndarray) -> float:
        """Energy [J] at x (n, 3)."""
        energy = 0.0
        if len(self.k_n):
            C, gap = self._gaps(x)
            depth = np.minimum(gap, 0.0)
            energy += 0.5 * float((self.k_n * depth * depth).sum())
            if self.sticks:
                u = self._slipped(C)
                energy += 0.5 * float((self.k_tau * dots(u, u)).sum())
        if self.rubs:
            energy += float((self.friction * (self._slid(x)[1] - self.creep)).sum())
        return energy

    def forces(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Forces (n, 3) [N], and the sum of the norms of all contacts' forces [N]."""
        f, scale = np.zeros((self.n, 3)), 0.0
        if len(self.k_n):
            C, gap = self._gaps(x)
            pull = (self.k_n * np.minimum(gap, 0.0))[:, None] * self.normal
            if self.sticks:
                pull += self.k_tau[:, None] * self._slipped(C)
            _spread(self.weights, self.vertices, -pull, f)
            scale += float((self.reach * norms(pull)).sum())
        if self.rubs:
            u, length = self._slid(x)
            rub = (self.friction / length)[:, None] * u
            np.subtract.at(f, self.vertex, rub)
            scale += float(norms(rub).sum())
        return f, scale

    def balance(self, f: np.ndarray, x: np.ndarray, tolerance: float) -> np.ndarray:
        """Take from forces f (n, 3) at x (n, 3), in place, what half-spaces that are touched bear, (k,) [N]."""
        # What is left is the part of a force along which its vertex could move: its projection onto a cone.
        return self.walls.move_in(f, np.where(self.held(x, tolerance), 0.0, -np.inf), far=np.inf)

    def put_outside(self, x: np.ndarray, held: np.ndarray | None = None) -> None:
        """Move x (n, 3), of any precision, into the half-spaces, in place; onto the planes of those ``held`` (k,)."""
        self.walls.move_in(x, self.level, held)

    def held(self, x: np.ndarray, tolerance: float) -> np.ndarray:
        """Which half-spaces are touched at x to within a tolerance [m], (k,) bool."""
        return self.walls.height(x, self.level) <= tolerance

    def stiffness(self, x: np.ndarray, n: int) -> np.ndarray:
        """A third of the trace of each node's Hessian [N/m] at x, of the first n nodes."""
        stiffness = np.zeros((self.n, 1))
        if len(self.k_n):
            k = (np.where(self._gaps(x)[1] < 0, self.k_n, 0.0) + 2 * self.k_tau) / 3
            _spread(self.weights**2, self.vertices, k[:, None], stiffness)
        if self.rubs:
            np.add.at(stiffness[:, 0], self.vertex, 2 / 3 * self.friction / self._slid(x)[1])
        return stiffness[:n, 0]

    def active(self, x: np.ndarray, tolerance: float) -> np.ndarray:
        """Which contacts resist at x, and which half-spaces are touched to within a tolerance [m], (m + k,) bool."""
        return np.concatenate([self._gaps(x)[1] < 0, self.held(x, tolerance)])

    def hessian(
        self, x: np.ndarray, active: np.ndarray, bearing: np.ndarray, U: scipy.sparse.csr_matrix
    ) -> scipy.sparse.bsr_matrix:
        """UᵀHU [N/m] in blocks of 3x3 at x for interpolation weights U (k, l) of the first k positions.

        ``active`` says what resists; half-spaces count as springs of stiffness ``bearing`` (k,) [N/m], and so does what
        sticks to them.
        """
        m, k = len(self.k_n), U.shape[0]
        unit = np.eye(3)
        along = self.normal[:, :, None] * self.normal[:, None]
        K = (active[:m] * self.k_n)[:, None, None] * along + self.k_tau[:, None, None] * (unit - along)
        used = np.flatnonzero(active[:m] | (self.k_tau > 0))
        held = np.flatnonzero(active[m:])
        p, v = self.plane[held], self.vertex[held]
        across = p[:, :, None] * p[:, None]
        sticks = np.minimum(self.friction / self._slid(x)[1], bearing[self.vertex])[held]
        walls = bearing[v][:, None, None] * across + sticks[:, None, None] * (unit - across)
        at = scipy.sparse.csr_matrix((np.ones(len(v)), (np.arange(len(v)), v)), (len(v), k))
        rows = np.arange(0, CORNERS * len(used) + 1, CORNERS)
        entries = self.weights[used].ravel(), self.vertices[used].ravel(), rows
        between = scipy.sparse.csr_matrix(entries, (len(used), self.n))[:, :k]
        W = scipy.sparse.vstack([between, at]).tocsr() @ U
        return stencil_hessian(W, np.concatenate([K[used], walls]))

    def closing(self, x: np.ndarray, active: np.ndarray, bearing: np.ndarray) -> np.ndarray:
        """Forces (n, 3) [N] that draw shut those contacts and half-spaces that are ``active`` and open at x.

        With them the springs of :meth:`hessian` are at rest where the gap is zero, not where it is now.
        """
        m = len(self.k_n)
        gap = np.maximum(self._gaps(x)[1], 0.0)
        f = np.zeros((self.n, 3))
        _spread(self.weights, self.vertices, -(active[:m] * self.k_n * gap)[:, None] * self.normal, f)
        k = np.flatnonzero(active[m:])
        height = np.maximum(self.walls.height(x, self.level)[k], 0.0)
        np.subtract.at(f, self.vertex[k], (bearing[self.vertex[k]] * height)[:, None] * self.plane[k])
        return f

    def _gaps(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """C (m, 3) and the gap (m,) of each contact."""
        C = _between(self.weights, self.vertices, x)
        return C, dots(self.normal, C) - self.offset

    def _slid(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far each vertex has slid along its half-space, (k, 3), and sqrt(|u|² + ε²)."""
        u = _across(x[self.vertex] - self.anchor, self.plane)
        return u, np.sqrt(dots(u, u) + self.creep**2)

    def _slipped(self, C: np.ndarray) -> np.ndarray:
        return _across(C - self.start, self.normal)


def _between(weights: np.ndarray, vertices: np.ndarray, x: np.ndarray) -> np.ndarray:
    """C = Σ_j w_j x_j of stencils (m, 4) at x (n, 3) [m], (m, 3)."""
    C = np.empty((len(vertices), 3))
    _interpolate(weights, vertices, x, C)
    return C


@serial
def _interpolate(weights, vertices, x, C):
    for m in range(len(C)):
        for i in range(3):
            C[m, i] = 0.0
            for j in range(CORNERS):
                C[m, i] += weights[m, j] * x[vertices[m, j], i]


@serial
def _spread(weights, vertices, values, out):
    """Add the values of stencils (m, l), times their weights, to those of their vertices, out (n, l)."""
    for m in range(len(values)):
        for j in range(CORNERS):
            for i in range(out.shape[1]):
                out[vertices[m, j], i] += weights[m, j] * values[m, i]


def _across(u: np.ndarray, n: np.ndarray) -> np.ndarray:
    """The part of vectors (k, 3) across unit normals (k, 3)."""
    return u - dots(n, u)[:, None] * n
