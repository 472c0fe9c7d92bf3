"""Fig. 18, section 11.4: a bar under gravity by PBD, XPBD-QS and PBNG."""

from itertools import pairwise

import numpy as np

from pbng.compare.contest import Comparison
from pbng.compare.curve import Curve
from pbng.compare.reference import Reference, converged
from pbng.compare.start import Start
from pbng.gallery import find
from pbng.problem import Problem
from pbng.reproduce.common import State, WholeSteps, file_of, need_pictures, settled, side_by_side, steps_contest
from pbng.reproduce.section import Picture, Row, Section, Settings
from pbng.solvers.base import Solver
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.pbng import PBNG
from pbng.solvers.xpbd import PBD, XPBD

FRAME = 1 / 30  # s, a frame
SECONDS = 2.0  # of pseudo-time that PBD is given to come to rest
COUNTS = (1, 10, 100, 1000)  # iterations a step of PBD, run to rest
ONCE = (*COUNTS, 10_000)  # and in one step
OWN = "own dt"
DTS = {"1/30 s": 1 / 30, "1/120 s": 1 / 120, OWN: None}  # pseudo-time steps of XPBD-QS
LOCAL = (1, 10)  # its iterations a step
CLOSE = 0.05  # of the length: how far a vertex may be from equilibrium in a plausible state
EQUILIBRIUM = "equilibrium"


def fig18(settings: Settings) -> Section:
    """A bar clamped at one end, by PBD with ever more iterations, XPBD-QS, PBNG and two grids."""
    need_pictures()
    n, steps = settings.by_size(4, 9, 17), settings.by_size(120, 240, 480)
    problem = find("hanging_bar")(resolution=n).scene.compile()
    known = converged(problem, Start.of(problem, at=0.0), settings.threads)
    c = _converging(problem, known, steps, settings)
    true = sag(problem, known.x)
    once, rest, pbd = _pbd(problem, settings)
    sags = {name: sag(problem, curve.x) for name, curve in c.curves.items()}
    states = {EQUILIBRIUM: known.x, "PBNG": c.curves["PBNG"].x}
    # With one iteration a step the bars are so long that nothing else would be seen.
    states |= {f"PBD, {k} it.": x for k, x in pbd.items() if k > 1}
    states |= {_name("1/120 s", k): c.curves[_name("1/120 s", k)].x for k in LOCAL}
    states |= {_name(OWN, 1): c.curves[_name(OWN, 1)].x}
    return Section(
        name="fig18",
        title="Bar under gravity",
        scene=f"A bar of 1 x 0.25 x 0.25 m, {problem.n_vert:,} vertices and {problem.n_elem:,} tets, E = 1000 Pa,"
        " density 10 kg/m³, clamped at its left end. PBD in two readings: one step of 1/30 s with ever more iterations,"
        f" and run for {SECONDS:g} s of pseudo-time in steps of 1/30 s with so many each. XPBD-QS with 1 and 10"
        f" iterations a pseudo-time step, {steps} frames of 1/30 s of it; its own dt is that in which a wave crosses"
        " about half an element. Sag is how far the free end has come down.",
        claim="The effect of external forcing vanishes in PBD as the number of iterations increases: it converges to a"
        " rigid bar. XPBD-QS with 10 iterations a pseudo-time step appears more converged than with 1. PBNG converges"
        " to a visually plausible result within fewer iterations than XPBD-QS.",
        found=_found(c, true, once, rest, sags),
        rows=_rows(c, true, once, rest, sags),
        pictures=_pictures(settings, problem, states, c),
        record=c.record()
        | {"sag": sags | {EQUILIBRIUM: true}}
        | {
            "PBD": {
                "at rest": dict(zip(map(str, COUNTS), rest)),
                "one step": dict(zip(map(str, ONCE), once)),
                "seconds": SECONDS,
                "dt": FRAME,
            }
        },
    )


def sag(problem: Problem, x: np.ndarray) -> float:
    """How far the free end of the bar has come down [m], x (n_vert, 3)."""
    tip = problem.X[:, 0] == problem.X[:, 0].max()
    return float((problem.X[tip, 1] - x[tip, 1]).mean())


def _name(dt: str, k: int) -> str:
    return f"XPBD-QS, {dt}, {k} it."


def _converging(problem: Problem, known: Reference, steps: int, settings: Settings) -> Comparison:
    """The methods that tend to equilibrium, looked at while they do."""
    solvers: dict[str, Solver] = {
        "PBNG": PBNG(threads=settings.threads),
        "two-grid": MultigridPBNG(threads=settings.threads),
    }
    limits = {"PBNG": settings.by_size(400, 1000, 4000), "two-grid": 60}
    own = XPBD(threads=settings.threads).set_up(problem).dt
    for words, given in DTS.items():
        dt = given or own
        for k in LOCAL:
            solvers[_name(words, k)] = WholeSteps(dt=dt, iterations=k, threads=settings.threads)
            limits[_name(words, k)] = k * round(steps * FRAME / dt)
    return steps_contest(problem, solvers, limits, at=0.0, reference=known, looks=60)


def _pbd(problem: Problem, settings: Settings) -> tuple[list[float], list[float], dict[int, np.ndarray]]:
    """Sag [m] of PBD after one step and at rest, for each of ``ONCE`` and ``COUNTS``, and states at rest."""
    x, targets = problem.constrain(problem.X, 0.0), problem.targets(0.0)
    steps, once, rest, states = round(SECONDS / FRAME), [], [], {}
    for k in COUNTS:
        method = PBD(dt=FRAME, iterations=k, threads=settings.threads).set_up(problem)
        method.start(x, targets)
        for _ in range(k * steps):
            method.step()
        states[k] = np.asarray(method.state(), float)
        rest.append(sag(problem, states[k]))
    method = PBD(dt=FRAME, dtype="float64", threads=settings.threads).set_up(problem)
    method.start(x, targets)
    for i in range(1, max(ONCE) + 1):
        method.step()
        if i in ONCE:
            once.append(sag(problem, method.state()))
    return once, rest, states


def _falls(values: list[float]) -> bool:
    """Whether each is below the one before."""
    return all(b < a for a, b in pairwise(values))


def _found(c: Comparison, true: float, once: list[float], rest: list[float], sags: dict[str, float]) -> str:
    words = f"In equilibrium the free end hangs {_m(true)} down. "
    tail = f"from {_m(rest[0])} to {_m(rest[-1])} with {COUNTS[0]} to {COUNTS[-1]} iterations a step"
    if _falls(rest):
        words += f"PBD's sag at rest falls with its iterations, {tail}: it forgets the weight. "
    else:
        words += f"PBD's sag at rest does not fall with every increase of its iterations; it goes {tail}. "
    words += f"In one step the weight brings it down by {_m(once[0])} with 1 iteration, and by {_m(once[-1])} with"
    words += f" {ONCE[-1]:,}{'' if _falls(once) else ', though it does not fall all the way'}. "
    errors = {name: abs(s - true) for name, s in sags.items()}
    better = [dt for dt in DTS if errors[_name(dt, 10)] < errors[_name(dt, 1)]]
    if len(better) == len(DTS):
        parts = [f"{_m(errors[_name(dt, 1)])} and {_m(errors[_name(dt, 10)])} with {dt}" for dt in DTS]
        words += f"XPBD-QS with 10 iterations a step is nearer than with 1: the sag is off by {', '.join(parts)}. "
    else:
        words += (
            f"10 iterations a step are nearer than 1 with steps of {', '.join(better) or 'none of the lengths'} only. "
        )
    reached = {name: _close(curve) for name, curve in c.curves.items()}
    ours = reached["PBNG"]
    theirs = [at for name, at in reached.items() if name.startswith("XPBD") and at is not None]
    if ours is None:
        words += "PBNG has not come within 5 cm of equilibrium everywhere"
    elif not theirs or ours < min(theirs):
        words += f"PBNG is within 5 cm of equilibrium everywhere, to stay, after {ours} iterations, XPBD-QS"
        words += f" after {min(theirs)} at the soonest" if theirs else " never"
    else:
        words += (
            f"The paper's order is not borne out: XPBD-QS is within 5 cm of equilibrium, to stay, after {min(theirs)}"
        )
        words += f" iterations, PBNG after {ours}"
    cycles = reached["two-grid"]
    return words + (f"; the two-grid method after {cycles} cycles." if cycles else ".")


def _rows(c: Comparison, true: float, once: list[float], rest: list[float], sags: dict[str, float]) -> tuple[Row, ...]:
    rows = [Row("sag in equilibrium", "-", _m(true), str(c.reference))]
    for what, values, counts in (("one step", once, ONCE), ("at rest", rest, COUNTS)):
        for k, s in zip(counts, values):
            paper = "rigid" if k == counts[-1] else "less with more"
            often = f"{k:,} iteration{'s' if k > 1 else ''}{' a step' if what == 'at rest' else ''}"
            rows.append(Row(f"PBD, {what}, {often}: sag", paper, _m(s), f"{s / true:.1%} of the true one"))
    for name, curve in c.curves.items():
        paper = "plausible, in fewer" if name == "PBNG" else "-"
        if name.startswith("XPBD"):
            paper = "more converged" if name.endswith("10 it.") else "less converged"
        error = float(curve.errors[-1])
        remark = f"{curve.iterations[-1]:,} iterations, {curve.seconds[-1]:.2g} s;"
        remark += f" a vertex is at most {_m(error)} off; {_plausible(curve)}"
        rows.append(Row(f"{name}: sag", paper, _m(sags[name]), remark))
    return tuple(rows)


def _close(curve: Curve) -> int | None:
    """Iterations after which all vertices stay within ``CLOSE`` of equilibrium."""
    return settled(curve.iterations, curve.errors, CLOSE)


def _plausible(curve: Curve) -> str:
    at = _close(curve)
    return "that is not within 5 cm" if at is None else f"within 5 cm from {at:,} on"


def _m(length: float) -> str:
    return f"{length:.3f} m" if length >= 0.01 else f"{length * 1e3:.2g} mm"


def _pictures(
    settings: Settings, problem: Problem, states: dict[str, np.ndarray], c: Comparison
) -> tuple[Picture, ...]:
    from pbng.view import plot_residuals

    bars = {name: State(problem, x) for name, x in states.items()}
    picture = side_by_side(bars, file_of(settings, "bars.png"), azimuth=20.0, elevation=8.0)
    errors = plot_residuals(
        {name: (curve.iterations[1:], curve.errors[1:]) for name, curve in c.curves.items()},
        file_of(settings, "errors.png"),
        "iterations (each method's own)",
        "largest distance [m]",
        "From equilibrium",
        log_x=True,
        size=(6.8, 3.8),
    )
    return (
        Picture(
            picture, "Final states, coloured by their largest principal stretch; PBD with steps of 1/30 s, at rest."
        ),
        Picture(errors, "How far a vertex is at most from equilibrium, against iterations."),
    )
