"""A stage for pictures: light, floor and camera, set once; then one image a frame."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import numpy as np

from pbng.view.camera import VIEW_ANGLE, Camera
from pbng.view.dots import Dots
from pbng.view.light import Light
from pbng.view.occlusion import occlude
from pbng.view.panes import LINE, LINE_OPACITY, LINE_WIDTH, Panes, edges
from pbng.view.shadow import PIXELS, Shadow
from pbng.view.springs import Springs, lay_lines
from pbng.view.surface import Surface
from pbng.view.window import INK, Window


@dataclass(frozen=True, eq=False)
class Floor:
    """A square: its centre (x, y, z) [m], half its side [m], the greatest height [m] of anything above it, how much the
    light leans (:func:`pbng.view.shadow.leaning`), how dark it is where no shadow falls, and over what share of the
    picture's width and height it fades towards the picture's edges.
    """

    centre: np.ndarray
    half: float
    top: float
    lean: float
    tint: float = 0.055
    ramp: float = 0.0


class Stage:
    """An image (height, width, 3) uint8 of a surface for each call; close it, or use it in ``with``.

    Args:
        surface: What to draw.
        camera: From where.
        size: Width and height [pixels].
        floor: What shadows fall on, if anything.
        reach: How far [m] surfaces take light from each other; 0 for no such shading.
        edges: Whether to draw the edges of the triangles.
        sampling: Each pixel is the mean of so many by so many.
        springs: What draws weak constraints.
        dots: What draws vertices in contact.
        panes: The panes of glass.

    Raises:
        InputError: pyvista is not installed, or the machine has nothing to draw with.
    """

    def __init__(
        self,
        surface: Surface,
        camera: Camera,
        size: tuple[int, int],
        *,
        floor: Floor | None,
        reach: float,
        edges: bool,
        sampling: int,
        springs: Springs,
        dots: Dots,
        panes: Panes,
    ) -> None:
        self.surface, self.sampling, self.reach = surface, sampling, reach
        n, triangles = len(surface.source), surface.triangles
        self.camera, self.frame = camera, camera.frame
        self.springs, self.dots, self.panes = springs, dots, panes
        # A plane seen face on has no shape to model by light.
        self.light = Light(self.frame) if camera.parallel is None else None
        large = sampling * size[0], sampling * size[1]
        self.window = Window(n, triangles, camera, large, 0.8 * sampling if edges else 0.0)
        # Light from around has no fine detail: it is found in an image of half the size, which shows the normals.
        self.guide = Window(n, triangles, camera, ((size[0] + 1) // 2, (size[1] + 1) // 2)) if reach > 0 else None
        self.shadow = None if floor is None else self._lay(floor, size)
        if len(panes):
            self.window.add_panes(len(panes))

    def __call__(
        self, x: np.ndarray, color: np.ndarray, springs: np.ndarray, panes: np.ndarray, dots: np.ndarray
    ) -> np.ndarray:
        """The image of a frame.

        Args:
            x: Where the parts of the surface are, (n_vert, 3) [m].
            color: Colours (n, 3) uint8 of its points.
            springs: Ends (m, 2, 3) [m] of weak constraints.
            panes: Corners (k, 4, 3) [m] of panes of glass.
            dots: Vertices in contact, (j, 3) [m].
        """
        points = self.surface.points(x)
        normals = self.surface.normals(points)
        if self.shadow is not None:
            self.shadow(points, self.surface.triangles)
        if len(panes):
            self.window.set_panes(*self.panes.glass(panes, self.camera))
        if self.light is None:
            self.window.draw(points, color, color)
        else:
            lit = (np.minimum(color * self.light(side), 255).astype(np.uint8) for side in (normals, -normals))
            self.window.draw(points, *lit)
        image, depth = self.window.image(), self.window.depth()
        if self.guide is not None:
            seen = normals @ self.frame.T
            self.guide.draw(points, *(np.rint(127.5 * (side + 1)).astype(np.uint8) for side in (seen, -seen)))
            tangent = np.tan(np.radians(VIEW_ANGLE) / 2)
            # Before the image is made smaller: on an edge between two surfaces each has light of its own.
            occlude(image, depth, self.guide.depth(), self.guide.image(), tangent, self.reach, self.surface.edge)
        image = _shrunk(image, self.sampling)
        if len(springs) or len(panes) or len(dots):
            lay_lines(image, depth, self.camera, edges(panes), LINE_WIDTH, LINE, LINE_OPACITY)
            self.dots.draw(image, depth, self.camera, dots)
            self.springs.draw(image, depth, self.camera, springs)
        return image

    def close(self) -> None:
        self.window.close()
        if self.guide is not None:
            self.guide.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _lay(self, floor: Floor, size: tuple[int, int]) -> Callable[[np.ndarray, np.ndarray], None]:
        """A floor that is all shadow: of one colour, as opaque as it is dark, gone towards its rim."""
        pv = self.window.pv
        cast = Shadow(floor.centre, floor.half, floor.top, floor.lean)
        corners = floor.centre + floor.half * np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]])
        quad = pv.PolyData.from_regular_faces(corners, [[0, 3, 2, 1]])
        quad.active_texture_coordinates = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
        image = pv.ImageData(dimensions=(PIXELS, PIXELS, 1))
        image.point_data["color"] = np.tile(np.array([*INK, 0], np.uint8), (PIXELS**2, 1))
        texture = pv.Texture(image)
        texture.InterpolateOn()
        self.window.plotter.add_mesh(quad, texture=texture, lighting=False, render=False, reset_camera=False)
        axis = (np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1
        fade = smooth((1 - np.hypot(axis[:, None], axis)) / 0.75)
        if floor.ramp > 0:
            spots = np.stack(np.broadcast_arrays(axis, 0.0, axis[:, None]), axis=2).reshape(-1, 3)
            places = self.camera.seen(floor.centre + floor.half * spots, size)
            inside = np.minimum(places[:, :2], size - places[:, :2]) / size  # shares of the picture, from its edge
            inside[places[:, 2] <= 0] = 0
            fade *= smooth(inside / floor.ramp).prod(1).reshape(fade.shape)
        noise = np.random.default_rng(0).random(fade.shape)  # or so few levels would show as rings

        def update(points: np.ndarray, triangles: np.ndarray) -> None:
            dark = 1 - (1 - floor.tint) * (1 - cast(points, triangles))
            image.point_data["color"][:, 3] = np.floor(255 * dark * fade + noise).ravel()
            image.Modified()

        return update


def smooth(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 as the shares (...) do, without corners."""
    share = np.clip(share, 0, 1)
    return share * share * (3 - 2 * share)


def _shrunk(image: np.ndarray, k: int) -> np.ndarray:
    """Means (h, w, 3) uint8 of squares of k by k pixels."""
    rows = sum((image[i::k] for i in range(1, k)), image[::k].astype(np.uint16))
    total = sum((rows[:, j::k] for j in range(1, k)), rows[:, ::k])
    return ((total + k * k // 2) // (k * k)).astype(np.uint8)
