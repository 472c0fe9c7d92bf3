"""Small scenes in which things touch: themselves, cloth, and colliders that move fast."""

import numpy as np
import pytest

import pbng

RUBBER = pbng.Corotated(E=1e4, nu=0.3, density=100.0)


def hairpin():
    """A bar bent into a U: arms 0.8 m apart, 0.3 m thick."""
    mesh = pbng.shapes.box((3.0, 0.3, 0.3), (31, 4, 4), origin=(-1.5, 0, 0))
    s, y, R = mesh.X[:, 0], mesh.X[:, 1], 0.4
    bend = np.pi * R / 2
    turn, beyond = np.clip(s, -bend, bend) / R, np.maximum(np.abs(s) - bend, 0)
    X = np.column_stack([(R + y) * np.sin(turn), beyond - (R + y) * np.cos(turn), mesh.X[:, 2]])
    return pbng.TetMesh(X, mesh.cells)


@pytest.mark.parametrize("inertia", [False, True])
def test_arms_that_are_pressed_together_touch_and_do_not_pass(inertia):
    scene = pbng.Scene()
    body = scene.add(hairpin(), RUBBER, name="hairpin")
    scene.pin(body.where(y=(-0.8, -0.65)))
    way = pbng.Translate((0.46, 0, 0)), pbng.Translate((-0.46, 0, 0))
    scene.collide_with(
        [
            pbng.Plane((-0.75, 0, 0), (1, 0, 0), motion=way[0], over=0.5),
            pbng.Plane((0.75, 0, 0), (-1, 0, 0), motion=way[1], over=0.5),
        ]
    )
    scene.contact(self_collision=True)
    options = {"inertia": True, "substeps": 4} if inertia else {}
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=100), frames=16, **options))
    assert frames[0].contact.pairs == 0
    last = frames[-1]
    assert last.contact.pairs > 4
    assert last.contact.deepest < 0.01
    assert last.result.inverted == 0
    left = body.where(lambda X: X[:, 0] < 0).vertices
    right = body.where(lambda X: (X[:, 0] > 0) & (X[:, 1] > 0)).vertices
    upper = left[body.mesh.X[left, 1] > 0]
    assert last.x[upper, 0].max() < last.x[right, 0].min() + 0.03


def test_cloth_catches_a_ball_and_both_pull_alike():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    cloth = scene.add(pbng.shapes.sheet((1.0, 1.0), 13), pbng.Membrane(E=2000.0, nu=0.3, density=0.5), name="cloth")
    rim = cloth.where(lambda X: (np.abs(X - X.mean(0)) > 0.499).any(1))
    scene.pin(rim)
    middle = cloth.mesh.X.mean(0)
    ball = scene.add(pbng.shapes.sphere(0.2, 7), RUBBER, name="ball", at=middle + np.array([0, 0.25, 0]))
    scene.contact()
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=30), frames=60, inertia=True, substeps=2))
    last = frames[-1]
    x = last.x[ball.start : ball.start + ball.mesh.n_vert]
    assert np.abs(x.mean(0) - middle)[[0, 2]].max() < 0.1
    assert -0.5 < x[:, 1].min() - middle[1] < 0.0
    assert last.contact.pairs > 5
    assert last.contact.deepest < 0.01
    assert last.result.inverted == 0
    speed = np.abs(last.v[ball.start : ball.start + ball.mesh.n_vert]).mean()
    assert speed < 0.5


def crossings(x, triangles, edges):
    """How many times an edge passes through a triangle that it shares no vertex with, at x (n, 3)."""
    corners = x[triangles].transpose(1, 0, 2)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    side = x @ normal.T - (corners[0] * normal).sum(1)
    p, q = side[edges[:, 0]], side[edges[:, 1]]
    apart = (edges[:, :, None, None] != triangles).all((1, 3))
    e, t = np.nonzero((p * q < 0) & apart)
    share = p[e, t] / (p[e, t] - q[e, t])
    hit = x[edges[e, 0]] + share[:, None] * (x[edges[e, 1]] - x[edges[e, 0]])
    inside = np.ones(len(e), bool)
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):
        inside &= (np.cross(b[t] - a[t], hit - a[t]) * normal[t]).sum(1) > 0
    return int(inside.sum())


def test_crossings_are_counted():
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0.2, 1, 0.2], [0.2, -1, 0.2], [0.9, 1, 0.9]])
    edges = np.array([[3, 4], [5, 4], [5, 3], [0, 1]])
    assert [crossings(x, np.array([[0, 1, 2]]), edges[[k]]) for k in range(4)] == [1, 0, 0, 0]


def test_cloth_does_not_pass_through_itself():
    """A sheet is folded over by its edge, which comes to lie 3 cm above the other, and lies on itself."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    sheet = pbng.shapes.sheet((1.0, 0.4), (26, 11))
    cloth = scene.add(sheet, pbng.Membrane(E=500.0, nu=0.3, density=0.2), pbng.Bending(k=1e-4), name="cloth")
    low, high = sheet.X[:, 0].min(), sheet.X[:, 0].max()
    scene.pin(cloth.where(x=low))
    middle = [(low + high) / 2, sheet.X[0, 1] + 0.015, 0.0]
    turn = pbng.Rotate("z", 0.5, center=middle)
    scene.move(cloth.where(x=high), turn, over=0.5, until=0.6)
    scene.collide_with(pbng.Plane((0, sheet.X[0, 1] - 0.02, 0), (0, 1, 0)))
    scene.contact(self_collision=True)
    frames = list(pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=30), frames=40, inertia=True, substeps=4))
    last = frames[-1]
    assert last.contact.pairs > 100
    kept = last.problem.contact.surfaces.skin[0] * 2
    assert max(f.contact.deepest for f in frames[1:]) < 0.02 * kept
    assert [crossings(np.asarray(f.x, float), sheet.cells, sheet.edges) for f in frames[::4]] == [0] * 10
    # What was the upper side of the moved half now lies face down on the other half.
    over = cloth.where(x=(high - 0.3, high - 0.1)).vertices
    under = cloth.where(x=(low + 0.1, low + 0.3)).vertices
    assert last.x[over, 1].mean() > last.x[under, 1].mean() + 0.5 * kept


def crossed():
    """Two bars at right angles, each upon an edge, which cross between vertices: the upper's lowest and the lower's
    highest, of which the middles of both are given."""
    scene = pbng.Scene()
    mesh = pbng.shapes.box((1.2, 0.3, 0.3), (6, 2, 2), origin=(-0.6, -0.15, -0.15))
    c = np.sqrt(0.5)
    X = mesh.X @ np.array([[1, 0, 0], [0, c, c], [0, -c, c]])
    lower = scene.add(pbng.TetMesh(X, mesh.cells), RUBBER, name="lower")
    X = X @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    upper = scene.add(pbng.TetMesh(X, mesh.cells), RUBBER, name="upper", at=(0, 0.6 * c + 0.02, 0))
    scene.pin(lower.where(x=(-0.6, -0.59)))
    scene.pin(lower.where(x=(0.59, 0.6)))
    scene.contact()
    ridge = lower.where(lambda X: (X[:, 1] > 0.2) & (np.abs(X[:, 0]) < 0.2)).index
    keel = upper.where(lambda X: (X[:, 1] < X[:, 1].min() + 0.01) & (np.abs(X[:, 2]) < 0.2)).index
    assert len(ridge) == len(keel) == 2
    return scene, upper, ridge, keel


@pytest.mark.parametrize("how", ["dropped", "pressed", "pressed slowly"])
def test_edges_do_not_pass_through_edges(how):
    """Vertices would find the other bar's sides only half an edge, 0.12 m, further down."""
    scene, upper, ridge, keel = crossed()
    velocity = None
    if how == "dropped":
        velocity = np.zeros((2 * upper.start, 3))
        velocity[upper.start :, 1] = -2.0
    else:
        scene.move(upper.where(lambda X: np.abs(X[:, 2]) > 0.59), pbng.Translate((0, -0.25, 0)), over=0.3)
    inertia = how != "pressed slowly"
    frames = list(
        pbng.simulate(
            scene, pbng.PBNG(), pbng.Budget(rtol=1e-3, iterations=300), frames=12, inertia=inertia, velocity=velocity
        )
    )
    height = [(f.x[keel, 1] - f.x[ridge, 1]).mean() for f in frames]
    assert min(height) > -0.015
    assert frames[-1].x[ridge, 1].mean() < frames[0].x[ridge, 1].mean() - 0.05
    assert frames[-1].result.inverted == 0


@pytest.mark.parametrize("collider", ["plate", "bullet"])
def test_what_moves_fast_does_not_pass(collider):
    """A thin plate hits a cube from the side, faster than the cube is wide in a step; or the cube a plate."""
    scene = pbng.Scene()
    cube = scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 4), RUBBER, name="cube")
    velocity = np.zeros((cube.mesh.n_vert, 3))
    low, high = (-0.5, -1.0, -1.0), (-0.49, 1.0, 1.0)
    if collider == "plate":
        scene.collide_with(pbng.Box(low, high, motion=pbng.Translate((2.0, 0, 0)), over=0.1))
    else:
        scene.collide_with(pbng.Box(low, high))
        velocity[:, 0] = -30.0
    frames = list(
        pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=50), frames=4, inertia=True, velocity=velocity)
    )
    t = frames[-1].t
    front = -0.49 + (2.0 * min(t / 0.1, 1.0) if collider == "plate" else 0.0)
    assert frames[-1].x[:, 0].min() > front - 1e-5
