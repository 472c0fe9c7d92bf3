"""The packed layout of a problem: what the sweep reads (SELL-16, lanes are nodes of one colour).

Free vertices are renumbered: by colour, inside a colour by the groups they touch, along a Morton curve, and in windows
by falling valence; 16 consecutive ones form a block. A *row* holds one incidence for each lane of a block; the rows of
a block that belong to one element group form a *segment*. Lanes that run out of incidences repeat one with weight
zero. Blocks of compound nodes follow; their "positions" are movements, zero between sweeps. Prescribed vertices come
after all blocks, and the targets of weak constraints after them.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from pbng.compounds import Compounds
from pbng.dispatch import call, specialised
from pbng.elements.base import W
from pbng.families import Family, Groups, families
from pbng.jit import inline, serial
from pbng.parallel import array, body, each, rows
from pbng.problem import Problem

NODAL = 9  # numbers a node: external force (3), constant part of its Hessian (6, upper triangle)
WINDOW = 512  # nodes within which valence is sorted: enough to fill blocks evenly, few enough to keep locality


@dataclass(frozen=True, eq=False)
class Packed:
    """A problem in packed layout, of one precision; see the module.

    Attributes:
        slot: New number of each vertex, (n_vert,).
        origin: What positions are stored relative to [m], (3,): zero but for scenes far from the origin.
        n_slot, n_block: Length of position arrays; blocks of W free vertices.
        color_start: First block of each colour, the first past the last included.
        seg_start: First segment of each block, (n_block + 1,).
        seg: For each segment: term, place of the parameters, rows, place in ``idx``, place in ``coef``, (n, 5).
        idx, coef: The rows: places of the other corners in a flat position array, and coefficients; flat, lane fastest.
        nodal: External force and constant Hessian of the nodes, flat (n_block, NODAL, W).
        parameters: Numbers of the groups' materials, flat.
        functions: What sweeps the segments of each term.
        stiffness: Constant part of each node's elastic stiffness [N/m], a third of its Hessian's trace, (n_block * W,).
        weak_stiffness: The same of weak constraints.
        n_target: Number of targets, the last slots.
        n_color: Colours of vertices; those that follow are of compound nodes.
        carried: For each of these the places of the vertices that it moves, of the compounds, and the shares.
        layout: What lays out further blocks of the same nodes.
        places: Number of each vertex, and then of each target.
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
    functions: tuple
    stiffness: np.ndarray
    weak_stiffness: np.ndarray
    n_target: int
    n_color: int
    carried: tuple
    layout: "Layout"
    places: np.ndarray

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

    def pack(self, x: np.ndarray, targets: np.ndarray | None = None) -> np.ndarray:
        """Positions (n_vert, 3) and targets (n_target, 3) as the flat array (4 n_slot,) that kernels read."""
        out = aligned(4 * self.n_slot, self.dtype)
        out[:] = 0
        places = out.reshape(-1, 4)[:, :3]
        places[self.slot] = x - self.origin if self.origin.any() else x
        if targets is not None and len(targets):
            places[self.n_slot - self.n_target :] = targets - self.origin
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


class Layout:
    """What the nodes of a problem see, ready to be laid out for any choice of nodes.

    Args:
        problem: What is laid out.
        dtype: Precision of the rows.
        paper_block: Take Eq. (32) in place of the majorising block.
        compounds: Nodes besides the vertices, numbered on from them.
    """

    def __init__(self, problem: Problem, dtype: Any, paper_block: bool, compounds: Compounds | None) -> None:
        self.problem, self.dtype = problem, np.dtype(dtype)
        self.groups = Groups(problem, dtype, paper_block, compounds is not None)
        self.families = families(problem, compounds)
        self.f_ext = problem.f_ext
        if compounds:
            self.f_ext = np.concatenate([self.f_ext, compounds.beta @ self.f_ext])
        self.valence = np.zeros(problem.n_vert, np.int64)
        self.touched = np.zeros(problem.n_vert, np.int64)  # a hash of the groups a vertex touches
        for n, cells in enumerate([g.cells for g in problem.groups] + [w.vertices for w in problem.weak]):
            mine = np.bincount(cells.ravel(), minlength=problem.n_vert)
            self.valence += mine
            self.touched += (mine > 0) * (1 << min(n, 62))

    def numbering(self, order: np.ndarray, color: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First block of each colour, and the vertex in each place of the blocks, -1 in padding lanes.

        ``order`` (n,) lists the vertices, and ``color`` (n,) their colours.
        """
        touched = self.touched[order] if len(self.groups.table) > 1 else np.zeros(len(order))
        by_color = np.lexsort((touched, color))
        order, color, touched = order[by_color], color[by_color], touched[by_color]
        place = np.arange(len(order)) - np.searchsorted(color, color)  # within the colour
        order = order[np.lexsort((-self.valence[order], touched, place // WINDOW, color))]
        color_start = np.concatenate([[0], np.cumsum(-(-np.bincount(color) // W))])
        node = np.full(W * color_start[-1], -1)
        node[W * color_start[color] + place] = order
        return color_start, node

    def rows(self, node: np.ndarray, places: np.ndarray, n_block: int) -> "Rows":
        """The rows of blocks of nodes (n,), -1 in padding lanes, the first ``n_block`` of which are of vertices.

        ``places`` are the numbers of vertices and then targets in position arrays.
        """
        real = node >= 0
        owner = np.where(real, node, np.repeat(node[::W], W))  # padding lanes repeat the first of their block
        spans, n_idx, n_coef = _layout(self.families, owner, self.groups.table)
        idx, coef = aligned(n_idx, np.uint32), aligned(n_coef, self.dtype)
        nodal = np.zeros((len(node) // W, NODAL, W))
        nodal[:, :3] = self.f_ext[owner].reshape(-1, W, 3).transpose(0, 2, 1) * real.reshape(-1, 1, W)
        stiffness = []
        for elastic in (True, False):
            for family, span in zip(self.families, spans):
                if family.elastic == elastic:
                    _fill(family, span, self.problem.X, owner, real, places, self.groups, idx, coef, nodal)
            stiffness.append((nodal[:n_block, 3] + nodal[:n_block, 6] + nodal[:n_block, 8]).ravel() / 3)
        seg_start, seg = spans[0] if len(spans) == 1 else _merge(spans)
        constant = _padded(nodal, real).astype(self.dtype).ravel()
        return Rows(seg_start, seg[:, :5].copy(), idx, coef, constant, stiffness[0], stiffness[1] - stiffness[0])


class Rows(NamedTuple):
    """What :meth:`Layout.rows` makes; see :class:`Packed`."""

    seg_start: np.ndarray
    seg: np.ndarray
    idx: np.ndarray
    coef: np.ndarray
    nodal: np.ndarray
    stiffness: np.ndarray
    weak_stiffness: np.ndarray


def pack_problem(problem: Problem, dtype: Any = np.float32, paper_block: bool = False) -> Packed:
    """Colour a problem and lay it out; ``paper_block`` takes Eq. (32) in place of the majorising block."""
    compounds = Compounds(problem) if problem.weak else None
    compounds = compounds if compounds and compounds.n else None
    layout = Layout(problem, dtype, paper_block, compounds)
    free = problem.order[problem.color[problem.order] >= 0]
    color_start, node = layout.numbering(free, problem.color[free])
    n_color, n_block = len(color_start) - 1, len(node) // W
    if compounds:
        node, color_start = _with_compounds(problem, compounds, node, color_start)
    real = node >= 0
    place = np.full(len(layout.f_ext), -1, np.int64)  # of vertices, then of compounds
    place[node[real]] = np.flatnonzero(real)
    rest = np.flatnonzero(place < 0)
    place[rest] = len(node) + np.arange(len(rest))
    slot = place[: problem.n_vert].copy()
    n_slot = len(node) + len(rest) + problem.n_target
    places = np.concatenate([slot, np.arange(n_slot - problem.n_target, n_slot)])
    rows = layout.rows(node, places, n_block)
    return Packed(
        slot, origin_of(problem.X), n_slot, n_block, color_start, *rows[:5],
        layout.groups.parameters, layout.groups.functions, rows.stiffness, rows.weak_stiffness, problem.n_target,
        n_color, _carried(compounds, place, color_start[n_color:], np.dtype(dtype)) if compounds else (),
        layout, places,
    )  # fmt: skip


def _with_compounds(problem: Problem, compounds: Compounds, node: np.ndarray, color_start: np.ndarray):
    """The places of vertices and, behind them, of compounds, numbered on from the vertices; first blocks of colours."""
    nodes, starts = [node], color_start.tolist()
    for c in range(compounds.color.max() + 1):
        mine = problem.n_vert + np.flatnonzero(compounds.color == c)
        nodes.append(np.concatenate([mine, np.full(-len(mine) % W, -1)]))
        starts.append(starts[-1] + len(nodes[-1]) // W)
    return np.concatenate(nodes), np.array(starts)


def _carried(compounds: Compounds, place: np.ndarray, color_start: np.ndarray, dtype: np.dtype) -> tuple:
    """For each colour of compounds: places of the vertices it moves, of the compounds, and the shares (k, 1)."""
    member = compounds.beta.tocoo()
    n_vert = compounds.beta.shape[1]
    to, source = place[member.col], place[n_vert + member.row]
    color = np.searchsorted(W * color_start, source, side="right") - 1
    return tuple(
        (to[color == c], source[color == c], member.data[color == c, None].astype(dtype))
        for c in range(len(color_start) - 1)
    )


def _layout(seen: list[Family], owner: np.ndarray, table: np.ndarray) -> tuple[list, int, int]:
    """For each family the segments as :func:`_segments` gives them, and the lengths of ``idx`` and ``coef``."""
    spans = []
    n_idx = n_coef = 0
    for f in seen:
        seg_start, seg = _segments(owner, f.start, f.incident, f.group, f.corners, table)
        seg[:, 3] += n_idx
        seg[:, 4] += n_coef
        if len(seg):
            n_idx = int(seg[-1, 3] + seg[-1, 2] * table[seg[-1, 5], 2])
            n_coef = int(seg[-1, 4] + seg[-1, 2] * table[seg[-1, 5], 3])
        spans.append((seg_start, seg))
    return spans, n_idx, n_coef


def _fill(f: Family, span, X, owner, real, places, groups: Groups, idx, coef, nodal) -> None:
    """Write the rows of a family, and add what is constant of its Hessians to ``nodal``."""
    sizes = np.array([f.corners, f.opposite.shape[1], f.cells.shape[1], f.data.shape[1]])
    arrays = (
        owner, real, places, X, *span, np.ascontiguousarray(f.cells), f.group, f.start, f.incident,
        np.ascontiguousarray(f.opposite), groups.table, f.packer, groups.numbers, np.ascontiguousarray(f.data),
        idx, coef, nodal, sizes,
    )  # fmt: skip
    each(specialised(make_fill, f.packers, coef.dtype), arrays, len(span[0]) - 1, grain=64)


def origin_of(X: np.ndarray) -> np.ndarray:
    """The middle of a scene that lies far away, where float32 positions would lose too many digits, else zero."""
    low, high = X.min(0), X.max(0)
    far = np.abs(X).max() > 4 * (high - low).max()
    return (low + high) / 2 if far else np.zeros(3)


def _padded(nodal: np.ndarray, real: np.ndarray) -> np.ndarray:
    """Give padding lanes the unit matrix for a Hessian: they are solved like the others, and never move."""
    lanes = ~real.reshape(-1, 1, W)
    unit = np.array([0, 0, 0, 1, 0, 0, 1, 0, 1.0]).reshape(1, NODAL, 1)
    return np.where(lanes, unit, nodal)


def _merge(spans: list) -> tuple[np.ndarray, np.ndarray]:
    """Segments of several kinds, brought together block by block."""
    counts = np.array([s[1:] - s[:-1] for s, _ in spans])
    block = np.repeat(np.tile(np.arange(counts.shape[1]), len(counts)), counts.ravel())
    seg = np.concatenate([s for _, s in spans])[np.argsort(block, kind="stable")]
    return np.concatenate([[0], np.cumsum(counts.sum(0))]), seg


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


def make_fill(key: str, dtype: np.dtype):
    """Body that writes the rows of one coupling for blocks low .. high."""
    real_type = dtype.type

    @body
    def fill(arguments, low, high):
        sizes = array(arguments, 18, np.int64)
        corners, others = sizes[0], sizes[1]
        owner, real = array(arguments, 0, np.int64), array(arguments, 1, np.bool_)
        places, X = array(arguments, 2, np.int64), array(arguments, 3, np.float64)
        seg_start, seg = array(arguments, 4, np.int64), rows(arguments, 5, 6, np.int64)
        cells, group = rows(arguments, 6, sizes[2], np.int32), array(arguments, 7, np.int32)
        start, incident = array(arguments, 8, np.int64), array(arguments, 9, np.int32)
        opposite, table = rows(arguments, 10, others, np.int64), rows(arguments, 11, 4, np.int64)
        packer, numbers = array(arguments, 12, np.int64), rows(arguments, 13, 3, np.float64)
        data, idx = rows(arguments, 14, sizes[3], np.float64), array(arguments, 15, np.uint32)
        coef, nodal = array(arguments, 16, real_type), array(arguments, 17, np.float64)
        for b in range(low, high):
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
                            idx[i + W * j] = 4 * places[cells[e, opposite[a, j]]]
                        once = 1.0 if row < n and real[place] else 0.0
                        at = (NODAL * b + 3) * W + lane
                        block = numbers[which]
                        call(key, packer[which], (X, cells, e, a, opposite, once, coef, c, block, data, nodal, at))
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
