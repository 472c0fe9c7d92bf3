"""Constraint projection, XPBD's inner loop: one constraint after the other, colour by colour (Eqs. 24-26, section 10).

A vertex is four numbers, the fourth its inverse mass w [1/kg]: 0 where it is prescribed. With κ = Δt²/α, the stiffness
of a constraint times the square of the time step, the update of its multiplier λ, Eq. (26) with the sign of the
compliance term corrected, is::

    Δλ  = -(κ C + a λ) / (κ Σ_j w_j |∇_j C|² + a)        a = 1; PBD, the limit κ → ∞, has κ = 1 and a = 0
    x_j = x_j + w_j Δλ ∇_j C

The constraints of one element have the same vertices, hence the same colour, and are projected in turn by the same
thread; elements of one colour share no vertex.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numba import get_num_threads, uint64

from pbng.coloring import color_constraints
from pbng.dispatch import call, specialised
from pbng.elements.base import W, gather, parameters
from pbng.jit import inline
from pbng.linalg import add, combine, combine3, dot, scale, sub
from pbng.materials.base import ConstraintForm
from pbng.packing import aligned
from pbng.parallel import array, body, rows, run, scratch
from pbng.problem import ElementGroup, Problem

COEFFICIENTS = 7  # numbers an element: K, upper triangular, with F = [a b e] K, and its volume
LOST = 1e-6  # of Σ w |g|²: where gradients squared have become so small and no compliance helps, nothing is done
MULTIPLIERS = uint64(16 * W)  # where they are in scratch, after four vertices
zero, one, two, three = (uint64(j) for j in range(4))
_1, _2, _3, _4, _5, _6 = (uint64(W * j) for j in range(1, 7))
_Q, _R, _S = (uint64(4 * W * j) for j in range(1, 4))  # second, third, fourth vertex in the scratch array


class ElasticPass:
    """All constraints of all elements, laid out in blocks of W elements of one colour and one group.

    Args:
        problem: Its element groups; their materials must have constraints.
        place: New number of each vertex, (n_vert,).
        dt: Time step [s].
        compliant: False for PBD, which takes every stiffness for infinite.
        dtype: Precision of positions, coefficients and multipliers.

    Attributes:
        color: Colour (n_elem,) of the elements, numbered through the groups.
        start: First block of each colour, (n_color + 1,).
        blocks: For each block: function, place of the group's numbers, place in ``idx``, in ``coef``, in
            ``multipliers``, (n, 5).
        idx, coef, multipliers: Places of the corners in a flat position array, coefficients and λ [N m s²]; flat, lane
            fastest.
    """

    def __init__(self, problem: Problem, place: np.ndarray, dt: float, compliant: bool, dtype: Any) -> None:
        groups = problem.groups
        self.dtype = np.dtype(dtype)
        self.color = color_constraints([g.cells for g in groups], len(place))
        forms = [_form(g) for g in groups]
        projections = [
            project_element(f.functions, len(g.material.parameters()), g.kind.corners) for f, g in zip(forms, groups)
        ]
        self.functions = tuple(dict.fromkeys(projections))
        self.most = max(len(f.functions) for f in forms)
        numbers, first = _numbers(groups, dt, compliant)
        self.numbers = numbers.astype(self.dtype)
        places = [(4 * place[g.cells[:, g.kind.order]]).astype(np.uint32) for g in groups]
        frames = [_coefficients(g, problem.X).astype(self.dtype) for g in groups]
        blocks, idx, coef, color = [], [], [], []
        at = np.zeros(3, np.int64)
        for group, mine, c in self._runs(problem, place):
            size = W * np.array([groups[group].kind.corners, COEFFICIENTS, len(forms[group].functions)])
            row = np.empty((len(mine), 5), np.int64)
            row[:, 0] = self.functions.index(projections[group])
            row[:, 1] = first[group]
            row[:, 2:] = at + np.arange(len(mine))[:, None] * size
            at += len(mine) * size
            blocks.append(row)
            idx.append(places[group][mine].transpose(0, 2, 1).ravel())
            coef.append(frames[group][mine].transpose(0, 2, 1).ravel())
            color.append(np.full(len(mine), c))
        self.blocks = np.concatenate(blocks) if blocks else np.empty((0, 5), np.int64)
        self.start = np.cumsum(np.bincount(np.concatenate(color) + 1)) if color else np.zeros(1, np.int64)
        self.idx, self.coef = _joined(idx, np.uint32), _joined(coef, self.dtype)
        self.multipliers = aligned(int(at[2]), self.dtype)
        self.reset()

    def _runs(self, problem: Problem, place: np.ndarray) -> Iterator[tuple[int, np.ndarray, int]]:
        """By colour and group, elements that can move, in order of place: group, their numbers in it (n, W), colour.

        Lanes that are left over repeat an element of their own block: they read and write just what it does.
        """
        groups = problem.groups
        of = np.repeat(np.arange(len(groups)), [len(g.cells) for g in groups])
        number = np.concatenate([np.arange(len(g.cells)) for g in groups])
        near = np.concatenate([place[g.cells].min(1) for g in groups])
        held = np.concatenate([problem.fixed[g.cells].all(1) for g in groups])
        order = np.lexsort((near, of, self.color))
        order = order[~held[order]]
        cut = np.flatnonzero(np.diff(of[order]) | np.diff(self.color[order])) + 1
        for part in np.split(order, cut) if len(order) else []:
            lanes = np.concatenate([part, np.full(-len(part) % W, part[(len(part) - 1) // W * W])])
            yield int(of[part[0]]), number[lanes].reshape(-1, W), int(self.color[part[0]])

    def reset(self) -> None:
        """Set all multipliers to zero: a new time step."""
        self.multipliers[:] = 0

    def run(self, x: np.ndarray) -> None:
        """Project every constraint once; x flat (4 n_vert,), positions and inverse masses, changed in place."""
        arrays = x, self.blocks, self.idx, self.coef, self.multipliers, self.numbers
        colors = np.arange(len(self.start) - 1)
        # Several helpings a thread and colour, to even out, but not too small ones.
        grain = len(self.blocks) / max(len(colors), 1) / (8 * get_num_threads())
        kernel = specialised(make_project, self.functions, self.dtype, self.most)
        run(kernel, arrays, colors, self.start, int(min(max(grain, 4), 64)))


def _form(group: ElementGroup) -> ConstraintForm:
    form = group.material.constraints()
    assert form is not None, "the solver checks that"
    return form


def _joined(parts: list[np.ndarray], dtype: Any) -> np.ndarray:
    out = aligned(sum(p.size for p in parts), dtype)
    if parts:
        np.concatenate(parts, out=out)
    return out


def _numbers(groups: tuple[ElementGroup, ...], dt: float, compliant: bool) -> tuple[np.ndarray, list[int]]:
    """What kernels read of each group: a, κ/V of its constraints, parameters of its material; and where it starts."""
    rows, first = [], [0]
    for g in groups:
        stiffness = _form(g).stiffness
        kappa = [k * dt**2 if compliant else float(k > 0) for k in stiffness]
        rows.append([float(compliant), *kappa, *g.material.parameters()])
        first.append(first[-1] + len(rows[-1]))
    return np.array([v for r in rows for v in r]), first[:-1]


def _coefficients(group: ElementGroup, X: np.ndarray) -> np.ndarray:
    """K (six numbers) and the volume of each element (n, 7): its axes at rest are turned so that K is triangular."""
    x = X[group.cells[:, group.kind.order]]
    a, e = x[:, 1] - x[:, 0], x[:, -1] - x[:, 0]
    b = x[:, 2] - x[:, 0] if group.kind.corners == 4 else np.broadcast_to([0.0, 0.0, 1.0], a.shape)
    R = np.linalg.qr(np.stack([a, b, e], axis=2), mode="r")
    K = np.linalg.inv(R * np.sign(np.einsum("nii->ni", R))[:, :, None])
    return np.column_stack([K[:, [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]], group.kind.volume(X[group.cells])])


@cache
def project_element(functions: tuple[Any, ...], n_parameters: int, corners: int) -> Any:
    """``(i, c, l, p, x, idx, coef, multipliers, numbers, g, h)``: project the constraints of the W elements at
    ``idx[i]``, whose coefficients, multipliers and numbers start at c, l, p; g and h are scratch."""
    count, plane = len(functions), corners == 3
    stiffness, parameter = parameters(count), parameters(n_parameters)
    load, store = (_load_triangle, _store_triangle) if plane else (_load_tet, _store_tet)
    projected = _projected(functions, 0, plane)
    n_multiplier, own = W * count, uint64(count + 1)

    @inline
    def project(i, c, l, p, x, idx, coef, multipliers, numbers, g, h):
        a, kappa, m = numbers[p], stiffness(numbers, p + one), parameter(numbers, p + own)
        gather(corners, i, x, idx, g, zero)
        for n_ in range(n_multiplier):
            n = uint64(n_)
            h[MULTIPLIERS + n] = multipliers[l + n]
        for n_ in range(W):
            n = uint64(n_)
            k = c + n
            K = coef[k], coef[k + _1], coef[k + _2], coef[k + _3], coef[k + _4], coef[k + _5]
            v, w = load(g, n * uint64(4))
            store(h, n * uint64(4), projected(v, w, K, coef[k + _6], kappa, a, m, h, MULTIPLIERS + n), w)
        for n_ in range(n_multiplier):
            n = uint64(n_)
            multipliers[l + n] = h[MULTIPLIERS + n]
        scatter(corners, i, x, idx, h)

    return project


@cache
def _projected(functions: tuple[Any, ...], j: int, plane: bool) -> Any:
    """``(v, w, K, V, kappa, a, m, h, l) -> v``: the vertices after constraints j and further; h holds multipliers."""
    if j == len(functions):
        return inline(lambda v, w, K, V, kappa, a, m, h, l: v)
    constraint, after, at = functions[j], _projected(functions, j + 1, plane), uint64(j * W)
    edges, move = (_triangle_edges, _move_triangle) if plane else (_tet_edges, _move_tet)

    @inline
    def projected(v, w, K, V, kappa, a, m, h, l):
        p, q, r = edges(v)
        F = scale(K[0], p), combine(K[1], p, K[2], q), combine3(K[3], p, K[4], q, K[5], r)
        C, N = constraint(F, *m)
        ga = combine3(K[0], N[0], K[1], N[1], K[3], N[2])  # ∂C/∂p, and so on
        gb, ge = combine(K[2], N[1], K[4], N[2]), scale(K[5], N[2])
        moved, change = move(v, w, K, ga, gb, ge, kappa[j] * V, a, C, h[l + at])
        h[l + at] += change
        return after(moved, w, K, V, kappa, a, m, h, l)

    return projected


@inline
def _change(S, at_rest, kappa, a, C, multiplier):
    """Δλ, Eq. (26), with S = Σ_j w_j |∇_j C|²; ``at_rest`` is Σ_j w_j |g_j|²."""
    real = type(C)
    denominator = kappa * S + a
    lost = real(LOST) * kappa * at_rest >= denominator
    change = -(kappa * C + a * multiplier) / (real(1) if lost else denominator)
    return real(0) if lost else change


@inline
def _tet_edges(v):
    return sub(v[1], v[0]), sub(v[2], v[0]), sub(v[3], v[0])


@inline
def _triangle_edges(v):
    p, o = sub(v[1], v[0]), type(v[0][0])(0)
    return p, (o, o, type(o)(1)), sub(v[2], v[0])


@inline
def _move_tet(v, w, K, ga, gb, ge, kappa, a, C, multiplier):
    """The vertices after the update, Eqs. (24)-(25), and Δλ; the first vertex has the gradient -(ga + gb + ge)."""
    real = type(C)
    gp = add(add(ga, gb), ge)
    S = w[0] * dot(gp, gp) + w[1] * dot(ga, ga) + w[2] * dot(gb, gb) + w[3] * dot(ge, ge)
    sum_a, sum_b, sum_e = (K[0], K[1], K[3]), (real(0), K[2], K[4]), (real(0), real(0), K[5])
    sum_p = add(add(sum_a, sum_b), sum_e)
    at_rest = w[0] * dot(sum_p, sum_p) + w[1] * dot(sum_a, sum_a) + w[2] * dot(sum_b, sum_b) + w[3] * dot(sum_e, sum_e)
    d = _change(S, at_rest, kappa, a, C, multiplier)
    moved = (
        combine(real(1), v[0], -w[0] * d, gp),
        combine(real(1), v[1], w[1] * d, ga),
        combine(real(1), v[2], w[2] * d, gb),
        combine(real(1), v[3], w[3] * d, ge),
    )
    return moved, d


@inline
def _move_triangle(v, w, K, ga, gb, ge, kappa, a, C, multiplier):
    """The same for a triangle, whose second edge is along z and stays."""
    real = type(C)
    gp = add(ga, ge)
    S = w[0] * dot(gp, gp) + w[1] * dot(ga, ga) + w[2] * dot(ge, ge)
    sum_a, sum_e = (K[0], K[1], K[3]), (real(0), real(0), K[5])
    sum_p = add(sum_a, sum_e)
    at_rest = w[0] * dot(sum_p, sum_p) + w[1] * dot(sum_a, sum_a) + w[2] * dot(sum_e, sum_e)
    d = _change(S, at_rest, kappa, a, C, multiplier)
    moved = (
        combine(real(1), v[0], -w[0] * d, gp),
        combine(real(1), v[1], w[1] * d, ga),
        combine(real(1), v[2], w[2] * d, ge),
    )
    return moved, d


@inline
def _point(g, j):
    return g[j], g[j + one], g[j + two]


@inline
def _load_tet(g, j):
    """Vertices of one lane, and their inverse masses."""
    v = _point(g, j), _point(g, _Q + j), _point(g, _R + j), _point(g, _S + j)
    return v, (g[j + three], g[_Q + j + three], g[_R + j + three], g[_S + j + three])


@inline
def _load_triangle(g, j):
    v = _point(g, j), _point(g, _Q + j), _point(g, _R + j)
    return v, (g[j + three], g[_Q + j + three], g[_R + j + three])


@inline
def _put(h, j, v, w):
    h[j], h[j + one], h[j + two], h[j + three] = v[0], v[1], v[2], w


@inline
def _store_triangle(h, j, v, w):
    _put(h, j, v[0], w[0])
    _put(h, _Q + j, v[1], w[1])
    _put(h, _R + j, v[2], w[2])


@inline
def _store_tet(h, j, v, w):
    _store_triangle(h, j, v, w)
    _put(h, _S + j, v[3], w[3])


@inline
def scatter(n, i, x, idx, h):
    """Copy n * W vertices back: the reverse of :func:`pbng.elements.base.gather`."""
    for l_ in range(n * W):
        l = uint64(l_)
        p, q = uint64(idx[i + l]), l * uint64(4)
        a, b, c, d = h[q], h[q + one], h[q + two], h[q + three]
        x[p] = a
        x[p + one] = b
        x[p + two] = c
        x[p + three] = d


def make_project(key: str, dtype: np.dtype, most: int) -> Any:
    """Body of :meth:`ElasticPass.run` for blocks low .. high of a colour; elements have up to ``most`` constraints."""
    real = dtype.type
    n_vertex, n_all = 16 * W, (16 + most) * W

    @body
    def project(arguments, low, high):
        x, blocks = array(arguments, 0, real), rows(arguments, 1, 5, np.int64)
        idx, coef = array(arguments, 2, np.uint32), array(arguments, 3, real)
        multipliers, numbers = array(arguments, 4, real), array(arguments, 5, real)
        g, h = scratch(n_vertex, real), scratch(n_all, real)
        for b in range(low, high):
            k, p, i, c, l = blocks[b]
            call(key, k, (uint64(i), uint64(c), uint64(l), uint64(p), x, idx, coef, multipliers, numbers, g, h))

    return project
