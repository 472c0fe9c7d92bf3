"""What the solver left of the residuals of a run."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from pbng.io.frames import Run


def solved(frames: Sequence[Any], moving: bool) -> Sequence[Any]:
    """Those of the frames of a run, or of what is known of each, that a solver made.

    With inertia, ``moving``, the first is the start, whose residual says nothing of how well the run was solved; if
    there is no other, it has to do.
    """
    return frames[1:] or frames if moving else frames


def residual_curves(run: Run) -> tuple[dict[str, tuple[np.ndarray, np.ndarray]], str]:
    """Curves for :func:`pbng.view.plot_residuals`, and what their x is: the residuals over the iterations of the one
    frame, or before and after those of each frame.
    """
    if len(run) == 1:
        frame = run[0]
        return {frame.status.lower(): (frame.monitored, frame.residuals)}, "iteration"
    ends = [(frame.t, frame.residuals[0], frame.residuals[-1]) for frame in run]
    t, first, last = np.array(solved(ends, run[0].v is not None)).T
    return {"start of frame": (t, first), "end of frame": (t, last)}, "time [s]"
