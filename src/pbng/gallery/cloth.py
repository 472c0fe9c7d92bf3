"""Cloth: on a ball, hung up by two corners (section 11.5), and a strip that is twisted until it coils."""

import numpy as np

from pbng.checks import checked_number
from pbng.contact.colliders import Sphere
from pbng.gallery.motion import Eased
from pbng.gallery.recipe import Recipe, checked_count
from pbng.materials.bending import Bending
from pbng.materials.membrane import Membrane
from pbng.motions import Rotate, Translate
from pbng.scene import Scene
from pbng.shapes import sheet
from pbng.solvers.base import Budget

GRAVITY = (0.0, -9.8, 0.0)  # m/s²

RADIUS = 0.25  # m, of the ball
EDGE = 1.0  # m, of the cloth that falls on it

STRIP = 1.6, 0.32  # m
TURNS, TWIST = 3.0, 3.0  # turns of the two ends against each other, and seconds for them
NEARER = 0.12  # of its length: by how much the ends of the strip come together meanwhile


def cloth_on_sphere(resolution: int = 48) -> Recipe:
    """A square cloth falls on a ball and hangs down in folds.

    Args:
        resolution: Vertices along an edge of the cloth.
    """
    checked_count("cloth_on_sphere: resolution", resolution, 2)
    scene = Scene(gravity=GRAVITY, name="cloth_on_sphere")
    mesh = sheet((EDGE, EDGE), resolution, (-EDGE / 2, 0.02, -EDGE / 2))
    thickness = _thickness(EDGE, resolution)
    scene.add(mesh, Membrane(E=500.0, nu=0.3, density=0.2), Bending(1e-4, weighted=True), name="cloth")
    scene.collide_with(Sphere((0.0, -RADIUS, 0.0), RADIUS, thickness=thickness, friction=0.3, name="ball"))
    scene.contact(self_collision=True, thickness=thickness)
    return Recipe(scene, frames=121, inertia=True, substeps=8, budget=Budget(iterations=20))


def hanging_cloth(resolution: int = 32, k_bend: float = 0.0) -> Recipe:
    """A rectangle of 1 m by 2 m, level at first, is held by the corners of a long side, falls and swings.

    Args:
        resolution: Vertices along the short side; 64 are the paper's 8 K.
        k_bend: Stiffness against bending [N m]; the paper's is 0.
    """
    checked_count("hanging_cloth: resolution", resolution, 2)
    k_bend = checked_number("hanging_cloth: k_bend", k_bend, positive=False)
    scene = Scene(gravity=GRAVITY, name="hanging_cloth")
    mesh = sheet((2.0, 1.0), (2 * resolution, resolution), (-1.0, 0.0, 0.0))
    cloth = scene.add(mesh, Membrane(E=1e3, nu=0.3, density=10.0), Bending(k_bend), name="cloth")
    scene.pin(cloth.where((mesh.X[:, 2] == 0) & (np.abs(mesh.X[:, 0]) == 1)))
    return Recipe(scene, frames=61, inertia=True, substeps=7, budget=Budget(iterations=44))


def twisted_cloth(resolution: int = 24) -> Recipe:
    """A strip whose two ends are turned against each other, three turns in all, wrinkles and coils.

    Args:
        resolution: Vertices across the strip.
    """
    checked_count("twisted_cloth: resolution", resolution, 2)
    scene = Scene(name="twisted_cloth")
    length, width = STRIP
    along = round(length / width * (resolution - 1)) + 1
    mesh = sheet(STRIP, (along, resolution), (-length / 2, 0.0, -width / 2))
    strip = scene.add(mesh, Membrane(E=500.0, nu=0.3, density=0.2), Bending(1e-4, weighted=True), name="strip")
    for side in (-1, 1):
        end = strip.where(np.isclose(mesh.X[:, 0], side * length / 2))
        motion = Rotate("x", side * TURNS / 2) + Translate((-side * NEARER * length / 2, 0, 0))
        scene.move(end, Eased(motion), over=TWIST)
    scene.contact(self_collision=True, thickness=_thickness(width, resolution))
    return Recipe(scene, frames=round(30 * TWIST) + 16, inertia=True, substeps=4, budget=Budget(iterations=40))


def _thickness(edge: float, vertices: int) -> float:
    """Distance [m] that is kept from cloth: a quarter of the distance of its vertices, but 1 cm at most."""
    return min(0.25 * edge / (vertices - 1), 0.01)
