"""What colour the points of a run have: that of their body, or of how far they are stretched."""

from typing import Any

import numpy as np

from pbng.errors import InputError
from pbng.view.stretch import Stretch
from pbng.view.surface import Motion, Surface

# Muted, and told apart by those who do not see red or green.
PALETTE = ("#7ba6d0", "#e3996b", "#62b09a", "#dcc574", "#c98aaa", "#978fc7", "#a8a299", "#86b6c4")
COLLIDER = "#d5d9de"
TOUCHED = "#d8342c"  # where there is contact
PALE = 0.55  # how much white bodies have on which that is to be seen
STRETCH_MAP = ("#4474ba", "#8cb1da", "#e9e6e1", "#e9a387", "#c8433a")  # evenly changing lightness on either side
SAMPLES = 16  # frames looked at to find the range of stretch


class Paint:
    """Colours (n, 3) uint8 of the points of a surface when the parts are at x (n_vert, 3): ``paint(x)``.

    Colliders are grey. Vertices in contact are ``paint(x, touching)``.

    Args:
        surface: What is drawn.
        motion: The run; the range of stretch is taken from all of it, so that colours keep their meaning.
        color: "stretch", "body", "contact" (pale bodies, red where something touches), or any colour that matplotlib
            knows.

    Attributes:
        bar: The least and greatest stretch shown, or None.
        contact: Whether vertices in contact are shown.

    Raises:
        InputError: The colour is unknown, or contact is to be shown of a run without.
    """

    def __init__(self, surface: Surface, motion: Motion, color: str) -> None:
        from matplotlib.colors import is_color_like, to_rgb

        self.bar: tuple[float, float] | None = None
        self.contact = color == "contact"
        self.surface, self.own = surface, surface.owner < surface.n_bodies
        if self.contact and touching(motion.frames[0]) is None:
            raise InputError("color 'contact': nothing in this run may touch anything; see Scene.contact, collide_with")
        if not (color in ("stretch", "body", "contact") or is_color_like(color)):
            expected = "'stretch', 'body', 'contact' or the name of a colour"
            raise InputError(f"unknown color {color!r}: expected {expected}")
        names = PALETTE if color in ("stretch", "body", "contact") else (color,)
        palette = np.array([to_rgb(name) for name in names])
        if self.contact:
            palette = palette + PALE * (1 - palette)
        self._fixed = np.where(self.own[:, None], palette[surface.owner % len(palette)], to_rgb(COLLIDER))
        if color == "stretch":
            self._stretch, self._source = Stretch(motion.bodies), surface.source[self.own]
            self.bar = self._range(motion)
            self._table = stretch_map()(np.linspace(0, 1, 256))[:, :3]
        self._touched = np.array(to_rgb(TOUCHED))

    def __call__(self, x: np.ndarray, touching: np.ndarray | None = None) -> np.ndarray:
        color = self._fixed
        if self.bar is not None:
            low, high = self.bar
            level = (np.nan_to_num(self._stretch(x)[self._source], nan=high) - low) / (high - low)
            color = color.copy()
            color[self.own] = self._table[np.rint(255 * np.clip(level, 0, 1)).astype(np.intp)]
        if self.contact and touching is not None:
            mark = np.zeros((len(x), 3))
            mark[touching] = 1
            mark = self.surface.carried(mark)
            color = color + mark * (self._touched - color)
        return _bytes(color)

    def _range(self, motion: Motion) -> tuple[float, float]:
        """Least and greatest stretch over the run, but for outliers, rounded outward to a round number."""
        chosen = np.unique(np.linspace(0, len(motion) - 1, SAMPLES).round().astype(int))
        low, high = 1.0, 1.0
        for k in chosen:
            values = self._stretch(motion.frames[k].x)[self._source]
            values = values[np.isfinite(values)]
            if len(values):
                least, greatest = np.percentile(values, [0.5, 99.5])
                low, high = min(low, least), max(high, greatest)
        high = max(high, low + 0.02)  # of a body that does not stretch, show no noise
        step = 10 ** np.floor(np.log10(high - low)) / 4
        return float(np.floor(low / step + 1e-2) * step), float(np.ceil(high / step - 1e-2) * step)


def touching(frame: Any) -> np.ndarray | None:
    """Vertices in contact (n,) of a frame; None if it does not know."""
    contact = getattr(frame, "contact", None)
    return None if contact is None else contact.vertices


def stretch_map() -> Any:
    """The colour map of stretch: matplotlib's kind, blue over white to red."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("stretch", STRETCH_MAP)


def _bytes(color: np.ndarray) -> np.ndarray:
    return np.rint(255 * color).astype(np.uint8)
