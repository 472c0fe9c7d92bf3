"""Which vertices are inside of other solids, whatever moves how fast; tets tell."""

import numpy as np
import pytest

import pbng
from pbng.contact.bvh import BoxTree
from pbng.contact.detection import Detector
from pbng.contact.inside import NOTHING
from pbng.contact.queries import closest_triangles, containing_tets

CLOTH = pbng.Membrane(E=100.0, nu=0.3, density=0.1)
SOFT = pbng.Corotated(E=1e3, nu=0.3, density=10.0)


def inside(problem, x):
    """Of each vertex, whether a tet of another body contains it, None where it is at its surface."""
    out = np.zeros(problem.n_vert, object)
    for b in problem.bodies:
        if b.mesh.cells.shape[1] < 4:
            continue
        others = np.r_[: b.start, b.stop : problem.n_vert]
        found, _ = containing_tets(BoxTree(x, b.start + b.mesh.cells), x, x[others])
        *_, distance = closest_triangles(BoxTree(x, b.start + b.mesh.surface), x, x[others])
        out[others[found >= 0]] = True
        out[others[distance < 1e-6]] = None
    return out


@pytest.mark.parametrize("speed", [0.0, 1.0, 30.0])
def test_vertices_know_what_they_are_inside_of(rng, speed):
    """A ball goes through a box, both shaken, and some vertices fast: step by step each is inside where tets say so.

    A sheet in the box, along the way, is closest to what is deep inside, and comes to lie in both.
    """
    scene = pbng.Scene()
    scene.add(pbng.shapes.box((1.0, 0.7, 1.0), 5), SOFT, name="box")
    ball = scene.add(pbng.shapes.sphere(0.35, 5), SOFT, name="ball", at=(0.4, 1.2, 0.55))
    sheet = scene.add(pbng.shapes.sheet((0.5, 0.5), 6, origin=(0.25, 0.3, 0.25)), CLOTH, name="sheet")
    scene.contact()
    problem = scene.compile(free=True)
    shaken = problem.X + 0.01 * rng.normal(size=problem.X.shape)
    detector = Detector(problem.contact, problem.X, problem.fixed)
    surface, ins = detector.surfaces.vertex, detector.surfaces.insides
    most = 0
    for step in range(40):
        x = shaken + 0.001 * rng.normal(size=shaken.shape)
        x[ball.start : sheet.start, 1] -= 0.03 * step
        ahead = x + 0.01 * speed * rng.normal(size=x.shape) * (rng.random(len(x)) < 0.2)[:, None]
        ahead[ball.start : sheet.start, 1] -= 0.03
        detector.find(x, ahead, 0.01 * step, 0.01 * (step + 1), dt=0.01)
        wanted = inside(problem, x)[surface]
        sure = wanted != None  # noqa: E711 (element by element)
        found = ins.inside_of[0] != NOTHING
        np.testing.assert_array_equal(found[sure], wanted[sure].astype(bool))
        most = max(most, int(found[surface < sheet.start].sum()))
    assert most > 20


@pytest.mark.parametrize("by", [0.3, 0.6, 0.95])
def test_what_comes_near_in_one_step_takes_nothing_along(by):
    """A plate over a block is moved down without touching it; only its far side is known to move."""
    scene = pbng.Scene()
    block = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), SOFT, name="block")
    plate = scene.add(pbng.shapes.box((3.0, 0.2, 3.0), (14, 2, 14)), SOFT, name="plate", at=(-1.0, 2.0, -1.0))
    scene.pin(block.where(y=0))
    scene.move(plate.where(y=2.2), pbng.Translate((0, -by, 0)))
    scene.contact()
    result = pbng.solve(scene, pbng.PBNG(), pbng.Budget(rtol=1e-4))
    assert result.status is pbng.Status.CONVERGED
    np.testing.assert_allclose(result.x[: plate.start], scene.compile().X[: plate.start], atol=1e-6)
    assert result.x[plate.start :, 1].min() == pytest.approx(2 - by, abs=1e-3)


def test_the_outside_of_what_is_far_and_fast_tells_nothing():
    """What is deep in a torso sees of it, for a step, only an arm that comes near: it stays inside."""
    torso, arm = (
        pbng.shapes.box((1.0, 1.0, 1.0), 4),
        pbng.shapes.box((0.2, 1.0, 1.0), (2, 4, 4), origin=(1.2, 0.0, 0.0)),
    )
    both = pbng.TetMesh(np.concatenate([torso.X, arm.X]), np.concatenate([torso.cells, torso.n_vert + arm.cells]))
    scene = pbng.Scene()
    scene.add(both, SOFT, name="body")
    rod = scene.add(pbng.shapes.box((0.2, 1.0, 0.2), (3, 6, 3)), SOFT, name="rod", at=(0.4, 0.5, 0.4))
    scene.contact()
    problem = scene.compile(free=True)
    detector = Detector(problem.contact, problem.X, problem.fixed)
    x, ins = problem.X, detector.surfaces.insides
    ahead = x.copy()
    ahead[torso.n_vert : rod.start][np.isclose(arm.X[:, 0], 1.2), 0] -= 0.6
    inside_of = []
    for to in (x, ahead, x):
        detector.find(x, to, 0.0, 0.01, dt=0.01)
        inside_of.append(ins.inside_of[0] != NOTHING)
    assert inside_of[0].sum() > 5
    for later in inside_of[1:]:
        assert np.array_equal(later, inside_of[0])
