"""Scenes by name: those of the paper's figures, and a body of one's own that is bent.

``pbng.gallery.twisting_block(resolution=16)`` returns a :class:`Recipe`; ``SCENES`` lists what there is. The scenes are
loaded on first use, so that a list of them appears at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from pbng.errors import InputError

if TYPE_CHECKING:
    from pbng.gallery.recipe import Recipe


@dataclass(frozen=True)
class Entry:
    """A scene of the gallery, not yet loaded.

    Attributes:
        name: What it is called by.
        module: Where its function lives.
        figure: The figure of the paper that it follows, if any.
        summary: One line about it.
        resolution: What the resolution counts, and its default.
        takes_surface: Whether it can be given a file.
    """

    name: str
    module: str
    figure: str
    summary: str
    resolution: str
    takes_surface: bool = False

    def __call__(self, **options: Any) -> "Recipe":
        """The recipe; options are those of the function of the scene."""
        recipe: Recipe = getattr(import_module(self.module), self.name)(**options)
        return recipe


_ENTRIES = (
    Entry(
        "twisting_block",
        "pbng.gallery.twisting",
        "Fig. 7",
        "A block, clamped at both ends, is squeezed, stretched and twisted.",
        "vertices along an edge, 32",
    ),
    Entry(
        "resolutions",
        "pbng.gallery.twisting",
        "Fig. 8",
        "The same block at three resolutions, each twice the one above.",
        "vertices along an edge of the finest, 32",
    ),
    Entry(
        "constitutive_models",
        "pbng.gallery.twisting",
        "Fig. 9",
        "The same block of three materials: corotated, stable Neo-Hookean, Neo-Hookean.",
        "vertices along an edge, 32",
    ),
    Entry(
        "hanging_bar",
        "pbng.gallery.gravity",
        "Fig. 18",
        "A bar, clamped at one end, bends under its weight; the clamp turns over to the other side.",
        "vertices across the bar, 9",
    ),
    Entry(
        "two_blocks_hanging",
        "pbng.gallery.hanging",
        "Fig. 17",
        "A block hangs below another, bound by stiff springs that close a gap.",
        "vertices along an edge of each block, 16",
    ),
    Entry(
        "swinging_block",
        "pbng.gallery.hanging",
        "Fig. 3",
        "A block at a wall falls under gravity and swings (with inertia).",
        "vertices along an edge, 16",
    ),
    Entry(
        "bent_surface",
        "pbng.gallery.gravity",
        "",
        "A body from a file, or a little dragon, is held by one end, bends under its weight and is rocked.",
        "cells along the longest side, 32",
        takes_surface=True,
    ),
    Entry(
        "two_blocks_colliding",
        "pbng.gallery.contact",
        "Fig. 13",
        "Two blocks are driven against each other, and drawn apart again (with inertia).",
        "vertices along an edge of each block, 16",
    ),
    Entry(
        "dropping_shapes",
        "pbng.gallery.falling",
        "Fig. 14",
        "Boxes, balls, rings, planks and rods, 40 in all, fall into a glass box (with inertia).",
        "vertices along an edge of a box, 12",
    ),
    Entry(
        "armadillos",
        "pbng.gallery.falling",
        "Fig. 16",
        "Bodies from a file, or little dragons, fall onto a cloth that gives way, and into a box (with inertia).",
        "cells along the longest side of each, 24",
        takes_surface=True,
    ),
    Entry(
        "squeezed_ball",
        "pbng.gallery.contact",
        "",
        "A ball is squeezed between two plates, and let go.",
        "vertices along a diameter, 20",
    ),
    Entry(
        "cloth_on_sphere",
        "pbng.gallery.cloth",
        "",
        "A square cloth falls on a ball and hangs down in folds (with inertia).",
        "vertices along an edge, 48",
    ),
    Entry(
        "hanging_cloth",
        "pbng.gallery.cloth",
        "Fig. 19",
        "A rectangle of cloth, held by two corners, falls and swings (with inertia).",
        "vertices along the short side, 32",
    ),
    Entry(
        "twisted_cloth",
        "pbng.gallery.cloth",
        "",
        "A strip of cloth is twisted by three turns, wrinkles and coils (with inertia).",
        "vertices across the strip, 24",
    ),
)

SCENES: Mapping[str, Entry] = MappingProxyType({entry.name: entry for entry in _ENTRIES})

__all__ = ["SCENES", "Entry", "Recipe", "find", *SCENES]


def find(name: str) -> Entry:
    """The scene of that name.

    Raises:
        InputError: There is none; it names those that come near.
    """
    if name in SCENES:
        return SCENES[name]
    near = get_close_matches(name.lower().replace("-", "_"), SCENES, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(SCENES)}"
    raise InputError(f"no scene {name!r} in the gallery; {hint}")


def __getattr__(name: str) -> Any:
    if name == "Recipe":
        from pbng.gallery.recipe import Recipe

        return Recipe
    if name in SCENES:
        return getattr(import_module(SCENES[name].module), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
