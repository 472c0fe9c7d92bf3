"""Blocks that are squeezed, stretched and twisted (section 11.1): one, several resolutions, several materials."""

from pbng.gallery.motion import Eased
from pbng.gallery.recipe import Recipe, checked_count
from pbng.materials.base import Material
from pbng.materials.corotated import Corotated
from pbng.materials.neo_hookean import NeoHookean
from pbng.materials.stable_neo_hookean import StableNeoHookean
from pbng.motions import Rotate, Translate
from pbng.scene import Body, Scene
from pbng.shapes import box
from pbng.solvers.base import Budget

E, NU, DENSITY = 1e5, 0.3, 10.0  # Pa, -, kg/m³
SQUEEZE, STRETCH = 0.5, 1.5  # seconds of the two parts of the motion
SPACING = 1.6  # m from block to block: the twisted ends are 1.41 m from corner to corner
# The paper's big budget (its low one is 6 iterations a frame), less where the residual is small or was from the start.
BUDGET = Budget(iterations=40, rtol=1e-3, atol=1.0)


def twisting_block(resolution: int = 32) -> Recipe:
    """A cube of 1 m, clamped at both ends, is squeezed to 0.7 m, then stretched to 2 m and twisted by half a turn.

    Args:
        resolution: Vertices along an edge; 32 is the paper's, 64 and 128 its finer ones.
    """
    scene = Scene(name="twisting_block")
    _twist(scene, _block(scene, resolution, Corotated(E=E, nu=NU, density=DENSITY), "block"))
    return Recipe(scene, budget=BUDGET)


def resolutions(resolution: int = 32) -> Recipe:
    """The twisting block at three resolutions, one above the other, the finest at the bottom.

    Args:
        resolution: Vertices along an edge of the finest, 128 in the paper; the others have a half and a quarter of it.
    """
    checked_count("resolutions: resolution", resolution, 2)
    scene = Scene(name="resolutions")
    rubber = Corotated(E=E, nu=NU, density=DENSITY)
    for level, n in enumerate((resolution // 4, resolution // 2, resolution)):
        _twist(scene, _block(scene, max(2, n), rubber, f"level {level}", 2 - level))
    return Recipe(scene, budget=BUDGET)


def constitutive_models(resolution: int = 32) -> Recipe:
    """Three twisting blocks, from top to bottom corotated, stable Neo-Hookean and Neo-Hookean.

    Args:
        resolution: Vertices along an edge of each.
    """
    scene = Scene(name="constitutive_models")
    for level, model in enumerate((Corotated, StableNeoHookean, NeoHookean)):
        material = model(E=E, nu=NU, density=DENSITY)
        _twist(scene, _block(scene, resolution, material, model.__name__, 2 - level))
    return Recipe(scene, budget=BUDGET)


def _block(scene: Scene, n: int, material: Material, name: str, story: int = 0) -> Body:
    return scene.add(box((1.0, 1.0, 1.0), n, (-0.5, -0.5, -0.5)), material, name=name, at=(0.0, SPACING * story, 0.0))


def _twist(scene: Scene, block: Body) -> None:
    """Squeeze the block, then stretch it, its ends turned against each other; turned further, it would buckle."""
    for side in (-1, 1):
        end = block.where(x=0.5 * side)
        scene.move(end, Eased(Rotate("x", -side / 16) + Translate((-0.15 * side, 0, 0))), over=SQUEEZE)
        scene.move(end, Eased(Rotate("x", side * 5 / 16) + Translate((0.65 * side, 0, 0))), over=STRETCH, start=SQUEEZE)
