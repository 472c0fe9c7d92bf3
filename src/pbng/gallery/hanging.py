"""Blocks that hang: one below another on stiff springs (section 11.3), and one at a wall that swings (section 11.7)."""

from pbng.gallery.recipe import Recipe
from pbng.materials.corotated import Corotated
from pbng.scene import Scene
from pbng.shapes import box
from pbng.solvers.base import Budget

E, NU, DENSITY = 1e3, 0.3, 10.0  # Pa, -, kg/m³
GRAVITY = (0.0, -9.8, 0.0)  # m/s²
GAP = 0.2  # m, which the springs close


def two_blocks_hanging(resolution: int = 16, k: float = 1e8) -> Recipe:
    """Two cubes of 1 m; the upper one's top is held, and springs draw the lower one up to it, against its weight.

    Args:
        resolution: Vertices along an edge of each.
        k: Stiffness of each spring [N/m], one a vertex of the face; the paper's is 1e8.
    """
    scene = Scene(gravity=GRAVITY, name="two_blocks_hanging")
    flesh = Corotated(E=E, nu=NU, density=DENSITY)
    upper = scene.add(box((1.0, 1.0, 1.0), resolution), flesh, name="upper", at=(0.0, 1.0 + GAP, 0.0))
    lower = scene.add(box((1.0, 1.0, 1.0), resolution), flesh, name="lower")
    scene.pin(upper.where(y=2.0 + GAP))
    scene.bind(lower.where(y=1.0), upper.where(y=1.0 + GAP), k=k)
    return Recipe(scene, frames=1, budget=Budget(rtol=1e-9, iterations=200))


def swinging_block(resolution: int = 16) -> Recipe:
    """A cube of 1 m, one side of which is held, falls under gravity and swings.

    Args:
        resolution: Vertices along an edge; 16 are the paper's 4.1 K.
    """
    scene = Scene(gravity=GRAVITY, name="swinging_block")
    block = scene.add(box((1.0, 1.0, 1.0), resolution), Corotated(E=E, nu=NU, density=DENSITY), name="block")
    scene.pin(block.where(x=0.0))
    return Recipe(scene, frames=61, inertia=True, substeps=2)
