"""Trees and closest points against brute force and libigl; filters, ties, threads."""

import json

import numba
import numpy as np
import pytest
from typer.testing import CliRunner

import pbng
from pbng.contact.bvh import BoxTree
from pbng.contact.queries import closest_edges, closest_triangles, containing_tets
from pbng.contact.rings import neighbourhoods, spans

ball = pbng.shapes.sphere(radius=1.0, vertices=9)


@pytest.fixture(params=[1, 2])
def threads(request):
    if request.param > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("one thread only")
    before = numba.get_num_threads()
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


def soup(rng, m=300, size=0.3):
    """Triangles anywhere in the unit cube, degenerate ones among them."""
    x = (rng.random((m, 1, 3)) + size * rng.standard_normal((m, 3, 3))).reshape(-1, 3)
    triangles = np.arange(3 * m, dtype=np.int32).reshape(-1, 3)
    x[triangles[::17, 2]] = 0.3 * x[triangles[::17, 0]] + 0.7 * x[triangles[::17, 1]]
    x[triangles[::31, 1]] = x[triangles[::31, 0]]
    x[triangles[::97, 1]] = x[triangles[::97, 2]] = x[triangles[::97, 0]]
    return x, triangles


def segment_distance(p, a, b):
    """Distance of points from segments, broadcast."""
    d = b - a
    length2 = (d * d).sum(-1)
    s = np.clip(((p - a) * d).sum(-1) / np.where(length2 > 0, length2, 1), 0, 1)
    return np.linalg.norm(p - a - s[..., None] * d, axis=-1)


def triangle_distance(p, a, b, c):
    """Distance of points from triangles, broadcast: to the plane above the inside, else to the closest side."""
    sides = np.min([segment_distance(p, a, b), segment_distance(p, b, c), segment_distance(p, c, a)], axis=0)
    n = np.cross(b - a, c - a)
    area2 = (n * n).sum(-1)
    sliver = area2 < 1e-20 * ((b - a) ** 2).sum(-1) * ((c - a) ** 2).sum(-1)
    inside = ~sliver & (area2 > 0)
    for u, v in ((a, b), (b, c), (c, a)):
        inside = inside & ((np.cross(v - u, p - u) * n).sum(-1) >= 0)
    height = np.abs(((p - a) * n).sum(-1)) / np.sqrt(np.where(inside, area2, 1))
    return np.where(inside, height, sides)


def distances(x, triangles, p):
    """All distances (points, triangles)."""
    a, b, c = x[triangles].transpose(1, 0, 2)
    return triangle_distance(p[:, None], a[None], b[None], c[None])


def at(x, cells, found, weights):
    return np.einsum("kc,kcd->kd", weights, x[cells[found]])


@pytest.mark.parametrize("spread", [0.3, 3.0, 1e4])
def test_closest_triangles_beat_all_others(rng, spread):
    x, triangles = soup(rng)
    p = 0.5 + spread * rng.standard_normal((400, 3))
    found, weights, distance = closest_triangles(BoxTree(x, triangles), x, p)
    every = distances(x, triangles, p)
    np.testing.assert_allclose(distance, every.min(1), rtol=1e-10, atol=1e-9)
    np.testing.assert_allclose(every[np.arange(len(p)), found], every.min(1), rtol=1e-10, atol=1e-9)
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(1), 1, atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(at(x, triangles, found, weights) - p, axis=1), distance, rtol=1e-12, atol=1e-14
    )


def test_closest_triangles_agree_with_libigl(rng):
    igl = pytest.importorskip("igl")
    p = rng.uniform(-1.5, 1.5, (2000, 3))
    found, weights, distance = closest_triangles(BoxTree(ball.X, ball.surface), ball.X, p)
    d2, _, c = igl.point_mesh_squared_distance(p, ball.X, ball.surface.astype(np.int64))
    np.testing.assert_allclose(distance, np.sqrt(d2), atol=1e-14)
    np.testing.assert_allclose(at(ball.X, ball.surface, found, weights), c, atol=1e-12)


def test_nothing_is_found_beyond_reach(rng):
    x, triangles = soup(rng)
    p, tree = 2 * rng.standard_normal((500, 3)), BoxTree(x, triangles)
    everything = closest_triangles(tree, x, p)
    for reach in (0.2, rng.uniform(-0.3, 1.0, len(p))):
        found, weights, distance = closest_triangles(tree, x, p, reach)
        within = everything[2] <= reach
        assert 0 < within.sum() < len(p)
        np.testing.assert_array_equal(found, np.where(within, everything[0], -1))
        np.testing.assert_array_equal(distance, np.where(within, everything[2], np.inf))
        np.testing.assert_array_equal(weights, np.where(within[:, None], everything[1], 0))


def test_ties_go_to_the_lowest(rng):
    """Triangles given several times over; points whose closest point is a vertex of several."""
    x, triangles = soup(rng, 40)
    four = np.tile(triangles, (4, 1))
    p = rng.standard_normal((300, 3))
    expected = closest_triangles(BoxTree(x, triangles), x, p)
    found = closest_triangles(BoxTree(x, four), x, p)
    for a, b in zip(expected, found):
        np.testing.assert_array_equal(a, b)
    box = pbng.shapes.box(vertices=4)
    axes = np.linspace(-0.4, 1.4, 9), np.linspace(-0.1, 1.1, 7), np.linspace(0, 4 / 3, 9)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)  # many closest points are on edges
    found, _, _ = closest_triangles(BoxTree(box.X, box.surface), box.X, grid)
    every = distances(box.X, box.surface, grid)
    np.testing.assert_array_equal(found, (every < every.min(1, keepdims=True) + 1e-13).argmax(1))


@pytest.mark.parametrize("which", ["others", "own", "switches"])
def test_groups(rng, which):
    x, triangles = soup(rng)
    n = 7
    group, own = rng.integers(0, n, len(triangles)), rng.integers(0, n, 400)
    meets = {"others": ~np.eye(n, dtype=bool), "own": np.eye(n, dtype=bool), "switches": rng.random((n, n)) < 0.3}[
        which
    ]
    meets[2] &= which != "switches"  # not asked
    p = rng.random((400, 3))
    found, _, distance = closest_triangles(BoxTree(x, triangles, group), x, p, 0.4, own=own, meets=meets)
    every = np.where(meets[own][:, group], distances(x, triangles, p), np.inf)
    expected = np.where(every.min(1) <= 0.4, every.min(1), np.inf)
    np.testing.assert_allclose(distance, expected, atol=1e-9)
    assert ((found >= 0) == np.isfinite(expected)).all()
    hit = found >= 0
    assert hit.sum() > 20
    assert meets[own[hit], group[found[hit]]].all()


def test_groups_of_very_different_sizes_and_none_at_all(rng):
    """Groups of 1, 1, 2, 4, ... in one place, and numbers that no triangle has."""
    group = np.repeat([9, 1, 4, 3, 5, 6, 0], [1, 1, 2, 4, 8, 300, 600])
    x, triangles = soup(rng, len(group))
    meets = np.zeros((1, 10), bool)
    meets[0, [3, 9]] = True
    p = rng.random((50, 3))
    for _ in range(2):
        tree = BoxTree(x, triangles, group)
        found, _, _ = closest_triangles(tree, x, p, own=np.zeros(50, int), meets=meets)
        every = np.where(meets[0][group], distances(x, triangles, p), np.inf)
        np.testing.assert_allclose(every[np.arange(50), found], every.min(1), atol=1e-9)
        leaves = tree.nodes[:, 0] < 0
        assert (tree.nodes[leaves, 3] >= 0).all()
        np.testing.assert_array_equal(np.sort(tree.order), np.arange(len(group)))
        x[:] = 0.5  # all in one point, in which no axis divides


def test_excluded_triangles_are_not_found():
    """A vertex of a surface finds the nearest triangle outside its rings."""
    X, surface = ball.X, ball.surface
    vertex = np.unique(surface)
    tree = BoxTree(X, surface)
    for rings in (0, 1, 2):
        start, ids = neighbourhoods(surface, len(X), rings)
        found, _, distance = closest_triangles(
            tree, X, X[vertex], vertex=vertex, excluded=spans(tree.order, start, ids)
        )
        every = distances(X, surface, X[vertex])
        for k, v in enumerate(vertex):
            every[k, ids[start[v] : start[v + 1]]] = np.inf
        np.testing.assert_allclose(distance, every.min(1), atol=1e-12)
        np.testing.assert_allclose(every[np.arange(len(vertex)), found], every.min(1), atol=1e-12)
        assert (rings > 0) == (distance.min() > 0.01)


@pytest.mark.parametrize("rings", [0, 1, 2, 3])
def test_neighbourhoods(rings):
    X, surface = ball.X, ball.surface
    start, ids = neighbourhoods(surface, len(X), rings)
    assert start[-1] == len(ids)
    for v in (*np.unique(surface)[::40], np.setdiff1d(np.arange(len(X)), surface)[0]):
        vertices, cells = {v}, set()
        for _ in range(rings):
            cells = set(np.flatnonzero(np.isin(surface, list(vertices)).any(1)))
            vertices |= set(surface[sorted(cells)].ravel())
        assert ids[start[v] : start[v + 1]].tolist() == sorted(cells)


def test_spans():
    """Places are joined that follow each other, and those of no two vertices."""
    start, ids = np.array([0, 3, 3, 5, 6]), np.array([0, 1, 3, 2, 3, 0])
    found = spans(np.array([3, 1, 0, 2]), start, ids)  # places: of 0 the third, of 1 the second, of 2 the last ...
    assert found.start.tolist() == [0, 1, 1, 3, 4]
    assert list(zip(found.low.tolist(), found.high.tolist())) == [(0, 3), (0, 1), (3, 4), (2, 3)]


def test_triangles_that_a_point_is_behind(rng):
    """Inside a ball all triangles count, outside only those that face away."""
    X, surface = ball.X, ball.surface
    tree = BoxTree(X, surface)
    p = rng.uniform(-0.6, 0.6, (200, 3))
    inside = p[np.linalg.norm(p, axis=1) < 0.8]
    for a, b in zip(closest_triangles(tree, X, inside), closest_triangles(tree, X, inside, behind=True)):
        np.testing.assert_array_equal(a, b)
    outside = 1.5 * p / np.linalg.norm(p, axis=1, keepdims=True)
    found, weights, distance = closest_triangles(tree, X, outside, behind=True)
    a, b, c = X[surface].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    q = at(X, surface, found, weights)
    assert (((outside - q) * normal[found]).sum(1) < 0).all()
    assert (distance > 0.9).all()
    assert (closest_triangles(tree, X, outside, 0.9, behind=True)[0] == -1).all()


@pytest.mark.parametrize("limit", [0.0, 0.5])
def test_triangles_that_face_a_direction(rng, limit):
    """Of all triangles those are looked at whose normals do not point along a direction; without one, all."""
    x, triangles = soup(rng, 200)
    p, against = rng.random((50, 3)), rng.standard_normal((50, 3))
    against[::10] = 0.0
    a, b, c = x[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    triangles, normal = (k[np.linalg.norm(normal, axis=1) > 1e-9] for k in (triangles, normal))
    along = against @ normal.T
    bound = limit * np.linalg.norm(against, axis=1)[:, None] * np.linalg.norm(normal, axis=1)
    every = np.where((along <= 0) | (along < bound), distances(x, triangles, p), np.inf)
    found, _, distance = closest_triangles(BoxTree(x, triangles), x, p, against=against, limit=limit)
    np.testing.assert_allclose(distance, every.min(1), atol=1e-12)
    np.testing.assert_allclose(every[np.arange(50), found], every.min(1), atol=1e-12)


def test_what_is_looked_for_farther_away_the_more_it_moves_relatively(rng):
    """Within reach, plus the margin of a triangle's or edge's vertices, plus how far it goes relative to who asks."""
    x, triangles = soup(rng, 150)
    margin, way = 0.05 * rng.random(len(x)), rng.normal(0.1, 0.05, (len(x), 3))
    vertex = np.arange(0, len(x), 3)
    reach = 0.1 * rng.random(len(vertex))
    tree = BoxTree(x, triangles)
    tree.refit(x, margin=margin, way=way)
    mine = spans(tree.order, *neighbourhoods(triangles, len(x), 1))
    found, _, distance = closest_triangles(tree, x, x[vertex], reach, vertex=vertex, excluded=mine)
    alone = [closest_triangles(BoxTree(x, t[None]), x, x[vertex], vertex=vertex) for t in triangles]
    for k in range(len(vertex)):
        d = np.array([a[2][k] for a in alone])
        theirs = np.array([a[1][k] @ way[t] for a, t in zip(alone, triangles)])
        limit = reach[k] + margin[triangles].max(1) + np.linalg.norm(theirs - way[vertex[k]], axis=1)
        d[(d > limit) | (triangles == vertex[k]).any(1)] = np.inf
        assert distance[k] == pytest.approx(d.min())
        assert found[k] == (d.argmin() if np.isfinite(d.min()) else -1)
    assert 10 < (found < 0).sum() < len(vertex) - 10
    resting = closest_triangles(tree, x, x[vertex], reach)[0]  # points that are no vertices are at rest
    assert (resting != found).any()

    x, edges = edge_soup(rng)
    margin, way = 0.01 * rng.random(len(x)), rng.normal(0.1, 0.005, (len(x), 3))
    reach = 0.02 * rng.random(len(edges))
    tree = BoxTree(x, edges)
    tree.refit(x, margin=margin, way=way)
    found, _, _, distance = closest_edges(tree, x, edges, reach)
    for k, (v, w) in enumerate(edges):
        d = np.full(len(edges), np.inf)
        for e, (a, b) in enumerate(edges):
            if e == k:
                continue
            _, s, t, (gap,) = (q for q in closest_edges(BoxTree(x, edges[e : e + 1]), x, edges[k : k + 1]))
            apart = (1 - s) * way[v] + s * way[w] - (1 - t) * way[a] - t * way[b]
            if gap <= reach[k] + max(margin[a], margin[b]) + np.linalg.norm(apart):
                d[e] = gap
        assert distance[k] == pytest.approx(d.min(), abs=1e-12)
    assert 10 < (found < 0).sum() < len(edges) - 10


def edge_soup(rng, n=120):
    x = rng.random((2 * n, 3))
    edges = np.arange(2 * n, dtype=np.int32).reshape(-1, 2)
    d = x[edges[:, 1]] - x[edges[:, 0]]
    x[edges[1::9, 1]] = x[edges[1::9, 0]] + d[0]  # parallel
    x[edges[2::13, 1]] = x[edges[2::13, 0]]  # points
    x[edges[3::15, 1]] = x[edges[3::15, 0]] + (1 + 1e-9 * rng.standard_normal(3)) * d[0]  # nearly parallel
    x[edges[5]] = x[edges[4]] + [0, 0.01, 0]
    x[edges[7]] = x[edges[6]][::-1]  # on top of each other
    return x, edges


def edge_distance(a, b, c, d):
    """Distances of segments ab from cd by minimising over ends, and over lines where that is inside both."""
    best = np.min(
        [segment_distance(a, c, d), segment_distance(b, c, d), segment_distance(c, a, b), segment_distance(d, a, b)], 0
    )
    e, f, r = b - a, d - c, a - c
    n = np.cross(e, f)
    area = (n * n).sum(-1)
    ok = area > 1e-24
    one = np.where(ok, area, 1)
    s, t = -(np.cross(r, f) * n).sum(-1) / one, -(np.cross(r, e) * n).sum(-1) / one
    ok &= (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    return np.where(ok, np.minimum(best, np.abs((r * n).sum(-1)) / np.sqrt(one)), best)


def test_closest_edges_beat_all_others(rng):
    x, edges = edge_soup(rng)
    tree = BoxTree(x, edges)
    for reach in (np.inf, 0.05):
        found, s, t, distance = closest_edges(tree, x, edges, reach)
        (a, b), (c, d) = x[edges].transpose(1, 0, 2)[:, :, None], x[edges].transpose(1, 0, 2)[:, None]
        every = edge_distance(a, b, c, d)
        np.fill_diagonal(every, np.inf)
        expected = np.where(every.min(1) <= reach, every.min(1), np.inf)
        np.testing.assert_allclose(distance, expected, atol=1e-9)
        assert (np.minimum(s, t) >= 0).all()
        assert (np.maximum(s, t) <= 1).all()
        hit = np.flatnonzero(found >= 0)
        p = x[edges[hit, 0]] + s[hit, None] * (x[edges[hit, 1]] - x[edges[hit, 0]])
        q = x[edges[found[hit], 0]] + t[hit, None] * (x[edges[found[hit], 1]] - x[edges[found[hit], 0]])
        np.testing.assert_allclose(np.linalg.norm(p - q, axis=1), distance[hit], atol=1e-12)
        assert (found[distance == np.inf] == -1).all()


def test_closest_edges_leave_out_neighbours_and_groups(rng):
    X = ball.X
    edges = pbng.topology.unique_edges(ball.surface, pbng.topology.TRIANGLE_EDGES)
    tree = BoxTree(X, edges)
    start, ids = neighbourhoods(edges, len(X), 2)
    found, *_ = closest_edges(tree, X, edges, excluded=spans(tree.order, start, ids))
    for e, f in zip(edges, found):
        assert not np.isin(f, np.concatenate([ids[start[v] : start[v + 1]] for v in e]))
    found, *_ = closest_edges(tree, X, edges)
    assert (found >= 0).all()
    assert not (edges[found][:, :, None] == edges[:, None]).any()
    x, edges = edge_soup(rng)
    group = rng.integers(0, 3, len(edges))
    others = ~np.eye(3, dtype=bool)
    found, *_ = closest_edges(BoxTree(x, edges, group), x, edges, own=group, meets=others)
    assert (group[found] != group).all()


def crumpled(rng, n=5):
    box = pbng.shapes.box(vertices=n)
    return box, box.X + 0.3 / n * rng.standard_normal(box.X.shape)


def contained(x, cells, p):
    """Whether points are in tets (points, tets), and by how much at least."""
    a, b, c, d = x[cells].transpose(1, 0, 2)
    w = np.linalg.solve(np.stack([b - a, c - a, d - a], -1)[None], (p[:, None] - a)[..., None])[..., 0]
    return np.concatenate([1 - w.sum(-1, keepdims=True), w], -1).min(-1)


def test_containing_tets(rng):
    """The lowest of all, inverted ones included, at rest and deformed."""
    box, x = crumpled(rng)
    p = rng.uniform(-0.2, 1.2, (500, 3))
    tree = BoxTree(box.X, box.cells)
    for positions in (box.X, x, 3 * x @ np.linalg.qr(rng.standard_normal((3, 3)))[0], x * [1, -1, 1]):
        tree.refit(positions)
        found, weights = containing_tets(tree, positions, p)
        least = contained(positions, box.cells, p)
        inside = least >= 0
        expected = np.where(inside.any(1), inside.argmax(1), -1)
        clear = ~(np.abs(least) < 1e-9).any(1)
        assert clear.sum() > 450
        np.testing.assert_array_equal(found[clear], expected[clear])
        hit = found >= 0
        assert (weights[hit] >= 0).all()
        np.testing.assert_allclose(at(positions, box.cells, found[hit], weights[hit]), p[hit], atol=1e-12)
        assert (weights[~hit] == 0).all()


def test_containing_tets_leave_out_those_of_the_vertex(rng):
    """At rest no vertex is in a tet of its neighbours; two bodies within each other are found from either side."""
    box = pbng.shapes.box(vertices=5)
    v = np.arange(box.n_vert)
    assert (containing_tets(BoxTree(box.X, box.cells), box.X, box.X)[0] >= 0).all()
    assert (containing_tets(BoxTree(box.X, box.cells), box.X, box.X, v)[0] == -1).all()
    x = np.concatenate([box.X, 0.8 * box.X + [0.53, 0.21, 0.17]])
    cells = np.concatenate([box.cells, box.cells + box.n_vert])
    body, group = np.repeat([0, 1], box.n_vert), np.repeat([0, 1], box.n_elem)
    tree = BoxTree(x, cells, group)
    found, _ = containing_tets(tree, x, x, np.arange(len(x)), own=body, meets=~np.eye(2, dtype=bool))
    low, high = np.array([[0, 0, 0], [0.53, 0.21, 0.17]]), np.array([[1, 1, 1], [1.33, 1.01, 0.97]])
    inside = ((x >= low[1 - body]) & (x <= high[1 - body])).all(1)
    np.testing.assert_array_equal(found >= 0, inside)
    assert (group[found[inside]] != body[inside]).all()
    assert (containing_tets(tree, x, x, np.arange(len(x)), own=body, meets=np.eye(2, dtype=bool))[0] == -1).all()
    lists = spans(tree.order, *neighbourhoods(cells, len(x), 1))
    others = containing_tets(tree, x, x, np.arange(len(x)), excluded=lists)
    np.testing.assert_array_equal(others[0], found)


@pytest.mark.parametrize("rings", [2, 8])
def test_long_lists_of_what_is_left_out(rings):
    x, triangles = ball.X, ball.surface
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0).astype(np.int32)
    v = np.unique(triangles)
    start, ids = neighbourhoods(triangles, len(x), rings)
    tree = BoxTree(x, triangles)
    left_out = spans(tree.order, start, ids)
    found, _, distance = closest_triangles(tree, x, x[v], 1.5, vertex=v, excluded=left_out)
    every = distances(x, triangles, x[v])
    for k, w in enumerate(v):
        every[k, ids[start[w] : start[w + 1]]] = np.inf
    lowest = (every <= every.min(1, keepdims=True) + 1e-13).argmax(1)
    np.testing.assert_array_equal(found, np.where(every.min(1) <= 1.5, lowest, -1))
    np.testing.assert_allclose(distance, np.where(every.min(1) <= 1.5, every.min(1), np.inf), atol=1e-12)
    start, ids = neighbourhoods(edges, len(x), rings)
    tree = BoxTree(x, edges)
    found, _, _, distance = closest_edges(tree, x, edges, 1.5, excluded=spans(tree.order, start, ids))
    for k in range(0, len(edges), 7):
        out = np.concatenate([ids[start[w] : start[w + 1]] for w in edges[k]])
        rest = np.setdiff1d(np.arange(len(edges)), out)
        alone = closest_edges(BoxTree(x, edges[rest]), x, edges[k : k + 1], 1.5)
        assert found[k] == (rest[alone[0][0]] if alone[0][0] >= 0 else -1)
        assert distance[k] == alone[3][0]


def test_it_does_not_matter_what_is_asked_together(rng):
    """Neither near points of one group, nor far ones of several, nor in which order."""
    x, triangles = soup(rng)
    group, own, meets = rng.integers(0, 5, len(triangles)), np.sort(rng.integers(0, 5, 600)), ~np.eye(5, dtype=bool)
    tree = BoxTree(x, triangles, group)
    p, reach = rng.random((600, 3)) + 0.2 * own[:, None], rng.choice([-1.0, 0.05, 0.3, np.inf], 600)
    together = closest_triangles(tree, x, p, reach, own=own, meets=meets)
    order = rng.permutation(600)
    apart = closest_triangles(tree, x, p[order], reach[order], own=own[order], meets=meets)
    for a, b in zip(together, apart):
        np.testing.assert_array_equal(a[order], b)
    for k in range(0, 600, 10):
        alone = closest_triangles(tree, x, p[k : k + 1], reach[k : k + 1], own=own[k : k + 1], meets=meets)
        assert alone[0][0] == together[0][k]


def test_boxes_follow_motion(rng):
    """After a refit trees find what fresh ones find; boxes hold all that they should, and no more."""
    x, triangles = soup(rng, 5000, 0.02)
    tree = BoxTree(x, triangles)
    y = x @ np.linalg.qr(rng.standard_normal((3, 3)))[0] + 0.1 * rng.standard_normal(x.shape)
    tree.refit(y)
    p = rng.standard_normal((200, 3))
    for a, b in zip(closest_triangles(tree, y, p), closest_triangles(BoxTree(y, triangles), y, p)):
        np.testing.assert_array_equal(a, b)
    for positions, margin in (((y,), 0.0), ((x, y), 0.0), ((x, y), 0.01)):
        tree.refit(*positions, margin=margin)
        for i in (0, 1, 2, 7, 1500, len(tree.nodes) // 2, len(tree.nodes) - 1):
            vertices = triangles[tree.order[tree.nodes[i, 1] : tree.nodes[i, 2]]].ravel()
            corners = np.concatenate([z[vertices] for z in positions])
            expected = np.concatenate([corners.min(0) - margin, corners.max(0) + margin])
            np.testing.assert_allclose(tree.boxes[i], expected, rtol=1e-14)


def test_same_bits_for_any_number_of_threads(rng):
    if numba.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one thread only")
    before = numba.get_num_threads()
    x, triangles = soup(rng, 20000, 0.02)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]]])
    box, deformed = crumpled(rng)
    p = rng.random((3000, 3))
    results = []
    for count in (1, 2):
        numba.set_num_threads(count)
        tree = BoxTree(x, triangles)
        found = closest_triangles(tree, x, p), closest_edges(BoxTree(x, edges), x, edges[:3000], 0.01)
        found += (containing_tets(BoxTree(deformed, box.cells), deformed, p),)
        results.append([tree.boxes, *(a for f in found for a in f)])
    numba.set_num_threads(before)
    for a, b in zip(*results):
        np.testing.assert_array_equal(a, b)


def test_small_and_empty(rng):
    x = rng.random((4, 3))
    p = rng.random((10, 3))
    for triangles in ([[0, 1, 2]], [[0, 1, 2], [0, 1, 2]], [[3, 3, 3]]):
        tree = BoxTree(x, np.array(triangles))
        found, _, distance = closest_triangles(tree, x, p)
        assert (found == 0).all()
        np.testing.assert_allclose(distance, distances(x, np.array(triangles), p)[:, 0], atol=1e-12)
        none = closest_triangles(tree, x, np.empty((0, 3)))
        assert [len(a) for a in none] == [0, 0, 0]
    tree = BoxTree(x, np.empty((0, 3), int))
    found, _, distance = closest_triangles(tree, x, p)
    assert (found == -1).all()
    assert (distance == np.inf).all()
    assert (closest_edges(BoxTree(x, [[0, 1]]), x, [[1, 2]])[0] == -1).all()  # a shared vertex
    assert closest_edges(BoxTree(x, [[0, 1]]), x, [[2, 3]])[0].tolist() == [0]
    assert len(closest_edges(BoxTree(x, [[0, 1]]), x, np.empty((0, 2)))[0]) == 0
    flat = BoxTree(x, [[0, 1, 2, 2]])
    assert (containing_tets(flat, x, x)[0] == -1).all()
    assert (containing_tets(flat, x, np.full((3, 3), np.nan))[0] == -1).all()
    assert (closest_triangles(BoxTree(x, [[0, 1, 2]]), x, np.full((3, 3), np.nan))[0] == -1).all()
    with pytest.raises(pbng.InputError, match="primitive 1 is not finite"):
        BoxTree(np.array([[0, 0, 0], [np.inf, 0, 0]]), [[0, 0, 0], [0, 1, 0]])


def test_what_does_not_fit_is_refused(rng):
    """Bodies read without looking: nothing out of range may come to them."""
    x, triangles = soup(rng, 20)
    tree, p, k = BoxTree(x, triangles, np.arange(20) % 3), rng.random((5, 3)), np.arange(5)
    lists = spans(tree.order, *neighbourhoods(triangles, len(x), 1))
    everything = np.ones((3, 3), bool)
    for wrong in (
        lambda: tree.refit(x[:-1]),
        lambda: closest_triangles(tree, x[:-1], p),
        lambda: closest_triangles(tree, x, p[:, :2]),
        lambda: closest_triangles(tree, x, p, own=k % 3),
        lambda: closest_triangles(tree, x, p, own=k, meets=everything),
        lambda: closest_triangles(tree, x, p, own=k % 3, meets=everything[:, :2]),
        lambda: closest_triangles(tree, x, p, own=k[:2], meets=everything),
        lambda: closest_triangles(tree, x, p, excluded=lists),
        lambda: closest_triangles(tree, x, p, vertex=k + 57, excluded=lists),
        lambda: closest_edges(tree, x, triangles[:, :2]),
        lambda: closest_edges(BoxTree(x, triangles[:, :2]), x, [[0, len(x)]]),
        lambda: containing_tets(tree, x, p),
    ):
        with pytest.raises(AssertionError):
            wrong()


def test_bench(tmp_path):
    from pbng.bench import app

    path = tmp_path / "contact.json"
    arguments = ["contact", "--n", "6", "--points", "50", "--tets", "3", "--threads", "1", "--rounds", "1"]
    result = CliRunner().invoke(app, [*arguments, "--record", str(path)])
    assert result.exit_code == 0, result.output
    rows = json.loads(path.read_text())["rows"]
    assert [r["query"] for r in rows] == ["closest triangle", "closest edge", "containing tet"]
    assert [r["primitives"] for r in rows] == [300, 450, 240]
    assert all(r["refit_ms"] > 0 and max(r.get("near", 0), r.get("cut", 0)) > 0 for r in rows)
