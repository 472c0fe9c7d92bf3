"""Hinges: the bending of cloth at the edge between two triangles, Eqs. (35)-(37).

Corners 0, 1 are the ends of the edge e, 2 and 3 the wings, such that (0, 1, 2) and (1, 0, 3) are the triangles, with
normals n₁ and n₂. Exchanging 0 with 1 and 2 with 3 leaves the angle θ as it is, so that every node can be taken for
corner 0 or corner 3. With p = n₁/|n₁|², q = n₂/|n₂|², ê = e/|e|,

    ∂θ/∂x₀ = (x₁-x₂)·ê p + (x₁-x₃)·ê q,    ∂θ/∂x₃ = -|e| q.

The node's block is (37) with what (37) leaves out, w (a g gᵀ + |M| c² I): M is the moment, g the gradient of θ and c²
bounds its second derivatives. For a wing c is 1/height exactly; for an end of the edge c² is the sum of 1/height² over
the two triangles, the heights being the node's over the edges opposite to it (docs/method.md).

Where a triangle has shrunk to a hundredth of its rest area, gradients stop growing, so that slivers stay finite.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.elements.base import AHEAD, ElementKind, W, add_outer, gather, parameters, spread, summed, vec, wide_vec
from pbng.elements.simplex import corner
from pbng.jit import inline
from pbng.linalg import arctan2, combine, cross, dot, scale, sub
from pbng.materials.base import Model

COEFFICIENTS, COMPOUND = 4, 7  # of an incidence: whether corner 0, w, θ₀, least |n|²; of a compound's: β, w, θ₀, least
LEAST = 1e-2  # of the rest area: below, gradients stop growing
zero = uint64(0)
_1, _2, _3, _4, _5, _6 = (uint64(W * j) for j in range(1, 7))
_8, _9, _10, _11, _12 = (uint64(W * j) for j in range(8, 13))
_Q, _R, _S = (uint64(4 * W * j) for j in range(1, 4))  # second to fourth vertex in the scratch array


@inline
def fold(x0, x1, x2, x3, least):
    """θ [rad], the edge e, |e|, ê, a = x₂ - x₀, b = x₃ - x₀, and p and q with |n|² no smaller than ``least``."""
    real = type(x0[0])
    e, a, b = sub(x1, x0), sub(x2, x0), sub(x3, x0)
    n1, n2 = cross(e, a), cross(b, e)
    length = math.sqrt(dot(e, e))
    angle = arctan2(-length * dot(n1, b), dot(n1, n2))
    p = scale(real(1) / max(dot(n1, n1), least), n1)
    q = scale(real(1) / max(dot(n2, n2), least), n2)
    return angle, e, length, scale(real(1) / max(length, real(1e-18)), e), a, b, p, q


@inline
def gradients(e, length, unit, a, b, p, q):
    """∂θ/∂x₀ to ∂θ/∂x₃ from what :func:`fold` returns."""
    return (
        combine(dot(sub(e, a), unit), p, dot(sub(e, b), unit), q),
        combine(dot(a, unit), p, dot(b, unit), q),
        scale(-length, p),
        scale(-length, q),
    )


@inline
def turned(angle, angle0):
    """θ - θ₀, taken into [-π, π]: so the energy does not jump where θ does."""
    real = type(angle)
    d = angle - real(angle0)
    d = d - real(2 * math.pi) if d > real(math.pi) else d
    return d + real(2 * math.pi) if d < -real(math.pi) else d


@inline
def rest(x0, x1, x2, x3):
    """θ, 3 |e|²/A with A the area of both triangles, and the least |n|² of :func:`fold`, at rest."""
    real = type(x0[0])
    e, a, b = sub(x1, x0), sub(x2, x0), sub(x3, x0)
    n1, n2 = cross(e, a), cross(b, e)
    e2, first, second = dot(e, e), dot(n1, n1), dot(n2, n2)
    angle = arctan2(-math.sqrt(e2) * dot(n1, b), dot(n1, n2))
    return angle, real(6) * e2 / (math.sqrt(first) + math.sqrt(second)), real(LEAST * LEAST) * min(first, second)


@inline
def add_bound(acc, l, h):
    """Add h I to the Hessians of lane l."""
    acc[_3 + l] += h
    acc[_6 + l] += h
    acc[_8 + l] += h


@inline
def add_nothing(acc, l, h):
    """What the paper's block (37) adds besides g gᵀ."""


def least_squares(X: np.ndarray) -> np.ndarray:
    """The least |n|² of :func:`fold`, (n,), of corners at rest, (n, 4, 3)."""
    return LEAST**2 * np.minimum(*((n**2).sum(1) for n in normals(X)))


def normals(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """n₁ and n₂ (n, 3) of corners (n, 4, 3)."""
    e, a, b = (x[:, k] - x[:, 0] for k in (1, 2, 3))
    return np.cross(e, a), np.cross(b, e)


class Hinge(ElementKind):
    """Hinges, with Eq. (35)'s weight or the weight that does not depend on the mesh, and θ₀ zero or at rest."""

    name = "hinge"
    corners = 4
    others = 3
    opposite = np.array([[1, 2, 3], [0, 3, 2], [0, 3, 1], [1, 2, 0]])
    solid = False

    def __init__(self, weighted: bool, curved: bool) -> None:
        self.weighted, self.curved = weighted, curved

    @property
    def order(self) -> list[int]:
        return [0, 1, 2, 3]

    def width(self, isotropic: bool) -> int:
        return COEFFICIENTS

    def gradients(self, X: np.ndarray) -> np.ndarray:
        e, a, b = (X[:, k] - X[:, 0] for k in (1, 2, 3))
        n1, n2 = normals(X)
        length = np.linalg.norm(e, axis=1, keepdims=True)
        p, q = n1 / (n1**2).sum(1, keepdims=True), n2 / (n2**2).sum(1, keepdims=True)
        s2, s3 = ((v * e).sum(1, keepdims=True) / length**2 for v in (a, b))
        return np.stack(
            [length * ((1 - s2) * p + (1 - s3) * q), length * (s2 * p + s3 * q), -length * p, -length * q], axis=1
        )

    def volume(self, X: np.ndarray) -> np.ndarray:
        if not self.weighted:
            return np.ones(len(X))
        area = sum(np.linalg.norm(n, axis=1) for n in normals(X))
        return 6 * ((X[:, 1] - X[:, 0]) ** 2).sum(1) / area

    @cache
    def _rest(self) -> Any:
        """``(x0, x1, x2, x3) -> θ₀, w, least`` of corners at rest."""
        weighted, curved = self.weighted, self.curved

        @inline
        def numbers(x0, x1, x2, x3):
            angle, weight, least = rest(x0, x1, x2, x3)
            return angle if curved else 0.0, weight if weighted else 1.0, least

        return numbers

    @cache
    def pack(self, isotropic: bool) -> Any:
        at_rest = self._rest()

        @inline
        def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
            angle, weight, least = at_rest(
                corner(X, cells[e, 0]), corner(X, cells[e, 1]), corner(X, cells[e, 2]), corner(X, cells[e, 3])
            )
            coef[at] = 1.0 if a < 2 else 0.0
            coef[at + W], coef[at + 2 * W], coef[at + 3 * W] = once * weight, angle, least

        return pack

    @cache
    def sweep(self, model: Model) -> Any:
        return self._sweep(model, add_bound)

    @cache
    def paper_sweep(self, model: Model) -> Any:
        return self._sweep(model, add_nothing)

    def _sweep(self, model: Model, add_further: Any) -> Any:
        moment, numbers = model.stress, parameters(model.n_parameters)

        @inline
        def sweep(n, i, c, x, idx, coef, par, p, g, acc):
            k = par[p]
            m = numbers(par, p + uint64(1))
            for first in range(0, n, AHEAD):
                rows = min(AHEAD, n - first)
                gather(rows * 3, i, x, idx, g, zero)
                i += uint64(rows * 3 * W)
                for row in range(rows):
                    here = uint64(row * 12 * W)
                    for l_ in range(W):
                        l = uint64(l_)
                        j, at = here + l * uint64(4), c + l
                        node, last = (acc[_9 + l], acc[_10 + l], acc[_11 + l]), vec(g, j + _R)
                        is_end, w = coef[at], coef[at + _1]
                        is_wing = type(is_end)(1) - is_end
                        x0, x3 = combine(is_end, node, is_wing, last), combine(is_end, last, is_wing, node)
                        x1, x2 = vec(g, j), vec(g, j + _Q)
                        angle, e, length, unit, a, b, u, v = fold(x0, x1, x2, x3, coef[at + _3])
                        d, f = sub(e, a), sub(e, b)
                        gradient = combine(is_end * dot(d, unit), u, is_end * dot(f, unit) - is_wing * length, v)
                        c2 = is_end * (dot(d, d) * dot(u, u) + dot(f, f) * dot(v, v))
                        c2 += is_wing * length * length * dot(v, v)
                        M = w * moment(turned(angle, coef[at + _2]), *m)
                        acc[l] -= M * gradient[0]
                        acc[_1 + l] -= M * gradient[1]
                        acc[_2 + l] -= M * gradient[2]
                        add_outer(acc, l, w * k, gradient)
                        add_further(acc, l, abs(M) * c2)
                    c += uint64(COEFFICIENTS * W)

        return sweep

    @cache
    def energy(self, model: Model) -> Any:
        at_rest, psi, numbers = self._rest(), model.energy, parameters(model.n_parameters)

        @inline
        def energy(m, i, x, X, idx, par, p, gx, gX, out, f):
            number = numbers(par, p + uint64(1))
            gather(4, i, x, idx, gx, zero)
            gather(4, i, X, idx, gX, zero)
            for l_ in range(W):
                l = uint64(l_)
                j = l * uint64(4)
                angle0, weight, least = at_rest(vec(gX, j), vec(gX, j + _Q), vec(gX, j + _R), vec(gX, j + _S))
                x0, x1, x2, x3 = wide_vec(gx, j), wide_vec(gx, j + _Q), wide_vec(gx, j + _R), wide_vec(gx, j + _S)
                out[l] = weight * psi(turned(fold(x0, x1, x2, x3, least)[0], angle0), *number)
            return summed(out, m), 0

        return energy

    @cache
    def forces(self, model: Model) -> Any:
        at_rest, moment, numbers = self._rest(), model.stress, parameters(model.n_parameters)

        @inline
        def forces(m, i, x, X, idx, par, p, gx, gX, out, f):
            number = numbers(par, p + uint64(1))
            gather(4, i, x, idx, gx, zero)
            gather(4, i, X, idx, gX, zero)
            for l_ in range(W):
                l = uint64(l_)
                j = l * uint64(4)
                angle0, weight, least = at_rest(vec(gX, j), vec(gX, j + _Q), vec(gX, j + _R), vec(gX, j + _S))
                x0, x1, x2, x3 = wide_vec(gx, j), wide_vec(gx, j + _Q), wide_vec(gx, j + _R), wide_vec(gx, j + _S)
                angle, e, length, unit, a, b, u, v = fold(x0, x1, x2, x3, least)
                M = -weight * moment(turned(angle, angle0), *number)
                g0, g1, g2, g3 = gradients(e, length, unit, a, b, u, v)
                f0, f1, f2, f3 = scale(M, g0), scale(M, g1), scale(M, g2), scale(M, g3)
                out[l], out[_1 + l], out[_2 + l] = f0
                out[_3 + l], out[_4 + l], out[_5 + l] = f1
                out[_6 + l], out[uint64(7 * W) + l], out[_8 + l] = f2
                out[_9 + l], out[_10 + l], out[_11 + l] = f3
                out[_12 + l] = math.sqrt(dot(f0, f0) + dot(f1, f1) + dot(f2, f2) + dot(f3, f3))
            spread(4, m, i, idx, out, f)
            return summed(out[_12:], m), 0

        return forces

    # How a compound node sees it: g = Σ β_v ∂θ/∂x_v and c = Σ |β_v| c_v. A translation changes nothing, so the mean of
    # the β is taken off beforehand.

    compound_width = COMPOUND

    @cache
    def compound_pack(self) -> Any:
        at_rest = self._rest()

        @inline
        def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
            angle, weight, least = at_rest(
                corner(X, cells[e, 0]), corner(X, cells[e, 1]), corner(X, cells[e, 2]), corner(X, cells[e, 3])
            )
            mean = 0.25 * (data[e, 0] + data[e, 1] + data[e, 2] + data[e, 3])
            for j in range(4):
                coef[at + W * j] = data[e, j] - mean
            coef[at + 4 * W], coef[at + 5 * W], coef[at + 6 * W] = once * weight, angle, least

        return pack

    @cache
    def compound_sweep(self, model: Model) -> Any:
        moment, numbers = model.stress, parameters(model.n_parameters)

        @inline
        def sweep(n, i, c, x, idx, coef, par, p, g, acc):
            k = par[p]
            m = numbers(par, p + uint64(1))
            for _ in range(n):
                gather(4, i, x, idx, g, zero)
                for l_ in range(W):
                    l = uint64(l_)
                    j, at = l * uint64(4), c + l
                    b0, b1, b2, b3 = coef[at], coef[at + _1], coef[at + _2], coef[at + _3]
                    x0, x1, x2, x3 = vec(g, j), vec(g, j + _Q), vec(g, j + _R), vec(g, j + _S)
                    angle, e, length, unit, a, b, u, v = fold(x0, x1, x2, x3, coef[at + _6])
                    d, f = sub(e, a), sub(e, b)
                    along_u = b0 * dot(d, unit) + b1 * dot(a, unit) - b2 * length
                    along_v = b0 * dot(f, unit) + b1 * dot(b, unit) - b3 * length
                    gradient = combine(along_u, u, along_v, v)
                    u2, v2 = dot(u, u), dot(v, v)
                    bound = abs(b0) * math.sqrt(dot(d, d) * u2 + dot(f, f) * v2)
                    bound += abs(b1) * math.sqrt(dot(a, a) * u2 + dot(b, b) * v2)
                    bound += length * (abs(b2) * math.sqrt(u2) + abs(b3) * math.sqrt(v2))
                    w = coef[at + _4]
                    M = w * moment(turned(angle, coef[at + _5]), *m)
                    acc[l] -= M * gradient[0]
                    acc[_1 + l] -= M * gradient[1]
                    acc[_2 + l] -= M * gradient[2]
                    add_outer(acc, l, w * k, gradient)
                    add_bound(acc, l, abs(M) * bound * bound)
                i += uint64(4 * W)
                c += uint64(COMPOUND * W)

        return sweep


HINGES = {(weighted, curved): Hinge(weighted, curved) for weighted in (False, True) for curved in (False, True)}
