"""How queries go down a tree of boxes, near nodes first, and what they pass by: pieces of the bodies of queries.

Near queries begin together: what lies within reach of their common box is found once, and each goes on from there.
"""

from math import sqrt

import numpy as np

from pbng.contact.bvh import DEPTH
from pbng.jit import inline

STARTS = 48  # nodes from which these go on by themselves, at most
STACK = DEPTH + STARTS  # nodes that wait their turn
SLOTS = 256  # for the primitives that one query leaves out; where they would fill more than half, they are looked up
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
def is_listed(start, ids, v, t):
    """Whether t is among the numbers of v."""
    low, high = start[v], start[v + 1]
    while low < high:
        middle = (low + high) >> 1
        if ids[middle] < t:
            low = middle + 1
        else:
            high = middle
    return low < start[v + 1] and ids[low] == t


@inline
def note(noted, query, t):
    """Note that a query, numbered from 1, leaves out t: in the next free slot, as a table of hashes does."""
    i = (t * 40503) & (SLOTS - 1)
    while noted[i] >> 32 == query:
        i = (i + 1) & (SLOTS - 1)
    noted[i] = query << 32 | t


@inline
def is_noted(noted, query, t):
    """Whether the query leaves out t."""
    i = (t * 40503) & (SLOTS - 1)
    while noted[i] >> 32 == query and noted[i] != query << 32 | t:
        i = (i + 1) & (SLOTS - 1)
    return noted[i] >> 32 == query


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
def find_starts(nodes, boxes, meets, row, low, high, reach, starts, stack):
    """Nodes with all that is no farther than ``reach`` from a box, and how many; a row of -1 is that of many groups.

    Without a bound there is only the root: from there near nodes come first.
    """
    if reach == np.inf:
        starts[0] = 0
        return 1
    within = reach * reach
    n, top = 0, 1
    stack[0] = 0
    while top > 0:
        top -= 1
        i = stack[top]
        if gap2(boxes, i, low, high) > within or (row >= 0 and nodes[i, 3] >= 0 and not meets[row + nodes[i, 3]]):
            continue
        child = nodes[i, 0]
        if child < 0 or n + top + 2 > STARTS:
            starts[n] = i
            n += 1
        else:
            stack[top], stack[top + 1] = child + 1, child
            top += 2
    return n


@inline
def begin(boxes, starts, n, low, high, within, stack, gaps):
    """Put those starts on the stack that are no farther than √within from a box, near ones on top; how many."""
    top = 0
    for s in range(n):
        gap = gap2(boxes, starts[s], low, high)
        if gap <= within:
            j = top
            while j > 0 and gaps[j - 1] < gap:
                stack[j], gaps[j] = stack[j - 1], gaps[j - 1]
                j -= 1
            stack[j], gaps[j] = starts[s], gap
            top += 1
    return top


@inline
def next_leaf(nodes, boxes, meets, row, low, high, within, stack, gaps, top):
    """The next leaf on the way, -1 for none, and how many nodes are left on the stack with their squared distances.

    Of nodes that the groups of ``row`` meet, near ones first; none whose box is farther than √within from a box.
    """
    while top > 0:
        top -= 1
        i, gap = stack[top], gaps[top]
        while gap <= within and (nodes[i, 3] < 0 or meets[row + nodes[i, 3]]):
            child = nodes[i, 0]
            if child < 0:
                return i, top
            near, far = gap2(boxes, child, low, high), gap2(boxes, child + 1, low, high)
            i, child = child, child + 1
            if far < near:
                i, child, near, far = child, i, far, near
            if far <= within:
                stack[top], gaps[top] = child, far
                top += 1
            gap = near
    return -1, top
