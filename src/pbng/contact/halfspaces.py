"""Half-spaces {x: n·x >= level} in which vertices have to stay, and the nearest point of all those of one vertex.

That point is x + Σ p n with p >= 0, and p > 0 only for half-spaces whose planes it lies on; three with independent
normals are enough. So the nearest point of each set of up to three planes is tried, the smallest sets first: the first
one with no p < 0 that is in all half-spaces is it. Where there is none, or only one far away, as between plates that
have met, projections onto one half-space after the other (Dykstra's) end near by.
"""

import math

import numpy as np

from pbng.jit import inline, serial
from pbng.linalg import add, combine3, cross, dot, point, scale

MANY = 16  # half-spaces of a vertex of which sets are tried
FAR = 16.0  # of the depth: the edge of a wedge of seven degrees is within that, and farther off none is meant
EXACT = 1e-9  # of the depth: what counts as being in a half-space
ROUNDING = 1e-14  # of the largest number: the same
SHARP = 1e-10  # volume of unit normals below which they do not count as independent
ROUNDS = 64  # of projections, at most


class HalfSpaces:
    """Half-spaces, those of one vertex together; without their levels, which may change.

    Args:
        vertex: Vertex of each, (k,).
        plane: Its unit normal, (k, 3), or zero if nothing can be done about it; its level is then not positive.
    """

    def __init__(self, vertex: np.ndarray, plane: np.ndarray) -> None:
        self.vertex, self.plane = vertex.astype(np.int64), np.ascontiguousarray(plane, float)
        self.order = np.argsort(self.vertex, kind="stable")
        grouped = self.vertex[self.order]
        self.first = np.flatnonzero(np.diff(grouped, prepend=-1))
        self.owner = grouped[self.first]
        self.first = np.append(self.first, len(grouped))

    def height(self, x: np.ndarray, level: np.ndarray) -> np.ndarray:
        """How far inside of each half-space its vertex is at x (n, 3) [m], (k,)."""
        height = np.empty(len(level))
        _measure(x, self.vertex, self.plane, level, height)
        return height

    def move_in(self, x: np.ndarray, level: np.ndarray, held: np.ndarray | None = None, far: float = FAR) -> np.ndarray:
        """Move each vertex to the nearest point of its half-spaces, in place.

        Args:
            x: Positions (n, 3) [m], of any precision.
            level: What n·x must not be less than [m], (k,); -inf leaves a half-space out.
            held: Of which half-spaces (k,) the vertex is moved onto the plane, whichever side it is on.
            far: How far a vertex goes at most, in multiples of the depth that it is at; if farther, only part of it.

        Returns:
            How far each half-space has pushed its vertex [m], (k,): x is what it was plus Σ pushed n.
        """
        pushed = np.zeros(len(level))
        both = np.zeros(len(level), bool) if held is None else held
        _move_in(x, self.owner, self.first, self.order, self.plane, level, both, far, pushed)
        return pushed


@inline
def _double(x, v):
    """Row v of the array x (n, 3), in float64."""
    return np.float64(x[v, 0]), np.float64(x[v, 1]), np.float64(x[v, 2])


@serial
def _measure(x, vertex, plane, level, height):
    for k in range(level.size):
        height[k] = dot(point(plane, k), _double(x, vertex[k])) - level[k]


@serial
def _move_in(x, owner, first, order, plane, level, held, far, pushed):
    for g in range(owner.size):
        v, low, high = owner[g], first[g], first[g + 1]
        y = _double(x, v)
        depth, size = 0.0, max(abs(y[0]), abs(y[1]), abs(y[2]))
        for o in range(low, high):
            i = order[o]
            missing = level[i] - dot(point(plane, i), y)
            depth = max(depth, abs(missing) if held[i] else missing)
            if level[i] > -math.inf:
                size = max(size, abs(level[i]))
        if depth > 0.0:
            slack = EXACT * depth + ROUNDING * size
            x[v, 0], x[v, 1], x[v, 2] = _nearest(y, order[low:high], plane, level, held, slack, far * depth, pushed)


@serial
def _nearest(x, mine, plane, level, held, slack, far, pushed):
    """The nearest point of half-spaces ``mine``, to within a slack, if it is not too far; their pushes are written."""
    if mine.size <= MANY:
        for i in mine:
            done, y = _try(x, i, -1, -1, mine, plane, level, held, slack, far, pushed)
            if done:
                return y
        for b in range(mine.size):
            for a in range(b):
                done, y = _try(x, mine[a], mine[b], -1, mine, plane, level, held, slack, far, pushed)
                if done:
                    return y
        for c in range(mine.size):
            for b in range(c):
                for a in range(b):
                    done, y = _try(x, mine[a], mine[b], mine[c], mine, plane, level, held, slack, far, pushed)
                    if done:
                        return y
    return _project(x, mine, plane, level, held, pushed)


@serial
def _try(x, i, j, k, mine, plane, level, held, slack, far, pushed):
    """Whether the point of planes i, j, k (-1 for none) that is nearest to x is that of all half-spaces, and it."""
    n = point(plane, i)
    r = level[i] - dot(n, x)
    p, q, s, step = r, 0.0, 0.0, scale(r, n)
    if j >= 0:
        m = point(plane, j)
        edge = cross(n, m)
        o, t = edge, 0.0  # of two planes the nearest point is across their edge
        if k >= 0:
            o = point(plane, k)
            t = level[k] - dot(o, x)
        volume = dot(o, edge)
        if not abs(volume) > SHARP:
            return False, x
        a, b, c = scale(1 / volume, cross(m, o)), scale(1 / volume, cross(o, n)), scale(1 / volume, edge)
        step = combine3(r, a, level[j] - dot(m, x), b, t, c)
        p, q = dot(step, a), dot(step, b)
        if k >= 0:
            s = dot(step, c)
    if (p < 0.0 and not held[i]) or (q < 0.0 and not held[j]) or (s < 0.0 and not held[k]):
        return False, x
    if not dot(step, step) <= far * far:
        return False, x
    y = add(x, step)
    for h in mine:
        missing = level[h] - dot(point(plane, h), y)
        if not (abs(missing) if held[h] else missing) <= slack:
            return False, x
    pushed[i] = p
    if j >= 0:
        pushed[j] = q
    if k >= 0:
        pushed[k] = s
    return True, y


@serial
def _project(x, mine, plane, level, held, pushed):
    """Where projections of x onto half-spaces ``mine`` in turn end; their pushes are written."""
    for _ in range(ROUNDS):
        change, most = 0.0, 0.0
        for i in mine:
            n = point(plane, i)
            now = level[i] - dot(n, x) + pushed[i]
            if not held[i]:
                now = max(now, 0.0)
            x = add(x, scale(now - pushed[i], n))
            change, most = max(change, abs(now - pushed[i])), max(most, abs(now))
            pushed[i] = now
        if change <= EXACT * most:
            break
    return x
