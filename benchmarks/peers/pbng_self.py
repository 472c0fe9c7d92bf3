"""pbng itself, on the clock of the others: ``python pbng_self.py PROBLEM.npz SECONDS SOLVER MATERIAL``.

The clock holds all that ``pbng.solve`` does, its own evaluations of the residual included, which no peer makes; kernels
are compiled beforehand. The solve is repeated. As its states are the same each time, bit for bit, the time of each is
the median over the repetitions.
"""

import sys

import numba
import numpy as np
from record import arguments
from scene import hard_start

import pbng
from pbng.solvers.loop import run

SOLVERS = {
    "two-grid": pbng.MultigridPBNG(),
    "anderson": pbng.PBNG(),
}
ROUNDS = 5
TARGET = 3e-7  # of the first residual, or of that of the corotated model if it is less


def main() -> None:
    data, record = arguments()
    name, material = sys.argv[3:]
    solver, n = SOLVERS[name], int(data.n)
    problem = hard_start(n, material)
    solver.set_up(problem)  # compiles
    with record.phase("set-up"):
        method = solver.set_up(problem)
    first = min(problem.residual(data.x0), hard_start(n, "corotated").residual(data.x0))
    budget = pbng.Budget(atol=TARGET * first, seconds=record.limit)

    def solve() -> tuple[list, list]:
        """Iterations, wall and CPU seconds at each residual that the solve evaluates, and the states there."""
        moments, states = [], []

        def look(progress) -> None:
            record.__exit__()
            moments.append((progress.iteration, record.wall, record.cpu))
            states.append(method.state())
            record.__enter__()

        record.wall = record.cpu = 0.0
        with record:
            run(method, data.x0, budget, look, before=problem.X)
        return moments, states

    solve()
    rounds = [solve() for _ in range(ROUNDS)]
    moments, states = np.median([r[0] for r in rounds], axis=0), rounds[-1][1]
    record.wall = record.cpu = 0.0
    record.add(0, lambda: data.x0, always=True)
    for (iteration, record.wall, record.cpu), x in zip(moments, states):
        record.add(int(iteration), lambda x=x: x, always=True)
    versions = {"pbng": pbng.__version__, "numba": numba.__version__}
    record.close(versions, unit="cycle" if name == "two-grid" else "sweep", rounds=ROUNDS)


if __name__ == "__main__":
    main()
