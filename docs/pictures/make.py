"""Draw pictures of this folder anew, those that are named: ``python docs/pictures/make.py twist dragon falling``.

The first two take half a minute on one core, ``falling`` minutes. The others come from ``pbng``: ``springs.png`` is the
``blocks.png`` of ``pbng reproduce fig17``, and the plots are those of ``pbng bench accuracy``, ``bench convergence``
and ``bench frames`` with ``--out``.
"""

import sys
from pathlib import Path

import pbng

HERE = Path(__file__).parent


def frames(name: str, count: int) -> list[pbng.Frame]:
    """The first frames of a scene of the gallery, run as it is meant to be."""
    r = pbng.gallery.find(name)()
    options = {"fps": r.fps, "inertia": r.inertia, "substeps": r.substeps}
    return list(pbng.simulate(r.scene, r.solver, r.budget, frames=count, **options))


def twist() -> None:
    """The block of the paper, twisted and stretched."""
    pbng.view.sheet(frames("twisting_block", 61), HERE / "twist.png", width=1440)


def dragon() -> None:
    """The little dragon as it hangs at first, and with its head turned farthest to either side."""
    run = frames("bent_surface", 46)
    pbng.view.sheet([run[k] for k in (0, 15, 45)], HERE / "dragon.png", width=1280)


def falling() -> None:
    """Soft bodies that fall into a glass box."""
    pbng.view.sheet(frames("dropping_shapes", 76), HERE / "falling.png", color="body", width=1280)


if __name__ == "__main__":
    for name in sys.argv[1:]:
        {"twist": twist, "dragon": dragon, "falling": falling}[name]()
