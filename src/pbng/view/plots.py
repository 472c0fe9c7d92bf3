"""Curves in the style of a paper, and the lettering of pictures; by matplotlib, with no state shared."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbng.errors import InputError

# Told apart by those who do not see red or green, and in grey by their order of lightness.
CURVES = ("#1f5a94", "#d9662b", "#2a9d7f", "#8a5fb0", "#b8902a", "#c0527f", "#5b6770", "#4aa3c7")
INK = "#262c38"
FAINT = "#dfe2e7"


def plot_residuals(
    series: Mapping[str, tuple[Any, ...]],
    path: str | os.PathLike[str],
    xlabel: str = "iteration",
    ylabel: str | Sequence[str] = "residual [N]",
    title: str = "",
    *,
    log_x: bool = False,
    top: float | None = None,
    size: tuple[float, float] = (5.2, 3.4),
) -> Path:
    """Plot curves on a logarithmic y axis, each labelled at its end; returns the path.

    Args:
        series: Label -> (x, y), of equal length. What is not finite, or not positive on a logarithmic axis, is left
            out, and the curve is broken there. For panels side by side (x, y, y', ...); the labels are in the last.
        path: The .png, .pdf or .svg.
        xlabel, ylabel, title: Words for the axes and above them; of ``ylabel`` as many as there are panels.
        log_x: Whether the x axis is logarithmic too.
        top: Where the y axes end at most; curves that rise further leave the panel.
        size: Width and height [inches]; a .png has 200 pixels an inch.

    Raises:
        InputError: There are no curves, one has x and y of different length, or the file cannot be written.
    """
    if not series:
        raise InputError("no curves to plot")
    words = (ylabel,) if isinstance(ylabel, str) else tuple(ylabel)
    curves = {label: _curve(label, values, len(words), log_x) for label, values in series.items()}
    figure, panels = _paper(size, len(words))
    for p, axes in enumerate(panels):
        axes.set_yscale("log")
        if log_x:
            axes.set_xscale("log")
        ends = []
        for k, (label, (x, *ys)) in enumerate(curves.items()):
            y, color = ys[p], CURVES[k % len(CURVES)]
            style = "-" if k < len(CURVES) else "--"
            dots = "o" if np.isfinite(y).sum() < 2 else None
            clip = top is not None
            axes.plot(x, y, style, color=color, lw=1.6, marker=dots, ms=3.5, solid_capstyle="round", clip_on=clip)
            last = np.flatnonzero(np.isfinite(y))
            if len(last):
                ends.append((label, x[last[-1]], min(y[last[-1]], top or np.inf), color))
        if top is not None and axes.get_ylim()[1] > top:
            low = min((np.nanmin(c[p + 1]) for c in curves.values() if np.isfinite(c[p + 1]).any()), default=top)
            axes.set_ylim(low * min(low / top, 0.5) ** 0.05, top)
        axes.set_xlabel(xlabel)
        axes.set_ylabel(words[p])
        axes.margins(x=0.0)
        if title and p == 0:
            axes.set_title(title, loc="left", fontsize=10, fontweight="bold", pad=10)
    _label_ends(figure, panels[-1], ends)
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=200, facecolor="white", bbox_inches="tight", pad_inches=0.08)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot write {path}: {getattr(error, 'strerror', None) or error}") from error
    return path


def color_bar(size: tuple[int, int], low: float, high: float, cmap: Any, label: str, unit: float) -> np.ndarray:
    """A transparent page (height, width, 4) uint8 with a slim vertical colour bar at its right edge.

    ``unit`` is the size [pixels] of what is one pixel in a picture 720 high.
    """
    width, height = size
    figure = _page(size)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    tall = min(0.5 * height, 300 * unit)
    box = ((width - 88 * unit) / width, (height - tall) / 2 / height, 11 * unit / width, tall / height)
    bar = figure.colorbar(ScalarMappable(Normalize(low, high), cmap), cax=figure.add_axes(box))
    bar.outline.set_visible(False)
    bar.locator = MaxNLocator(4)
    bar.update_ticks()
    bar.ax.tick_params(length=0, pad=4 * unit * 72 / 100, labelsize=13 * unit * 72 / 100, labelcolor=INK)
    bar.set_label(label, size=13 * unit * 72 / 100, color=INK, labelpad=7 * unit * 72 / 100)
    return _rgba(figure)


def caption(size: tuple[int, int], words: str, unit: float) -> np.ndarray:
    """A transparent page (height, width, 4) uint8 with words at the middle of its lower edge."""
    figure = _page(size)
    figure.text(0.5, 7 * unit / size[1], words, ha="center", va="bottom", size=14 * unit * 72 / 100, color=INK)
    return _rgba(figure)


def over(image: np.ndarray, page: np.ndarray) -> np.ndarray:
    """The image (h, w, 3) uint8 with a transparent page (h, w, 4) laid over it."""
    rows = np.flatnonzero(page[..., 3].any(1))
    if not len(rows):
        return image
    part = slice(rows[0], rows[-1] + 1)
    alpha = page[part, :, 3:].astype(np.float32) / 255
    out = image.copy()
    out[part] = np.rint(image[part] * (1 - alpha) + page[part, :, :3] * alpha)
    return out


def _label_ends(figure: Any, axes: Any, ends: list[tuple[str, float, float, str]]) -> None:
    """Write each label where its curve ends, moved apart where they would overlap."""
    if not ends:
        return
    figure.canvas.draw()  # settles the size of the axes
    low, high = axes.get_ylim()
    height = axes.get_window_extent().height * 72 / figure.dpi  # [points]
    right = max(x for _, x, _, _ in ends)
    to_points = height / (np.log10(high) - np.log10(low))
    wanted = np.array([(np.log10(y) - np.log10(low)) * to_points for _, _, y, _ in ends])
    order = np.argsort(wanted, kind="stable")
    placed = _apart(wanted[order], 11.5)
    for place, k in zip(placed, order):
        label, x, y, color = ends[k]
        axes.annotate(
            label,
            xy=(1, 0),
            xycoords="axes fraction",
            xytext=(6, place),
            textcoords="offset points",
            color=color,
            fontsize=9,
            va="center",
            annotation_clip=False,
        )
        if x < right:  # the curve ends before the edge: a thin line leads on to its label
            axes.plot([x, right], [y, y], ":", color=color, lw=0.8)


def _apart(wanted: np.ndarray, gap: float) -> np.ndarray:
    """Sorted places moved as little as possible (least squares) so that neighbours are ``gap`` apart."""
    groups: list[list[float]] = []  # sum of shifted places, count; merged while out of order
    for place in wanted - gap * np.arange(len(wanted)):
        groups.append([float(place), 1])
        while len(groups) > 1 and groups[-2][0] / groups[-2][1] >= groups[-1][0] / groups[-1][1]:
            total, count = groups.pop()
            groups[-1][0] += total
            groups[-1][1] += count
    level = np.concatenate([np.full(int(count), total / count) for total, count in groups])
    return level + gap * np.arange(len(wanted))


def _curve(label: str, values: tuple[Any, ...], panels: int, log_x: bool) -> list[np.ndarray]:
    """x and the y of every panel, NaN where there is nothing to draw."""
    x, *ys = (np.asarray(v, float).ravel() for v in values)
    if len(ys) != panels:
        raise InputError(f"curve {label!r} has {len(ys)} y for {panels} panels")
    for y in ys:
        if len(x) != len(y):
            raise InputError(f"curve {label!r} has {len(x)} x and {len(y)} y")
    drawn = np.isfinite(x) & ((x > 0) | (not log_x))
    return [x, *(np.where(drawn & np.isfinite(y) & (y > 0), y, np.nan) for y in ys)]


def _paper(size: tuple[float, float], panels: int) -> tuple[Any, list[Any]]:
    figure = _figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12 if panels > 1 else 0.04)
    row = list(figure.subplots(1, panels, squeeze=False)[0])
    for axes in row:
        for side, spine in axes.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(INK)
            spine.set_linewidth(0.8)
        axes.grid(True, which="major", color=FAINT, lw=0.7)
        axes.set_axisbelow(True)
        axes.tick_params(which="major", color=INK, labelcolor=INK, labelsize=9, length=3, width=0.8)
        axes.tick_params(which="minor", length=0)
        axes.xaxis.label.set(color=INK, fontsize=9.5)
        axes.yaxis.label.set(color=INK, fontsize=9.5)
        axes.title.set_color(INK)
    return figure, row


def _page(size: tuple[int, int]) -> Any:
    return _figure(figsize=(size[0] / 100, size[1] / 100), dpi=100, facecolor="none")


def _figure(**options: Any) -> Any:
    """A figure on a canvas in memory, which needs no window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(**options)
    FigureCanvasAgg(figure)
    return figure


def _rgba(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba()).copy()
