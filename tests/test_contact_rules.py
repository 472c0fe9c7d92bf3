"""Who meets whom, and what is refused by name."""

import numpy as np
import pytest
from test_contact import SOFT, two_blocks

import pbng
from pbng.contact.detection import Detector

CLOTH = pbng.Membrane(E=1e3, nu=0.3, density=0.2)


def found(scene):
    """What touches at rest, and between which bodies."""
    problem = scene.compile(free=True)
    detector = Detector(problem.contact, problem.X, problem.fixed)
    contacts = detector.find(problem.X, problem.X, 0, 0)
    return contacts, {tuple(sorted(set(row))) for row in detector.surfaces.body[contacts.vertices].tolist()}


def three_in_a_row():
    """Boxes that overlap by a fifth."""
    scene = pbng.Scene()
    return scene, [
        scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT, name=n, at=(0, 0.8 * k, 0)) for k, n in enumerate("abc")
    ]


def test_who_meets_whom():
    scene, _ = three_in_a_row()
    scene.contact()
    assert found(scene)[1] == {(0, 1), (1, 2)}
    scene, (a, b, _) = three_in_a_row()
    scene.contact(a, b)
    assert found(scene)[1] == {(0, 1)}
    scene, (a, b, _) = three_in_a_row()
    scene.contact(a, self_collision=[b])
    assert found(scene)[1] == set()


def test_what_collides_only_with_itself_does_not_meet_others():
    """A folded sheet upon a box."""
    scene = pbng.Scene()
    box = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT, name="box")
    sheet = pbng.shapes.sheet((1.0, 0.4), (21, 9))
    s = sheet.X[:, 0]
    X = np.column_stack([np.minimum(s, 1 - s), 1.001 + 0.02 * (s > 0.5), sheet.X[:, 2]])
    cloth = scene.add(pbng.TriMesh(X, sheet.cells), CLOTH, name="cloth")
    scene.contact(box, self_collision=[cloth])
    assert found(scene)[1] == {(1,)}


@pytest.mark.parametrize("times", [1, 2])
def test_a_body_alone_is_refused(times):
    scene, (a, *_) = three_in_a_row()
    scene.contact(*[a] * times)
    with pytest.raises(pbng.InputError, match="body 'a' is alone, and does not collide with itself"):
        scene.compile(free=True)


def test_cloth_needs_a_thickness():
    scene = pbng.Scene()
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT, name="box")
    scene.add(pbng.shapes.sheet((0.5, 0.5), 4, origin=(0.2, 1.1, 0.2)), CLOTH, name="cloth")
    scene.contact(thickness=0.0)
    with pytest.raises(pbng.InputError, match="thickness must be positive for body 'cloth'"):
        scene.compile(free=True)


def test_a_sheet_that_lies_flush_on_a_box_is_not_inside():
    scene = pbng.Scene(gravity=(0, -9.8, 0))
    box = scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 3), SOFT, name="box")
    scene.pin(box.where(y=0))
    cloth = scene.add(pbng.shapes.sheet((0.5, 0.5), 5, origin=(0.25, 1.0, 0.25)), CLOTH, name="cloth")
    scene.contact()
    frames = [*pbng.simulate(scene, pbng.PBNG(), pbng.Budget(iterations=20), frames=10, inertia=True, substeps=2)]
    assert max(f.contact.pairs for f in frames[6:]) > 3  # it has sprung up to its thickness, and fallen back
    for f in frames:
        assert f.x[cloth.start :, 1].min() > f.x[: cloth.start, 1].max() - 1e-3


@pytest.mark.parametrize(
    "collider", [pbng.Sphere((0.5, 0.5, 0.5), 0.9, name="trap"), pbng.Box((0, 0, 0), (1, 1, 1), name="trap")]
)
@pytest.mark.parametrize("inertia", [False, True])
def test_a_body_wholly_inside_a_collider_is_refused(collider, inertia):
    scene = pbng.Scene()
    scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 3, origin=(0.4, 0.4, 0.4)), SOFT, name="inner")
    scene.collide_with(collider)
    problem = scene.compile(free=True)
    with pytest.raises(pbng.InputError, match="'inner' starts fully inside collider 'trap'"):
        next(pbng.simulate(problem, frames=1, inertia=inertia))


def test_a_thickness_that_leaves_rest_no_room_is_refused():
    def sheet(thickness, rings):
        scene = pbng.Scene()
        cloth = scene.add(pbng.shapes.sheet((1.0, 1.0), 11), pbng.Membrane(E=1.0, nu=0.3), name="sheet")
        scene.pin(cloth.where(x=0))
        scene.contact(self_collision=True, thickness=thickness, rings=rings)
        problem = scene.compile()
        return Detector(problem.contact, problem.X, problem.fixed).find(problem.X, problem.X, 0, 0)

    assert (sheet(0.06, 1).clearance(pbng.shapes.sheet((1.0, 1.0), 11).X) > 0).all()
    sheet(0.1, 2)
    with pytest.raises(pbng.InputError, match=r"'sheet' keeps 0.1 m from itself.* is 0.07071 m from a triangle"):
        sheet(0.1, 1)


def test_a_body_that_starts_inside_another_is_refused():
    scene = pbng.Scene()
    scene.add(pbng.shapes.box((1.0, 1.0, 1.0), 4), SOFT, name="out")
    scene.add(pbng.shapes.box((0.2, 0.2, 0.2), 3), SOFT, name="in", at=(0.4, 0.4, 0.4))
    scene.contact()
    with pytest.raises(pbng.InputError, match="'in' starts fully inside body 'out'"):
        next(pbng.simulate(scene, frames=1, inertia=True))


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        ({"k_n": 0.0}, "k_n must be positive and finite"),
        ({"radius": -1.0}, "radius must be positive and finite"),
        ({"k_tau": -1.0}, "k_tau must be finite and not negative"),
        ({"rings": 0}, "rings must be a whole number"),
    ],
)
def test_bad_rules(rule, said):
    with pytest.raises(pbng.InputError, match=said):
        two_blocks(3, **rule)


def test_a_plane_body_has_no_surface():
    scene = pbng.Scene()
    flat = scene.add(pbng.shapes.rectangle((1.0, 1.0), 4), SOFT, name="flat")
    with pytest.raises(pbng.InputError, match="'flat' has no surface"):
        scene.contact(self_collision=[flat])
    scene.contact(self_collision=True)
    with pytest.raises(pbng.InputError, match="'flat' has no surface"):
        scene.compile(free=True)
    with pytest.raises(pbng.InputError, match="called twice"):
        scene.contact()


def test_only_colliders_collide():
    with pytest.raises(pbng.InputError, match="expected a collider such as Plane"):
        pbng.Scene().collide_with([pbng.Plane((0, 0, 0), (0, 1, 0)), 3])


def test_other_methods_say_that_they_know_no_contact():
    scene, _ = two_blocks(3)
    problem = scene.compile(free=True)
    for solver in (pbng.Newton(), pbng.XPBD(), pbng.PBD()):
        with pytest.raises(pbng.InputError, match="knows nothing of contact"):
            solver.set_up(problem)
