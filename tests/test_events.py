"""Pins that let go, motions that stop, bodies that wait."""

import logging

import numpy as np
import pytest

import pbng

RUBBER = pbng.Corotated(E=1e4, nu=0.3, density=100.0)


def cube(scene, name="cube", **options):
    return scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 3), RUBBER, name=name, **options)


@pytest.mark.parametrize("compiled", [False, True])
def test_what_is_let_go_falls_freely(compiled):
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = cube(scene)
    scene.pin(body.where(), until=0.5)
    scene = scene.compile(free=True) if compiled else scene
    frames = list(
        pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-6), frames=11, fps=10, inertia=True, substeps=5)
    )
    height = np.array([f.x[:, 1].mean() for f in frames]) - 0.1
    assert np.all(height[:6] == pytest.approx(0, abs=1e-8))
    steps = 5 * np.arange(1, 6)
    assert height[6:] == pytest.approx(-9.8 * 0.02**2 * steps * (steps + 1) / 2, rel=1e-4)


def test_a_body_waits_and_then_falls():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    cube(scene, "early")
    cube(scene, "late", at=(1, 0, 0), wait=0.3)
    *_, last = pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-6), frames=7, fps=10, inertia=True, substeps=4)
    early, late = (last.x[b.start : b.stop, 1].mean() - 0.1 for b in last.problem.bodies)
    assert early == pytest.approx(-9.8 * 0.6**2 / 2, rel=0.06)
    assert late == pytest.approx(-9.8 * 0.3**2 / 2, rel=0.1)


def test_quasistatic_release_goes_to_the_other_equilibrium():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    bar = scene.add(pbng.shapes.box((1.0, 0.2, 0.2), (11, 3, 3)), RUBBER)
    scene.pin(bar.where(x=0))
    scene.pin(bar.where(x=1), until=0.1)
    frames = list(pbng.simulate(scene, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-8), frames=3, fps=10))
    free = pbng.Scene(gravity=(0, -9.8, 0))
    other = free.add(pbng.shapes.box((1.0, 0.2, 0.2), (11, 3, 3)), RUBBER)
    free.pin(other.where(x=0))
    wanted = pbng.solve(free, pbng.PBNG(dtype="float64"), pbng.Budget(rtol=1e-9)).x
    assert np.abs(frames[0].x[bar.where(x=1).index] - bar.mesh.X[bar.where(x=1).index]).max() == 0
    assert np.abs(frames[2].x - wanted).max() < 1e-4


def test_a_motion_can_stop_and_let_go():
    scene = pbng.Scene()
    body = cube(scene)
    scene.move(body.where(x=0.2), pbng.Translate((1.0, 0, 0)), over=1.0, until=0.5)
    *_, last = pbng.simulate(scene, pbng.PBNG(), pbng.Budget(rtol=1e-6), frames=11, fps=10, inertia=True, substeps=4)
    assert last.problem.fixed.sum() == 0
    assert last.momentum[0] / 0.8 == pytest.approx(1.0, abs=0.2)  # it flies on about as fast as it was drawn


def place(scene, selection, t):
    """How far the vertices of a selection are prescribed to be from rest at time t [s], and that they are held then."""
    problem = scene.compile(free=True).at(t)
    assert problem.fixed[selection.index].all()
    return (problem.constrain(problem.X, t) - problem.X)[selection.index]


@pytest.mark.parametrize("after", ["move", "pin", "wait"])
def test_what_follows_a_move_that_has_ended_starts_where_it_was_left(after):
    """A move that stops at 1 s, on its way or at its end, has left its vertices where what follows finds them."""
    for over in (1.0, 2.0):
        left = np.array([1.0 / over, 0, 0])
        scene = pbng.Scene()
        body = cube(scene, wait=2.0 if after == "wait" else 0.0)
        right = body.where(x=0.2)
        scene.move(right, pbng.Translate((1.0, 0, 0)), over=over, until=1.0)
        if after == "move":
            scene.move(right, pbng.Translate((0, 1.0, 0)), start=1.0, over=1.0)
        if after == "pin":
            scene.pin(right)
        for t in (0.5, 0.999, 1.0, 1.5, 1.999):
            further = [0, max(t - 1.0, 0), 0] if after == "move" else 0
            np.testing.assert_allclose(place(scene, right, t), np.tile(left * min(t, 1) + further, (9, 1)), atol=1e-15)
        problem = scene.compile(free=True)
        assert problem.at(2.0).fixed.sum() == (0 if after == "wait" else 9)
        assert problem.end == (1.0 if after == "pin" else 2.0)


def test_a_waiting_body_is_held_where_moves_have_left_it_and_else_at_rest():
    scene = pbng.Scene()
    body = cube(scene, wait=2.0)
    scene.move(body.where(x=0.2), pbng.Translate((1.0, 0, 0)), until=1.0)
    assert (place(scene, body.where(x=(0, 0.1)), 1.5) == 0).all()
    assert scene.compile(free=True).at(1.5).fixed.all()


def test_turning_goes_on_about_where_the_move_before_has_left_the_centroid():
    """Moves are carried out in order of their start, whichever was said first."""
    for order in (1, -1):
        scene = pbng.Scene()
        right = cube(scene).where(x=0.2)
        moves = [
            {"motion": pbng.Translate((0, 1.0, 0)), "over": 1.0, "until": 1.0},
            {"motion": pbng.Rotate("x", 0.25), "over": 1.0, "start": 1.0},
        ]
        for options in moves[::order]:
            scene.move(right, **options)
        X = right.body.mesh.X[right.vertices] - [0.2, 0.1, 0.1]
        expected = np.column_stack([X[:, 0], 1.0 - X[:, 2], X[:, 1]]) - X
        np.testing.assert_allclose(place(scene, right, 2.0), expected, atol=1e-15)


def test_a_move_that_goes_on_from_another_does_not_jump():
    """The state of a simulation, too: no vertex moves farther from frame to frame than its move does."""
    scene = pbng.Scene()
    body = cube(scene)
    scene.pin(body.where(x=0.0))
    right = body.where(x=0.2)
    scene.move(right, pbng.Translate((0.1, 0, 0)), over=0.5, until=0.5)
    scene.move(right, pbng.Translate((0, 0.1, 0)), start=0.5, over=0.5)
    x = np.array([f.x[right.index] for f in pbng.simulate(scene, budget=pbng.Budget(rtol=1e-3), frames=11, fps=10)])
    assert np.linalg.norm(np.diff(x, axis=0), axis=2) == pytest.approx(0.02, abs=1e-6)


def test_overlapping_selections_may_be_held_one_after_the_other():
    """The common vertices of a pin until 1 s and of a move from then on; the others of the pin are free."""
    for order in (1, -1):
        scene = pbng.Scene()
        body = cube(scene)
        left, low = body.where(x=0.0), body.where(y=0.0)
        uses = [
            lambda scene=scene, left=left: scene.pin(left, until=1.0),
            lambda scene=scene, low=low: scene.move(low, pbng.Translate((1.0, 0, 0)), over=1.0, start=1.0),
        ]
        for use in uses[::order]:
            use()
        problem = scene.compile()
        assert problem.fixed.sum() == 15
        assert (np.flatnonzero(problem.at(1.0).fixed) == low.index).all()
        np.testing.assert_allclose(place(scene, low, 1.5), np.tile([0.5, 0, 0], (9, 1)), atol=1e-15)


def test_a_move_counts_for_as_long_as_something_that_follows_from_it_is_held():
    """Each of three takes over some vertices of the one before, and turns about the centroid it finds."""
    scene = pbng.Scene()
    body = scene.add(pbng.shapes.box((4.0, 1.0, 1.0), (5, 2, 2)), RUBBER)
    for k, until in ((0, 1.0), (1, 2.0), (2, np.inf)):
        one = body.where(x=(k, k + 1))
        motion = pbng.Rotate("z", 0.5) if k else pbng.Translate((0, 1.0, 0))
        scene.move(one, motion, start=float(k), until=until)
    # The first raises those at x = 1, the second exchanges these with those at 2, the third what has come there with
    # those at 3.
    problem = scene.compile().at(2.0)
    assert (np.flatnonzero(problem.fixed) == body.where(x=(2, 3)).index).all()
    x = problem.constrain(problem.X, 2.0)
    for k, wanted in ((2, [3.0, 0.5, 0.5]), (3, [1.0, 1.5, 0.5])):
        np.testing.assert_allclose(x[body.where(x=k).index].mean(0), wanted, atol=1e-12)


def warnings_of(caplog, scene):
    caplog.clear()
    with caplog.at_level(logging.WARNING, "pbng"):
        scene.compile()
    return [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]


def test_a_body_that_is_let_go_is_warned_of(caplog):
    """At the time at which nothing holds it any longer, and only then; not while it waits."""
    scene = pbng.Scene()
    alice, bob = cube(scene, "alice"), cube(scene, "bob", at=(1, 0, 0))
    late = cube(scene, "late", at=(2, 0, 0), wait=3.0)
    scene.pin(alice.where(x=0.0))
    scene.pin(alice.where(x=0.2), until=0.5)
    scene.pin(bob.where(x=1.0), until=0.5)
    scene.pin(bob.where(x=1.2), until=1.0)
    said = warnings_of(caplog, scene)
    assert [m.split(":")[0] for m in said] == [
        "after t = 1 s nothing holds body 'bob'",
        "after t = 3 s nothing holds body 'late'",
    ]
    scene.pin(late.where(x=2.0))
    scene.bind(bob.where(x=1.0), alice.where(x=0.2), k=1.0)
    assert warnings_of(caplog, scene) == []


def test_bodies_that_hang_together_are_warned_of_once(caplog):
    scene = pbng.Scene()
    a, b, c = (cube(scene, name, at=(k, 0, 0)) for k, name in enumerate("abc"))
    scene.bind(a.where(x=0.2), b.where(x=1.0), k=1.0)
    scene.pin(c.where(x=2.0))
    assert [m.split(":")[0] for m in warnings_of(caplog, scene)] == ["nothing holds body 'a' and body 'b'"]


def test_solving_for_a_time_at_which_all_is_let_go_is_refused(caplog):
    """By default that is the time of the release itself; before it all is well, and with inertia after it too."""
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    body = cube(scene, "bob")
    scene.pin(body.where(x=0.0), until=1.0)
    wanted = r"after t = 1 s nothing holds scene 'scene': the equilibrium is not unique"
    with pytest.raises(pbng.InputError, match=f"solve: {wanted}; give a time at= before that"):
        pbng.solve(scene)
    with pytest.raises(pbng.InputError, match=f"simulate: {wanted}; take fewer frames, or inertia=True"):
        pbng.simulate(scene, frames=11, fps=10)
    assert warnings_of(caplog, scene)[0].startswith("after t = 1 s nothing holds body 'bob': it can move")
    assert pbng.solve(scene, at=0.9).status is pbng.Status.CONVERGED
    assert len(list(pbng.simulate(scene, frames=2, fps=10))) == 2
    assert len(list(pbng.simulate(scene, budget=pbng.Budget(iterations=1), frames=3, fps=1, inertia=True))) == 3


def test_what_contact_may_hold_is_not_warned_of(caplog):
    """Colliders hold what may touch them, and bodies each other; but not themselves, nor what takes no part."""
    scene = pbng.Scene()
    cube(scene, "ball")
    scene.collide_with(pbng.Plane((0, 0, 0), (0, 1, 0)))
    assert warnings_of(caplog, scene) == []

    for rule, loose in (
        ({}, []),
        ({"self_collision": True}, []),
        ({"bodies": [0, 1]}, ["c"]),
        ({"bodies": [1], "self_collision": True}, ["b", "c"]),
    ):
        scene = pbng.Scene()
        bodies = [cube(scene, name, at=(k, 0, 0)) for k, name in enumerate("abc")]
        scene.pin(bodies[0].where(x=0.0))
        scene.contact(*(bodies[k] for k in rule.pop("bodies", [])), **rule)
        said = [m.split(":")[0] for m in warnings_of(caplog, scene)]
        assert said == [f"nothing holds body {name!r}" for name in loose]


def test_bodies_that_only_touch_each_other_are_warned_of_when_all_is_let_go(caplog):
    scene = pbng.Scene()
    a, _ = cube(scene, "a"), cube(scene, "b", at=(0, 0.2, 0))
    scene.pin(a.where(y=0.0), until=2.0)
    scene.contact()
    assert [m.split(":")[0] for m in warnings_of(caplog, scene)] == [
        f"after t = 2 s nothing holds body {name!r}" for name in "ab"
    ]


@pytest.mark.parametrize("until", [0.0, -1.0, np.nan, "1", None])
def test_bad_ends_of_pins_are_named(until):
    scene = pbng.Scene()
    body = cube(scene)
    with pytest.raises(pbng.InputError, match=r"pin of cube.where\(x=0.0\): until must be positive, not"):
        scene.pin(body.where(x=0.0), until=until)


@pytest.mark.parametrize("until", [0.5, 1.0, np.nan, "2"])
def test_a_move_must_not_end_before_it_starts(until):
    scene = pbng.Scene()
    body = cube(scene)
    with pytest.raises(pbng.InputError, match=r"until must be later than its start, 1 s, not"):
        scene.move(body.where(), pbng.Translate((1, 0, 0)), start=1.0, until=until)
    with pytest.raises(pbng.InputError, match=r"over and start must be finite and not negative, not 'x' and 0"):
        scene.move(body.where(), pbng.Translate((1, 0, 0)), over="x")


@pytest.mark.parametrize("wait", [-1.0, np.inf, np.nan, None, "soon"])
def test_bad_waits_are_named(wait):
    with pytest.raises(pbng.InputError, match="body 'other': wait must be finite and not negative, not"):
        cube(pbng.Scene(), "other", wait=wait)
