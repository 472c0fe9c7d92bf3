"""Shadows fall where the light casts them, softly and within the picture; hollows are dark, and edges stay smooth."""

from dataclasses import replace

import numpy as np
import pytest
from fake_runs import box, frames, sheet
from pictures import body_pixels

from pbng.mesh import TriMesh
from pbng.view.camera import Extent, framed
from pbng.view.surface import Motion

pytest.importorskip("pyvista")
pytest.importorskip("PIL.Image")

from pbng.view import render, shadow
from pbng.view.occlusion import occlude


@pytest.mark.parametrize("aspect", [0.5, 1.0, 16 / 9])
def test_the_camera_sees_shadows_nearer_to_the_edge(aspect, rng):
    points = rng.standard_normal((200, 3)) * [3, 1, 0.5]
    bodies = Extent(points)
    extent = replace(bodies, shadows=points * [1, 0, 1] + [4, -1, -4])
    margins = (0.07, 0.1, 0.12, 0.06)

    def shares(points, camera):
        places = camera.seen(points, (aspect, 1.0))[:, :2] / [aspect, 1]
        return np.array([*places.min(0), *(1 - places.max(0))])  # free at the left, top, right and bottom

    camera = framed(extent, aspect, margins=margins, shadow_margins=4 * (0.03,))
    own, cast = shares(points, camera), shares(extent.shadows, camera)
    assert (own > np.array([0.07, 0.06, 0.1, 0.12]) - 1e-9).all()
    assert (cast > 0.03 - 1e-9).all()
    assert min(cast) < 0.03 + 1e-9, "it could be nearer"
    alone = framed(bodies, aspect, margins=margins)
    near = replace(bodies, shadows=points.mean(0)[None])
    assert np.allclose(framed(near, aspect, margins=margins).position, alone.position), "where they are seen anyhow"


@pytest.mark.parametrize("height", [0.3, 2.0, 20.0])
@pytest.mark.parametrize("azimuth", [28.0, 150.0, -80.0])
def test_shadows_are_in_the_picture_and_bodies_stay_large(height, azimuth):
    cube = box((2, 2, 2))
    motion = Motion.of(list(frames([cube], 2, lambda X, s: X + np.array([0, height * (1 - s), 0]))))
    artist = render.Artist(motion, "body", None, azimuth, 20.0)
    size = (200, round(200 / np.clip(artist.aspect(), 0.4, 4)))
    with artist.stage(size, tile=True) as stage:
        image = artist.draw(stage, motion.frames[0], bar=False)
        floor, lean = stage.camera.seen(np.array([artist.floor.centre]), size), artist.floor.lean
        landed = shadow.landed(motion.frames[0].x, artist.floor.centre[1], lean)
        places = stage.camera.seen(landed, size)[:, :2] / size
    assert floor[0, 2] > 0
    assert 0.03 < places.min() < places.max() < 0.97, "all of the shadow"
    assert np.ptp(landed[:, 0]) > 1
    edge = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert edge.min() > 250, "no seam"
    artist.extent = replace(artist.extent, shadows=np.empty((0, 3)))
    with artist.stage(size, tile=True) as stage:
        bare = body_pixels(artist.draw(stage, motion.frames[0], bar=False))
    assert body_pixels(image).mean() > 0.55 * bare.mean()


def test_shadows_are_dark_below_and_soft_with_height():
    plate = sheet(4, height=0.0)
    cast = shadow.Shadow(np.zeros(3), 2.0, 1.0)
    low, high = (cast(plate.X + np.array([0, h, 0]), plate.cells) for h in (0.01, 1.0))
    middle = shadow.PIXELS // 2
    assert low[middle, middle] == pytest.approx(1 - np.prod([1 - s.strength for s in shadow.SOURCES]), abs=0.01)
    assert low[:20].max() == 0
    assert high.max() < low.max()
    assert np.abs(np.diff(high, axis=0)).max() < 0.3 * np.abs(np.diff(low, axis=0)).max()


def test_shadows_land_where_the_light_is_said_to_cast_them():
    plate = sheet(4, height=0.8)
    for lean in (1.0, 0.4):
        dark = shadow.Shadow(np.zeros(3), 2.0, 1.0, lean)(plate.X, plate.cells)
        dark = np.where(dark > 0.99 * shadow.SOURCES[0].strength, dark, 0)
        at = (np.arange(shadow.PIXELS) + 0.5) / shadow.PIXELS * 4 - 2
        middle = [(dark.sum(0) * at).sum() / dark.sum(), (dark.sum(1) * at).sum() / dark.sum()]
        landed = shadow.landed(plate.X, 0.0, lean)
        assert np.allclose(landed[:, 1], 0)
        assert np.allclose(landed.mean(0)[[0, 2]], 0.8 * lean * np.array([0.42, -0.42]))
        assert np.abs(np.array(middle) - landed.mean(0)[[0, 2]]).max() < 0.1, "that of the sky pulls it inward a little"


def test_what_is_lower_lets_no_light_into_a_shadow():
    large, small = sheet(4, height=1.0), sheet(4, height=1.0)
    small = TriMesh(0.3 * small.X, small.cells)
    cast = shadow.Shadow(np.zeros(3), 2.0, 1.0)
    alone = cast(large.X, large.cells)
    both = cast(np.concatenate([large.X, small.X]), np.concatenate([large.cells, small.cells + len(large.X)]))
    assert (both > alone - 0.02).all()
    assert (both > alone + 0.05).any()


def test_hollows_are_darker_than_planes():
    h = w = 60
    tangent = 0.1
    toward = np.full((h, w, 3), 128, np.uint8)
    toward[..., 2] = 255
    plane = np.full((h, w), 10, np.float32)
    before = np.full((2 * h, 2 * w, 3), 200, np.uint8)
    fine = np.full((2 * h, 2 * w), 10, np.float32)
    image = before.copy()
    occlude(image, fine, plane, toward, tangent, 0.5, 0.01)
    assert np.array_equal(image, before)
    step = plane.copy()
    step[:, :30] = 9.7  # the left half stands nearer: the right half is darker beside it
    fine[:, :60] = 9.7
    occlude(image, fine, step, toward, tangent, 0.5, 0.01)
    assert image[60, 64, 0] < 185
    assert image[60, 110, 0] == 200
    assert image[60, 20, 0] == 200
    fine[:], step[:] = np.inf, np.inf
    image = before.copy()
    occlude(image, fine, step, toward, tangent, 0.5, 0.01)
    assert np.array_equal(image, before), "there is nothing to darken"
