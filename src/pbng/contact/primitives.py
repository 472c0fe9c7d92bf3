"""Closest points of triangles and of edges, and where in a tet a point lies: scalar formulas on tuples."""

from pbng.jit import inline
from pbng.linalg import combine, combine3, cross, dot, sub

FLAT = 1e-14  # squared sine below which a triangle is a sliver, whose edges will do; sine below which a tet is one
PARALLEL = 1e-6  # squared sine below which edges are compared by their ends too


@inline
def closest_on_triangle(p, a, b, c):
    """The point of triangle abc that is closest to p: its weights, its offset from p [m] and that squared [m²].

    The regions of the plane follow Ericson (Real-Time Collision Detection, 5.1.5), with the areas taken from products
    of edges, which loses less for points far away. The offset is summed from the corners' offsets from p, so that
    triangles that meet at the closest corner are at just the same distance.
    """
    A, B, C = sub(a, p), sub(b, p), sub(c, p)
    ab, ac = sub(B, A), sub(C, A)
    d1, d2 = -dot(ab, A), -dot(ac, A)
    aa, t, cc = dot(ab, ab), dot(ab, ac), dot(ac, ac)
    u, v, w = 1.0, 0.0, 0.0
    if d1 > 0.0 or d2 > 0.0:
        d3, d4, d5, d6 = d1 - aa, d2 - t, d1 - t, d2 - cc
        area = aa * cc - t * t
        vb, vc = cc * d1 - t * d2, aa * d2 - t * d1
        if d3 >= 0.0 and d4 <= d3:
            u, v = 0.0, 1.0
        elif d6 >= 0.0 and d5 <= d6:
            u, w = 0.0, 1.0
        elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and aa > 0.0:
            v = d1 / aa
            u = 1.0 - v
        elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
            w = d2 / cc
            u = 1.0 - w
        elif area <= FLAT * aa * cc:
            u, v, w = _closest_on_sides(A, B, C)
        elif area - vb - vc <= 0.0 and d4 >= d3 and d5 >= d6:
            w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
            u, v = 0.0, 1.0 - w
        else:
            v, w = vb / area, vc / area
            u = 1.0 - v - w
    offset = combine3(u, A, v, B, w, C)
    return (u, v, w), offset, dot(offset, offset)


@inline
def _closest_on_sides(A, B, C):
    """Weights of the point of the triangle's three sides that is closest to the origin."""
    s = foot(A, sub(B, A))
    u, v, w = 1.0 - s, s, 0.0
    q = combine(1.0 - s, A, s, B)
    best = dot(q, q)
    s = foot(B, sub(C, B))
    q = combine(1.0 - s, B, s, C)
    d = dot(q, q)
    if d < best:
        best, u, v, w = d, 0.0, 1.0 - s, s
    s = foot(C, sub(A, C))
    q = combine(1.0 - s, C, s, A)
    if dot(q, q) < best:
        u, v, w = s, 0.0, 1.0 - s
    return u, v, w


@inline
def foot(A, d):
    """Parameter in [0, 1] of the point of the segment A, A + d that is closest to the origin."""
    length2 = dot(d, d)
    return min(max(-dot(A, d) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0


@inline
def closest_segments(a, b, c, d):
    """The closest points of segments ab and cd: parameters s, t in [0, 1], offset from the first [m], squared [m²].

    The lines' closest points, clamped one after the other (Ericson, 5.1.9); where the lines are so nearly parallel that
    rounding hides them, the ends are looked at too.
    """
    e, f, r = sub(b, a), sub(d, c), sub(c, a)
    ee, ef, ff, er, fr = dot(e, e), dot(e, f), dot(f, f), dot(e, r), dot(f, r)
    area = ee * ff - ef * ef
    s = min(max((er * ff - fr * ef) / area, 0.0), 1.0) if area > 0.0 else 0.0
    t = min(max((s * ef - fr) / ff, 0.0), 1.0) if ff > 0.0 else 0.0
    s = min(max((t * ef + er) / ee, 0.0), 1.0) if ee > 0.0 else 0.0
    offset = _between(r, e, f, s, t)
    d2 = dot(offset, offset)
    if area <= PARALLEL * ee * ff:
        for end in range(4):
            if end < 2:
                t1 = float(end)
                s1 = min(max((t1 * ef + er) / ee, 0.0), 1.0) if ee > 0.0 else 0.0
            else:
                s1 = float(end - 2)
                t1 = min(max((s1 * ef - fr) / ff, 0.0), 1.0) if ff > 0.0 else 0.0
            other = _between(r, e, f, s1, t1)
            o2 = dot(other, other)
            if o2 < d2:
                s, t, offset, d2 = s1, t1, other, o2
    return s, t, offset, d2


@inline
def _between(r, e, f, s, t):
    """r + t f - s e."""
    return r[0] + t * f[0] - s * e[0], r[1] + t * f[1] - s * e[1], r[2] + t * f[2] - s * e[2]


@inline
def tet_weights(p, a, b, c, d):
    """Barycentric weights of p in the tet abcd, and six times its volume [m³]; -1, all of them, where it is flat."""
    A, B, C, D = sub(a, p), sub(b, p), sub(c, p), sub(d, p)
    ab, ac, ad = sub(B, A), sub(C, A), sub(D, A)
    volume = dot(ab, cross(ac, ad))
    if not volume * volume > FLAT * FLAT * dot(ab, ab) * dot(ac, ac) * dot(ad, ad):
        return (-1.0, -1.0, -1.0, -1.0), volume
    wb, wc, wd = -dot(A, cross(ac, ad)) / volume, -dot(A, cross(ad, ab)) / volume, -dot(A, cross(ab, ac)) / volume
    return (1.0 - wb - wc - wd, wb, wc, wd), volume
