"""Time of one iteration of pypbd's XPBD of tets: ``python pypbd_iteration.py PROBLEM.npz``. For ``iteration.py``.

What an iteration takes is what a step of one takes longer with constraints than without. (More than one a step blow up,
and inverted tets take longer.) The state is smooth and deformed everywhere, and put back before each step, so that no
constraint is idle and no tet inverted.
"""

import json
import sys
import time
from types import SimpleNamespace

import numpy as np
from pypbd_body import build, constrain, place, positions

DT = 1e-4  # s
ROUNDS = 31


def main() -> None:
    with np.load(sys.argv[1]) as arrays:
        problem = SimpleNamespace(**{k: v[()] if v.ndim == 0 else v for k, v in arrays.items()})
    simulation, model, particles = build(problem, DT)
    stepper = simulation.getTimeStep()

    def steps() -> np.ndarray:
        """Wall and CPU seconds of steps, (ROUNDS, 2)."""
        stepper.step(model)  # colours the constraints
        seconds = []
        for _ in range(ROUNDS):
            place(particles, problem.smooth)
            wall, cpu = time.perf_counter(), time.process_time()
            stepper.step(model)
            seconds.append([time.perf_counter() - wall, time.process_time() - cpu])
        return np.array(seconds)

    none = steps()
    place(particles, problem.X)  # what constraints take for rest is where particles are
    constrain(model, problem)
    one = steps()
    report = {
        "median": (np.median(one, 0) - np.median(none, 0)).tolist(),
        "best": (one.min(0) - none.min(0)).tolist(),
        "step": np.median(one, 0).tolist(),
        "moved": float(np.abs(positions(particles) - problem.smooth).max()),
        "colors": len(model.getConstraintGroups()),
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
