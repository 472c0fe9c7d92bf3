"""Fig. 12, section 11.1.5: accelerations of PBNG, and what came after."""

import math

from pbng.bench.scenes import MODELS, box, hard_start
from pbng.compare.contest import Comparison, contest
from pbng.compare.curve import Curve
from pbng.drivers import solve
from pbng.gallery import find
from pbng.problem import Problem
from pbng.reproduce.common import file_of, first_below, need_pictures
from pbng.reproduce.section import Picture, Row, Section, Settings
from pbng.solvers.acceleration import SOR, Anderson, Chebyshev, NodeSOR
from pbng.solvers.base import Budget, Solver
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.pbng import PBNG

ACCELERATIONS = {
    "plain": None,
    "Chebyshev": Chebyshev(rho=0.95, gamma=1.7),
    "SOR as printed": SOR(1.7),
    "node SOR": NodeSOR(1.7),
    "Anderson": Anderson(),
}
TWO_GRID = "two-grid"
PAPERS = ("Chebyshev", "SOR as printed")
LEVELS = (1e-2, 1e-3, 1e-6)
FRAME = 1 / 30  # s, the first time step
LOOKS = 80
HIGHEST = 3.0  # ratio that a plot shows


def fig12(settings: Settings) -> Section:
    """Residual against iterations of every acceleration: a first time step, and a hard start."""
    need_pictures()
    n, most = settings.by_size(8, 32, 32), settings.by_size(120, 200, 1000)
    block = hard_start(box(n), MODELS["corotated"](E=1e5, nu=0.3, density=10.0))
    starts = {
        "first step": _contest(find("twisting_block")(resolution=n).scene.compile(), FRAME, most, settings.threads),
        "hard start": _contest(block, 0.0, most, settings.threads),
    }
    return Section(
        name="fig12",
        title="Acceleration techniques",
        scene=f"The stretching block, {block.n_vert:,} vertices and {block.n_elem:,} tets, E = 1e5 Pa, all in float64,"
        f" at most {most} iterations: its first time step of 1/30 s from rest, as in the paper, and a hard start, a"
        " quarter turn and half its length in one step. Iterations are each method's own: a sweep, or a cycle of four"
        f" sweeps and a correction from a grid; each is looked at {LOOKS} times, more often at first.",
        claim="The convergence rate of PBNG may slow down as the iteration count increases. The Chebyshev"
        " semi-iterative method (ρ = 0.95, γ = 1.7) and SOR (ω = 1.7) effectively accelerate the residual reduction,"
        " and behave similarly.",
        found=" ".join(_found(name, c) for name, c in starts.items()) + _beyond(starts),
        rows=tuple(row for name, c in starts.items() for row in _rows(name, c)),
        pictures=tuple(p for name, c in starts.items() for p in _pictures(settings, name, c)),
        record={name: c.record() for name, c in starts.items()},
    )


def _contest(problem: Problem, at: float, most: int, threads: int | None) -> Comparison:
    solvers: dict[str, Solver] = {
        name: PBNG(acceleration=a, dtype="float64", threads=threads) for name, a in ACCELERATIONS.items()
    }
    solvers[TWO_GRID] = MultigridPBNG(dtype="float64", threads=threads)
    true = solve(problem, solvers[TWO_GRID], Budget(rtol=1e-10, iterations=200), at=at).x
    limits = dict.fromkeys(solvers, most) | {TWO_GRID: min(most, 40)}
    return contest(problem, solvers, iterations=limits, at=at, reference=true, looks=LOOKS)


def iterations_to(curve: Curve, level: float) -> int | None:
    """The first iteration that was looked at with the residual at most ``level`` of the first one, or None."""
    return first_below(curve.iterations, curve.ratios, level)


def _found(name: str, c: Comparison) -> str:
    plain = c.curves["plain"]
    half = len(plain.ratios) // 2
    early, late = _rate(plain, 0, half), _rate(plain, half, len(plain.ratios) - 1)
    words = f"At the {name}, plain PBNG"
    words += " slows down" if late > early else " does not slow down"
    words += f" (a decade takes {_decade(early)} sweeps in the first half of the looks, {_decade(late)} in the second)."
    last = {k: float(curve.ratios[-1]) for k, curve in c.curves.items()}
    faster = [k for k in PAPERS if last[k] < last["plain"]]
    if len(faster) == len(PAPERS):
        lowest = min(last[k] for k in PAPERS), max(last[k] for k in PAPERS)
        words += f" Both accelerations of the paper help: after {plain.iterations[-1]} iterations the residual is"
        words += f" {lowest[0]:.1e} and {lowest[1]:.1e} of the first one, of plain sweeps {last['plain']:.1e};"
        words += " they behave similarly." if lowest[1] < 10 * lowest[0] else " they differ from each other."
    else:
        slower = ", ".join(k for k in PAPERS if k not in faster)
        words += (
            f" Not both accelerations of the paper help here: {slower} ended at no lower a residual than plain sweeps"
        )
        words += " (" + ", ".join(f"{k} {last[k]:.1e}" for k in ("plain", *PAPERS)) + ")."
    return words


def _beyond(starts: dict[str, Comparison]) -> str:
    parts = []
    for name, c in starts.items():
        best = min((r for k in PAPERS if (r := iterations_to(c.curves[k], 1e-3))), default=None)
        ours, cycles = iterations_to(c.curves["Anderson"], 1e-3), iterations_to(c.curves[TWO_GRID], 1e-3)
        theirs = f"the better of the paper's {best}" if best else "neither of the paper's got there"
        parts.append(
            f"at the {name} {ours or 'never'} with Anderson mixing and {cycles or 'no'} two-grid cycles, {theirs}"
        )
    return f" Iterations to 1e-3: {'; '.join(parts)}."


def _rate(curve: Curve, a: int, b: int) -> float:
    """Sweeps a decade of the residual between two looks; infinite if it has not fallen."""
    fall = math.log10(curve.ratios[a] / curve.ratios[b])
    return float(curve.iterations[b] - curve.iterations[a]) / fall if fall > 0 else math.inf


def _decade(sweeps: float) -> str:
    return f"{sweeps:.0f}" if math.isfinite(sweeps) else "endless"


def _rows(name: str, c: Comparison) -> list[Row]:
    rows = []
    for label, curve in c.curves.items():
        reached = [iterations_to(curve, level) for level in LEVELS]
        paper = "slows down" if label == "plain" else "accelerates" if label in PAPERS else "-"
        ours = " / ".join("-" if k is None else str(k) for k in reached)
        remark = f"{curve.ratios[-1]:.1e} after {curve.iterations[-1]}, {curve.ms:.3g} ms an iteration"
        error = float(c.errors(label)[-1])
        remark += f"; the largest position error is then {error:.0e} of the size" if math.isfinite(error) else ""
        rows.append(Row(f"{name}, {label}: iterations to 1e-2 / 1e-3 / 1e-6", paper, ours, remark))
    return rows


def _pictures(settings: Settings, name: str, c: Comparison) -> list[Picture]:
    from pbng.view import plot_residuals

    file, words = name.replace(" ", "_"), "residual / first residual"
    by_count = plot_residuals(
        {label: (curve.iterations[1:], curve.ratios[1:]) for label, curve in c.curves.items()},
        file_of(settings, f"{file}_iterations.png"),
        "iterations",
        words,
        f"{name.capitalize()}: {c.problem.n_vert:,} vertices",
        log_x=True,
        top=HIGHEST,
        size=(6.0, 3.8),
    )
    by_time = plot_residuals(
        {label: (curve.seconds[1:], curve.ratios[1:]) for label, curve in c.curves.items()},
        file_of(settings, f"{file}_seconds.png"),
        "seconds",
        words,
        f"{name.capitalize()}: {c.problem.n_vert:,} vertices",
        log_x=True,
        top=HIGHEST,
        size=(6.0, 3.8),
    )
    return [
        Picture(by_count, f"The {name}: residual against iterations, each method's own."),
        Picture(by_time, f"The {name}: residual against seconds of stepping, set-up left out."),
    ]
