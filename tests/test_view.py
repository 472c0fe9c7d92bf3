"""Pictures show all of a motion, lit and in place; colours keep their meaning; films have every frame."""

import subprocess
import sys

import numpy as np
import pytest
from fake_runs import box, frames, sheet, twisted
from pictures import SIZE, assert_well_framed, body_pixels, drawn, read

from pbng.errors import InputError
from pbng.io.frames import FrameWriter, Run
from pbng.mesh import Embedding, TetMesh, TriMesh
from pbng.view.camera import VIEW_ANGLE, Extent, facing, framed
from pbng.view.plots import _apart
from pbng.view.stretch import Stretch
from pbng.view.surface import Motion, Surface, creased

pytest.importorskip("pyvista")
imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")

from pbng import view as views  # noqa: E402
from pbng.view import colors, render, springs  # noqa: E402


def drawn_out(X, s):
    return twisted(X, 0.25 * s) * [1 + s, 1, 1]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "twist"
    with FrameWriter(path, fps=10) as out:
        for frame in frames([box((6, 6, 6)), box((4, 4, 4), at=(2.5, 0, 0))], 5, drawn_out):
            out.write(frame)
    return Run(path)


def test_boxes_are_cut_along_their_edges_only():
    mesh = box((3, 3, 3))
    source, triangles = creased(mesh.X, mesh.surface)
    assert len(source) == 6 * 16
    assert np.array_equal(source[triangles], mesh.surface)
    surface = Surface(Motion.of(mesh))
    normals = surface.normals(surface.points(mesh.X))
    assert np.allclose(np.sort(np.abs(normals), axis=1), [0, 0, 1])
    outward = surface.points(mesh.X) - 0.5
    assert (np.einsum("pi,pi->p", outward, normals) > 0.49).all()
    rounded, _ = creased(mesh.X, mesh.surface, angle=91)
    assert sorted(rounded) == sorted(set(mesh.surface.ravel())), "no edge is that sharp"


def test_triangles_turned_the_other_way_are_cut_off_and_keep_their_normals():
    plate = sheet(3)
    mixed = plate.cells.copy()
    mixed[4:] = mixed[4:, ::-1]
    source, triangles = creased(plate.X, mixed)
    assert np.array_equal(source[triangles], mixed)
    assert not set(triangles[:4].ravel()) & set(triangles[4:].ravel())


@pytest.mark.parametrize("name", ["tets", "plane", "cloth", "skin"])
def test_stretch_of_an_affine_map_is_its_largest_singular_value(name, rng):
    F = np.eye(3) + 0.5 * rng.standard_normal((3, 3))
    expected = np.linalg.svd(F)[1][0]
    block = box((2, 2, 2))
    if name == "tets":
        mesh = block
    elif name == "plane":
        mesh = sheet(3)
        expected = np.linalg.svd(F[:, :2])[1][0]
    elif name == "cloth":
        mesh = sheet(3, height=0.7)
        expected = np.linalg.svd(F[:, [0, 2]])[1][0]
    else:
        skin = Embedding(np.array([[0, 1, 2]]), block.cells[:3], np.full((3, 4), 0.25))
        mesh = TetMesh(block.X, block.cells, skin=skin)
    motion = Motion.of(mesh)
    x = mesh.X @ F.T + [1, 2, 3]
    values = Stretch(motion.bodies)(x)[Surface(motion).source]
    assert np.allclose(values, expected, rtol=1e-12)
    assert np.allclose(Stretch(motion.bodies)(mesh.X)[Surface(motion).source], 1, atol=1e-7)


def test_colours_mean_the_same_in_every_frame(run):
    motion = Motion.of(run)
    surface = Surface(motion)
    paint = colors.Paint(surface, motion, "stretch")
    low, high = paint.bar
    values = [Stretch(motion.bodies)(frame.x)[surface.source] for frame in run]
    assert low == 1
    assert np.percentile(values[-1], 98) <= high <= 1.3 * values[-1].max()
    rest, end = paint(run[0].x), paint(run[-1].x)
    assert (np.ptp(rest, axis=0) <= 2).all(), "at rest all is of one colour"
    assert rest[0, 2] > rest[0, 0], "which is blue"
    most = values[-1].argmax()
    assert end[most, 0] > end[most, 2], "and the most stretched is red"
    fixed = colors.Paint(surface, motion, "body")(run[3].x)
    assert len(np.unique(fixed, axis=0)) == 2
    with pytest.raises(InputError, match="unknown color 'stress'"):
        colors.Paint(surface, motion, "stress")


@pytest.mark.parametrize("aspect", [0.5, 1.0, 16 / 9])
@pytest.mark.parametrize("angles", [(28, 20), (-70, 60), (10, -15)])
def test_the_camera_sees_all_and_no_more(aspect, angles, rng):
    points = rng.standard_normal((200, 3)) * [3, 1, 0.5] + 7
    margins = (0.05, 0.2, 0.1, 0.05)
    camera = framed(Extent(points), aspect, azimuth=angles[0], elevation=angles[1], margins=margins)
    ahead = (camera.focus - camera.position) / np.linalg.norm(camera.focus - camera.position)
    ray = points - camera.position
    half = np.tan(np.radians(VIEW_ANGLE) / 2)
    across = ray @ np.cross(ahead, camera.up) / (ray @ ahead) / half / aspect
    upward = ray @ camera.up / (ray @ ahead) / half
    # From 0 to 1 over the picture, less the margins: slack on either side.
    x, y = (across + 1) / 2, (upward + 1) / 2
    slack = np.array([x.min() - 0.05, 0.8 - x.max(), y.min() - 0.1, 0.95 - y.max()])
    assert (slack > -1e-9).all()
    assert (slack[:2] < 1e-9).all() or (slack[2:] < 1e-9).all(), "it could be nearer"


def test_the_camera_faces_planes():
    extent = Extent(np.array([[0, 0, 0], [4, 1, 0]], float))
    camera = facing(extent, 2.0, (0.1, 0.3, 0.1, 0.1))
    width = 2 * camera.parallel * 2.0
    left = camera.position[0] - width / 2
    assert np.isclose((0 - left) / width, 0.1)
    assert np.isclose((4 - left) / width, 0.7)


@pytest.mark.parametrize("color", ["stretch", "body"])
@pytest.mark.parametrize("frame", [0, -1])
def test_pictures_are_well_framed(run, tmp_path, color, frame):
    path = views.picture(run, tmp_path / "new" / "a.png", color=color, size=SIZE, frame=frame)
    image = read(path)
    if color == "stretch":  # its bar is coloured too
        assert body_pixels(image)[:, -40:].any()
        image[:, -40:] = 255
    assert_well_framed(image, SIZE, least=0.06)


def test_pictures_of_meshes_frames_and_folders(run, tmp_path):
    a = views.picture(run, tmp_path / "a.png", color="body", size=SIZE)
    b = views.picture(run.path, tmp_path / "b.png", color="body", size=SIZE)
    assert a.read_bytes() == b.read_bytes(), "pictures are reproducible"
    made = list(frames([box((6, 6, 6)), box((4, 4, 4), at=(2.5, 0, 0))], 5, drawn_out))
    c = views.picture(made, tmp_path / "c.png", color="body", size=SIZE)
    assert np.array_equal(read(a), read(c))
    single = views.picture(made[-1], tmp_path / "d.png", color="body", size=SIZE)
    assert_well_framed(read(single), SIZE)
    pair = views.picture((made[-1].problem, made[-1].x), tmp_path / "f.png", color="body", size=SIZE)
    assert pair.read_bytes() == single.read_bytes()
    moved = views.picture((box(), box().X + 5), tmp_path / "g.png", color="body", size=SIZE)
    assert np.abs(read(moved) - read(views.picture(box(), tmp_path / "h.png", color="body", size=SIZE))).mean() < 0.5
    tall = (150, 301)
    assert_well_framed(read(views.picture([box(), sheet(3, 2.0)], tmp_path / "e.png", color="body", size=tall)), tall)


def test_planes_are_seen_face_on(tmp_path):
    image = read(views.picture(sheet(4), tmp_path / "a.png", color="#3060c0", size=(200, 100), edges=False))
    body = body_pixels(image)
    rows, columns = np.flatnonzero(body.any(1)), np.flatnonzero(body.any(0))
    assert abs(len(rows) - len(columns)) <= 1, "a square is square"
    assert (image[body.nonzero()] == [0x30, 0x60, 0xC0]).all(1).mean() > 0.9
    edged = read(views.picture(sheet(4), tmp_path / "b.png", color="#3060c0", size=(200, 100)))
    assert (edged != image).any(), "plane meshes show their edges"


def test_both_sides_of_cloth_are_lit(tmp_path):
    cloth = TriMesh(*(getattr(sheet(6, 0.5), name) for name in ("X", "cells")))
    for elevation in (60, -60):
        image = read(views.picture(cloth, tmp_path / "a.png", color="body", size=SIZE, elevation=elevation))
        assert_well_framed(image, SIZE)


def test_not_finite_positions_are_no_disaster(tmp_path):
    frame = next(frames([box()], 1))
    frame.x[7] = np.nan
    assert read(views.picture(frame, tmp_path / "a.png", size=SIZE)).shape == (180, 320, 3)


def test_films_have_every_frame(run, tmp_path, capfd):
    path = views.film(run, tmp_path / "a.mp4", size=(161, 120), color="body")
    reader = imageio_ffmpeg.read_frames(str(path))
    facts = next(reader)
    images = [np.frombuffer(data, np.uint8).reshape(120, 162, 3).astype(int) for data in reader]
    assert len(images) == len(run)
    assert facts["fps"] == 10
    assert facts["codec"] == "h264"
    assert facts["pix_fmt"].startswith("yuv420p")
    assert facts["size"] == (162, 120)
    still = read(views.picture(run, tmp_path / "a.png", size=(162, 120), color="body"))
    assert np.abs(images[-1] - still).mean() < 3, "the film has the colours of the picture"
    assert np.abs(np.diff([image[:20, :20] for image in images], axis=0)).max() <= 3, (
        "what does not move does not flicker"
    )
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.mp4", "a.png"}
    said = capfd.readouterr()
    assert said.out == ""
    assert "WARN" not in said.err
    assert "film" not in said.err, "no progress where nobody looks"


def test_a_film_that_fails_leaves_nothing(tmp_path, monkeypatch):
    with FrameWriter(tmp_path / "run") as out:
        for frame in frames([box((2, 2, 2))], 3):
            out.write(frame)
    draw, motion = render.Artist.draw, Run(tmp_path / "run")

    def damage(*args):
        (tmp_path / "run" / "frame_000002.npz").write_bytes(b"")
        return draw(*args)

    monkeypatch.setattr(render.Artist, "draw", damage)
    with pytest.raises(InputError, match="frame_000002"):
        views.film(motion, tmp_path / "a.mp4", size=(64, 64))
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]


def test_progress_is_shown_to_people_only(monkeypatch):
    assert render._shown(range(3), "film") == range(3)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    assert list(render._shown(range(3), "film")) == [0, 1, 2]


def test_strips_show_the_motion(run, tmp_path):
    image = read(views.sheet(run, tmp_path / "a.png", 4, width=640, color="body"))
    assert abs(image.shape[1] - 640) < 8
    half = image.shape[0] // 2, image.shape[1] // 2
    tiles = [image[i : i + half[0], j : j + half[1]] for i in (0, half[0]) for j in (0, half[1])]
    shares = [body_pixels(tile).mean() for tile in tiles]
    assert min(shares) > 0.05
    assert shares == sorted(shares), "the bodies grow"
    one = views.sheet(run, tmp_path / "b.png", 1, width=300)
    assert read(one).shape[1] == pytest.approx(300, abs=3)


def test_view_writes_what_it_says(run, tmp_path):
    written = views.view(run.path, tmp_path / "out")
    assert sorted(tmp_path.glob("out/*")) == sorted(written)
    assert [path.name for path in written] == ["last.png", "strip.png", "film.mp4", "residuals.png"]
    assert all(path.stat().st_size > 1000 for path in written)


def test_bad_input_is_named(run, tmp_path):
    with pytest.raises(InputError, match="no frame 9 in a run of 5"):
        views.picture(run, tmp_path / "a.png", frame=9)
    with pytest.raises(InputError, match="nothing to draw in list"):
        views.picture([], tmp_path / "a.png")
    with pytest.raises(InputError, match="nothing to draw in int"):
        views.picture(3, tmp_path / "a.png")
    with pytest.raises(InputError, match=r"positions must have shape \(64, 3\), not \(2, 3\)"):
        views.picture((box(), np.zeros((2, 3))), tmp_path / "a.png")
    with pytest.raises(InputError, match="too small"):
        views.picture(run, tmp_path / "a.png", size=(3, 3))
    with pytest.raises(InputError, match=r"two whole numbers of pixels, not \(100.5, 100\)"):
        views.picture(run, tmp_path / "a.png", size=(100.5, 100))
    with pytest.raises(InputError, match=r"width must be .*finite, not nan"):
        views.sheet(run, tmp_path / "a.png", width=np.nan)
    for angles in ({"azimuth": np.nan}, {"elevation": -np.inf}, {"azimuth": "left"}):
        for draw, name in ((views.picture, "a.png"), (views.film, "a.mp4"), (views.sheet, "a.png")):
            with pytest.raises(InputError, match="azimuth and elevation: expected 2 finite numbers, not"):
                draw(run, tmp_path / name, **angles)
    with pytest.raises(InputError, match="elevation must lie between -90 and 90 degrees, not 120"):
        views.picture(run, tmp_path / "a.png", elevation=120)
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    for draw, name in ((views.picture, "a.png"), (views.film, "a.mp4"), (views.sheet, "a.png")):
        with pytest.raises(InputError, match=r"cannot write .*file"):
            draw(run, tmp_path / "file" / name, color="body")
    with pytest.raises(InputError, match=r"cannot write .*a\.xyz"):
        views.picture(run, tmp_path / "a.xyz", size=SIZE)
    with pytest.raises(InputError, match=r"cannot write .*a\.xyz"):
        views.film(run, tmp_path / "a.xyz", size=SIZE)


def two_boxes(gap, lines=None):
    """Frames of a box that sinks that far [m] below another, with the springs (m, 2, 3) between them or others."""
    upper, lower = box(at=(0, 1, 0)), box()
    made = list(frames([upper, lower], 3, lambda X, s: X - [0, gap * s * (X[:, 1].min() == 0), 0]))
    for frame in made:
        below = frame.x[len(upper.X) :][lower.X[:, 1] == 1]
        tied = np.stack([upper.X[upper.X[:, 1] == 1], below], axis=1)
        frame.springs = tied if lines is None else np.array(lines, float)
    return made


def green(image):
    """Pixels that springs cover for a good part; no body here is green, blues and greys are not."""
    return image[..., 1] - image[..., [0, 2]].max(2) > 25


def test_springs_are_seen_between_what_they_tie(tmp_path):
    made = two_boxes(0.5)
    image = drawn(made, tmp_path)
    rows, columns = np.nonzero(green(image))
    assert 150 < rows.min() < rows.max() < 330, "in the gap"
    least, most = np.flatnonzero(body_pixels(image).any(0))[[0, -1]]
    assert least - 2 <= columns.min() < least + 60 < most - 60 < columns.max() <= most + 2
    with FrameWriter(tmp_path / "run") as out:
        for frame in made:
            out.write(frame)
    assert np.array_equal(drawn(tmp_path / "run", tmp_path), image)
    strip = green(read(views.sheet(Run(tmp_path / "run"), tmp_path / "b.png", 3, width=900, color="body")))
    thirds = [part.sum() for part in np.array_split(strip, 3, axis=1)]
    assert thirds[2] > thirds[1] > 30, "they grow"
    reader = imageio_ffmpeg.read_frames(str(views.film(made, tmp_path / "a.mp4", size=(480, 480), color="body")))
    next(reader)
    last = [np.frombuffer(data, np.uint8).reshape(480, 480, 3).astype(int) for data in reader][-1]
    assert green(last).sum() > 0.5 * len(rows)


def test_without_springs_nothing_changes(tmp_path):
    made = two_boxes(0.5, np.empty((0, 2, 3)))
    empty = drawn(made, tmp_path)
    for frame in made:
        del frame.springs
    assert np.array_equal(drawn(made, tmp_path), empty)
    for end in (0.5, np.nan):
        vanished = drawn(two_boxes(0.5, [[[0.5, 0.5, 0.5], [0.5, 0.5, end]]]), tmp_path)
        assert np.abs(vanished - empty).mean() < 0.1, "but for rounding in where the camera stands"
        assert not green(vanished).any()


def test_springs_are_hidden_by_what_is_before_them(tmp_path):
    front, side = [[0, 0, 1], [1, 0, 1]], [[1, 1, 0.2], [2, 1, -0.8]]  # seen from the z axis, turned towards x
    seen = [green(drawn(two_boxes(0, [line]), tmp_path)).sum() for line in (np.add(front, [0, 1.5, 0]), side)]
    assert min(seen) > 50, "what lies in a surface or beside it is seen"
    inside, behind = [[0.2, 1.2, 0.2], [0.8, 1.8, 0.8]], [[0, 1.2, -0.2], [0.4, 1.5, -0.2]]
    assert not green(drawn(two_boxes(0, [inside, behind]), tmp_path)).any()
    plane = next(frames([sheet(4)], 1, lambda X, s: X))
    for z, least, most in ((0.0, 60, 200), (-0.1, 0, 0)):
        plane.springs = np.array([[[-0.4, -0.3, z], [0.4, 0.3, z]]])
        assert least <= green(drawn(plane, tmp_path, (120, 120))).sum() <= most


def test_springs_that_end_far_away_are_framed(tmp_path):
    motion = Motion.of(made := two_boxes(0.5, [[[1, 2, 1], [4, 5, 1]], [[0, 2, 0], [np.inf, 0, 0]]]))
    extent = Extent.of(motion, Surface(motion))
    assert np.allclose(extent.high, [4, 5, 1])
    assert np.allclose(extent.bodies.high, [1, 2, 1])
    image = drawn(made, tmp_path)
    assert_well_framed(image, (480, 480), least=0.02)
    assert green(image[:160, 320:]).sum() > 30


def test_of_very_many_springs_some_are_drawn(tmp_path):
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 50)], [0.0, 0.0]), axis=-1).reshape(-1, 3)
    lines = np.stack([grid, grid + np.array([0, 0, 3])], axis=1)
    chosen = np.unique(springs.apart(lines, springs.MOST))
    assert len(chosen) == springs.MOST
    counts = np.histogram2d(*grid[chosen, :2].T, bins=4)[0]
    assert counts.min() > 0.6 * counts.max(), "evenly"
    assert np.array_equal(springs.apart(lines[:7], 7), range(7))
    assert len(np.unique(springs.apart(np.zeros((900, 2, 3)), 500))) == 500
    image = drawn(two_boxes(0.0, lines), tmp_path)
    assert green(image).sum() > 500
    assert not (np.abs(image - springs.COLOR).sum(2) < 15).any(), "what is behind them shows through"


def test_residuals_are_plotted(tmp_path):
    k = np.arange(50)
    series = {"PBNG": (k, 0.5**k), "XPBD": (k[:20], 1 / (1 + k[:20])), "bad": (k, np.where(k % 2, np.nan, -1))}
    path = views.plot_residuals(series, tmp_path / "new" / "a.png", "iteration", "residual [N]", "A title")
    image = read(path)
    assert image.shape[1] > 800
    for color in ("#1f5a94", "#d9662b"):
        rgb = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
        assert (np.abs(image - rgb).sum(2) < 12).sum() > 300
    assert views.plot_residuals(series, tmp_path / "b.pdf", log_x=True).stat().st_size > 1000
    with pytest.raises(InputError, match="no curves"):
        views.plot_residuals({}, tmp_path / "c.png")
    with pytest.raises(InputError, match="curve 'a' has 2 x and 3 y"):
        views.plot_residuals({"a": ([1, 2], [1, 2, 3])}, tmp_path / "c.png")
    with pytest.raises(InputError, match=r"c\.xyz"):
        views.plot_residuals(series, tmp_path / "c.xyz")


def test_labels_are_moved_apart_as_little_as_possible(rng):
    wanted = np.sort(rng.random(12) * 60)
    placed = _apart(wanted, 10.0)
    assert (np.diff(placed) > 10 - 1e-9).all()
    assert placed.mean() == pytest.approx(wanted.mean())
    assert np.array_equal(_apart(np.array([0.0, 50, 100]), 10.0), [0, 50, 100])


def test_view_is_a_function_and_a_module(tmp_path):
    with pytest.raises(InputError, match="absent: no such folder"):
        views(tmp_path / "absent")


def test_importing_views_needs_nothing():
    code = "import sys, pbng.view; print([m for m in ('pyvista', 'matplotlib', 'imageio_ffmpeg') if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={"PYTHONPATH": ":".join(sys.path)}
    )
    assert done.stdout.strip() == "[]", done.stderr
