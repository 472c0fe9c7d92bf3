"""What an element kind is: a stencil and its functions, each made for a material model and inlined into kernels.

Kernels work on *lanes*: W nodes (or elements) side by side, which LLVM turns into vector instructions. Arrays are flat
and indices unsigned, because run-time strides and sign checks keep it from doing so. A position is four numbers, the
fourth zero: reading it too keeps the loads of a lane free of gaps.
"""

from abc import ABC, abstractmethod
from functools import cache
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numba import uint64

from pbng.jit import inline, leaf
from pbng.linalg import scale
from pbng.materials.base import Model

W = 16  # lanes: float32 fills one AVX-512 register; float64 is as fast with 16 as with 8
AHEAD = 6  # rows gathered before they are computed: the accumulators then stay in registers for so many rows, and no
# load waits for the narrower stores that it spans


class ElementKind(ABC):
    """An element kind; ``corners`` vertices, ``others`` of which one incidence of a node refers to besides it."""

    name: ClassVar[str]
    corners: ClassVar[int]
    others: ClassVar[int]
    opposite: ClassVar[np.ndarray]  # (corners, others): for each corner, the local numbers of the others, in order
    across: ClassVar[float] = 0.0  # part of F₃₃ that does not come from the vertices
    solid: ClassVar[bool] = True  # whether elements fill space, or the plane, and can be inverted; cloth does not
    compound_width: ClassVar[int]  # coefficients stored for one incidence of a compound node

    @property
    def order(self) -> list[int]:
        """Order of a cell's corners in which ``energy`` and ``forces`` take them: others of the last, then the last."""
        return [*self.opposite[-1].tolist(), self.corners - 1]

    @abstractmethod
    def width(self, isotropic: bool) -> int:
        """Coefficients stored for one incidence."""

    @abstractmethod
    def gradients(self, X: np.ndarray) -> np.ndarray:
        """Gradients (n, corners, 3) [1/m] of the shape functions of elements X (n, corners, 3) at rest, or [rad/m] of
        the angle of hinges."""

    @abstractmethod
    def volume(self, X: np.ndarray) -> np.ndarray:
        """Rest volumes (n,) [m³] of elements X (n, corners, 3): what their energy density is multiplied by, so areas
        [m²] of membranes and weights of hinges."""

    @abstractmethod
    def pack(self, isotropic: bool) -> Any:
        """``(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to)``: write the coefficients of corner a of
        element e to ``coef[at + W * j]`` and add the constant part of its Hessian to ``nodal[to + W * j]``; ``once`` is
        1, or 0 for a repeated incidence, which must have no effect; ``data`` is for weak constraints."""

    @abstractmethod
    def sweep(self, model: Model) -> Any:
        """``(n, i, c, x, idx, coef, par, p, g, acc)``: for n rows from ``idx[i]`` and ``coef[c]``, add forces and
        Hessians of the W nodes of a block to ``acc``; the material's numbers start at ``par[p]``."""

    def paper_sweep(self, model: Model) -> Any:
        """The same with the paper's block, where that differs in form and not only by its numbers."""
        return self.sweep(model)

    @abstractmethod
    def energy(self, model: Model) -> Any:
        """``(m, i, x, X, idx, par, p, gx, gX, out, f) -> (energy [J], 0)`` of the first m of the W elements at
        ``idx[i]``; gx, gX and out are scratch, f is not used."""

    @abstractmethod
    def forces(self, model: Model) -> Any:
        """The same, with the forces on the elements' corners added to f; returns the sum of the norms of the
        elements' forces [N] and the number of inverted elements."""

    @abstractmethod
    def compound_pack(self) -> Any:
        """As :meth:`pack`, for compound nodes; ``data`` holds how much each corner moves with the compound.

        Such an incidence refers to all corners, as several may move, in their :attr:`order`.
        """

    @abstractmethod
    def compound_sweep(self, model: Model) -> Any:
        """As :meth:`sweep`, for compound nodes."""


class Term(NamedTuple):
    """An element kind with a material model: what kernels are specialised to."""

    kind: ElementKind
    model: Model


@leaf
def vec(g, j):
    """Vector at position j of a scratch array of 4-component vectors, the fourth zero."""
    return g[j] + g[j + uint64(3)], g[j + uint64(1)], g[j + uint64(2)]


@leaf
def wide_vec(g, j):
    """The same in float64."""
    a = vec(g, j)
    return np.float64(a[0]), np.float64(a[1]), np.float64(a[2])


@leaf
def gather(n, i, x, idx, g, to):
    """Copy n * W positions to ``g[to:]``; ``idx[i:]`` holds their places in x, which are multiples of 4."""
    for l_ in range(n * W):
        l = uint64(l_)
        p = uint64(idx[i + l])
        q = to + l * uint64(4)
        a = x[p]
        b = x[p + uint64(1)]
        c = x[p + uint64(2)]
        d = x[p + uint64(3)]
        g[q] = a
        g[q + uint64(1)] = b
        g[q + uint64(2)] = c
        g[q + uint64(3)] = d


@cache
def parameters(n: int) -> Any:
    """``(par, p) -> (par[p], ..., par[p + n - 1])``, as a tuple of scalars."""
    if n == 0:
        return inline(lambda par, p: ())
    before, last = parameters(n - 1), uint64(n - 1)
    return inline(lambda par, p: (*before(par, p), par[p + last]))


@inline
def add_outer(acc, l, h, v):
    """Add h v vᵀ to the Hessians (rows 3 to 8 of acc) of lane l."""
    u = scale(h, v)
    acc[uint64(3 * W) + l] += u[0] * v[0]
    acc[uint64(4 * W) + l] += u[0] * v[1]
    acc[uint64(5 * W) + l] += u[0] * v[2]
    acc[uint64(6 * W) + l] += u[1] * v[1]
    acc[uint64(7 * W) + l] += u[1] * v[2]
    acc[uint64(8 * W) + l] += u[2] * v[2]


@inline
def summed(out, m):
    """The sum of the first m numbers."""
    total = 0.0
    for l_ in range(m):
        total += out[uint64(l_)]
    return total


@inline
def spread(corners, m, i, idx, out, f):
    """Add the forces on the corners of the first m elements, vector by vector in out, to f at ``idx[i]``."""
    for l_ in range(m):
        l = uint64(l_)
        for a in range(corners):
            at, j = uint64(idx[i + uint64(W * a) + l]), uint64(3 * W * a) + l
            f[at] += out[j]
            f[at + uint64(1)] += out[j + uint64(W)]
            f[at + uint64(2)] += out[j + uint64(2 * W)]
