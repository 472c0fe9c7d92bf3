"""Kinematic meshes: against all triangles, against boxes, signs everywhere, motions that deform, bad meshes named."""

import numpy as np
import pytest

import pbng
from pbng import Rotate, Scale, Translate
from pbng.contact.colliders import Box
from pbng.contact.kinematic import Kinematic

CUBE = pbng.shapes.box((1, 1, 1), 2)
SHEET = pbng.shapes.rectangle((1, 1), 2)
SURFACE = CUBE.surface


def points(n, seed=0, low=-1.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, (n, 3))


def brute(collider, p):
    """Unsigned distances of points to a surface: to each of its planes where the foot is inside, and to each edge."""
    x, triangles = collider.surface()
    a = x[triangles]
    b = np.roll(a, -1, 1)  # the other end of each edge
    n = np.cross(b[:, 0] - a[:, 0], b[:, 1] - a[:, 0])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    off = p[:, None, None] - a  # (points, triangles, edges, 3)
    s = np.clip(((b - a) * off).sum(-1) / ((b - a) ** 2).sum(-1), 0, 1)
    to_edges = np.linalg.norm(off - s[..., None] * (b - a), axis=-1).min((1, 2))
    inside = (np.cross(b - a, off) * n[:, None]).sum(-1).min(-1) >= 0
    to_planes = np.where(inside, np.abs((off[:, :, 0] * n).sum(-1)), np.inf).min(1)
    return np.minimum(to_edges, to_planes)


@pytest.mark.parametrize(
    "mesh",
    [
        Kinematic(pbng.shapes.sphere(0.6, 6)),
        Kinematic(pbng.shapes.box((0.7, 0.6, 1.1), 3), motion=Rotate((1, 2, 3), 0.2)),
        Kinematic(pbng.shapes.rectangle((1.0, 1.0), 4, (-0.5, -0.5)), thickness=0.01),
    ],
)
def test_distances_are_those_of_all_triangles(mesh):
    p = points(300, 2)
    assert np.allclose(np.abs(mesh.distance(p)[0]), brute(mesh, p), atol=1e-13)


def test_a_mesh_of_a_box_is_a_box():
    box, mesh = Box((0, 0, 0), (1, 1, 1)), Kinematic(pbng.shapes.box((1, 1, 1), 3))
    p = points(3000, 3, -0.5, 1.5)
    for a, b in zip(mesh.distance(p), box.distance(p)):
        assert np.allclose(a, b, atol=1e-12)
    after = p + np.random.default_rng(4).normal(size=p.shape) * 0.3
    for a, b in zip(mesh.touch(p, after, 0.0, 0.1, 0.05), box.touch(p, after, 0.0, 0.1, 0.05)):
        assert np.allclose(a, b, atol=1e-12)


def l_shape():
    """Three unit cubes: (0, 0), (1, 0) and (0, 1) in the plane of x and y; reentrant at x = y = 1."""
    grid = pbng.shapes.box((2, 2, 1), (3, 3, 2))
    center = grid.X[grid.cells].mean(1)
    cells = grid.cells[(center[:, :2] < 1).any(1)]
    used, cells = np.unique(cells, return_inverse=True)
    return pbng.TetMesh(grid.X[used], cells.reshape(-1, 4))


@pytest.mark.parametrize("spread", [1e-7, 1e-3, 0.3])
def test_signs_next_to_edges_and_corners(spread):
    """Closest points of most of these are on edges, or on corners, some of them reentrant."""
    mesh = l_shape()
    p = np.repeat(mesh.X, 200, 0) + np.random.default_rng(5).normal(size=(200 * len(mesh.X), 3)) * spread
    x, y, z = p.T
    inside = (np.minimum(x, y) > 0) & (np.maximum(x, y) < 2) & (np.minimum(x, y) < 1) & (z > 0) & (z < 1)
    d, closest, _ = Kinematic(mesh).distance(p)
    assert ((d < 0) == inside).all()
    assert np.allclose(np.abs(d), np.linalg.norm(p - closest, axis=1), atol=1e-15)


def test_a_rigid_mesh_moves_like_the_shape():
    options = {"motion": Rotate("y", 0.4) + Translate((0.5, 0.2, 0)), "over": 1.0, "thickness": 0.02}
    box, mesh = Box((0, 0, 0), (1, 1, 1), **options), Kinematic(pbng.shapes.box((1, 1, 1), 3), **options)
    before = points(3000, 7, -0.7, 1.7)
    after = before + np.random.default_rng(8).normal(size=before.shape) * 0.1
    one, two = (c.touch(before, after, 0.3, 0.5, 0.01) for c in (box, mesh))
    for a, b in zip(one, two):
        assert np.allclose(a, b, atol=1e-12)
    slip = [c.carried(t.point, 0.3, 0.5) for c, t in ((box, one), (mesh, two))]
    assert np.allclose(*slip, atol=1e-12)
    assert np.abs(slip[0]).max() > 0.1


def test_a_mesh_that_deforms_as_if_rigid_moves_like_the_rigid_one():
    """A translation given as a function is found in the world, not in the body's frame."""
    mesh, by = pbng.shapes.box((1, 1, 1), 3), np.array([0.5, 0.2, 0.1])
    times = np.array([0.0, 1.0])
    for other in (lambda t, X: X + t * by, pbng.Animation(times, np.stack([mesh.X, mesh.X + by]))):
        rigid = Kinematic(mesh, motion=Translate(by), over=1.0)
        free = Kinematic(mesh, motion=other)
        before = points(2000, 9, -0.5, 1.5)
        after = before + np.random.default_rng(10).normal(size=before.shape) * 0.1
        assert np.allclose(rigid.distance(before, 0.4)[0], free.distance(before, 0.4)[0], atol=1e-13)
        assert np.allclose(rigid.surface(0.4)[0], free.surface(0.4)[0])
        for a, b in zip(rigid.touch(before, after, 0.2, 0.6, 0.01), free.touch(before, after, 0.2, 0.6, 0.01)):
            assert np.allclose(a, b, atol=1e-10)


def test_scaled_meshes():
    mesh = Kinematic(pbng.shapes.sphere(0.5, 9), motion=Scale(2.0), over=1.0)
    p = np.array([[0.75, 0.0, 0.0]])
    assert mesh.distance(p, 0.0)[0][0] == pytest.approx(0.25)
    assert mesh.distance(p, 1.0)[0][0] == pytest.approx(-0.25, abs=0.02)
    _, (point,), (normal,) = mesh.touch(p, p, 0.0, 1.0)
    assert np.allclose(point, [1, 0, 0], atol=1e-9)
    assert np.allclose(normal, [1, 0, 0], atol=0.05)
    assert np.allclose(mesh.carried(point[None], 0.0, 1.0), [0.5, 0, 0], atol=1e-9)


def test_a_bending_mesh_is_followed_in_pieces():
    """A half turn given as a function, in one step: straight from start to end it would go through the axis."""

    def turn(t, X):
        a = np.pi * t
        return X @ np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])

    sheet = pbng.shapes.rectangle((1.0, 1.0), 3)
    fan = Kinematic(sheet, thickness=0.01, motion=turn)
    direction = turn(0.5, np.array([[1.0, 0, 0]]))[0]
    p = np.array([[0, 0.4, 0] + 0.7 * direction, [0, 0.4, 0] - 0.7 * direction])
    touches = fan.touch(p, p, 0.0, 1.0)
    assert touches.vertex.tolist() == [0]
    assert np.allclose(touches.point[0], [-0.7, 0.4, touches.point[0, 2]], atol=0.05)
    assert abs(touches.normal[0, 2]) == pytest.approx(1)
    assert (touches.normal[0] @ direction) * (turn(1.0, direction[None])[0] @ touches.normal[0]) <= 1e-9


@pytest.mark.parametrize("thickness", [0.0, 0.01])
@pytest.mark.parametrize("move", [False, True])
def test_nothing_slips_between_triangles(thickness, move):
    """Straight at vertices and edges, of a solid and of a sheet, by the points or by the mesh."""
    mesh = (
        pbng.shapes.rectangle((1.0, 1.0), 4) if thickness else pbng.shapes.box((1.0, 1.0, 0.1), (4, 4, 2), (0, 0, -0.1))
    )
    inner = np.array([[1, 1], [1, 2], [2, 1], [1.5, 1], [1, 1.5], [1.5, 1.5], [1.25, 1.75], [2, 1.1]]) / 3
    for direction in ([0, 0, -1.0], [0.2, 0.1, -1], [0.3, -0.3, -2], [0, 0.7, -0.3]):
        top = np.column_stack([inner, np.zeros(len(inner))])
        before, after = top - np.array(direction), top + np.array(direction)
        way = -2 * np.array(direction) if move else np.zeros(3)
        for scale in (1.0, 1.0 + 1e-12):
            motion = {"motion": lambda t, X, step=scale * way: X + t * step} if move else {}
            collider = Kinematic(mesh, thickness=thickness, **motion)
            touches = collider.touch(before, before if move else after, 0.0, 1.0)
            assert touches.vertex.tolist() == list(range(len(inner)))
            assert np.allclose(touches.normal, [0, 0, 1])
            assert np.allclose(touches.point - way, top + np.array([0, 0, thickness]), atol=1e-9)


def test_who_gets_into_a_deforming_mesh_is_held():
    def twisted(t, X):
        c, s = np.cos(2 * t * X[:, 1]), np.sin(2 * t * X[:, 1])
        return np.stack([c * X[:, 0] - s * X[:, 2], (1 + t) * X[:, 1], s * X[:, 0] + c * X[:, 2]], 1)

    mesh = Kinematic(pbng.shapes.box((0.4, 1.4, 1.0), 6, (-0.2, -0.7, -0.5)), motion=twisted)
    before = points(4000, 20)
    after = before + np.random.default_rng(21).normal(size=before.shape) * 0.2
    touches = mesh.touch(before, after, 0.2, 0.6)
    held = np.isin(np.arange(len(before)), touches.vertex)
    path = [(1 - s) * before + s * after for s in np.linspace(0, 1, 81)]
    d = np.stack([mesh.distance(x, t)[0] for x, t in zip(path, np.linspace(0.2, 0.6, 81))])
    assert (d < -0.01).any(0).sum() > 500
    assert held[(d < -0.01).any(0)].all()
    never = (d > 0.01).all(0) & (mesh.distance(before, 0.6)[0] > 0)  # nor would if it stayed where it is
    assert never.sum() > 1000
    assert not held[never].any()
    assert np.abs(mesh.distance(touches.point, 0.6)[0]).max() < 1e-12
    assert np.allclose(np.linalg.norm(touches.normal, axis=1), 1)


def parts(*placed):
    """One surface of cubes about the origin: their edge lengths, negative for one inside-out, and where they are."""
    X = np.concatenate([(CUBE.X - 0.5) * abs(edge) + at for edge, at in placed])
    triangles = [SURFACE[:, ::-1] if edge < 0 else SURFACE for edge, _ in placed]
    return pbng.TriMesh(X, np.concatenate([t + len(CUBE.X) * k for k, t in enumerate(triangles)]))


def test_cavities_are_outside():
    """A cube, hollow but for another cube within it, beside one more; also turned, and grown by its motion."""
    mesh = parts((1.0, (0, 0, 0)), (-0.6, (0, 0, 0)), (0.2, (0, 0, 0)), (1.0, (2, 0, 0)))
    p = np.array([[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0], [0.7, 0, 0], [2, 0, 0]])
    expected = np.array([-0.1, 0.1, -0.1, 0.2, -0.5])
    assert np.allclose(Kinematic(mesh).distance(p)[0], expected)
    turned = Kinematic(mesh, motion=Scale((-1, -1, 1), center=(0, 0, 0)), over=1.0)
    assert np.allclose(turned.distance(p * (-1, -1, 1), 1.0)[0], expected)
    grown = Kinematic(mesh, motion=Scale(2.0, center=(0, 0, 0)), over=1.0, start=0.5)
    assert np.allclose(grown.distance(2 * p, 1.5)[0], 2 * expected)


def test_a_cavity_may_touch_the_outside():
    """At a vertex that both have, and with a wall of no thickness: face upon face."""
    a, b = parts((1.0, (0, 0, 0)), (-0.5, (0.25, 0.25, 0.25))), parts((1.0, (0, 0, 0)), (-0.5, (0.25, 0, 0)))
    Kinematic(b)
    X, index = np.unique(a.X, axis=0, return_inverse=True)
    assert len(X) == 15
    d = Kinematic(pbng.TriMesh(X, index.ravel()[a.cells])).distance(np.array([[0.2, 0.2, 0.2], [-0.2, -0.2, -0.2]]))[0]
    assert np.allclose(d, [0.2, -0.3])


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Kinematic("dress.obj"), "Kinematic: expected a TriMesh or a TetMesh, not str"),
        (lambda: Kinematic(SHEET), r"the surface is open, with 4 boundary edges, the first from vertex \d to \d;"),
        (
            lambda: Kinematic(pbng.TriMesh(CUBE.X, SURFACE[:, ::-1]), name="body"),
            r"body: the surface is inside-out: its signed volume is -1 m³; reverse its triangles",
        ),
        (
            lambda: Kinematic(parts((1.0, (0, 0, 0)), (-0.3, (2, 0, 0))), name="body"),
            "body: the part of 12 triangles that vertex 10 belongs to is inside-out: its signed volume is -0.027 m³,"
            " and it is no cavity of another; reverse its triangles",
        ),
        (
            lambda: Kinematic(parts((1.0, (0, 0, 0)), (-1.0, (1, 0, 0)))),  # side by side, face upon face
            "vertex 10 belongs to is inside-out",
        ),
        (
            lambda: Kinematic(parts((-1.0, (0, 0, 0)), (-0.3, (0, 0, 0)))),  # nothing is inside of what is inside-out
            "vertex 2 belongs to is inside-out: its signed volume is -1 m³",
        ),
        (
            lambda: Kinematic(parts((1.0, (0, 0, 0)), (-0.5, (0, 0, 0)), (-0.3, (0, 0, 0)))),  # nor within a cavity
            "vertex 18 belongs to is inside-out",
        ),
        (
            lambda: Kinematic(CUBE, motion=Scale(-1.0), over=2.0, start=1.0, name="body"),
            "body: the surface is inside-out at the end of the motion, 3 s: its signed volume is -1 m³; the motion must"
            " not turn it over or flatten it",
        ),
        (
            lambda: Kinematic(CUBE, motion=Scale((1, 0, 1)) + Rotate((1, 2, 3), 0.1)),
            "the surface is inside-out at the end of the motion, 0 s: its signed volume is ",
        ),
        (
            lambda: Kinematic(  # the cavity leaves its cube
                parts((1.0, (0, 0, 0)), (-0.6, (0, 0, 0))),
                motion=lambda t, X: X + np.array([3.0, 0, 0]) * (np.arange(16) >= 8)[:, None],
            ),
            "vertex 10 belongs to is inside-out at the end of the motion",
        ),
        (
            lambda: Kinematic(
                CUBE, motion=pbng.Animation(np.array([0.0, 1.0]), np.stack([CUBE.X, CUBE.X * (1, 1, -1)]))
            ),
            "inside-out at the end of the motion, 1 s",
        ),
        (
            lambda: Kinematic(pbng.TriMesh(CUBE.X, np.concatenate([SURFACE[:5], SURFACE[5:6, ::-1], SURFACE[6:]]))),
            r"triangles \d+ and \d+ are oriented against each other at their edge \[\d, \d\] \(3 such edges\)",
        ),
        (
            lambda: Kinematic(
                pbng.TriMesh(
                    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], [[0, 1, 2], [1, 0, 3], [0, 1, 4]]
                ),
                thickness=0.1,
            ),
            r"edge \[0, 1\] belongs to 3 triangles, \[0, 1, 2\]",
        ),
        (
            lambda: Kinematic(CUBE, motion=pbng.Animation(np.zeros(1), np.zeros((1, 5, 3)))),
            "Kinematic: Animation has 5 vertices, the selection 8",
        ),
        (lambda: Kinematic(CUBE, motion=lambda t, X: X[:2]), r"Kinematic: motion <lambda>\(t=0\) must return finite"),
    ],
)
def test_bad_meshes_are_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()
