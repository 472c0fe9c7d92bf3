"""How far contacts are searched for in a step, and what is left out of the search."""

import numpy as np
import pytest

import pbng
import pbng.gallery
from pbng.contact.detection import Detector
from pbng.contact.quiet import Quiet
from pbng.motions import Translate

CLOTH = pbng.Membrane(E=100.0, nu=0.3, density=0.1)
SOFT = pbng.Corotated(E=1e3, nu=0.3, density=10.0)


def detector_of(*meshes, materials, **rules):
    scene = pbng.Scene()
    for k, (mesh, material) in enumerate(zip(meshes, materials)):
        scene.add(mesh, material, name=str(k))
    scene.contact(**rules)
    problem = scene.compile(free=True)
    return problem, Detector(problem.contact, problem.X, problem.fixed)


@pytest.mark.parametrize("speed", [0.2, 1.0])  # times the gap: slow, and fast enough for ways to count
def test_of_two_that_fly_together_either_may_stop(speed):
    """Two sheets, one over the other, fall by more than their gap: should one stop, the other would go through it."""
    sheets = [pbng.shapes.sheet((1.0, 1.0), 6, origin=(0.0, 0.3 * k, 0.0)) for k in range(2)]
    problem, detector = detector_of(*sheets, materials=[CLOTH] * 2, thickness=0.05)
    x, way = problem.X, np.array([0.0, -0.3 / 0.9 * speed, 0.0])
    found = detector.find(x, x + way, 0.0, 0.01, dt=0.01)
    vertices = {int(v) for v, w in zip(found.vertices[:, 0], found.weights[:, 0]) if w == 1}
    assert vertices == (set(range(problem.n_vert)) if speed == 1.0 else set())


def test_what_flies_together_is_not_searched_for_far_away():
    """Two sheets that are farther apart than either goes, and not three times that."""
    sheets = [pbng.shapes.sheet((1.0, 1.0), 6, origin=(0.0, 0.9 * k, 0.0)) for k in range(2)]
    problem, detector = detector_of(*sheets, materials=[CLOTH] * 2, thickness=0.05)
    half = problem.n_vert // 2
    for upper, found in ((-0.5, False), (-1.3, True)):  # where it is expected, they meet
        ahead = problem.X.copy()
        ahead[:half, 1] -= 0.5
        ahead[half:, 1] += upper
        contacts = detector.find(problem.X, ahead, 0.0, 0.01, dt=0.01)
        assert bool(len(contacts.vertices)) == found


def test_a_bowl_that_flies_does_not_meet_its_own_smooth_surface():
    """Though its inner side lies in front of itself."""
    slab = pbng.shapes.box((2.0, 0.2, 2.0), (17, 3, 17), origin=(-1.0, 0.0, -1.0))
    X = slab.X + np.column_stack([0 * slab.X[:, 0], 0.3 * (slab.X[:, [0, 2]] ** 2).sum(1), 0 * slab.X[:, 0]])
    _, detector = detector_of(pbng.TetMesh(X, slab.cells), materials=[SOFT], self_collision=True)
    found = detector.find(X, X + np.array([0.3, -0.2, 0.1]), 0.0, 0.01, dt=0.01)
    middle = (np.abs(X[:, [0, 2]]) < 0.7).all(1)
    assert not middle[found.vertices[:, 0]].any()


def test_a_thin_edge_meets_what_is_below_it():
    """Of one body a wedge over a block; its tips' mean normals point up, along that of the block's top."""
    block, layers, angle, gap = pbng.shapes.box((6.0, 1.0, 6.0), 2, origin=(-3.0, -1.0, -3.0)), 4, 0.2, 0.02
    X = np.array([[a, b, 0.4 * k] for k in range(layers) for a, b in ((0.6, gap), (0.0, gap + angle), (1.0, gap))])
    cells = []
    for k in range(layers - 1):
        a, b, c, d, e, f = range(3 * k, 3 * k + 6)
        cells += [[a, b, c, f], [a, b, f, e], [a, e, f, d]]
    cells = np.array(cells)
    turned = np.linalg.det(X[cells[:, 1:]] - X[cells[:, :1]]) < 0
    cells[turned] = cells[turned][:, [1, 0, 2, 3]]
    both = pbng.TetMesh(np.concatenate([block.X, X]), np.concatenate([block.cells, block.n_vert + cells]))
    problem, detector = detector_of(both, materials=[SOFT], self_collision=True)
    ahead = problem.X.copy()
    ahead[block.n_vert :, 1] -= 0.05
    found = detector.find(problem.X, ahead, 0.0, 0.01, dt=0.01)
    vertices = {int(v) - block.n_vert for v, w in zip(found.vertices[:, 0], found.weights[:, 0]) if w == 1}
    assert vertices >= {k for k in range(3 * layers) if X[k, 1] == gap}


def test_what_is_inside_its_own_body_leaves_by_the_closest_way():
    """However far is looked for a part that it faces."""
    slab, post = pbng.shapes.box((1.2, 0.4, 1.2), (4, 2, 4)), pbng.shapes.box((0.4, 0.88, 0.4), (4, 3, 4))
    post = pbng.TetMesh(post.X + np.array([0.4, -2.0, 0.4]), post.cells)
    both = pbng.TetMesh(np.concatenate([slab.X, post.X]), np.concatenate([slab.cells, slab.n_vert + post.cells]))
    problem, detector = detector_of(both, materials=[SOFT], self_collision=True)
    x = problem.X.copy()
    x[slab.n_vert :, 1] += 1.5  # its top 0.02 below that of the slab
    top = np.flatnonzero(np.isclose(x[:, 1], 0.38))
    for ahead in (0.0, 0.4):
        found = detector.find(x, x, 0.0, 0.0, None, ahead)
        mine = np.isin(found.vertices[:, 0], top) & (found.weights[:, 0] == 1)
        assert mine.sum() == len(top)
        np.testing.assert_allclose(found.normal[mine], [[0.0, 1.0, 0.0]] * len(top), atol=1e-9)


def test_quiet_cloth_finds_what_it_would_find_if_all_asked(monkeypatch):
    """Who is known to be alone need not ask; where vertices go too far, or one looks farther, nothing is known."""
    recipe = pbng.gallery.cloth_on_sphere(resolution=16)
    asked, last = [], []
    alone = Quiet.alone

    def noted(self, x, way, radius):
        known = alone(self, x, way, radius)
        asked.append(len(x) - (0 if known is None else len(known)))
        return known

    monkeypatch.setattr(Quiet, "alone", noted)
    for never in (False, True):
        if never:
            monkeypatch.setattr(Quiet, "pays", lambda self: False)
        frames = pbng.simulate(recipe.scene, budget=recipe.budget, inertia=True, substeps=8, frames=60, fps=recipe.fps)
        last.append([f.x for f in frames][-1])
        if not never:
            assert np.mean(np.array(asked[200:]) < 100) > 0.5  # of 256
    assert np.array_equal(*last)

    quiet, x, room = Quiet(), np.zeros((4, 3)), np.full(4, 1.0)
    quiet.note(x, room, 0.5, np.array([2]))
    assert quiet.alone(x, np.full(4, 0.9), 0.5).tolist() == [2]
    assert quiet.alone(x, np.full(4, 0.9), 0.6) is None
    assert quiet.alone(x + 0.2, np.full(4, 0.9), 0.5) is None
    assert quiet.alone(x + np.nan, np.full(4, 0.1), 0.5) is None
    quiet.forget()
    assert quiet.alone(x, room, 0.0) is None


class Sieve(pbng.Plane):
    """A plane that holds nobody."""

    def touch(self, before, after, t0, t1, reach=0.0):
        return super().touch(before[:0], after[:0], t0, t1, 0.0)


class Belt(pbng.Plane):
    """A plane that does not move, but whose material does."""

    def carried(self, points, t0, t1):
        return np.tile([t1 - t0, 0.0, 0.0], (len(points), 1))


def test_colliders_of_all_kinds_in_the_order_given():
    """Meshes, shapes and what a user made of them: each holds with its own friction, and carries along as it does."""
    floor = pbng.Kinematic(pbng.shapes.box((4.0, 1.0, 4.0), 3, origin=(-2.0, -1.0, -2.0)), friction=0.1)
    moving = pbng.Plane((0, 0, 0), (0, 1, 0), friction=0.4, motion=Translate((0.0, 0.0, 1.0)), over=1.0)
    belt = Belt((0, 0, 0), (0, 1, 0), friction=0.3)
    scene = pbng.Scene()
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT)
    scene.collide_with([belt, floor, Sieve((0, 0, 0), (0, 1, 0), friction=0.2), moving])
    problem = scene.compile(free=True)
    detector = Detector(problem.contact, problem.X, problem.fixed)
    borne = np.tile([0.0, 1.0, 0.0], (problem.n_vert, 1))
    found = detector.find(problem.X, problem.X, 0.0, 0.5, dt=0.5, borne=borne)
    n = int((problem.X[:, 1] == 0).sum())
    assert len(found.vertex) == 3 * n
    np.testing.assert_array_equal(found.vertex.reshape(3, n), [found.vertex[:n]] * 3)
    np.testing.assert_allclose(found.friction.reshape(3, n)[0], 0.3)  # the first of equals bears
    slips = (found.anchor - problem.X[found.vertex]).reshape(3, n, 3)
    np.testing.assert_allclose(slips, np.repeat([[[0.5, 0, 0]], [[0, 0, 0]], [[0, 0, 0.5]]], n, axis=1), atol=1e-12)


@pytest.mark.parametrize("shape", [(3,), (4, 2)])
def test_what_is_no_points_is_refused(shape):
    ball, p = pbng.Sphere((0, 0, 0), 1.0), np.zeros((4, 3))
    with pytest.raises(pbng.InputError, match="points must have shape"):
        ball.distance(np.ones(shape))
    for before, after in ((np.ones(shape), p), (p, np.ones(shape)), (p, p[:1])):
        with pytest.raises(pbng.InputError, match="points must have shape"):
            ball.touch(before, after, 0.0, 1.0)
