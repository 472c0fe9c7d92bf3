"""How queries go down a tree of boxes, near nodes first, and what they pass by: pieces of the bodies of queries.

Near queries begin together: what lies within reach of their common box is found once, and each goes on from there.

``tree`` is (nodes, boxes, ways, whether these count), as of :class:`pbng.contact.bvh.BoxTree`. ``who`` asks: the lowest
and the highest corner of a box, and those of a box about its ways.
"""

from math import sqrt

import numpy as np

from pbng.contact.bvh import DEPTH
from pbng.jit import inline

STARTS = 48  # nodes from which these go on by themselves, at most
CORNERS = 12 * STARTS
LARGEST = 1e300  # squared distance above all that count, but not infinite as of what is out of reach
STACK = DEPTH + STARTS  # nodes that wait their turn
ROUNDING = 1e-14  # distances that differ by less, relative to themselves or to the size of the tree, are the same


@inline
def gap2(boxes, i, low, high):
    """Squared distance of box i from the box between two corners."""
    dx = max(boxes[i, 0] - high[0], 0.0, low[0] - boxes[i, 3])
    dy = max(boxes[i, 1] - high[1], 0.0, low[1] - boxes[i, 4])
    dz = max(boxes[i, 2] - high[2], 0.0, low[2] - boxes[i, 5])
    return dx * dx + dy * dy + dz * dz


@inline
def lower_corner(a, b):
    """Lowest corner of the box about points a and b."""
    return min(a[0], b[0]), min(a[1], b[1]), min(a[2], b[2])


@inline
def upper_corner(a, b):
    """Highest corner of the box about points a and b."""
    return max(a[0], b[0]), max(a[1], b[1]), max(a[2], b[2])


@inline
def squared(a):
    """a², of what is worth naming only once."""
    return a * a


@inline
def slack_of(boxes):
    """A distance above the rounding errors of distances to what is in the tree [m]."""
    return ROUNDING * (abs(boxes[0, 3] - boxes[0, 0]) + abs(boxes[0, 4] - boxes[0, 1]) + abs(boxes[0, 5] - boxes[0, 2]))


@inline
def same_as(d2, slack):
    """Between which squared distances another one is taken for the same as ``d2``."""
    d = sqrt(d2)
    least, most = max(d * (1.0 - ROUNDING) - slack, 0.0), d * (1.0 + ROUNDING) + slack
    return least * least, most * most


@inline
def seek(start, high, v, e):
    """The first of the spans of v, sorted and apart, that does not end before place e, or the first of the next."""
    e, before = np.int32(e), np.int32(0)
    for r in range(start[v], start[v + 1]):
        before += np.int32(high[r] <= e)
    return start[v] + before


@inline
def go_on(low, high, r, end, e):
    """The first of spans r .. end that does not end before place e, which follows the last, and whether e is in it."""
    if r < end and high[r] <= e:
        r += 1
    return r, r < end and low[r] <= e


@inline
def common_ground(reach, own, n_group, grouped, first, last):
    """How far queries first .. last look at most, below 0 if none is asked, and the row of their group, -1 for many."""
    farthest, row = -1.0, own[first] * n_group if grouped else 0
    for q in range(first, last):
        if reach[q] >= 0.0:
            farthest = max(farthest, reach[q])
            row = row if not grouped or own[q] * n_group == row else -1
    return farthest, row


@inline
def limit2(tree, i, who, reach):
    """Squared distance up to which node i is looked at: the farther, the more its ways differ from who asks."""
    _, _, ways, moving = tree
    _, _, low, high = who
    if not moving:
        return reach * reach
    dx = max(high[0] - ways[i, 0], ways[i, 3] - low[0])
    dy = max(high[1] - ways[i, 1], ways[i, 4] - low[1])
    dz = max(high[2] - ways[i, 2], ways[i, 5] - low[2])
    return squared(reach + sqrt(dx * dx + dy * dy + dz * dz))


@inline
def find_starts(tree, meets, row, who, reach, starts, corners, stack):
    """Nodes with all that is within reach, and how many; a row of -1 is that of many groups.

    Without a bound there is only the root: from there near nodes come first. ``corners`` are those of their boxes and
    of their ways, one coordinate after the other.
    """
    nodes, boxes, ways, moving = tree
    n, top = 0, 1
    stack[0] = 0
    while top > 0:
        top -= 1
        i = stack[top]
        if gap2(boxes, i, who[0], who[1]) > limit2(tree, i, who, reach):
            continue
        if row >= 0 and nodes[i, 3] >= 0 and not meets[row + nodes[i, 3]]:
            continue
        child = nodes[i, 0]
        if child < 0 or n + top + 2 > STARTS or reach == np.inf:
            starts[n] = i
            for j in range(6):
                corners[j * STARTS + n] = boxes[i, j]
                if moving:
                    corners[(6 + j) * STARTS + n] = ways[i, j]
            n += 1
        else:
            stack[top], stack[top + 1] = child + 1, child
            top += 2
    return n


@inline
def begin(moving, starts, corners, n, who, reach, stack, gaps):
    """Put those starts on the stack, in their order, that are within reach; how many.

    Written out what :func:`gap2` and :func:`limit2` say, for one coordinate after the other, as vectors need it.
    """
    low, high, w_low, w_high = who
    for s in range(n):
        dx = max(corners[s] - high[0], 0.0, low[0] - corners[3 * STARTS + s])
        dy = max(corners[STARTS + s] - high[1], 0.0, low[1] - corners[4 * STARTS + s])
        dz = max(corners[2 * STARTS + s] - high[2], 0.0, low[2] - corners[5 * STARTS + s])
        gap, limit = dx * dx + dy * dy + dz * dz, reach * reach
        if moving:
            dx = max(w_high[0] - corners[6 * STARTS + s], corners[9 * STARTS + s] - w_low[0])
            dy = max(w_high[1] - corners[7 * STARTS + s], corners[10 * STARTS + s] - w_low[1])
            dz = max(w_high[2] - corners[8 * STARTS + s], corners[11 * STARTS + s] - w_low[2])
            limit = squared(reach + sqrt(dx * dx + dy * dy + dz * dz))
        gaps[s] = gap if gap <= limit else np.inf
    top = 0
    for s in range(n):
        gap = gaps[s]
        stack[top], gaps[top] = starts[s], gap
        top += 1 if gap < np.inf else 0
    return top


@inline
def leave_out(nodes, start, first, past, v, stack, gaps, top):
    """Take starts off the stack that lie wholly in one of the spans of v; how many are left."""
    r, end, left = start[v], start[v + 1], 0
    for s in range(top):  # which are in the order of the tree, as spans are
        i, gap = stack[s], gaps[s]
        while r < end and past[r] <= nodes[i, 1]:
            r += 1
        if not (r < end and first[r] <= nodes[i, 1] and past[r] >= nodes[i, 2]):
            stack[left], gaps[left] = i, gap
            left += 1
    return left


@inline
def put_nearest_on_top(stack, gaps, top):
    """Of what is on the stack."""
    nearest = 0
    for s in range(1, top):
        nearest = s if gaps[s] < gaps[nearest] else nearest
    if top > 0:
        stack[top - 1], stack[nearest] = stack[nearest], stack[top - 1]
        gaps[top - 1], gaps[nearest] = gaps[nearest], gaps[top - 1]


@inline
def next_leaf(tree, meets, row, who, reach, within, stack, gaps, top):
    """The next leaf on the way, -1 for none, and how many nodes are left on the stack with their squared distances.

    Of nodes that the groups of ``row`` meet, near ones first; none that is farther away than √within, or out of reach.
    """
    nodes, boxes, _, _ = tree
    while top > 0:
        top -= 1
        i, gap = stack[top], gaps[top]
        while gap <= within and (nodes[i, 3] < 0 or meets[row + nodes[i, 3]]):
            child = nodes[i, 0]
            if child < 0:
                return i, top
            near, far = gap2(boxes, child, who[0], who[1]), gap2(boxes, child + 1, who[0], who[1])
            near = near if near <= limit2(tree, child, who, reach) else np.inf
            far = far if far <= limit2(tree, child + 1, who, reach) else np.inf
            i, child = child, child + 1
            if far < near:
                i, child, near, far = child, i, far, near
            if far <= within:
                stack[top], gaps[top] = child, far
                top += 1
            gap = near
    return -1, top
