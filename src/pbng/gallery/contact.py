"""Solids that touch: two blocks driven together (Fig. 13), and a ball squeezed between two plates."""

from math import pi
from typing import Any

from pbng.contact.colliders import Plane
from pbng.gallery.motion import Eased, ThereAndBack
from pbng.gallery.recipe import Recipe
from pbng.materials.corotated import Corotated
from pbng.motions import Translate
from pbng.scene import Scene
from pbng.shapes import box, sphere
from pbng.solvers.base import Budget

E, NU, DENSITY = 1e3, 0.3, 10.0  # Pa, -, kg/m³
STEPS, SWEEPS = 17, 8  # steps of 1/510 s a frame, and iterations a step: the paper's 136 a frame
GAP = 0.2  # m between the blocks at first
ASIDE = 0.3, 0.1  # m by which they do not face each other, along y and z
DRIVE = 0.35  # m that each block's held face goes
IN, HELD, OUT = 1.0, 0.5, 1.0  # seconds in which they come together, stay, and part

GRAVITY = 9.8  # m/s²
RADIUS, BALL_DENSITY = 0.1, 1000.0  # m, kg/m³
SQUEEZE = 0.45  # of its diameter: how far the upper plate comes down


def two_blocks_colliding(resolution: int = 16, k_n: float | None = None) -> Recipe:
    """Two cubes of 1 m whose far faces are held are driven against each other, and drawn apart again.

    Args:
        resolution: Vertices along an edge of each; 16 are the paper's.
        k_n: Stiffness of contacts [N/m], the paper's is 1e8; by default that of :meth:`pbng.Scene.contact`.
    """
    scene = Scene(name="two_blocks_colliding")
    flesh = Corotated(E=E, nu=NU, density=DENSITY)
    for name, side in (("left", -1), ("right", 1)):
        low = (-1.0 - GAP / 2 if side < 0 else GAP / 2, side * ASIDE[0] / 2 - 0.5, side * ASIDE[1] / 2 - 0.5)
        block = scene.add(box((1.0, 1.0, 1.0), resolution, low), flesh, name=name)
        far = block.where(x=side * (1.0 + GAP / 2))
        scene.move(far, Eased(Translate((-side * DRIVE, 0, 0))), over=IN)
        scene.move(far, Eased(Translate((side * DRIVE, 0, 0))), over=OUT, start=IN + HELD)
    scene.contact(k_n=k_n)
    return Recipe(scene, inertia=True, substeps=STEPS, budget=Budget(iterations=SWEEPS), frames=91)


def squeezed_ball(resolution: int = 20) -> Recipe:
    """A ball lies on a plate under its weight; another plate comes down on it, and goes up again.

    Args:
        resolution: Vertices along a diameter.
    """
    scene = Scene(gravity=(0.0, -GRAVITY, 0.0), name="squeezed_ball")
    rubber = Corotated(E=1e5, nu=0.4, density=BALL_DENSITY)
    scene.add(sphere(RADIUS, resolution, (0.0, RADIUS, 0.0)), rubber, name="ball")
    plate: dict[str, Any] = {"size": 4 * RADIUS, "friction": 0.3}
    scene.collide_with(Plane((0, 0, 0), (0, 1, 0), name="lower plate", **plate))
    motion = ThereAndBack(Translate((0, -2 * RADIUS * SQUEEZE, 0)))
    scene.collide_with(Plane((0, 2 * RADIUS, 0), (0, -1, 0), name="upper plate", motion=motion, over=2.0, **plate))
    weight = GRAVITY * BALL_DENSITY * 4 / 3 * pi * RADIUS**3  # N
    # A frame is done when what is out of balance is a hundredth of the weight.
    return Recipe(scene, frames=61, budget=Budget(atol=0.01 * weight, iterations=200))
