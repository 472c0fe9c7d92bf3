"""``scene.bind``: closest points, given points, motions, stiffness; and what it refuses."""

import numpy as np
import pytest

import pbng
from pbng.closest import closest_on_faces

FLESH = pbng.Corotated(E=1e4, nu=0.3, density=10)
BOX = pbng.shapes.box(size=(1, 1, 1), vertices=(3, 3, 3))


@pytest.fixture
def scene():
    scene = pbng.Scene()
    upper, lower = (
        scene.add(BOX, FLESH, name="upper", at=(0, 1.2, 0)),
        scene.add(BOX, FLESH, name="lower", at=(0.1, 0, 0.1)),
    )
    scene.pin(upper.where(y=2.2))
    return scene, upper, lower


def rest_gaps(problem):
    return problem.weak_energy.gaps(problem.X, problem.targets(problem.end))


@pytest.mark.parametrize("corners", [1, 2, 3])
def test_closest_on_faces_looks_at_all(rng, corners):
    X, p = rng.standard_normal((40, 3)), rng.standard_normal((50, 3))
    faces = np.stack([rng.permutation(40)[:corners] for _ in range(30)])
    face, weights = closest_on_faces(p, X, faces)
    found = np.linalg.norm(np.einsum("nk,nkd->nd", weights, X[faces[face]]) - p, axis=1)
    for f in faces:
        _, w = closest_on_faces(p, X, f[None])
        assert (found <= np.linalg.norm(w @ X[f] - p, axis=1) + 1e-12).all()


def test_vertices_to_the_closest_points_of_a_body(scene):
    """The gap between two faces: each spring is as long as the gap is wide, and straight where it can be."""
    scene, upper, lower = scene
    scene.bind(lower.where(y=1.0), upper, k=10.0)
    gaps = rest_gaps(scene.compile())
    assert len(gaps) == 9
    np.testing.assert_allclose(gaps[:, 1], -0.2, atol=1e-12)
    inside = np.abs(gaps[:, [0, 2]]).max(1) < 1e-12
    assert inside.sum() == 4  # the others hang over the edge by 0.1
    np.testing.assert_allclose(np.abs(gaps[~inside][:, [0, 2]]).max(1), 0.1, atol=1e-12)


def test_a_selection_without_faces_gives_its_vertices(scene):
    scene, upper, lower = scene
    corner = upper.where(x=0.0, y=1.2, z=0.0)
    scene.bind(lower.where(x=0.1, y=1.0, z=0.1), corner, k=1.0)
    np.testing.assert_allclose(rest_gaps(scene.compile()), [[0.1, -0.2, 0.1]], atol=1e-12)


def test_given_points(scene):
    """Tet to edge: weights as told, zeros left out of the stencil."""
    scene, upper, lower = scene
    a = lower.points([[0, 1, 2, 3]], [[0.1, 0.2, 0.0, 0.7]])
    b = upper.points([[4, 5]], [[0.25, 0.75]])
    scene.bind(a, b, k=3.0)
    (w,) = scene.compile().weak
    n = lower.start
    assert dict(zip(w.vertices[0].tolist(), w.weights[0].tolist())) == {
        n: 0.1, n + 1: 0.2, n + 3: 0.7, 4: -0.25, 5: -0.75,
    }  # fmt: skip
    np.testing.assert_array_equal(w.K, 3 * np.eye(3)[None])


def test_stiffness_along_and_across_the_normal(scene):
    """K = k_n n nᵀ + k_τ (I - n nᵀ), with the normal of the closest face by default."""
    scene, upper, lower = scene
    scene.bind(lower.where(y=1.0), upper.where(y=1.2), k_n=5.0, k_tau=2.0)
    scene.bind(lower.where(x=0.1), [0.0, 0, 0], k_n=np.full(9, 4.0), normal=(0, 0, 3.0))
    problem = scene.compile()
    for w in problem.weak:
        expected = np.diag([0.0, 0, 4]) if w.anchored else np.diag([2.0, 5, 2])
        np.testing.assert_allclose(w.K, np.broadcast_to(expected, w.K.shape), atol=1e-12)


def test_points_that_move(scene):
    """A motion is that of the points from rest; its end is the scene's."""
    scene, _, lower = scene
    face = lower.where(y=0.0)
    scene.bind(face, pbng.Translate((0, -1, 0)), k=1e9, over=2.0, start=1.0)
    problem = scene.compile()
    assert problem.end == 3.0
    X = problem.X[face.index]
    for t, share in ((0.0, 0.0), (1.0, 0.0), (2.0, 0.5), (9.0, 1.0)):
        np.testing.assert_allclose(problem.targets(t), X - [0, share, 0], atol=1e-12)
    x = pbng.solve(problem, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-9, iterations=2000), at=2.0).x
    np.testing.assert_allclose(x[face.index], X - [0, 0.5, 0], atol=1e-6)


def test_frames_follow_moving_points(scene):
    scene, _, lower = scene
    scene.bind(lower.where(y=0.0), lambda t, X: X + np.array([0, 0, t]), k=1e9)
    frames = list(pbng.simulate(scene, pbng.PBNG(dtype="float64"), pbng.Budget(iterations=300), frames=3, fps=10))
    for frame in frames:
        z = frame.x[lower.where(y=0.0).index, 2] - frame.problem.X[lower.where(y=0.0).index, 2]
        np.testing.assert_allclose(z, frame.t, atol=1e-5)


def test_a_bound_body_is_not_loose(scene, caplog):
    scene, upper, lower = scene
    scene.compile()
    assert "body 'lower'" in caplog.text
    caplog.clear()
    scene.bind(lower.where(y=1.0), upper, k=1.0)
    scene.compile()
    assert caplog.text == ""


def test_springs_to_points_hold_a_scene():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = scene.add(BOX, FLESH)
    scene.bind(body.where(x=0.0), pbng.Translate((0, 0, 0)), k=1e4)
    result = pbng.solve(scene, budget=pbng.Budget(rtol=1e-8))
    assert result.status is pbng.Status.CONVERGED


def test_in_the_plane_z_does_not_move():
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.rectangle(size=(1, 1), vertices=(4, 4)), FLESH)
    scene.pin(body.where(x=0.0))
    scene.bind(body.where(x=1.0), [2.0, 0.5, 7.0], k=1e3)
    result = pbng.solve(scene, budget=pbng.Budget(rtol=1e-8))
    assert result.status is pbng.Status.CONVERGED
    assert (result.x[:, 2] == 0).all()
    assert result.x[:, 0].max() > 1.05


def test_bad_bindings_are_named(scene):
    scene, upper, lower = scene
    top = lower.where(y=1.0)
    other = pbng.Scene().add(BOX, FLESH, name="stranger")
    for arguments, more, word in [
        ((lower.where(x=9.0), upper), {"k": 1}, "selects no vertex"),
        ((top, upper), {}, "either k, or k_n"),
        ((top, upper), {"k": 1, "k_n": 1}, "either k, or k_n"),
        ((top, upper), {"k": -1.0}, "k must be finite and not negative, not -1"),
        ((top, upper), {"k": np.inf}, "k must be finite and not negative, not inf"),
        ((top, upper), {"k": [1, 2]}, r"k must be a number or have shape \(9,\)"),
        ((top, upper), {"k_n": 1, "k_tau": -2}, "k_tau must be finite and not negative, not -2"),
        ((top, [0, 0, 0]), {"k_n": 1}, "k_n needs normal="),
        ((top, upper), {"k_n": 1, "normal": (0, 0, 0)}, "normal 0 has no direction"),
        ((top, upper), {"k_n": 1, "normal": (0, 1)}, "normal must have shape"),
        ((top, other), {"k": 1}, "'stranger' belongs to another scene"),
        ((top, other.points([[0]], [[1]])), {"k": 1}, "'stranger' belongs to another scene"),
        ((top, upper.points([[0]], [[1]])), {"k": 1}, "9 points cannot be tied to 1"),
        ((top, top), {"k": 1}, "point 0 would be tied to itself"),
        ((top, "ceiling"), {"k": 1}, "expected points, a body"),
        ((top, [0, np.nan, 0]), {"k": 1}, "position 0 is not finite"),
        ((top, [[0, 0, 0]] * 2), {"k": 1}, "expected points, a body"),
        ((top, pbng.Translate((0, 1, 0))), {"k": 1, "over": -1}, "over and start must be finite"),
        (("top", upper), {"k": 1}, "expected a selection"),
    ]:
        with pytest.raises(pbng.InputError, match=word):
            scene.bind(*arguments, **more)
    for vertices, weights, word in [
        ([[0, 1]], [[0.5, 0.4]], "weights of point 0 sum to 0.9, not to 1"),
        ([[0, 99]], [[0.5, 0.5]], r"point 0 names vertices \[0, 99\]; there are 27"),
        ([[0, 1]], [[1.0]], "must have one shape"),
        ([[0.5]], [[1.0]], "whole numbers"),
        ([[0], [1]], [[1], [np.nan]], "weights of point 1 sum to nan"),
        (np.empty((0, 2), int), np.empty((0, 2)), "must have one shape"),
    ]:
        with pytest.raises(pbng.InputError, match=word):
            lower.points(vertices, weights)
