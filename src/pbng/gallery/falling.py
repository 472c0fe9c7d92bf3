"""Many bodies that fall: simple shapes into a glass box (Fig. 14), creatures onto a cloth that gives way (Fig. 16)."""

import os
from collections.abc import Iterator

import numpy as np

from pbng.checks import checked_number
from pbng.contact.colliders import container
from pbng.gallery.gravity import filled
from pbng.gallery.recipe import Recipe, checked_count
from pbng.gallery.solids import ball, brick, plank, ring, rod
from pbng.materials.bending import Bending
from pbng.materials.corotated import Corotated
from pbng.materials.membrane import Membrane
from pbng.mesh import TetMesh, TriMesh
from pbng.scene import Scene
from pbng.shapes import sheet
from pbng.solvers.base import Budget

GRAVITY = (0.0, -9.8, 0.0)  # m/s²
DENSITY, NU = 10.0, 0.3  # kg/m³, -
SEED = 7
MARGIN = 1.03  # between bodies at the start, in radii

SHAPES = brick, ball, ring, plank, rod
SHAPE_E = 3e3  # Pa
ABOVE = 0.2  # m from the floor to the lowest of the shapes

CREATURE_E = 1e3  # Pa
LENGTH = 1.0  # m, of a creature
CLOTH = 3.0  # m, edge of the cloth
CLOTH_E, CLOTH_DENSITY, CLOTH_BEND = 1e4, 10.0, 0.05  # N/m, kg/m², N m
DEPTH = 4.0  # m from the cloth to the floor


def dropping_shapes(resolution: int = 12, shapes: int = 40) -> Recipe:
    """Boxes, balls, rings, planks and rods, each turned at random, fall into a glass box.

    Args:
        resolution: Vertices along an edge of a box; the others have about as many in all. 19 make
            273 K in all, where the paper has 256 K.
        shapes: How many.

    Raises:
        InputError: The resolution is below 4, or there is no shape.
    """
    checked_count("dropping_shapes: resolution", resolution, 4)
    checked_count("dropping_shapes: shapes", shapes, 1)
    scene = Scene(gravity=GRAVITY, name="dropping_shapes")
    flesh = Corotated(E=SHAPE_E, nu=NU, density=DENSITY)
    meshes = [make(resolution) for make in SHAPES]
    radius = max(_radius(m) for m in meshes)
    across = 3 if shapes > 16 else 2
    places = _layers(shapes, across, 2 * MARGIN * radius, ABOVE + MARGIN * radius)
    rng = np.random.default_rng(SEED)
    for k, place in enumerate(places):
        kind = k % len(SHAPES)
        scene.add(_turned(meshes[kind], rng), flesh, name=f"{SHAPES[kind].__name__} {k // len(SHAPES)}", at=place)
    half = across * MARGIN * radius
    scene.collide_with(container((-half, 0.0, -half), (half, 2 * half, half), name="glass box"))
    scene.contact()
    return Recipe(scene, frames=76, inertia=True, substeps=17, budget=Budget(iterations=8))


def armadillos(
    surface: str | os.PathLike[str] | TriMesh | None = None,
    resolution: int = 24,
    bodies: int = 5,
    cloth: int = 64,
    free_at: float = 10 / 3,
) -> Recipe:
    """Bodies fall onto a cloth held at four corners; then two of the corners are let go, and all falls into a box.

    Args:
        surface: A file of a surface, which is filled with tets, or of tets; or a surface. By default a little dragon.
        resolution: Cells along the longest side of each body, tets of a file stay as they are; 44 give the dragon the
            17 K vertices of the paper's armadillos.
        bodies: How many; 20 in the paper.
        cloth: Vertices along an edge of the cloth.
        free_at: When the corners are let go [s].

    Raises:
        InputError: The file cannot be read, nothing can be made of it, or a count or time is none.
    """
    checked_count("armadillos: resolution", resolution, 4)
    checked_count("armadillos: bodies", bodies, 1)
    checked_count("armadillos: cloth", cloth, 2)
    free_at = checked_number("armadillos: free_at", free_at)
    scene = Scene(gravity=GRAVITY, name="armadillos")
    mesh = _of_length(filled("armadillos", surface, resolution), LENGTH)
    stuff = Membrane(E=CLOTH_E, nu=NU, density=CLOTH_DENSITY)
    blanket = scene.add(
        sheet((CLOTH, CLOTH), cloth, (-CLOTH / 2, 0.0, -CLOTH / 2)), stuff, Bending(CLOTH_BEND), name="cloth"
    )
    for side in (-1, 1):
        corners = blanket.where(np.isclose(blanket.mesh.X[:, 0], side * CLOTH / 2)
                                & np.isclose(np.abs(blanket.mesh.X[:, 2]), CLOTH / 2))  # fmt: skip
        scene.pin(corners, **({"until": free_at} if side > 0 else {}))
    flesh = Corotated(E=CREATURE_E, nu=NU, density=DENSITY)
    radius = _radius(mesh)
    rng = np.random.default_rng(SEED)
    for k, place in enumerate(_layers(bodies, 2, 2 * MARGIN * radius, 1.2 * radius)):
        scene.add(_turned(mesh, rng), flesh, name=f"body {k}", at=place)
    half = CLOTH / 2 + 0.4
    # Friction lets the bodies come to rest in the box.
    scene.collide_with(container((-half, -DEPTH, -half), (half, -1.5, half), friction=0.3, name="glass box"))
    scene.contact(self_collision=True)  # or limbs fold through their own bodies, and stay so
    frames = 1 + round(30 * (free_at + 3.0))
    return Recipe(scene, frames=frames, inertia=True, substeps=9, budget=Budget(iterations=40))


def _layers(n: int, across: int, spacing: float, lowest: float) -> Iterator[tuple[float, float, float]]:
    """Centres of n bodies [m]: layers of ``across`` by ``across``, one above the other."""
    middle = (across - 1) / 2
    for k in range(n):
        layer, i = divmod(k, across * across)
        yield spacing * (i % across - middle), lowest + spacing * layer, spacing * (i // across - middle)


def _turned(mesh: TetMesh, rng: np.random.Generator) -> TetMesh:
    """The mesh turned at random, all directions being equally likely."""
    w, x, y, z = _unit(rng.normal(size=4))
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return mesh.moved(mesh.X @ R.T)


def _of_length(mesh: TetMesh, length: float) -> TetMesh:
    """The mesh scaled so that its longest side has a length [m], about the middle of its bounding box."""
    low, high = mesh.X.min(0), mesh.X.max(0)
    return mesh.moved((mesh.X - (low + high) / 2) * (length / (high - low).max()))


def _radius(mesh: TetMesh) -> float:
    """Of the ball about the origin that holds the mesh [m]."""
    return float(np.linalg.norm(mesh.X, axis=1).max())


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
