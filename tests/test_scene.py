"""Scenes: selections, pins, motions, loads, materials by cell group; what is wrong is named."""

import logging

import numpy as np
import pytest
from models import SoftVolume

import pbng

RUBBER = pbng.Corotated(E=1e5, nu=0.3)
ANGLE = 2 * np.pi * 0.1


def by(x, y, z):
    return np.array([x, y, z], float)


def bar(n=(5, 3, 3)):
    scene = pbng.Scene()
    return scene, scene.add(pbng.shapes.box((2.0, 1.0, 1.0), n), RUBBER, name="bar")


def positions(scene, selection, t=None):
    """Where the vertices of a selection are prescribed to be at time t."""
    problem = scene.compile()
    return problem.constrain(problem.X, problem.end if t is None else t)[selection.index]


def turn(points, angle, center, axis=0):
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    R[a, a], R[a, b], R[b, a], R[b, b] = c, -s, s, c
    return (points - center) @ R.T + center


def test_pins_hold_the_rest_position():
    scene, body = bar()
    left = body.where(x=0.0)
    scene.pin(left)
    problem = scene.compile()
    assert problem.fixed.sum() == len(left) == 9
    np.testing.assert_array_equal(positions(scene, left), problem.X[left.index])
    assert problem.end == 0


def test_rotation_turns_about_the_centroid():
    """A positive rotation about x takes y to z, about the selection's centroid."""
    scene, body = bar()
    right = body.where(x=2.0)
    scene.move(right, pbng.Rotate("x", turns=0.1))
    X = scene.compile().X[right.index]
    np.testing.assert_allclose(positions(scene, right), turn(X, ANGLE, [2.0, 0.5, 0.5]), atol=1e-14)
    quarter, far = pbng.Rotate("x", 0.25).linear(1.0), np.array([0.0, 1.0, 0.0])
    np.testing.assert_allclose(quarter @ far, [0, 0, 1], atol=1e-15)


def test_rotation_about_a_centre_of_its_own_and_any_axis():
    scene, body = bar()
    right = body.where(x=2.0)
    scene.move(right, pbng.Rotate((0, 0, 7.0), turns=0.1, center=(1.0, 0.0, 0.0)))
    X = scene.compile().X[right.index]
    np.testing.assert_allclose(positions(scene, right), turn(X, ANGLE, [1.0, 0, 0], axis=2), atol=1e-14)


def test_sum_of_motions_composes():
    """Rotate + Translate: the translation is not turned; the same in either order; scales act with rotations."""
    scene, body = bar()
    right = body.where(x=2.0)
    X, center = scene.bodies[0].mesh.X[right.vertices], np.array([2.0, 0.5, 0.5])
    rotate, translate, scale = pbng.Rotate("x", 0.1), pbng.Translate((0.5, 0.2, 0)), pbng.Scale((1, 2, 1))
    expected = turn(X, ANGLE, center) + by(0.5, 0.2, 0)
    for motion in (rotate + translate, translate + rotate):
        np.testing.assert_allclose(motion.at(X, center, 1.0, 0.0), expected, atol=1e-14)
    widened = center + (X - center) * [1, 2, 1]
    np.testing.assert_allclose((scale + rotate).at(X, center, 1.0, 0.0), turn(widened, ANGLE, center), atol=1e-14)
    both = pbng.Rotate("x", 0.1, center=(0, 0, 0)) + pbng.Scale(2.0)
    turned = turn(X, ANGLE, [0, 0, 0])
    np.testing.assert_allclose(both.at(X, center, 1.0, 0.0).mean(0), turned.mean(0), atol=1e-14)


def test_over_and_start():
    """``over`` spreads a motion evenly in time, ``start`` delays it; it is held afterwards, and before."""
    scene, body = bar()
    right = body.where(x=2.0)
    scene.move(right, pbng.Translate((1.0, 0, 0)), over=2.0, start=1.0)
    X = scene.compile().X[right.index]
    assert scene.compile().end == 3.0
    for t, moved in ((0.0, 0.0), (1.0, 0.0), (1.5, 0.25), (2.0, 0.5), (3.0, 1.0), (99.0, 1.0)):
        np.testing.assert_allclose(positions(scene, right, t) - X, np.tile([moved, 0, 0], (len(X), 1)), atol=1e-15)


def test_at_once():
    """``over=0`` is a jump at its start."""
    scene, body = bar()
    right = body.where(x=2.0)
    scene.move(right, pbng.Translate((1.0, 0, 0)), start=1.0)
    assert np.ptp(positions(scene, right, 0.999)[:, 0] - 2.0) == 0
    np.testing.assert_allclose(positions(scene, right, 0.999)[:, 0], 2.0)
    np.testing.assert_allclose(positions(scene, right, 1.0)[:, 0], 3.0)


def test_moves_follow_upon_each_other():
    """The second move of the same vertices starts where the first left them, about their centroid there."""
    scene, body = bar()
    right = body.where(x=2.0)
    scene.move(right, pbng.Translate((0, 1.0, 0)), over=1.0)
    scene.move(right, pbng.Rotate("x", 0.1), over=1.0, start=1.0)
    X = scene.compile().X[right.index]
    np.testing.assert_allclose(positions(scene, right, 1.0), X + by(0, 1, 0), atol=1e-15)
    expected = turn(X + by(0, 1, 0), ANGLE, [2.0, 1.5, 0.5])
    np.testing.assert_allclose(positions(scene, right), expected, atol=1e-14)
    scene.pin(right)  # changes nothing
    np.testing.assert_allclose(positions(scene, right), expected, atol=1e-14)


def test_animation():
    """Positions at given times, linear in between, held outside; the number of vertices must fit."""
    scene, body = bar()
    right = body.where(x=2.0)
    X = scene.bodies[0].mesh.X[right.vertices]
    scene.move(right, pbng.Animation([1.0, 2.0, 4.0], np.stack([X, X + by(1, 0, 0), X + by(1, 2, 0)])))
    for t, moved in ((0.0, [0, 0, 0]), (1.5, [0.5, 0, 0]), (2.0, [1, 0, 0]), (3.0, [1, 1, 0]), (9.0, [1, 2, 0])):
        np.testing.assert_allclose(positions(scene, right, t), X + moved, atol=1e-15)
    other, body = bar()
    other.move(body.where(x=2.0), pbng.Animation([0.0], np.zeros((1, 4, 3))))
    with pytest.raises(pbng.InputError, match="Animation has 4 vertices, the selection 9"):
        positions(other, body.where(x=2.0))
    with pytest.raises(pbng.InputError, match="times must rise"):
        pbng.Animation([0.0, 0.0], np.zeros((2, 4, 3)))
    with pytest.raises(pbng.InputError, match="do not fit"):
        pbng.Animation([0.0, 1.0], np.zeros((3, 4, 3)))
    with pytest.raises(pbng.InputError, match="must be finite"):
        pbng.Animation([0.0], np.full((1, 4, 3), np.nan))


def test_solve_takes_an_animation_at_its_end():
    """``solve`` gives the equilibrium with every motion at its end; an animation ends at its last time."""
    scene, body = bar()
    right = body.where(x=2.0)
    X = scene.bodies[0].mesh.X[right.vertices]
    scene.move(right, pbng.Animation([0.0, 4.0], np.stack([X, X + by(1, 2, 0)])))
    assert scene.compile().end == 4.0


def test_function_of_time():
    scene, body = bar()
    right = body.where(x=2.0)

    def sway(t, X):
        return X + by(0, np.sin(t), 0)

    scene.move(right, sway)
    X = scene.compile().X[right.index]
    np.testing.assert_allclose(positions(scene, right, 0.5), X + by(0, np.sin(0.5), 0))


def test_bad_function_is_named():
    def short(t, X):
        return X[:4]

    scene, body = bar()
    scene.move(body.where(x=2.0), short)
    with pytest.raises(pbng.InputError, match=r"motion short\(t=0\) must return finite positions of shape \(9, 3\)"):
        positions(scene, body.where(x=2.0))


def test_sum_of_a_function_and_a_motion():
    """Displacements add where there is no linear part to compose."""
    scene, body = bar()
    right = body.where(x=2.0)
    X = scene.bodies[0].mesh.X[right.vertices]
    still = pbng.Animation([0.0], X[None])
    scene.move(right, still + pbng.Translate((0, 0, 1.0)))
    np.testing.assert_allclose(positions(scene, right), X + by(0, 0, 1), atol=1e-15)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: pbng.Rotate("w", 1.0), "axis must be 'x', 'y', 'z' or a vector, not 'w'"),
        (lambda: pbng.Rotate((0, 0, 0), 1.0), "the axis has no direction"),
        (lambda: pbng.Rotate("x", np.nan), "turns must be finite, not nan"),
        (lambda: pbng.Translate((1.0, 2.0)), "Translate: expected 3 finite numbers"),
        (lambda: pbng.Translate((1.0, 2.0, np.inf)), "Translate: expected 3 finite numbers"),
        (lambda: pbng.Scale((1.0, np.nan, 1.0)), "Scale: expected 3 finite numbers"),
    ],
)
def test_bad_motions_are_named(make, word):
    with pytest.raises(pbng.InputError, match=word):
        make()


def test_what_is_no_motion_is_named():
    scene, body = bar()
    with pytest.raises(pbng.InputError, match=r"expected a motion .* not 3"):
        scene.move(body.where(x=0.0), 3)
    with pytest.raises(pbng.InputError, match=r"over and start must be finite and not negative, not -1\.0 and 0"):
        scene.move(body.where(x=0.0), pbng.Translate((0, 0, 0)), over=-1.0)


def test_selections_of_nothing_are_named():
    """An empty selection names its words and where the body is."""
    scene, body = bar()
    for use in (scene.pin, lambda s: scene.move(s, pbng.Rotate("x", 1.0)), lambda s: scene.force(s, (1, 0, 0))):
        with pytest.raises(pbng.InputError, match=r"bar\.where\(x=5\.0\) selects no vertex; it has x in \[0, 2\]"):
            use(body.where(x=5.0))
    with pytest.raises(pbng.InputError, match="expected a selection such as"):
        scene.pin(np.array([0, 1]))
    _, other = bar()
    with pytest.raises(pbng.InputError, match="belongs to another scene"):
        scene.pin(other.where(x=0.0))


def test_overlapping_selections_are_named():
    """Selections of moves are the same or have no vertex in common; else the second is refused, and both are named."""
    scene, body = bar()
    scene.pin(body.where(x=0.0))
    wanted = (
        r"move of bar\.where\(y=0\.0\): 3 of its 15 vertices are also of the pin of bar\.where\(x=0\.0\), which has 9;"
        " select the same vertices, none in common, or let one go before the other starts"
    )
    with pytest.raises(pbng.InputError, match=wanted):
        scene.move(body.where(y=0.0), pbng.Rotate("x", 1.0))
    assert scene.compile().fixed.sum() == 9  # what was refused has left no trace


def test_selection_within_an_earlier_one_is_named():
    scene, body = bar()
    scene.pin(body.where(x=0.0), until=2.0)
    with pytest.raises(pbng.InputError, match="3 of its 3 vertices are also of the pin"):
        scene.move(body.where(x=0.0, y=0.0), pbng.Rotate("x", 1.0), start=1.0)
    other = scene.add(body.mesh, RUBBER, at=(0, 2, 0))
    scene.pin(other.where(x=0.0))
    with pytest.raises(pbng.InputError, match="9 of its 45 vertices are also of the pin"):
        scene.pin(body.where())


def test_nothing_prescribed_is_refused():
    scene, _ = bar()
    with pytest.raises(pbng.InputError, match="no vertex is pinned or moved"):
        scene.compile()
    with pytest.raises(pbng.InputError, match="the scene has no body"):
        pbng.Scene().compile()


def test_loose_parts_are_warned_of(caplog):
    """A body, or a part of a mesh, that nothing holds is named in a warning; held ones are not."""
    mesh = pbng.shapes.box(vertices=3)
    two = pbng.TetMesh(np.concatenate([mesh.X, mesh.X + by(3, 0, 0)]), np.concatenate([mesh.cells, mesh.cells + 27]))
    scene = pbng.Scene()
    both = scene.add(two, RUBBER, name="both")
    free = scene.add(mesh, RUBBER, name="free", at=(0, 3, 0))
    scene.pin(both.where(x=0.0))
    with caplog.at_level(logging.WARNING, "pbng"):
        scene.compile()
    messages = [r.getMessage() for r in caplog.records if r.levelno == logging.WARNING]
    assert len(messages) == 2
    assert messages[0].startswith("nothing holds a part of body 'both' (27 vertices, among them 27): it can move")
    assert messages[1].startswith("nothing holds body 'free': it can move as a rigid body")
    caplog.clear()
    scene.pin(both.where(x=3.0))
    scene.pin(free.where(x=0.0))
    with caplog.at_level(logging.WARNING, "pbng"):
        scene.compile()
    assert not caplog.records


def grouped():
    mesh = pbng.shapes.box((2.0, 1.0, 1.0), (5, 3, 3))
    left = mesh.X[mesh.cells].mean(1)[:, 0] < 1.0
    return pbng.TetMesh(mesh.X, mesh.cells, cell_groups={"left": left, "right": ~left, "all": np.ones(len(left), bool)})


def test_cell_groups_have_materials_of_their_own():
    """Elements, masses and stiffness follow the group; equal materials of several bodies share a group."""
    mesh, heavy = grouped(), SoftVolume(E=2e5, nu=0.2, density=3000.0)
    scene = pbng.Scene()
    a = scene.add(mesh, {"left": RUBBER, "right": heavy})
    scene.add(mesh, RUBBER, at=(0, 3, 0))
    scene.pin(a.where(x=0.0))
    problem = scene.compile()
    assert [g.material for g in problem.groups] == [RUBBER, heavy]
    assert [len(g.cells) for g in problem.groups] == [mesh.n_elem * 3 // 2, mesh.n_elem // 2]
    assert problem.mass[: mesh.n_vert].sum() == pytest.approx(1000.0 + 3000.0)
    assert problem.mass[mesh.n_vert :].sum() == pytest.approx(2000.0)
    centers = problem.X[problem.groups[1].cells].mean(1)
    assert (centers[:, 0] > 1.0).all()


@pytest.mark.parametrize(
    ("materials", "word"),
    [
        ({"left": RUBBER}, r"cell \d+ belongs to 0 of the groups \['left'\], not to one \(40 such cells\)"),
        ({"left": RUBBER, "all": RUBBER}, r"cell 0 belongs to 2 of the groups \['all', 'left'\]"),
        ({"left": RUBBER, "middle": RUBBER}, r"no cell group 'middle'; the mesh has \['all', 'left', 'right'\]"),
        ({"left": RUBBER, "right": 3}, "cell group 'right' needs a material, not 3"),
        ({}, "expected a material or a mapping"),
        (pbng.Corotated, "expected a material or a mapping"),
    ],
)
def test_bad_materials_are_named(materials, word):
    with pytest.raises(pbng.InputError, match=word):
        pbng.Scene().add(grouped(), materials)


def test_bodies_are_named_and_placed():
    """Names are unique or made up; ``at`` translates; vertices are numbered through."""
    scene, body = bar()
    mesh = pbng.shapes.box(vertices=2)
    second = scene.add(mesh, RUBBER, at=(0, 5, 0))
    assert second.name == "body1"
    assert second.start == body.mesh.n_vert
    np.testing.assert_allclose(second.mesh.X, mesh.X + by(0, 5, 0))
    np.testing.assert_array_equal(second.where(y=5.0).index, second.start + mesh.where(y=0.0))
    with pytest.raises(pbng.InputError, match="already has a body named 'bar'"):
        scene.add(mesh, RUBBER, name="bar")
    with pytest.raises(pbng.InputError, match="expected a TetMesh or TriMesh, not int"):
        scene.add(3, RUBBER)
    with pytest.raises(pbng.InputError, match="at: expected 3 finite numbers"):
        scene.add(mesh, RUBBER, at=(0, np.nan, 0))


def test_groups_survive_a_translation():
    scene = pbng.Scene()
    body = scene.add(grouped(), {"left": RUBBER, "right": RUBBER}, at=(0, 1, 0))
    assert set(body.mesh.cell_groups) == {"left", "right", "all"}


def test_surfaces_in_space_are_no_solids():
    bent = pbng.TriMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1.0]]), [[0, 1, 2], [1, 3, 2]])
    with pytest.raises(pbng.InputError, match="must lie in a plane of constant z"):
        pbng.Scene().add(bent, RUBBER)


def test_bad_gravity_is_named():
    with pytest.raises(pbng.InputError, match="gravity: expected 3 finite numbers"):
        pbng.Scene(gravity=(0, np.nan, 0))


def test_compiling_is_a_snapshot():
    """A problem does not change when its scene does."""
    scene, body = bar()
    scene.pin(body.where(x=0.0))
    problem = scene.compile()
    scene.pin(body.where(x=2.0))
    scene.force(body.where(x=1.0), (1, 0, 0))
    assert problem.fixed.sum() == 9
    assert not problem.f_ext.any()
    assert scene.compile().fixed.sum() == 18


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        *(({name: bad}, f"contact: {name} must be positive and finite, not {bad!r}")
          for name in ("k_n", "radius") for bad in (0.0, -1.0, np.nan, np.inf, "x")),
        *(({name: bad}, f"contact: {name} must be finite and not negative, not {bad!r}")
          for name in ("k_tau", "thickness") for bad in (-1.0, np.nan, np.inf, "x")),
        *(({"rings": bad}, f"contact: rings must be a whole number of at least 1, not {bad!r}")
          for bad in (0, -1, 1.5, np.nan, "x", None)),
        ({"self_collision": 3}, "contact: self_collision must be True, False or bodies, not 3"),
        ({"self_collision": None}, "contact: self_collision must be True, False or bodies, not None"),
        ({"self_collision": ["bar"]}, "contact: expected bodies, not str"),
    ],
)  # fmt: skip
def test_bad_contact_is_named(rule, said):
    scene, _ = bar()
    with pytest.raises(pbng.InputError) as error:
        scene.contact(**rule)
    assert str(error.value) == said


def test_one_body_may_collide_with_itself():
    """``self_collision`` takes a body as well as several, and whole numbers of any kind do for ``rings``."""
    scene, body = bar()
    scene.contact(self_collision=body, rings=np.int64(3))
    assert scene.compile(free=True).contact.surfaces.own.tolist() == [True]
    assert scene.compile(free=True).contact.surfaces.rings == 3
