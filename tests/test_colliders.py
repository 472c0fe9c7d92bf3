"""Colliders: distances against other formulas and brute force, half-spaces on the right side, bad input named."""

from dataclasses import replace

import numpy as np
import pytest

import pbng
from pbng import Rotate, Scale, Translate
from pbng.contact.collider import Collider
from pbng.contact.colliders import Box, Capsule, Plane, Sphere, container
from pbng.contact.kinematic import Kinematic
from pbng.contact.touching import Shapes

SHAPES: dict[str, Collider] = {
    "plane": Plane((0.1, 0.2, 0.3), (1.0, 2.0, -0.5)),
    "sphere": Sphere((0.1, 0.2, 0.3), 0.5),
    "capsule": Capsule((-0.4, 0.1, 0.0), (0.5, 0.3, 0.2), 0.3),
    "box": Box((-0.3, -0.4, -0.5), (0.4, 0.2, 0.6)),
    "ball of tets": Kinematic(pbng.shapes.sphere(0.6, 6)),
    "tilted box": Kinematic(pbng.shapes.box((0.7, 0.6, 1.1), 3), motion=Rotate((1, 2, 3), 0.2)),
    "sheet": Kinematic(pbng.shapes.rectangle((1.0, 1.0), 4, (-0.5, -0.5)), thickness=0.01),
}
MOTION = Rotate("z", 0.3, center=(1.0, 0.0, 0.0)) + Translate((0.2, -0.1, 0.4))


def points(n, seed=0, low=-1.0, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, (n, 3))


def kept(touches, k):
    """Point and normal of vertex k, which must have one half-space."""
    (i,) = np.flatnonzero(touches.vertex == k)
    return touches.point[i], touches.normal[i]


# Distances


def test_analytic_distances():
    p = points(2000)
    assert np.allclose(SHAPES["sphere"].distance(p)[0], np.linalg.norm(p - [0.1, 0.2, 0.3], axis=1) - 0.5, atol=1e-14)
    n = np.array([1.0, 2.0, -0.5]) / np.sqrt(5.25)
    assert np.allclose(SHAPES["plane"].distance(p)[0], (p - [0.1, 0.2, 0.3]) @ n, atol=1e-14)
    q = np.abs(p - [0.05, -0.1, 0.05]) - [0.35, 0.3, 0.55]
    exact = np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)
    assert np.allclose(SHAPES["box"].distance(p)[0], exact, atol=1e-14)
    along = np.linspace([-0.4, 0.1, 0.0], [0.5, 0.3, 0.2], 4001)
    exact = np.array([np.linalg.norm(along - x, axis=1).min() for x in p]) - 0.3
    assert np.allclose(SHAPES["capsule"].distance(p)[0], exact, atol=1e-6)


def test_capsule_ends():
    capsule = Capsule((0, 0, 0), (1, 0, 0), 0.25)
    p = np.array([[2.0, 0, 0], [-1, 0, 0], [1, 0, 0], [0.5, 0.1, 0], [0.5, 0, 0], [1.15, 0, 0]])
    d, closest, normal = capsule.distance(p)
    assert np.allclose(d, [0.75, 0.75, -0.25, -0.15, -0.25, -0.1])
    assert np.allclose(closest[[0, 1, 3, 5]], [[1.25, 0, 0], [-0.25, 0, 0], [0.5, 0.25, 0], [1.25, 0, 0]])
    assert np.allclose(np.linalg.norm(normal, axis=1), 1)  # on the axis too
    assert np.allclose(normal[[2, 4], 0], 0)


@pytest.mark.parametrize("name", SHAPES)
def test_normal_is_the_gradient_and_closest_points_lie_on_the_surface(name):
    collider, p, h = SHAPES[name], points(400, 1), 1e-6
    d, closest, normal = collider.distance(p)
    gradient = np.stack(
        [(collider.distance(p + h * e)[0] - collider.distance(p - h * e)[0]) / (2 * h) for e in np.eye(3)], 1
    )
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1) < 1e-6  # not next to the medial axis
    assert smooth.mean() > 0.95
    assert np.abs(gradient - normal)[smooth].max() < 1e-5
    assert np.allclose(closest + d[:, None] * normal, p, atol=1e-12)
    assert np.abs(collider.distance(closest)[0]).max() < 1e-12


@pytest.mark.parametrize("name", SHAPES)
def test_a_point_of_the_surface_has_the_normal_of_its_face(name):
    collider = SHAPES[name]
    x, triangles = collider.surface()
    a, b, c = x[triangles].transpose(1, 0, 2)
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    d, _, normal = collider.distance((a + b + c) / 3)
    assert np.abs(d).max() < 0.01  # the drawn sphere is a polyhedron
    assert (np.einsum("ki,ki->k", normal, face) > 0.98).all()
    if isinstance(collider, Kinematic):
        assert np.abs(d).max() < 1e-15
        assert np.allclose(normal, face, atol=1e-12)


@pytest.mark.parametrize("name", ["sphere", "capsule", "box"])
def test_drawn_surfaces_are_closed_and_outward(name):
    x, triangles = SHAPES[name].surface()
    x, index = np.unique(np.round(x, 12), axis=0, return_inverse=True)  # a box is drawn with sharp edges
    Kinematic(pbng.TriMesh(x, index.ravel()[triangles]))  # which refuses anything else
    volume = {"sphere": np.pi / 6, "capsule": np.pi * (0.09 * np.sqrt(0.89) + 0.036), "box": 0.7 * 0.6 * 1.1}[name]
    a, b, c = x[index.ravel()[triangles]].transpose(1, 0, 2)
    assert np.einsum("mi,mi->", a, np.cross(b, c)) / 6 == pytest.approx(volume, rel=0.02)


# Motions


@pytest.mark.parametrize("name", ["plane", "sphere", "capsule", "box"])
def test_rigid_motions_take_the_distance_along(name):
    rest = SHAPES[name]
    fields = {f: getattr(rest, f) for f in type(rest).__dataclass_fields__ if f not in ("motion", "over", "start")}
    moving = type(rest)(**fields, motion=MOTION, over=2.0, start=1.0)
    assert moving.end == 3.0
    p = points(200, 6)
    for t, s in ((0.0, 0.0), (1.0, 0.0), (2.0, 0.5), (3.0, 1.0), (9.0, 1.0)):
        a = 2 * np.pi * 0.3 * s
        R = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        there = (p - [1, 0, 0]) @ R.T + [1, 0, 0] + s * np.array([0.2, -0.1, 0.4])
        d, closest, normal = rest.distance(p)
        assert np.allclose(moving.distance(there, t)[0], d, atol=1e-14)
        assert np.allclose(moving.distance(there, t)[2], normal @ R.T, atol=1e-12)
        found = (moving.distance(there, t)[1] - s * np.array([0.2, -0.1, 0.4]) - [1, 0, 0]) @ R + [1, 0, 0]
        assert np.allclose(found, closest, atol=1e-14)


# What touches


def plate(kind, **options):
    """Something thin in the plane x = 0."""
    if kind == "box":
        return Box((-0.0005, -1, -1), (0.0005, 1, 1), **options)
    if kind == "closed mesh":
        return Kinematic(pbng.shapes.box((0.001, 2, 2), 3, (-0.0005, -1, -1)), **options)
    sheet = pbng.shapes.rectangle((2, 2), 5, (-1, -1))
    X = np.column_stack([np.zeros(len(sheet.X)), sheet.X[:, :2]])
    return Kinematic(pbng.TriMesh(X, sheet.cells), thickness=0.001, **options)


MOVES = {
    "translation": Translate((1.0, 0, 0)),
    "function": lambda t, X: X + t * np.array([1.0, 0, 0]),
    "animation of two": None,
}


@pytest.mark.parametrize("kind", ["box", "closed mesh", "sheet"])
@pytest.mark.parametrize("move", MOVES)
def test_a_thin_plate_takes_along_what_it_sweeps_over(kind, move):
    if kind == "box" and move != "translation":
        pytest.skip("a box moves rigidly")
    motion = MOVES[move]
    if move == "animation of two":
        X = plate(kind).mesh.X
        motion = pbng.Animation(np.array([0.0, 1.0]), np.stack([X, X + np.array([1.0, 0, 0])]))
    p = np.array([[0.5, 0.13, 0.27], [0.5, 1.2, 0.0], [-0.1, 0.0, 0.0], [1.2, 0.1, 0.1]])
    collider = plate(kind, motion=motion, over=1.0)
    touches = collider.touch(p, p, 0.0, 1.0)
    assert touches.vertex.tolist() == [0]
    point, normal = kept(touches, 0)
    assert np.allclose(normal, [1, 0, 0])
    assert point[0] == pytest.approx(1.0005 if kind != "sheet" else 1.001)
    assert np.allclose(point[1:], [0.13, 0.27])
    assert np.allclose(collider.carried(point[None], 0.0, 1.0), [1, 0, 0])


@pytest.mark.parametrize("over", [0.0, 1.0])
@pytest.mark.parametrize("turns", [0.25, 1.0])
def test_a_turning_blade_takes_along_what_it_sweeps_over(over, turns):
    """Its ends are where they were after a whole turn; at once or over the step, the path is the same."""
    blade = Box((0, -0.001, -0.1), (1, 0.001, 0.1), motion=Rotate("z", turns, center=(0, 0, 0)), over=over, start=0.5)
    p = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.2], [1.0, 1.0, 0.0]])
    touches = blade.touch(p, p, 0.2, 2.0)
    assert touches.vertex.tolist() == [0]
    point, normal = kept(touches, 0)
    assert np.allclose(normal, [-1, 0, 0] if turns == 0.25 else [0, 1, 0], atol=1e-9)
    assert np.allclose(point, [-0.001, 0.5**0.5, 0] if turns == 0.25 else [0.5**0.5, 0.001, 0], atol=2e-3)


@pytest.mark.parametrize("kind", ["box", "closed mesh", "sheet"])
def test_fast_points_stop_at_a_thin_plate(kind):
    before = np.array([[-3.0, 0.1, 0.2], [3.0, 0.1, 0.2], [-3.0, 0.1, 1.2], [-3.0, 0.1, 0.2]])
    after = before + np.array([[6, 0, 0], [-6, 0, 0], [6, 0, 0], [2.9, 0, 0]])
    touches = plate(kind).touch(before, after, 0.0, 0.1, 0.01)
    assert touches.vertex.tolist() == [0, 1]
    half = 0.0005 if kind != "sheet" else 0.001
    for k, side in ((0, -1), (1, 1)):
        point, normal = kept(touches, k)
        assert np.allclose(normal, [side, 0, 0])
        assert np.allclose(point, [side * half, 0.1, 0.2], atol=1e-9)
        assert (plate(kind).carried(point[None], 0.0, 0.1) == 0).all()


@pytest.mark.parametrize("name", SHAPES)
def test_half_spaces_leave_the_body_out_and_the_start_in(name):
    collider = SHAPES[name]
    before = points(3000, 11)
    before = before[collider.distance(before)[0] > 0.02]
    after = before + np.random.default_rng(12).normal(size=before.shape)
    touches = collider.touch(before, after, 0.0, 0.1, 0.01)
    assert (np.diff(touches.vertex) > 0).all()
    if name not in ("sheet", "ball of tets"):  # the others are convex
        body = np.einsum("bi,ki->kb", collider.surface()[0], touches.normal)
        assert (body <= np.einsum("ki,ki->k", touches.point, touches.normal)[:, None] + 1e-9).all()
    path = np.linspace(before, after, 101)
    d = np.stack([collider.distance(x)[0] for x in path])
    free = np.setdiff1d(np.arange(len(before)), touches.vertex)
    assert (d[:, free] > 0).all()
    if name != "sheet":
        into = (d[:, touches.vertex] < -1e-3).any(0)
        assert into.sum() > 100
        room = np.einsum("ki,ki->k", before[touches.vertex] - touches.point, touches.normal)
        assert (room[into] > 0).all()


def test_a_point_at_the_start_of_its_path_is_held_where_it_hits():
    touches = Sphere((0, 0, 0), 1.0, thickness=0.1).touch([[-2.0, 0.6, 0]], [[2.0, 0.6, 0]], 0.0, 1.0)
    assert np.allclose(touches.normal, [[-0.8, 0.6, 0]])
    assert np.allclose(touches.point, [[-0.88, 0.66, 0]])


def test_who_never_comes_near_is_not_reported():
    before = np.array([[0.0, 2.0, 0], [0, 2.0, 0], [0, 2.0, 0], [3.0, 0, 0], [2.2, 0, 0]])
    after = np.array([[0.0, 1.2, 0], [0, 1.05, 0], [0, 2.0, 0], [3.0, 5.0, 0], [1.5, 2, 0]])
    for ball in (Sphere((0, 0, 0), 1.0), Sphere((0, 0, 0), 0.9, thickness=0.1)):
        assert ball.touch(before, after, 0.0, 1.0, 0.1).vertex.tolist() == [1]
        assert ball.touch(before, after, 0.0, 1.0, [0.3, 0.01, 0.1, 0.1, 0.1]).vertex.tolist() == [0]


@pytest.mark.parametrize("mesh", [False, True])
def test_what_penetrates_is_projected_to_the_closest_surface(mesh):
    low, high = np.array([0.0, 0, 0]), np.array([1.0, 2, 1])
    options = {"motion": Translate((5, 0, 0)), "over": 1.0}
    box = Kinematic(pbng.shapes.box(high, (3, 5, 3)), **options) if mesh else Box(low, high, **options)
    p = np.array([[0.9, 1.0, 0.5], [0.5, 0.1, 0.5], [0.4, 0.7, 0.95]])
    after = p + np.array([[5.0, 0, 0], [7.0, 0, 0], [0, 0, 0]])  # whatever they want
    touches = box.touch(p, after, 0.0, 1.0)
    assert touches.vertex.tolist() == [0, 1, 2]
    assert np.allclose(touches.point, [[6, 1, 0.5], [5.5, 0, 0.5], [5.4, 0.7, 1]])
    assert np.allclose(touches.normal, [[1, 0, 0], [0, -1, 0], [0, 0, 1]])
    assert np.allclose(box.carried(touches.point, 0.0, 1.0), [[5, 0, 0]] * 3)


@pytest.mark.parametrize("mesh", [False, True])
def test_on_the_surface_one_may_slide_off_an_edge_but_not_go_in(mesh):
    box = Kinematic(pbng.shapes.box((1, 1, 1), 3)) if mesh else Box((0, 0, 0), (1, 1, 1))
    before = np.array([[0.9, 1.0, 0.5], [0.9, 1.0, 0.5], [0.9, 1.0, 0.5]])
    after = np.array([[1.2, 0.8, 0.5], [1.2, 1.0, 0.5], [0.9, 1.3, 0.5]])
    touches = box.touch(before, after, 0.0, 1.0, 0.01)
    assert touches.vertex.tolist() == [0, 1, 2]
    assert np.allclose(touches.normal[[0, 2]], [0, 1, 0])  # the first goes through the corner
    assert np.allclose(touches.normal[1], [1, 0, 0])  # the second went around it
    room = np.einsum("ki,ki->k", after - touches.point, touches.normal)
    assert np.allclose(room, [-0.2, 0.2, 0.3])


def test_both_sides_of_a_sheet():
    sheet = plate("sheet", motion=Translate((0.5, 0, 0)), over=1.0, start=1.0)
    before = np.array([[0.002, 0.1, 0.1], [-0.002, 0.1, 0.1], [0.0005, 0.3, 0.1], [-0.0005, 0.3, 0.1], [0.0, 0.2, 0.2]])
    after = before * [-1, 1, 1]
    touches = sheet.touch(before, after, 0.0, 1.0)
    side = np.array([1, -1, 1, -1, touches.normal[-1, 0]])
    assert touches.vertex.tolist() == [0, 1, 2, 3, 4]
    assert np.allclose(touches.normal[:, 0], side)
    assert np.allclose(touches.point[:, 0], 0.001 * side)
    near = sheet.touch(before, before, 0.0, 1.0, 0.0005)  # within the thickness: 2, 3, 4
    assert near.vertex.tolist() == [2, 3, 4]
    assert np.allclose(near.normal[:, 0], side[2:])
    d, _, normal = sheet.distance(before)
    assert np.allclose(d, np.abs(before[:, 0]))
    assert np.allclose(normal[:4, 0], [1, -1, 1, -1])


# Containers


def test_container():
    planes = container((-1, 0, -2), (1, 3, 2), thickness=0.1, friction=0.3)
    assert len(planes) == 5
    assert len(container((-1, 0, -2), (1, 3, 2), open_top=False)) == 6
    assert all(p.thickness == 0.1 and p.friction == 0.3 for p in planes)
    assert planes[0].name == "container: floor"
    p = points(500, 13) * [2, 4, 3]
    d = np.min([plane.distance(p)[0] for plane in planes], axis=0)
    inside = (np.abs(p[:, 0]) < 1) & (p[:, 1] > 0) & (np.abs(p[:, 2]) < 2)
    assert ((d > 0) == inside).all()
    corners = np.concatenate([plane.surface()[0] for plane in planes])
    assert np.allclose(corners.min(0), [-1, 0, -2])
    assert np.allclose(corners.max(0), [1, 3, 2])


def test_a_container_turns_about_its_middle():
    turned = container(
        (-1, 0, -1), (1, 2, 1), open_top=False, motion=Rotate("z", 0.125) + Translate((0, 0, 1)), over=1.0
    )
    assert all(p.end == 1.0 for p in turned)
    d = np.array([p.distance(np.array([[0, 1, 1.0]]), 1.0)[0][0] for p in turned])
    assert np.allclose(d, 1.0)
    assert min(p.distance(np.array([[1.2, 1, 1.0]]), 1.0)[0][0] for p in turned) > 0  # where a corner is now


# Everything else


@pytest.mark.parametrize("name", SHAPES)
def test_same_input_same_bits(name):
    collider = SHAPES[name]
    before, after = points(1000, 14), points(1000, 15)
    one, two = (collider.touch(before, after, 0.0, 0.1, 0.05) for _ in range(2))
    for a, b in zip(one, two):
        assert a.tobytes() == b.tobytes()
    few = collider.touch(before[::2], after[::2], 0.0, 0.1, 0.05)  # whoever else is asked about
    same = one.vertex % 2 == 0
    assert (few.vertex * 2).tolist() == one.vertex[same].tolist()
    assert np.allclose(few.point, one.point[same], atol=1e-14)


@pytest.mark.parametrize("motion", [None, MOTION, Rotate("x", 2.0)], ids=["rest", "screw", "spin"])
@pytest.mark.parametrize("name", ["plane", "sphere", "capsule", "box"])
def test_whoever_else_is_asked_about(name, motion):
    """Far ones are left out in a hurry, by bounds that depend on all."""
    collider = replace(SHAPES[name], motion=motion, over=1.0)
    before = np.concatenate([points(300, 16), 4 * points(300, 17), 40 * points(300, 18)])
    after = before + 0.3 * points(900, 19)
    margin = 0.1 * np.random.default_rng(20).random(900)
    every = collider.touch(before, after, 0.1, 0.2, margin)
    assert 10 < len(every.vertex) < 800
    found = 0
    for k in range(900):
        alone = collider.touch(before[k : k + 1], after[k : k + 1], 0.1, 0.2, margin[k])
        if len(alone.vertex):
            point, normal = kept(every, k)
            assert np.allclose(alone.point, point, atol=1e-13)
            assert np.allclose(alone.normal, normal, atol=1e-13)
            found += 1
    assert found == len(every.vertex)


def test_shapes_asked_together():
    """Of each shape the same as if it were alone, whether it rests, moves or turns."""
    motions = {"plane": None, "sphere": MOTION, "capsule": Rotate("x", 2.0), "box": None}
    shapes = [replace(SHAPES[name], motion=motion, over=1.0) for name, motion in motions.items()]
    before = points(500, 23)
    after = before + 0.3 * points(500, 24)
    which, together = Shapes(shapes).touch(before, after, 0.1, 0.2, 0.05)
    assert (np.diff(which) >= 0).all()
    for k, shape in enumerate(shapes):
        alone = shape.touch(before, after, 0.1, 0.2, 0.05)
        assert len(alone.vertex) > 20
        for a, b in zip(together, alone):
            assert np.array_equal(a[which == k], b)
    assert len(Shapes([]).touch(before, after, 0.1, 0.2, 0.05)[0]) == 0


@pytest.mark.parametrize("name", SHAPES)
def test_nothing_to_ask(name):
    nothing = np.empty((0, 3))
    assert [len(a) for a in SHAPES[name].distance(nothing)] == [0, 0, 0]
    assert [len(a) for a in SHAPES[name].touch(nothing, nothing, 0.0, 1.0)] == [0, 0, 0]
    far = np.full((3, 3), 1e3) * (1 if name != "plane" else [1, 1, 0])
    assert [len(a) for a in SHAPES[name].touch(far, far, 0.0, 1.0)] == [0, 0, 0]


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: Plane((0, 0, 0), (0, 0, 0)), "Plane: the normal has no direction"),
        (lambda: Plane((0, np.nan, 0), (0, 1, 0)), "Plane: point: expected 3 finite numbers"),
        (lambda: Plane((0, 0, 0), (0, 1, 0), -1.0), "Plane: size must be positive and finite, not -1.0"),
        (lambda: Plane((0, 0, 0), (0, 1, 0), (1, 2, 3)), "size must be one or two numbers"),
        (lambda: Sphere((0, 0, 0), 0.0, name="head"), "head: radius must be positive and finite, not 0"),
        (lambda: Sphere((0, 0), 1.0), "Sphere: center: expected 3 finite numbers"),
        (lambda: Sphere((0, 0, 0), 1.0, thickness=-1e-3), "thickness must be finite and not negative, not -0.001"),
        (lambda: Sphere((0, 0, 0), 1.0, friction=np.inf), "friction must be finite and not negative, not inf"),
        (lambda: Sphere((0, 0, 0), 1.0, over=-1.0), "over must be finite and not negative"),
        (lambda: Sphere((0, 0, 0), 1.0, motion=3), "expected a motion"),
        (lambda: Sphere((0, 0, 0), 1.0, motion=Scale(2.0)), r"Sphere: its motion must be rigid: .*Scale"),
        (lambda: Sphere((0, 0, 0), 1.0, motion=Translate((1, 0, 0)) + Scale(2.0)), "must be rigid"),
        (lambda: Sphere((0, 0, 0), 1.0, motion=lambda t, X: X), r"must be rigid: .*Function"),
        (lambda: Capsule((0, 0, 0), (0, 0, 0), 1.0), "a and b are the same point"),
        (lambda: Box((0, 1, 0), (1, 1, 1)), "Box: low must be below high along each axis; along y it is 1.0 and 1.0"),
        (lambda: container((0, 0, 0), (1, 1, -1)), "container: low must be below high along each axis; along z"),
        (lambda: container((0, 0, 0), (1, 1, 1), motion=Scale(2.0)), "container: its motion must be rigid"),
    ],
)
def test_bad_input_is_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()
