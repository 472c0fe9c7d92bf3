"""Linear simplices with constant F: tetrahedra, and plane-strain triangles as tetrahedra with one edge along z.

An incidence is a node x with the other corners p, q, r of one of its elements; a = q - p, b = r - p, e = x - p are its
edges, ordered so that det [a b e] > 0 at rest. For an isotropic material the axes of the rest state may be turned
freely, so they are turned for each incidence such that the gradient of x's shape function points along the third
(the *node frame*): then only the third columns of P and of cof F enter the node's force and Hessian. Six numbers
k give F = [a b e] K with K upper triangular, and a seventh is w = V |g|.
"""

import math
from functools import cache
from typing import Any

import numpy as np
from numba import uint64

from pbng.elements.base import AHEAD, ElementKind, W, add_outer, gather, parameters, spread, summed, vec, wide_vec
from pbng.jit import inline
from pbng.linalg import add, cofactor, combine, combine3, cross, det, dot, mat_vec, scale, sub
from pbng.materials.base import Model

NODE_FRAME, REST_FRAME, COMPOUND = 7, 10, 13  # coefficients of an incidence, of that of a compound node
zero = uint64(0)
_1, _2, _3, _4, _5, _6 = (uint64(W * j) for j in range(1, 7))
_7, _8, _9, _10, _11 = (uint64(W * j) for j in range(7, 12))
_12, _13 = uint64(12 * W), uint64(13 * W)
_Q, _R, _S = (uint64(4 * W * j) for j in range(1, 4))  # second, third, fourth vertex in the scratch array


@inline
def gradients(a, b, e, share):
    """Gradients ∂N/∂X of the shape functions of q, r, x from the rest edges, and the volume ``share * det [a b e]``."""
    n = cross(a, b)
    J = dot(n, e)
    d = type(J)(1) / J
    return scale(d, cross(b, e)), scale(d, cross(e, a)), scale(d, n), share * J


@inline
def node_frame(a, b, e, share):
    """The seven coefficients (k0 .. k5, w) of an incidence from its rest edges."""
    one = type(share)(1)
    la = math.sqrt(dot(a, a))
    u = scale(one / la, a)
    bu = dot(b, u)
    t = sub(b, scale(bu, u))
    lt = math.sqrt(dot(t, t))
    v = scale(one / lt, t)
    h = dot(e, cross(u, v))
    k0 = one / la
    k2 = one / lt
    k1 = -bu * k0 * k2
    k5 = one / h
    k3 = -(dot(e, u) * k0 + dot(e, v) * k1) * k5
    k4 = -dot(e, v) * k2 * k5
    return k0, k1, k2, k3, k4, k5, share * la * lt  # V k5, without the cancelling h


@inline
def deformation(a, b, e, k):
    """F = ∂x/∂X in the node frame from the current edges."""
    return scale(k[0], a), combine(k[1], a, k[2], b), combine3(k[3], a, k[4], b, k[5], e)


@inline
def outer_sum(a, ga, b, gb, e, ge):
    """F = a ⊗ ga + b ⊗ gb + e ⊗ ge, the deformation gradient in the axes of the rest state."""
    return (
        combine3(ga[0], a, gb[0], b, ge[0], e),
        combine3(ga[1], a, gb[1], b, ge[1], e),
        combine3(ga[2], a, gb[2], b, ge[2], e),
    )


@inline
def corner(X, i):
    """Vertex i of flat rest positions."""
    return X[3 * i], X[3 * i + 1], X[3 * i + 2]


class Simplex(ElementKind):
    """What tetrahedra and plane-strain triangles share; ``plane`` says which."""

    plane = False

    def width(self, isotropic: bool) -> int:
        return NODE_FRAME if isotropic else REST_FRAME

    @property
    def share(self) -> float:
        """Volume over det [a b e]."""
        return 1 / 2 if self.plane else 1 / 6

    def gradients(self, X: np.ndarray) -> np.ndarray:
        others = np.linalg.inv(self._rest_edges(X)).transpose(0, 2, 1)[:, : self.others]
        return np.concatenate([-others.sum(1, keepdims=True), others], axis=1)

    def volume(self, X: np.ndarray) -> np.ndarray:
        a, b, e = self._rest_edges(X).transpose(1, 2, 0)
        return self.share * np.abs((np.cross(a, b, axis=0) * e).sum(0))

    def _rest_edges(self, X: np.ndarray) -> np.ndarray:
        edges = X[:, 1:] - X[:, :1]
        if self.plane:
            edges = np.concatenate([edges, np.broadcast_to([[[0.0, 0.0, 1.0]]], (len(X), 1, 3))], axis=1)
        return edges

    @cache
    def edges(self, load: Any) -> Any:
        """``(g, j, x) -> a, b, e`` from the scratch array at lane position j and the last corner x."""
        if self.plane:

            @inline
            def edges(g, j, x):
                p, one = load(g, j), type(x[0])(1)
                return sub(load(g, _Q + j), p), (one - one, one - one, one), sub(x, p)
        else:

            @inline
            def edges(g, j, x):
                p = load(g, j)
                return sub(load(g, _Q + j), p), sub(load(g, _R + j), p), sub(x, p)

        return edges

    @cache
    def pack(self, isotropic: bool) -> Any:
        plane, share = self.plane, self.share

        @inline
        def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
            p = corner(X, cells[e, opposite[a, 0]])
            ea = sub(corner(X, cells[e, opposite[a, 1]]), p)
            eb = (0.0, 0.0, 1.0) if plane else sub(corner(X, cells[e, opposite[a, -1]]), p)
            ee = sub(corner(X, cells[e, a]), p)
            ga, gb, ge, V = gradients(ea, eb, ee, once * share)
            k = node_frame(ea, eb, ee, once * share) if isotropic else (*ga, *gb, *ge, V)
            for j in range(len(k)):
                coef[at + W * j] = k[j]
            s = V * block[0] * dot(ge, ge)
            t = V * block[2]  # the second term too is constant if the block is taken at rest
            nodal[to] += s + t * ge[0] * ge[0]
            nodal[to + W] += t * ge[0] * ge[1]
            nodal[to + 2 * W] += t * ge[0] * ge[2]
            nodal[to + 3 * W] += s + t * ge[1] * ge[1]
            nodal[to + 4 * W] += t * ge[1] * ge[2]
            nodal[to + 5 * W] += s + t * ge[2] * ge[2]

        return pack

    @cache
    def sweep(self, model: Model) -> Any:
        others = self.others
        incidence = self._incidence(model)
        numbers = parameters(model.n_parameters)
        idx_row, coef_row, positions = (
            uint64(W * others),
            uint64(W * self.width(model.isotropic)),
            uint64(4 * W * others),
        )

        @inline
        def sweep(n, i, c, x, idx, coef, par, p, g, acc):
            b = par[p]
            m = numbers(par, p + uint64(1))
            for first in range(0, n, AHEAD):
                rows = min(AHEAD, n - first)
                gather(rows * others, i, x, idx, g, zero)
                i += uint64(rows) * idx_row
                for row in range(rows):
                    here = uint64(row) * positions
                    for l_ in range(W):
                        l = uint64(l_)
                        xl = (acc[_9 + l], acc[_10 + l], acc[_11 + l])
                        f, h, v = incidence(g, here + l * uint64(4), xl, coef, c + l, b, m)
                        acc[l] -= f[0]
                        acc[_1 + l] -= f[1]
                        acc[_2 + l] -= f[2]
                        add_outer(acc, l, h, v)
                    c += coef_row

        return sweep

    @cache
    def _incidence(self, model: Model) -> Any:
        """``(g, j, x, coef, c, b, m) -> V P g, h, v``: a node's negative force and the term h v vᵀ of its Hessian."""
        edges, stress = self.edges(vec), model.stress
        if model.isotropic:

            @inline
            def incidence(g, j, x, coef, c, b, m):
                a, d, e = edges(g, j, x)
                k = (coef[c], coef[c + _1], coef[c + _2], coef[c + _3], coef[c + _4], coef[c + _5])
                w = coef[c + _6]
                F = deformation(a, d, e, k)
                return scale(w, stress(F, *m)[2]), b * w * k[5], cofactor(F)[2]
        else:

            @inline
            def incidence(g, j, x, coef, c, b, m):
                a, d, e = edges(g, j, x)
                ga = coef[c], coef[c + _1], coef[c + _2]
                gd = coef[c + _3], coef[c + _4], coef[c + _5]
                ge = coef[c + _6], coef[c + _7], coef[c + _8]
                V = coef[c + _9]
                F = outer_sum(a, ga, d, gd, e, ge)
                return scale(V, mat_vec(stress(F, *m), ge)), b * V, mat_vec(cofactor(F), ge)

        return incidence

    @cache
    def _element(self) -> Any:
        """``(gx, gX, j) -> F, ga, gb, ge, V`` in float64 from the current and the rest positions in scratch arrays."""
        edges, rest_edges, share = self.edges(wide_vec), self.edges(vec), self.share
        last = _R if self.plane else _S

        @inline
        def element(gx, gX, j):
            A, B, E = rest_edges(gX, j, vec(gX, last + j))
            ga, gb, ge, V = gradients(A, B, E, share)
            a, b, e = edges(gx, j, wide_vec(gx, last + j))
            return outer_sum(a, ga, b, gb, e, ge), ga, gb, ge, V

        return element

    @cache
    def energy(self, model: Model) -> Any:
        corners, element, psi = self.corners, self._element(), model.energy
        numbers = parameters(model.n_parameters)

        @inline
        def energy(m, i, x, X, idx, par, p, gx, gX, out, f):
            number = numbers(par, p + uint64(1))
            gather(corners, i, x, idx, gx, zero)
            gather(corners, i, X, idx, gX, zero)
            for l_ in range(W):
                l = uint64(l_)
                F, _ga, _gb, _ge, V = element(gx, gX, l * uint64(4))
                out[l] = V * psi(F, *number)
            return summed(out, m), 0

        return energy

    @cache
    def forces(self, model: Model) -> Any:
        corners, element, stress, plane = self.corners, self._element(), model.stress, self.plane
        numbers = parameters(model.n_parameters)
        last = _6 if plane else _9  # where the force on the last corner goes

        @inline
        def forces(m, i, x, X, idx, par, p, gx, gX, out, f):
            number = numbers(par, p + uint64(1))
            gather(corners, i, x, idx, gx, zero)
            gather(corners, i, X, idx, gX, zero)
            for l_ in range(W):
                l = uint64(l_)
                F, ga, gb, ge, V = element(gx, gX, l * uint64(4))
                P = stress(F, *number)
                fa = scale(-V, mat_vec(P, ga))
                fb = scale(-V, mat_vec(P, gb))
                fe = scale(-V, mat_vec(P, ge))
                fp = scale(-1.0, add(fa, fe)) if plane else scale(-1.0, add(add(fa, fb), fe))
                norm2 = dot(fp, fp) + dot(fa, fa) + dot(fe, fe)
                out[l], out[_1 + l], out[_2 + l] = fp
                out[_3 + l], out[_4 + l], out[_5 + l] = fa
                if not plane:
                    out[_6 + l], out[_7 + l], out[_8 + l] = fb
                    norm2 += dot(fb, fb)
                out[last + l], out[last + _1 + l], out[last + _2 + l] = fe
                out[_12 + l] = math.sqrt(norm2)
                out[_13 + l] = det(F)
            spread(corners, m, i, idx, out, f)
            inverted = 0
            for l_ in range(m):
                inverted += out[_13 + uint64(l_)] < 0.0
            return summed(out[_12:], m), inverted

        return forces

    # How a compound node sees it: F changes by d ⊗ g with g = Σ β_v ∂N_v/∂X. Coefficients are the shape gradients, g
    # and the volume.

    compound_width = COMPOUND

    @cache
    def compound_pack(self) -> Any:
        plane, share = self.plane, self.share

        @inline
        def pack(X, cells, e, a, opposite, once, coef, at, block, data, nodal, to):
            last = opposite.shape[1] - 1
            p = corner(X, cells[e, opposite[0, 0]])
            ea = sub(corner(X, cells[e, opposite[0, 1]]), p)
            eb = (0.0, 0.0, 1.0) if plane else sub(corner(X, cells[e, opposite[0, 2]]), p)
            ee = sub(corner(X, cells[e, opposite[0, last]]), p)
            ga, gb, ge, V = gradients(ea, eb, ee, once * share)
            bp, ba, be = data[e, opposite[0, 0]], data[e, opposite[0, 1]], data[e, opposite[0, last]]
            bb = 0.0 if plane else data[e, opposite[0, 2]]
            for k in range(3):
                through = 0.0 if plane else gb[k]  # along z nothing varies in the plane
                g = ba * ga[k] + bb * through + be * ge[k] - bp * (ga[k] + through + ge[k])
                coef[at + W * k], coef[at + W * (3 + k)], coef[at + W * (6 + k)] = ga[k], gb[k], ge[k]
                coef[at + W * (9 + k)] = g
            coef[at + W * 12] = V
            g0, g1, g2 = coef[at + W * 9], coef[at + W * 10], coef[at + W * 11]
            s, t = V * block[0] * (g0 * g0 + g1 * g1 + g2 * g2), V * block[2]
            nodal[to] += s + t * g0 * g0
            nodal[to + W] += t * g0 * g1
            nodal[to + 2 * W] += t * g0 * g2
            nodal[to + 3 * W] += s + t * g1 * g1
            nodal[to + 4 * W] += t * g1 * g2
            nodal[to + 5 * W] += s + t * g2 * g2

        return pack

    @cache
    def compound_sweep(self, model: Model) -> Any:
        edges, numbers, stress, n_corner = self.edges(vec), parameters(model.n_parameters), model.stress, self.corners
        last, row = uint64(4 * W * (n_corner - 1)), uint64(W * n_corner)

        @inline
        def sweep(n, i, c, x, idx, coef, par, p, g, acc):
            b = par[p]
            m = numbers(par, p + uint64(1))
            for _ in range(n):
                gather(n_corner, i, x, idx, g, zero)
                for l_ in range(W):
                    l = uint64(l_)
                    j, k = l * uint64(4), c + l
                    a, d, e = edges(g, j, vec(g, last + j))
                    ga = coef[k], coef[k + _1], coef[k + _2]
                    gd = coef[k + _3], coef[k + _4], coef[k + _5]
                    ge = coef[k + _6], coef[k + _7], coef[k + _8]
                    shape = coef[k + _9], coef[k + _10], coef[k + _11]
                    V = coef[k + _12]
                    F = outer_sum(a, ga, d, gd, e, ge)
                    f, v = scale(V, mat_vec(stress(F, *m), shape)), mat_vec(cofactor(F), shape)
                    acc[l] -= f[0]
                    acc[_1 + l] -= f[1]
                    acc[_2 + l] -= f[2]
                    add_outer(acc, l, b * V, v)
                i += row
                c += uint64(COMPOUND * W)

        return sweep


class Tet(Simplex):
    """Linear tetrahedra."""

    name = "tet"
    corners = 4
    others = 3
    opposite = np.array([[1, 3, 2], [0, 2, 3], [0, 3, 1], [0, 1, 2]])


class PlaneTriangle(Simplex):
    """Linear triangles in plane strain: F₃₃ = 1, and z never moves."""

    name = "triangle"
    corners = 3
    others = 2
    opposite = np.array([[2, 1], [0, 2], [1, 0]])
    plane = True
    across = 1.0


TET, PLANE_TRIANGLE = Tet(), PlaneTriangle()
