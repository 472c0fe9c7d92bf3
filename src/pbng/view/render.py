"""Pictures, films and contact strips of runs, in the manner of the figures of a paper."""

import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pbng.checks import checked_number
from pbng.errors import InputError
from pbng.io.frames import Run
from pbng.view.camera import Extent, checked_angles, facing, framed, projected_aspect
from pbng.view.colors import Paint, stretch_map, touching
from pbng.view.dots import Dots
from pbng.view.panes import APART, Panes
from pbng.view.plots import caption, color_bar, over, plot_residuals
from pbng.view.residuals import residual_curves
from pbng.view.shadow import landed, leaning
from pbng.view.springs import Springs
from pbng.view.stage import Floor, Stage, smooth
from pbng.view.surface import Motion, Surface, springs_of
from pbng.view.video import Video

MARGIN = 0.07
RAMP = 0.2  # share of a tile over which its shadows fade towards its edges, or the seams would show
BAR = 118  # width [pixels at a height of 720] that a colour bar needs


def picture(
    source: Any,
    path: str | os.PathLike[str],
    *,
    frame: int = -1,
    color: str = "stretch",
    size: tuple[int, int] = (1280, 720),
    edges: bool | None = None,
    azimuth: float = 28.0,
    elevation: float = 20.0,
) -> Path:
    """Draw one frame as a picture; returns its path.

    Weak constraints are thin lines between what they tie together; of thousands, some hundred are drawn. Colliders are
    grey, planes among them glass, but for the floor.

    Args:
        source: A run or its folder, a frame or a sequence of frames, a mesh or a sequence of meshes at rest, or a pair
            of a mesh or a problem and positions (n_vert, 3) [m].
        path: The .png (or .jpg).
        frame: Which frame.
        color: "stretch" (largest principal stretch, with a colour bar), "body" (a colour a body), "contact" (red where
            something touches), or a colour by name.
        size: Width and height [pixels].
        edges: Whether to draw the edges of the triangles; by default only of plane meshes.
        azimuth: Where the camera stands: angle [degrees] from the z axis towards x.
        elevation: Angle [degrees] at which it looks down.

    Raises:
        InputError: There is nothing to draw, the frame or the colour is unknown, the size or an angle is not usable, or
            the file cannot be written.
    """
    motion = Motion.of(source)
    if not -len(motion) <= frame < len(motion):
        raise InputError(f"no frame {frame} in a run of {len(motion)}")
    path = _ready(path)
    artist = Artist(motion, color, edges, azimuth, elevation)
    with artist.stage(size) as stage:
        return _save(artist.draw(stage, motion.frames[frame]), path)


def film(
    source: Any,
    path: str | os.PathLike[str],
    *,
    fps: float | None = None,
    color: str = "stretch",
    size: tuple[int, int] = (1280, 720),
    edges: bool | None = None,
    azimuth: float = 28.0,
    elevation: float = 20.0,
) -> Path:
    """Draw all frames as an .mp4 (H.264); returns its path.

    The arguments are those of :func:`picture`; ``fps`` is by default the run's own, and an odd width or height is made
    even. Progress is shown if stderr is a terminal.
    """
    motion = Motion.of(source)
    size = size[0] + size[0] % 2, size[1] + size[1] % 2
    path = _ready(path)
    artist = Artist(motion, color, edges, azimuth, elevation)
    with artist.stage(size, sampling=2) as stage, Video(path, size, motion.fps if fps is None else fps) as video:
        for k in _shown(range(len(motion)), path.name):
            video.write(artist.draw(stage, motion.frames[k]))
    return path


def sheet(
    source: Any,
    path: str | os.PathLike[str],
    frames: int = 6,
    *,
    captions: Sequence[str] | None = None,
    color: str = "stretch",
    width: int = 1800,
    edges: bool | None = None,
    azimuth: float = 28.0,
    elevation: float = 20.0,
) -> Path:
    """Draw several frames, evenly spaced in time, side by side in one picture; returns its path.

    The arguments are those of :func:`picture`; ``captions``, one for each frame of the source, stand in place of the
    times; ``width`` [pixels] is that of the whole, its height follows.
    """
    motion = Motion.of(source)
    if captions is not None and len(captions) != len(motion):
        raise InputError(f"there are {len(captions)} captions for {len(motion)} frames")
    chosen = np.unique(np.linspace(0, len(motion) - 1, max(1, min(frames, len(motion)))).round().astype(int))
    width = round(checked_number("width", width))
    path = _ready(path)
    artist = Artist(motion, color, edges, azimuth, elevation)
    unit = width / 1600
    room = round(BAR * unit) if artist.paint.bar else 0
    columns, tile = _tiles(len(chosen), artist.aspect(), width - room)
    page = np.full((-(-len(chosen) // columns) * tile[1], columns * tile[0] + room, 3), 255, np.uint8)
    with artist.stage(tile, tile=True) as stage:
        for i, k in enumerate(chosen):
            frame = motion.frames[k]
            row, column = i // columns * tile[1], i % columns * tile[0]
            words = f"t = {frame.t:.2f} s" if captions is None else captions[k]
            image = over(faded(artist.draw(stage, frame, bar=False)), caption(tile, words, unit))
            page[row : row + tile[1], column : column + tile[0]] = image
    return _save(artist.with_bar(page, unit), path)


def view(source: Any, out: str | os.PathLike[str] | None = None, color: str = "stretch") -> list[Path]:
    """Look at a run: its last frame, a strip, a film and its residuals; returns the files written.

    Args:
        source: A run or its folder.
        out: The folder for the pictures; by default next to the run, its name with "_view" added.
        color: As :func:`picture` takes it.
    """
    run = source if isinstance(source, Run) else Run(source)
    folder = run.path.parent / f"{run.path.stem}_view" if out is None else Path(out)
    written = [picture(run, folder / "last.png", color=color)]
    if len(run) > 1:
        written += [sheet(run, folder / "strip.png", color=color), film(run, folder / "film.mp4", color=color)]
    series, xlabel = residual_curves(run)
    return [*written, plot_residuals(series, folder / "residuals.png", xlabel, "residual [N]", run.name)]


class Artist:
    """What is the same in all pictures of a motion: its surface, colours, and what it sweeps."""

    def __init__(self, motion: Motion, color: str, edges: bool | None, azimuth: float, elevation: float) -> None:
        self.plane = motion.is_plane()
        self.edges = self.plane if edges is None else edges
        self.angles = checked_angles(azimuth, elevation)
        self.surface = Surface(motion)
        self.motion = motion
        swept = Extent.of(motion, self.surface)
        self.panes = Panes(motion, swept)
        self.extent = swept.joined(self.panes.swept)
        self.floor: Floor | None = None
        if not self.plane:
            self.floor = self._floor()
            shadows = landed(self.extent.surface.points, float(self.floor.centre[1]), self.floor.lean)
            self.extent = replace(self.extent, shadows=shadows)
        self.reach = 0.4 * float(np.median([np.linalg.norm(np.ptp(body.mesh.X, axis=0)) for body in motion.bodies]))
        self.paint = Paint(self.surface, motion, color)
        self.springs, self.dots = Springs(springs_of(motion.frames[0])), Dots(self.surface.edge)
        self._bar: np.ndarray | None = None

    def stage(self, size: tuple[int, int], *, tile: bool = False, sampling: int = 3) -> Stage:
        """A stage of the size [pixels], with room for the colour bar; a tile has neither that nor a tinted floor."""
        if len(size) != 2 or not all(isinstance(n, int | np.integer) for n in size):
            raise InputError(f"size: expected two whole numbers of pixels, not {size!r}")
        if min(size) < 16:
            raise InputError(f"a picture of {size[0]} x {size[1]} pixels is too small")
        aspect = size[0] / size[1]
        room = BAR * size[1] / 720 / size[0] if self.paint.bar and not tile else 0.0
        margins = (MARGIN, max(MARGIN, room), 1.6 * MARGIN, 0.8 * MARGIN)  # below there is shadow
        if self.plane:
            camera, reach = facing(self.extent, aspect, margins), 0.0
        else:
            azimuth, elevation = self.angles
            rim = 0.5 * MARGIN
            camera = framed(
                self.extent,
                aspect,
                azimuth=azimuth,
                elevation=elevation,
                margins=margins,
                shadow_margins=(rim, max(rim, room), rim, rim),
            )
            reach = self.reach
        floor = replace(self.floor, tint=0.0, ramp=RAMP) if tile and self.floor is not None else self.floor
        return Stage(
            self.surface,
            camera,
            size,
            floor=floor,
            reach=reach,
            edges=self.edges,
            sampling=sampling,
            springs=self.springs,
            dots=self.dots,
            panes=self.panes,
        )

    def aspect(self) -> float:
        """Width over height of what the motion covers in a picture."""
        if self.plane:
            width, height, _ = self.extent.high - self.extent.low
            return float(width / max(height, 1e-9 * self.extent.size))
        return projected_aspect(self.extent, *self.angles)

    def draw(self, stage: Stage, frame: Any, bar: bool = True) -> np.ndarray:
        """The image (height, width, 3) uint8 of a frame."""
        x, touched = self.motion.placed(frame), touching(frame)
        dots = x[touched] if self.paint.contact and touched is not None else np.empty((0, 3))
        image = stage(x, self.paint(x, touched), springs_of(frame), self.panes(frame), dots)
        return self.with_bar(image, image.shape[0] / 720) if bar else image

    def with_bar(self, image: np.ndarray, unit: float) -> np.ndarray:
        if self.paint.bar is None:
            return image
        if self._bar is None or self._bar.shape[:2] != image.shape[:2]:
            size = image.shape[1], image.shape[0]
            self._bar = color_bar(size, *self.paint.bar, stretch_map(), "largest principal stretch", unit)
        return over(image, self._bar)

    def _floor(self) -> Floor:
        seen = self.extent.surface  # springs and panes cast no shadow, but the floor is below them too
        low, high = seen.low, seen.high
        low[1] = self.extent.low[1] if self.panes.floor is None else self.panes.floor
        centre = (low + high) / 2
        centre[1] = low[1] - APART * seen.size  # below what lies on it, or the two would mix
        reach = np.hypot(*(high - low)[[0, 2]]) / 2
        half, top = 1.6 * reach + 1.1 * (high - low)[1], float(high[1] - centre[1])
        return Floor(centre, half, top, leaning(seen.points, float(centre[1])))


def _tiles(n: int, aspect: float, width: int) -> tuple[int, tuple[int, int]]:
    """How many columns of tiles of which size fill a page of the width best: one about twice as wide as high."""
    aspect = float(np.clip(aspect, 0.4, 4.0))

    def waste(columns: int) -> float:
        rows = -(-n // columns)
        return abs(np.log(columns * aspect / rows / 2.2)) + 0.5 * (rows * columns - n)

    columns = min(range(1, n + 1), key=waste)
    across = width // columns
    return columns, (across, round(across / aspect * 1.12))


def faded(image: np.ndarray) -> np.ndarray:
    """The image turning white towards its edges, within the margins, so that no seam shows between tiles."""
    rows, columns = (smooth(np.minimum(k := np.arange(n), n - 1 - k) / (1.3 * MARGIN * n)) for n in image.shape[:2])
    return np.rint(255 - (255 - image) * (rows[:, None] * columns)[..., None]).astype(np.uint8)


def _shown(items: range, what: str) -> Iterable[int]:
    """The items, with a progress bar if anyone is looking."""
    if not sys.stderr.isatty():
        return items
    return _with_progress(items, what)


def _with_progress(items: range, what: str) -> Iterator[int]:
    from rich.console import Console
    from rich.progress import track

    yield from track(items, what, console=Console(stderr=True), transient=True)


def _ready(path: str | os.PathLike[str]) -> Path:
    """The path, in a folder that exists: found out before the work, not after."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    return path


def _save(image: np.ndarray, path: Path) -> Path:
    from PIL import Image

    try:
        Image.fromarray(image).save(path)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write {path}: {error}") from error
    return path
