"""Bodies that are held by one end and bend under their own weight: a bar (Fig. 18), and any shape from a file."""

import os
from pathlib import Path

import numpy as np

from pbng.errors import InputError
from pbng.gallery.motion import Eased
from pbng.gallery.recipe import Recipe, checked_count
from pbng.io.meshes import MESHES, read_mesh, read_surface
from pbng.materials.corotated import Corotated
from pbng.mesh import Mesh, TetMesh, TriMesh
from pbng.meshing import creature, tetrahedralize
from pbng.motions import Rotate
from pbng.scene import Scene
from pbng.shapes import beam
from pbng.solvers.base import Budget

GRAVITY = 9.8  # m/s²
DENSITY = 1000.0  # kg/m³ of bodies from files
HELD = 0.12  # the part of the length that the clamp holds
SAG = 0.35  # of the length: how far bodies are to bend, see `softness`
SECTIONS = 40  # slices of a body, each taken for a piece of a beam


def hanging_bar(resolution: int = 9) -> Recipe:
    """A bar of 1 m, clamped at one end, bends under gravity; in two seconds the clamp turns over to the other side.

    Args:
        resolution: Vertices across the bar.
    """
    scene = Scene(gravity=(0.0, -GRAVITY, 0.0), name="hanging_bar")
    bar = scene.add(beam(1.0, 0.25, resolution), Corotated(E=1e3, nu=0.3, density=10.0), name="bar")
    scene.move(bar.where(x=0.0), Eased(Rotate("z", -0.5)), over=2.0)
    return _recipe(scene, 10.0 * 0.25**2)


def bent_surface(surface: str | os.PathLike[str] | TriMesh | None = None, resolution: int = 32) -> Recipe:
    """A body is held by one end of its longest side and bends under gravity, while the clamp rocks it to and fro.

    It is laid along x and held by the end that gives the firmer hold; its stiffness is chosen so that it bends well
    whatever its size and shape.

    Args:
        surface: A file of a surface, which is filled with tets, or of tets; or a surface. By default a little dragon.
        resolution: Cells along the longest side; tets of a file stay as they are.

    Raises:
        InputError: The file cannot be read, or nothing can be made of it.
    """
    checked_count("bent_surface: resolution", resolution, 2)
    mesh = laid_along_x(filled("bent_surface", surface, resolution))
    E, end = min((softness(mesh, end), end) for end in (1, -1))
    along = end * mesh.X[:, 0]
    scene = Scene(gravity=(0.0, -GRAVITY, 0.0), name="bent_surface")
    body = scene.add(mesh, Corotated(E=E, nu=0.3, density=DENSITY), name="body")
    clamp = body.where(along >= along.max() - HELD * np.ptp(along))
    for start, over, turns in ((0.0, 0.5, -0.12), (0.5, 1.0, 0.24), (1.5, 0.5, -0.12)):
        scene.move(clamp, Eased(Rotate("x", turns)), over=over, start=start)
    return _recipe(scene, DENSITY * mesh.volume.sum())


def laid_along_x(mesh: TetMesh) -> TetMesh:
    """The mesh turned by a right angle, if need be, so that its longest side lies along x."""
    turn = {
        0: np.eye(3),
        1: np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
        2: np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    }[int(np.ptp(mesh.X, axis=0).argmax())]
    return mesh.moved(mesh.X @ turn.T)


def softness(mesh: TetMesh, end: int) -> float:
    """Young's modulus [Pa] with which a body would sag by ``SAG`` of its length, by beam theory.

    With x the distance from the held end, w = ∫ M(x) (L - x) / (E I(x)) dx, where M is the moment of the weight beyond
    x and I = A² / 4π that of a round section of the same area A. The true sag is less: a body that has turned downward
    bends no further.

    Args:
        mesh: The body, its length along x.
        end: Which end is held: 1 the one of greatest x, -1 the other.
    """
    place = -end * mesh.X[:, 0]
    place = place - place.min()
    length = place.max()
    edges = np.linspace(HELD * length, length, SECTIONS + 1)
    x, step = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    volume = np.histogram(place[mesh.cells].mean(1), edges, weights=mesh.volume)[0]
    weight = DENSITY * GRAVITY * volume
    moment = np.array([np.sum(weight[k:] * (x[k:] - x[k])) for k in range(SECTIONS)])
    area = np.maximum(volume, 0.02 * volume.max()) / step  # where cells are coarse, a slice may hold no cell's middle
    return float(np.sum(moment * (length - x) * 4 * np.pi / area**2) * step / (SAG * length))


def filled(scene: str, surface: str | os.PathLike[str] | TriMesh | None, resolution: int) -> TetMesh:
    """The tets of a file, or of a surface, by default a little dragon's, ``resolution`` cells along its longest side.

    Raises:
        InputError: The file cannot be read, or nothing can be made of it.
    """
    found: Mesh
    if surface is None:
        found = creature()
    elif isinstance(surface, Mesh):
        found = surface
    else:
        if not isinstance(surface, str | os.PathLike):
            raise InputError(f"{scene}: surface must be a file or a surface, not {surface!r}")
        found = read_mesh(surface) if Path(surface).suffix.lower() in MESHES else read_surface(surface)
    if isinstance(found, TetMesh):
        return found
    if not isinstance(found, TriMesh):
        raise InputError(f"{scene}: surface must be a file or a surface, not a {type(surface).__name__}")
    return tetrahedralize(found, cell=float(np.ptp(found.X, axis=0).max()) / resolution)


def _recipe(scene: Scene, mass: float) -> Recipe:
    # A frame is done when what is out of balance is a thousandth of the weight; where a body snaps from one side to
    # another, the cap ends it.
    return Recipe(scene, budget=Budget(atol=1e-3 * GRAVITY * float(mass), iterations=1000))
