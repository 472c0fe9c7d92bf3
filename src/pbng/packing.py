"""The packed layout of a problem: what the sweep reads (SELL-16, lanes are nodes of one colour).

Free vertices are renumbered: by colour, inside a colour by the groups they touch, along a Morton curve, and in windows
by falling valence; 16 consecutive ones form a block. A *row* holds one incidence for each lane of a block; the rows of
a block that belong to one element group form a *segment*. Lanes that run out of incidences repeat one with weight
zero. Prescribed vertices come after all blocks.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from pbng.assembly import group_parameters
from pbng.dispatch import call, specialised
from pbng.elements.base import W
from pbng.jit import FLAGS, inline, serial
from pbng.problem import Problem

NODAL = 9  # numbers a node: external force (3), constant part of its Hessian (6, upper triangle)
WINDOW = 512  # nodes within which valence is sorted: enough to fill blocks evenly, few enough to keep locality


@dataclass(frozen=True, eq=False)
class Packed:
    """A problem in packed layout, of one precision; see the module.

    Attributes:
        slot: New number of each vertex, (n_vert,).
        origin: What positions are stored relative to [m], (3,): zero but for scenes far from the origin.
        n_slot, n_block: Vertices and padding in all; blocks of W of them that are free.
        color_start: First block of each colour, (n_color + 1,).
        seg_start: First segment of each block, (n_block + 1,).
        seg: For each segment: term, place of the parameters, rows, place in ``idx``, place in ``coef``, (n, 5).
        idx, coef: The rows: places of the other corners in a flat position array, and coefficients; flat, lane fastest.
        nodal: External force and constant Hessian of the nodes, flat (n_block, NODAL, W).
        parameters: Numbers of the groups' materials, flat.
    """

    slot: np.ndarray
    origin: np.ndarray
    n_slot: int
    n_block: int
    color_start: np.ndarray
    seg_start: np.ndarray
    seg: np.ndarray
    idx: np.ndarray
    coef: np.ndarray
    nodal: np.ndarray
    parameters: np.ndarray
    terms: tuple

    @property
    def dtype(self) -> np.dtype:
        return self.coef.dtype

    @property
    def n_free(self) -> int:
        """Length of the part of a flat position array that belongs to blocks."""
        return 4 * W * self.n_block

    @property
    def nbytes(self) -> int:
        """Memory [bytes] of the layout."""
        return sum(a.nbytes for a in (self.seg, self.idx, self.coef, self.nodal, self.slot))

    def stiffness(self) -> np.ndarray:
        """Constant part of each node's stiffness [N/m], a third of its Hessian's trace, (n_block * W,)."""
        nodal = self.nodal.reshape(-1, NODAL, W)
        real = np.zeros((self.n_block, W), bool)
        real.ravel()[self.slot[self.slot < self.n_block * W]] = True
        return np.where(real, nodal[:, 3] + nodal[:, 6] + nodal[:, 8], 0.0).ravel() / 3

    def pack(self, x: np.ndarray) -> np.ndarray:
        """Positions (n_vert, 3) as the flat array (4 n_slot,) that kernels read."""
        out = aligned(4 * self.n_slot, self.dtype)
        out[:] = 0
        out.reshape(-1, 4)[self.slot, :3] = x - self.origin if self.origin.any() else x
        return out

    def unpack(self, x: np.ndarray) -> np.ndarray:
        """Positions (n_vert, 3) of a flat array, in float64 where the origin is not zero."""
        found = x.reshape(-1, 4)[self.slot, :3]
        return found + self.origin if self.origin.any() else found


def aligned(n: int, dtype) -> np.ndarray:
    """An uninitialised array (n,) that begins at a cache line."""
    size = np.dtype(dtype).itemsize
    raw = np.empty(n * size + 64, np.uint8)
    shift = -raw.ctypes.data % 64
    return raw[shift : shift + n * size].view(dtype)


def pack_problem(problem: Problem, dtype=np.float32, paper_block: bool = False) -> Packed:
    """Colour a problem and lay it out; ``paper_block`` takes Eq. (32) in place of the majorising block."""
    color_start, node = _numbering(problem)
    n_block = len(node) // W
    slot = np.full(problem.n_vert, -1, np.int64)
    real = node >= 0
    slot[node[real]] = np.flatnonzero(real)
    rest = np.flatnonzero(slot < 0)
    slot[rest] = len(node) + np.arange(len(rest))
    owner = np.where(real, node, np.repeat(node[::W], W))  # padding lanes repeat the first of their block

    terms = tuple(dict.fromkeys(g.term for g in problem.groups))
    parameters, first = group_parameters(problem.groups, dtype, paper_block)
    frames = [(g.kind, g.term.model.isotropic) for g in problem.groups]
    packers = tuple(dict.fromkeys(kind.pack(isotropic) for kind, isotropic in frames))
    # For each group: term, parameters, indices a row, coefficients a row, packer.
    table = np.array(
        [
            (terms.index(g.term), p, W * kind.others, W * kind.width(iso), packers.index(kind.pack(iso)))
            for g, p, (kind, iso) in zip(problem.groups, first, frames)
        ]
    )
    blocks = [g.block(paper_block) for g in problem.groups]
    numbers = np.array([(b.a, b.b, b.b if b.at_rest else 0.0) for b in blocks])

    nodal = np.zeros((n_block, NODAL, W))
    nodal[:, :3] = problem.f_ext[owner].reshape(n_block, W, 3).transpose(0, 2, 1) * real.reshape(n_block, 1, W)
    kinds = list(problem.incidences)
    sizes, spans = [], []
    idx_at = coef_at = 0
    for kind in kinds:
        cells, group, start, incident = problem.incidences[kind]
        seg_start, seg = _segments(owner, start, incident, group, kind.corners, table)
        seg[:, 3] += idx_at
        seg[:, 4] += coef_at
        if len(seg):
            idx_at = int(seg[-1, 3] + seg[-1, 2] * table[seg[-1, 5], 2])
            coef_at = int(seg[-1, 4] + seg[-1, 2] * table[seg[-1, 5], 3])
        spans.append((seg_start, seg))
        sizes.append(len(seg))
    idx, coef = aligned(idx_at, np.uint32), aligned(coef_at, dtype)
    fill = specialised(make_fill, packers)
    for kind, (seg_start, seg) in zip(kinds, spans):
        cells, group, start, incident = problem.incidences[kind]
        fill(
            owner, real, slot, problem.X.ravel(), seg_start, seg, cells, group, start, incident, kind.opposite,
            table, numbers, idx, coef, nodal.reshape(-1),
        )  # fmt: skip
    seg_start, seg = spans[0] if len(spans) == 1 else _merge(spans)
    seg = seg[:, :5].copy()
    return Packed(
        slot, _origin(problem.X), len(node) + len(rest), n_block, color_start, seg_start, seg, idx, coef,
        _padded(nodal, real).astype(dtype).ravel(), parameters, terms,
    )  # fmt: skip


def _origin(X: np.ndarray) -> np.ndarray:
    """The middle of a scene that lies far away, where float32 positions would lose too many digits, else zero."""
    low, high = X.min(0), X.max(0)
    far = np.abs(X).max() > 4 * (high - low).max()
    return (low + high) / 2 if far else np.zeros(3)


def _numbering(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """First block of each colour, and the vertex in each place of the blocks, -1 in padding lanes."""
    color = problem.color
    valence = np.zeros(problem.n_vert, np.int64)
    touched = np.zeros(problem.n_vert, np.int64)  # a hash of the groups a vertex touches
    for n, g in enumerate(problem.groups):
        mine = np.bincount(g.cells.ravel(), minlength=problem.n_vert)
        valence += mine
        touched += (mine > 0) * (1 << min(n, 62))
    order = problem.order
    node, color_start = [], [0]
    for c in range(color.max() + 1 if len(color) else 0):
        mine = order[color[order] == c]
        if len(problem.groups) > 1:
            mine = mine[np.argsort(touched[mine], kind="stable")]
        window = np.arange(len(mine)) // WINDOW
        mine = mine[np.lexsort((-valence[mine], touched[mine] if len(problem.groups) > 1 else window, window))]
        node.append(np.concatenate([mine, np.full(-len(mine) % W, -1)]))
        color_start.append(color_start[-1] + len(node[-1]) // W)
    return np.array(color_start), np.concatenate(node) if node else np.empty(0, np.int64)


def _padded(nodal: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Give padding lanes the unit matrix for a Hessian: they are solved like the others, and never move."""
    lanes = ~real.reshape(-1, 1, W)
    unit = np.array([0, 0, 0, 1, 0, 0, 1, 0, 1.0]).reshape(1, NODAL, 1)
    return np.where(lanes, unit, nodal)


def _merge(spans: list) -> tuple[np.ndarray, np.ndarray]:
    """Segments of several kinds, brought together block by block."""
    block = np.concatenate([np.repeat(np.arange(len(s) - 1), np.diff(s)) for s, _ in spans])
    seg = np.concatenate([s for _, s in spans])[np.argsort(block, kind="stable")]
    counts = sum(np.diff(s) for s, _ in spans)
    return np.concatenate([[0], np.cumsum(counts)]), seg


@serial
def _segments(owner, start, incident, group, corners, table):
    """For each block the groups its nodes touch and the rows each needs: seg_start and (n, 6) segments.

    The incidences of a node come in order of their group, so the lanes are merged like sorted lists.
    """
    n_block = owner.size // 16
    seg_start = np.zeros(n_block + 1, np.int64)
    seg = np.empty((0, 6), np.int64)
    at = np.empty(16, np.int64)
    for write in range(2):
        if write:
            seg = np.zeros((seg_start[n_block], 6), np.int64)
        n, idx_at, coef_at = 0, 0, 0
        for b in range(n_block):
            for lane in range(16):
                at[lane] = start[owner[16 * b + lane]]
            while True:
                low = 2**31
                for lane in range(16):
                    if at[lane] < start[owner[16 * b + lane] + 1]:
                        low = min(low, group[incident[at[lane]] // corners])
                if low == 2**31:
                    break
                rows = 0
                for lane in range(16):
                    first, end = at[lane], start[owner[16 * b + lane] + 1]
                    while at[lane] < end and group[incident[at[lane]] // corners] == low:
                        at[lane] += 1
                    rows = max(rows, at[lane] - first)
                if write:
                    seg[n, 0] = table[low, 0]
                    seg[n, 1] = table[low, 1]
                    seg[n, 2] = rows
                    seg[n, 3] = idx_at
                    seg[n, 4] = coef_at
                    seg[n, 5] = low
                    idx_at += rows * table[low, 2]
                    coef_at += rows * table[low, 3]
                n += 1
            if not write:
                seg_start[b + 1] = n
    return seg_start, seg


def make_fill(key: str):
    """Kernel that writes the rows of one element kind."""

    @njit(parallel=True, cache=True, **FLAGS)
    def fill(
        owner, real, slot, X, seg_start, seg, cells, group, start, incident, opposite, table, numbers, idx, coef, nodal
    ):
        corners, others = cells.shape[1], opposite.shape[1]
        for b in prange(seg_start.size - 1):
            for lane in range(W):
                place = W * b + lane
                v = owner[place]
                k = start[v]
                for s in range(seg_start[b], seg_start[b + 1]):
                    which = seg[s, 5]
                    i, c = seg[s, 3] + lane, seg[s, 4] + lane
                    end = k
                    while end < start[v + 1] and group[incident[end] // corners] == which:
                        end += 1
                    n = end - k
                    for row in range(seg[s, 2]):
                        # A lane without an incidence in this segment borrows the first of the segment's group.
                        q = (
                            incident[k + min(row, n - 1)]
                            if n
                            else _borrowed(owner, b, start, incident, group, corners, which)
                        )
                        e, a = q // corners, q % corners
                        for j in range(others):
                            idx[i + W * j] = 4 * slot[cells[e, opposite[a, j]]]
                        once = 1.0 if row < n and real[place] else 0.0
                        at = (NODAL * b + 3) * W + lane
                        call(key, table[which, 4], (X, cells, e, a, opposite, once, coef, c, numbers[which], nodal, at))
                        i += table[which, 2]
                        c += table[which, 3]
                    k = end

    return fill


@inline
def _borrowed(owner, b, start, incident, group, corners, which):
    for lane in range(16):
        v = owner[16 * b + lane]
        for k in range(start[v], start[v + 1]):
            if group[incident[k] // corners] == which:
                return incident[k]
    return incident[0]
