"""A window of VTK's that nobody sees: both sides of a surface, in colours of one's own, and the image and its depth."""

import ctypes.util
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numba import prange

from pbng.errors import InputError
from pbng.jit import kernel
from pbng.view.camera import VIEW_ANGLE, Camera

INK = (38, 44, 56)  # colour of shadows and edges


class Window:
    """Draws triangles (m, 3) of n points as seen by a camera, without any light: what is given is what is seen.

    Args:
        size: Width and height [pixels].
        line: Width [pixels] of the edges of the triangles, 0 for none.

    Raises:
        InputError: pyvista is not installed, or the machine has nothing to draw with.
    """

    def __init__(self, n: int, triangles: np.ndarray, camera: Camera, size: tuple[int, int], line: float = 0.0) -> None:
        self.pv = _pyvista()
        self.size = size
        with _quietly():
            self.plotter = self.pv.Plotter(off_screen=True, window_size=list(size), lighting="none", border=False)
            self.plotter.disable_anti_aliasing()  # where there is multisampling there is no depth to read
            self.plotter.ren_win.SetMultiSamples(0)
            self.plotter.set_background("white")
        view = self.plotter.camera
        view.position, view.focal_point, view.up = camera.position, camera.focus, camera.up
        view.view_angle = VIEW_ANGLE
        if camera.parallel is not None:
            view.parallel_projection = True
            view.parallel_scale = camera.parallel
        # Each side has its own colours, so the surface is there twice: as seen from either side.
        self.sides = [self._side(n, triangles, culling, line) for culling in ("back", "front")]

    def _side(self, n: int, triangles: np.ndarray, culling: str, line: float) -> Any:
        mesh = self.pv.PolyData.from_regular_faces(np.zeros((n, 3), np.float32), triangles)
        mesh.point_data["color"] = np.zeros((n, 3), np.uint8)
        self.plotter.add_mesh(
            mesh,
            scalars="color",
            rgb=True,
            lighting=False,
            culling=culling,
            show_edges=line > 0,
            edge_color=[c / 255 for c in INK],
            edge_opacity=0.45,
            line_width=max(line, 1.0),
            render=False,
            reset_camera=False,
        )
        return mesh

    def add_panes(self, n: int) -> None:
        """Have n panes drawn too, that let things behind them show through and have no depth."""
        mesh = self.pv.PolyData.from_regular_faces(np.zeros((4 * n, 3), np.float32), np.arange(4 * n).reshape(n, 4))
        mesh.point_data["color"] = np.full((4 * n, 4), 128, np.uint8)
        self.plotter.add_mesh(
            mesh, scalars="color", rgb=True, lighting=False, render=False, reset_camera=False
        ).force_translucent = True  # fmt: skip
        self.panes = mesh

    def set_panes(self, panes: np.ndarray, tints: np.ndarray) -> None:
        """Where the panes are, (n, 4, 3) [m], and their colours and opacities (n, 4) uint8."""
        self.panes.points = panes.reshape(-1, 3)
        self.panes.point_data["color"] = np.repeat(tints, 4, axis=0)
        self.panes.set_active_scalars("color")

    def draw(self, points: np.ndarray, outside: np.ndarray, inside: np.ndarray) -> None:
        """Draw points (n, 3) [m] with the colours (n, 3) uint8 of either side."""
        for mesh, color in zip(self.sides, (outside, inside)):
            mesh.points = points
            mesh.point_data["color"] = color
            mesh.set_active_scalars("color")
        self.plotter.reset_camera_clipping_range()
        self.plotter.ren_win.Render()

    def image(self) -> np.ndarray:
        """What was drawn, (height, width, 3) uint8."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkUnsignedCharArray

        width, height = self.size
        data = vtkUnsignedCharArray()
        self.plotter.ren_win.GetPixelData(0, 0, width - 1, height - 1, 1, data, 0)
        return vtk_to_numpy(data).reshape(height, width, 3)[::-1]

    def depth(self) -> np.ndarray:
        """Distance (height, width) float32 [m] along the camera's axis in each pixel, infinite where nothing is."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonCore import vtkFloatArray

        width, height = self.size
        data = vtkFloatArray()
        self.plotter.ren_win.GetZbufferData(0, 0, width - 1, height - 1, data)
        depth = vtk_to_numpy(data).reshape(height, width)[::-1]
        _to_metres(depth, *self.plotter.camera.clipping_range, bool(self.plotter.camera.parallel_projection))
        return depth

    def close(self) -> None:
        self.plotter.close()


def _pyvista() -> Any:
    try:
        import pyvista
    except ImportError as error:
        raise InputError(f"pictures need pyvista: pip install 'pbng[view]' ({error})") from error
    return pyvista


@kernel
def _to_metres(depth, near, far, parallel):
    """Make distances [m] of the renderer's depths (h, w), from 0 at ``near`` [m] to 1 at ``far``, in place."""
    for i in prange(depth.shape[0]):
        for j in range(depth.shape[1]):
            z = depth[i, j]
            metres = near + z * (far - near) if parallel else near * far / (far - z * (far - near))
            depth[i, j] = metres if z < 1 else np.inf


@contextmanager
def _quietly() -> Iterator[None]:
    """Lets VTK draw without a display and without complaining that there is none."""
    choice = "VTK_DEFAULT_OPENGL_WINDOW"
    headless = sys.platform.startswith("linux") and not os.environ.get("DISPLAY")
    if not headless or choice in os.environ:
        yield
        return
    if ctypes.util.find_library("EGL"):
        os.environ[choice] = "vtkEGLRenderWindow"
    elif not ctypes.util.find_library("OSMesa"):
        raise InputError("nothing to draw with: install libegl1 and libgl1-mesa-dri (Debian's names), or set DISPLAY")
    try:
        yield
    finally:
        os.environ.pop(choice, None)
