"""What colour the points of a run have: that of their body, or of how far they are stretched."""

from typing import Any

import numpy as np

from pbng.errors import InputError
from pbng.view.stretch import Stretch
from pbng.view.surface import Motion, Surface

# Muted, and told apart by those who do not see red or green.
PALETTE = ("#7ba6d0", "#e3996b", "#62b09a", "#dcc574", "#c98aaa", "#978fc7", "#a8a299", "#86b6c4")
STRETCH_MAP = ("#4474ba", "#8cb1da", "#e9e6e1", "#e9a387", "#c8433a")  # evenly changing lightness on either side
SAMPLES = 16  # frames looked at to find the range of stretch


class Paint:
    """Colours (n, 3) uint8 of the points of a surface when the bodies are at x (n_vert, 3): ``paint(x)``.

    Args:
        surface: What is drawn.
        motion: The run; the range of stretch is taken from all of it, so that colours keep their meaning.
        color: "stretch", "body", or any colour that matplotlib knows.

    Attributes:
        bar: The least and greatest stretch shown, or None.

    Raises:
        InputError: The colour is unknown.
    """

    def __init__(self, surface: Surface, motion: Motion, color: str) -> None:
        from matplotlib.colors import is_color_like, to_rgb

        self.bar: tuple[float, float] | None = None
        if color == "stretch":
            self._stretch, self._source = Stretch(motion.bodies), surface.source
            self.bar = self._range(motion)
            self._table = _bytes(stretch_map()(np.linspace(0, 1, 256))[:, :3])
        elif color == "body" or is_color_like(color):
            names = PALETTE if color == "body" else (color,)
            palette = _bytes(np.array([to_rgb(name) for name in names]))
            self._fixed = palette[surface.owner % len(palette)]
        else:
            raise InputError(f"unknown color {color!r}: expected 'stretch', 'body' or the name of a colour")

    def __call__(self, x: np.ndarray) -> np.ndarray:
        if self.bar is None:
            return self._fixed
        low, high = self.bar
        level = (np.nan_to_num(self._stretch(x)[self._source], nan=high) - low) / (high - low)
        return self._table[np.rint(255 * np.clip(level, 0, 1)).astype(np.intp)]

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


def stretch_map() -> Any:
    """The colour map of stretch: matplotlib's kind, blue over white to red."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("stretch", STRETCH_MAP)


def _bytes(color: np.ndarray) -> np.ndarray:
    return np.rint(255 * color).astype(np.uint8)
