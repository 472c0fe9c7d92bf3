"""Random poses of a bar solved to an error that is asked for: does the estimate keep its word?"""

from typing import Any

import numpy as np

from pbng import shapes
from pbng.bench.scenes import model_of
from pbng.materials.base import Material
from pbng.motions import Motion, Rotate, Translate
from pbng.problem import Problem
from pbng.scene import Scene
from pbng.solvers.base import Budget, Status
from pbng.solvers.loop import run
from pbng.solvers.multigrid import MultigridPBNG

SIZE = (2.0, 1.0, 1.0)
Row = dict[str, Any]


def random_pose(rng: np.random.Generator, amount: float = 0.5) -> Motion:
    """Where the far end of the bar goes.

    With amount 1 it is twisted by ±120°, turned about y and z by ±60°, drawn to 0.8 .. 1.5 of the bar's length and
    shifted by ±0.3 m along each axis, so that most poses fold elements over.
    """
    twist, bend = amount * rng.uniform(-120, 120) / 360, amount * rng.uniform(-60, 60, 2) / 360
    shift = amount * rng.uniform(-0.3, 0.3, 3)
    shift[0] += amount * (rng.uniform(0.8, 1.5) - 1) * SIZE[0]
    return Rotate("x", twist) + Rotate("y", bend[0]) + Rotate("z", bend[1]) + Translate(tuple(shift))


def bar(n: int, material: Material, poses: list[Motion]) -> Problem:
    """A bar of n vertices across, held at x = 0; at time k its other end is in pose k."""
    scene = Scene(name="poses")
    body = scene.add(shapes.box(SIZE, (2 * n - 1, n, n)), material, name="bar")
    scene.pin(body.where(x=0.0))
    scene.move(body.where(x=SIZE[0]), lambda t, X: poses[int(t)].at(X, X.mean(0), 1.0, t))
    return scene.compile()


def measure(
    count: int,
    n: int,
    error: float,
    model: str = "corotated",
    nu: float = 0.3,
    threads: int | None = None,
    seed: int = 0,
    amount: float = 0.5,
) -> list[Row]:
    """One row a pose, each solved from rest to an estimated error of ``error`` times the length of the bar.

    ``true`` and ``estimate`` [m] are the largest distance of a vertex from a float64 reference and what the method made
    of it; ``true`` is NaN where the reference did not converge.
    """
    rng = np.random.default_rng(seed)
    problem = bar(n, model_of(model)(E=1e5, nu=nu, density=10.0), [random_pose(rng, amount) for _ in range(count)])
    bound = error * SIZE[0]
    method = MultigridPBNG(threads=threads).set_up(problem)
    exact = MultigridPBNG(dtype="float64", start="previous", threads=threads).set_up(problem)
    run(method, problem.constrain(problem.X, 0), Budget(iterations=4), before=problem.X)  # kernels are loaded
    rows = []
    for k in range(count):
        result = run(method, problem.constrain(problem.X, k), Budget(error=bound, iterations=100), before=problem.X)
        reference = run(exact, result.x.astype(float), Budget(atol=1e-11 * result.residuals[0], iterations=300))
        distance = np.linalg.norm(result.x - reference.x, axis=1).max()
        rows.append(
            {
                "certified": result.status is Status.CONVERGED,
                "bound": bound,
                "estimate": result.error,
                "true": float(distance) if reference.status is Status.CONVERGED else float("nan"),
                "cycles": result.iterations,
                "ms": result.seconds * 1e3,
                "setup_s": method.setup_seconds,
                "inverted": result.inverted,
                "status": result.status.name,
                "ratio": result.reduction,
            }
        )
    return rows


def summary(rows: list[Row]) -> Row:
    """All poses in one row; true error over estimate is that of the certified ones."""
    column = {k: np.array([r[k] for r in rows]) for k in rows[0]}
    certified, true = column["certified"], column["true"]
    share = (true / column["estimate"])[certified & np.isfinite(true)]
    return {
        "poses": len(rows),
        "certified": int(certified.sum()),
        "falsely": int((certified & (true > column["bound"])).sum()),
        "unknown": int((~np.isfinite(true)).sum()),
        "true/estimate": float(np.median(share)) if len(share) else None,
        "worst true/estimate": float(share.max()) if len(share) else None,
        "cycles": float(np.median(column["cycles"])),
        "most cycles": int(column["cycles"].max()),
        "ms": float(np.median(column["ms"])),
        "most ms": float(column["ms"].max()),
        "setup_s": rows[0]["setup_s"],
        "inverted": int((column["inverted"] > 0).sum()),
    }
