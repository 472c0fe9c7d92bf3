"""What the solver left of the residuals of a run."""

import numpy as np

from pbng.io.frames import Run, solved


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
