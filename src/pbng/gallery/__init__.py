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
