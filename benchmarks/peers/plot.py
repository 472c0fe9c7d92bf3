"""Draw records of ``run.py``: ``python plot.py results/hard_start_32.json``, residual against seconds by material."""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from environment import PeerError

import pbng
from pbng.view import plot_residuals

SIZE = (5.0, 3.6)
FIRST = {"neo-hookean": "first", "stvk": "first_corotated"}
WORDS = {
    "neo-hookean": ("Neo-Hookean", "residual / first residual"),
    "stvk": ("Saint Venant-Kirchhoff", "residual / first residual of corotated"),
}
LOWEST = 5e-7  # that is drawn
HIGHEST = {"neo-hookean": 1.0, "stvk": 100.0}  # that is drawn; a load step that fails goes far beyond
EARLIEST = 1e-3  # s


def panel(rows: list[dict[str, Any]], material: str, clock: str, path: Path) -> Path:
    """The curves of one material."""
    series = {}
    for row in sorted(rows, key=lambda r: r["peer"].startswith("pbng")):
        t, ratio = np.array(row[clock]), np.array(row["residual"]) / row[FIRST[material]]
        met = np.flatnonzero(ratio < LOWEST)
        keep = np.arange(len(t)) <= (met[0] if len(met) else len(t))
        keep &= t >= EARLIEST
        series[row["peer"]] = (t[keep], np.maximum(ratio[keep], LOWEST))
    name, label = WORDS[material]
    seconds = "CPU seconds, set-up apart" if clock == "cpu" else "seconds, set-up apart"
    title = f"{name}, {rows[0]['n']}³ vertices"
    top = HIGHEST[material]
    return plot_residuals(series, path, seconds, label, title, log_x=True, top=top, size=SIZE)


def beside(paths: list[Path], out: Path) -> None:
    """Pictures of one height, side by side on white."""
    from matplotlib.image import imread, imsave

    pictures = [imread(path)[..., :3] for path in paths]
    tall = max(p.shape[0] for p in pictures)
    padded = [np.pad(p, ((0, tall - len(p)), (0, 40), (0, 0)), constant_values=1.0) for p in pictures]
    out.parent.mkdir(parents=True, exist_ok=True)
    imsave(out, np.concatenate(padded, axis=1))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0], prog="plot.py")
    parser.add_argument("record", type=Path, help="what run.py --record wrote")
    parser.add_argument("--out", type=Path, help="the .png; by default beside the record")
    parser.add_argument("--clock", choices=("cpu", "wall"), default="cpu")
    args = parser.parse_args()
    try:
        rows = json.loads(args.record.read_text())["rows"]
    except (OSError, ValueError, KeyError) as error:
        raise PeerError(f"{args.record} is no record of run.py: {error}") from error
    with tempfile.TemporaryDirectory() as scratch:
        panels = []
        for material in WORDS:
            mine = [r for r in rows if r["material"] == material]
            if mine:
                panels.append(panel(mine, material, args.clock, Path(scratch) / f"{material}.png"))
        beside(panels, args.out or args.record.with_suffix(".png"))


if __name__ == "__main__":
    try:
        main()
    except (PeerError, pbng.InputError) as error:
        sys.exit(f"plot.py: {error}")
