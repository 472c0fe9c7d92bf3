"""Pictures show what bodies run into without hiding them, and where they touch."""

from types import SimpleNamespace

import numpy as np
import pytest
from fake_runs import box, frames, sheet
from pictures import SIZE, assert_well_framed, body_pixels, drawn, read

import pbng
from pbng.equilibrium import ContactReport
from pbng.errors import InputError
from pbng.io.frames import FrameWriter
from pbng.view.camera import Extent
from pbng.view.panes import Panes, edges
from pbng.view.surface import Motion, Surface

pytest.importorskip("pyvista")
pytest.importorskip("PIL.Image")

from pbng import view as views
from pbng.view import colors


def red(image, least=90):
    return image[..., 0] - image[..., 1:].max(2) > least


def colliding(meshes, colliders, n=2, touched=(), motion=lambda X, s: X):
    """Frames of bodies among colliders, some of their vertices in contact."""
    made = list(frames(meshes, n, motion, np.float64))
    for frame in made:
        frame.problem.contact = SimpleNamespace(colliders=tuple(colliders))
        frame.contact = SimpleNamespace(vertices=np.array(touched, int))
    return made


def test_glass_does_not_hide_bodies(tmp_path):
    cube = box(at=(0, 0.02, 0))
    floor, container = [pbng.Plane((0, 0, 0), (0, 1, 0))], pbng.container((-0.5, 0, -0.5), (1.5, 1.6, 1.5), False)
    bare, boxed = (
        read(views.picture(colliding([cube], planes), tmp_path / "a.png", size=(480, 480), color="#c03020"))
        for planes in (floor, container)
    )
    body = red(boxed, 50)
    assert 0.1 < body.mean() < red(bare, 50).mean()
    assert np.abs(boxed[body].mean(0) - bare[red(bare, 50)].mean(0)).max() < 20, "it is clear"
    blueish = (boxed[..., 2] - boxed[..., 0] > 12) & (boxed[..., 2] < 215)
    rows, columns = np.nonzero(blueish)
    body = np.nonzero(body)
    assert rows.min() < body[0].min() - 5, "the edges of the container are above the body"
    assert columns.min() < body[1].min() - 5
    assert columns.max() > body[1].max() + 5


@pytest.mark.parametrize("size", [3.0, 1000.0])
def test_large_and_distant_planes_do_not_change_the_framing(tmp_path, size):
    cube = box()
    free = drawn(colliding([cube], []), tmp_path, SIZE)
    floor = drawn(colliding([cube], [pbng.Plane((5, 0, 0), (0, 1, 0), size=size)]), tmp_path, SIZE)
    assert np.abs(free - floor).mean() < 1, "one floor, where it was"
    distant = drawn(colliding([cube], [pbng.Plane((0, -90, 0), (0, 1, 0), size=size)]), tmp_path, SIZE)
    assert np.abs(free - distant).mean() < 1
    ground = drawn(colliding([cube], [pbng.Box((-500, -9, -500), (500, 0, 500))]), tmp_path, SIZE)
    assert body_pixels(ground).mean() > 0.03


def test_panes_are_cut_to_the_surroundings():
    motion = Motion.of(made := colliding([box()], pbng.container((-0.1, 0, -20), (1.1, 1, 20), motion=None)))
    extent = Extent.of(motion, Surface(motion))
    panes = Panes(motion, extent)
    corners = panes(made[0])
    assert panes.floor == 0
    assert np.abs(corners[..., 2]).max() < 2, "the far walls are left out, the long ones cut"
    assert len(panes) == 3
    assert np.ptp(corners[..., 0]) == pytest.approx(1.2)
    alone = Panes(Motion.of(colliding([box()], [pbng.Plane((0, 0, 0), (0, 1, 0), size=2)])), extent)
    assert (alone.floor, len(alone)) == (0, 0), "a floor alone has no edges"
    tilted = pbng.Plane((0, 0, 0), (1, 1, 0), motion=pbng.Translate((0, 5, 0)), over=1 / 30)
    motion = Motion.of(made := colliding([box()], [tilted]))
    panes = Panes(motion, extent)
    assert panes.floor is None
    shift = panes(made[1]) - panes(made[0])
    assert np.allclose(shift, [0, 5, 0]), "it moves as one"
    assert len(panes.swept) == 8


def test_edges_that_panes_share_are_drawn_once():
    motion = Motion.of(made := colliding([box(at=(0.1, 0, 0.1))], pbng.container((0, 0, 0), (1.2, 1.1, 1.2), False)))
    panes = Panes(motion, Extent.of(motion, Surface(motion)))
    assert len(panes) == 6
    assert len(edges(panes(made[0]))) == 12
    assert edges(np.empty((0, 4, 3))).shape == (0, 2, 3)


def test_solid_colliders_are_grey_and_in_the_picture(tmp_path):
    cube = box(at=(0, 1, 0))
    alone = drawn(colliding([cube], []), tmp_path, SIZE)
    over = drawn(colliding([cube], [pbng.Sphere((0.5, 0.5, 0.5), 0.5)]), tmp_path, SIZE)
    assert_well_framed(over, SIZE, least=0.05)
    assert body_pixels(over).mean() < body_pixels(alone).mean(), "the camera has stepped back"
    rows, columns = np.nonzero(body_pixels(over))
    below = over[rows.max() + 8, int(columns.mean())]
    assert np.ptp(below) < 20
    assert 90 < below.mean() < 235
    turned = pbng.Kinematic(box(at=(0, 1, 2.0)), motion=pbng.Translate((0, 0, -4)), over=1 / 30)
    made = colliding([cube], [turned])
    shares = [body_pixels(drawn(made, tmp_path, SIZE, frame=k, azimuth=0.0)).mean() for k in (0, 1)]
    assert shares[0] < shares[1], "what stands before a body hides it, until it has moved on"


def test_edges_between_surfaces_have_colours_between_theirs(tmp_path):
    image = drawn(colliding([sheet(6, 1.0)], [pbng.Sphere((0, 0.6, 0), 0.35)]), tmp_path)
    body = body_pixels(image)
    middle = int(np.flatnonzero(body.any(0)).mean())
    seen = 0
    for column in range(middle - 60, middle + 60):
        last = np.flatnonzero(body[:, column]).max()  # of the sheet; below it is the ball in its shade
        above, below = image[last - 3, column], image[last + 4, column]
        between = image[last - 2 : last + 4, column]
        if below.max() < 160:
            assert (between >= np.minimum(above, below) - 8).all()
            assert (between <= np.maximum(above, below) + 8).all()
            seen += 1
    assert seen > 40


def test_colliders_of_stored_runs_and_of_states_are_drawn(tmp_path):
    press = pbng.Plane((0, 1, 0), (0, -1, 0), motion=pbng.Translate((0, -0.3, 0)), over=1 / 30)
    ball = pbng.Sphere((1.6, 0.5, 0.5), 0.5, motion=pbng.Translate((0.5, 0, 0)), over=1 / 30)
    made = colliding(
        [box()], [pbng.Plane((0, 0, 0), (0, 1, 0)), press, ball], motion=lambda X, s: X * [1, 1 - 0.3 * s, 1]
    )
    for frame in made:
        frame.contact = ContactReport(0, 4, 0.0, 0.0, 1.7, np.arange(4), 0, 0, 0.0, 0.0, 0.1)
    with FrameWriter(tmp_path / "run") as out:
        for frame in made:
            out.write(frame)
    for color in ("body", "contact"):
        image = read(views.picture(made, tmp_path / "a.png", size=SIZE, color=color))
        stored = read(views.picture(tmp_path / "run", tmp_path / "b.png", size=SIZE, color=color))
        assert np.abs(image - stored).max() <= 2
    problem = made[1].problem
    problem.end = 1 / 30
    state = drawn((problem, made[1].x), tmp_path, SIZE)
    assert np.abs(state - drawn([made[1]], tmp_path, SIZE)).mean() < 0.5


def test_contact_is_red(tmp_path):
    cube = box()
    touched = cube.where(y=1.0)
    made = colliding([cube, sheet(6, 1.4)], [], touched=touched)
    image = read(views.picture(made, tmp_path / "a.png", size=(480, 480), color="contact", elevation=40.0))
    assert red(image).mean() > 0.03
    pale = read(
        views.picture(
            colliding([cube, sheet(6, 1.4)], []), tmp_path / "b.png", size=(480, 480), color="contact", elevation=40.0
        )
    )
    assert not red(pale).any()
    one = colliding([cube], [], touched=[int(np.flatnonzero((cube.X == [1, 1, 1]).all(1))[0])])
    few = read(views.picture(one, tmp_path / "a.png", size=(480, 480), color="contact"))
    assert 20 < red(few).sum() < 0.1 * body_pixels(few).sum() + 4000
    with pytest.raises(InputError, match="color 'contact': nothing in this run may touch"):
        views.picture(cube, tmp_path / "a.png", color="contact")
    surface = Surface(motion := Motion.of(made))
    color = colors.Paint(surface, motion, "contact")(made[0].x, touched)
    top = np.isin(surface.source, touched) & (surface.owner == 0)
    assert (color[top] == color[top][0]).all()
    assert (np.ptp(color[~top].astype(int), axis=1) < 80).all()


def test_plane_bodies_meet_planes_face_on(tmp_path):
    made = colliding([sheet(4)], [pbng.Plane((0, -0.5, 0), (0, 1, 0))])
    assert Motion.of(made).is_plane()
    image = read(views.picture(made, tmp_path / "a.png", color="#3060c0", size=(200, 100), edges=False))
    assert body_pixels(image).mean() > 0.1
