"""Fig. 17, section 11.3: two blocks bound by stiff springs; what XPBD-QS makes of them depends on the order."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pbng.compare.contest import Comparison
from pbng.compare.curve import Curve
from pbng.compare.reference import converged
from pbng.compare.start import Start
from pbng.gallery import find
from pbng.gallery.hanging import DENSITY, GRAVITY
from pbng.packing import Packed
from pbng.problem import Problem
from pbng.reproduce.common import State, WholeSteps, file_of, need_pictures, settled, side_by_side, steps_contest
from pbng.reproduce.section import Picture, Row, Section, Settings
from pbng.solvers.acceleration import SOR
from pbng.solvers.base import Solver
from pbng.solvers.multigrid import MultigridPBNG
from pbng.solvers.newton import Newton
from pbng.solvers.pbng import PBNG, PackedMethod
from pbng.solvers.xpbd import XPBD

WEIGHT = DENSITY * -GRAVITY[1]  # N, of one block of 1 m³
FRAME = 1 / 30  # s, one frame: the pseudo-time step that comes to mind
ORDERS = {"XPBD-QS": "elastic first", "XPBD-QS flipped": "weak first"}
ROUGH, MORE, OWN = "1/30 s, 1 it.", "1/30 s, 10 it.", "own dt, 1 it."
STEPS = {ROUGH: (FRAME, 1), MORE: (FRAME, 10), OWN: (None, 1)}
BALANCED = 1e-3  # of the weight of a block: a residual that is an equilibrium to the eye
GAP, STRETCHED = 0.01, 1.1  # m of gap, and stretch of the top layer over that in equilibrium, that show
WAVES = 1.5  # greatest over least residual at the later looks that oscillates
START, EQUILIBRIUM = "start", "equilibrium"
SINGLE = "PBNG, no compounds"


@dataclass(frozen=True)
class SingleVertices(PBNG):
    """PBNG as the paper has it: sweeps over single vertices; what springs tie is not moved as one."""

    def set_up(self, problem: Problem) -> PackedMethod:
        """As that of :class:`PBNG`."""
        return _SingleVertices(problem, self)


class _SingleVertices(PackedMethod):
    def layout(self, dtype: str) -> Packed:
        if dtype not in self.layouts:
            self.layouts[dtype] = replace(super().layout(dtype), carried=())
        return self.layouts[dtype]


@dataclass(frozen=True)
class Look:
    """What is to be seen of the two blocks: largest gap of a spring [m], and mean stretch of the top layer of cells of
    the lower one."""

    gap: float
    layer: float


def fig17(settings: Settings) -> Section:
    """A block hangs below another on springs of 1e8 N/m: both orders of XPBD-QS, PBNG, two grids and Newton."""
    need_pictures()
    n, most = settings.by_size(5, 16, 16), settings.by_size(200, 1000, 4000)
    problem = find("two_blocks_hanging")(resolution=n).scene.compile()
    solvers = _solvers(settings.threads)
    limits = dict.fromkeys(solvers, most) | {"PBNG": 300, SINGLE: most // 2, "two-grid": 100, "Newton": 40}
    known = converged(problem, Start.of(problem), settings.threads)
    c = steps_contest(problem, solvers, limits, reference=known, looks=60)
    looks = {name: look(problem, curve.x) for name, curve in c.curves.items()}
    looks[EQUILIBRIUM] = look(problem, known.x)
    return Section(
        name="fig17",
        title="Two blocks hanging",
        scene=f"Two cubes of 1 m, together {problem.n_vert:,} vertices and {problem.n_elem:,} tets, E = 1000 Pa,"
        f" density 10 kg/m³; the top of the upper one is held, and {n * n} springs of 1e8 N/m"
        f" draw the lower one up over a gap of 0.2 m. The residual begins at k times the gap, {c.first:.1e} N; what"
        f" matters is how it compares with the weight of a block, {WEIGHT:.0f} N. Iterations are each method's own:"
        " sweeps, cycles, Newton steps, or projections of all constraints. A pseudo-time step of XPBD-QS has 1 or 10 of"
        " these, and it is looked at after whole steps only; it is in float64, since in float32 the rounding of springs"
        " so stiff would be its floor. Its own dt is that in which a wave crosses about half an element.",
        claim="PBNG is able to reduce the residual by a few orders of magnitude and converges quickly. XPBD-QS methods"
        " demonstrate iteration-order-dependent behaviour: residuals oscillate, and there is either a gap between the"
        " blocks or a very stretched top layer of the lower one.",
        found=_found(c, looks),
        rows=_rows(c, looks),
        pictures=_pictures(settings, c, known.x),
        record=c.record()
        | {"weight": WEIGHT, "looks": {name: {"gap": v.gap, "layer": v.layer} for name, v in looks.items()}}
        | {"relative": {name: _relative(c, name) for name in c.curves}},
    )


def _solvers(threads: int | None) -> dict[str, Solver]:
    out: dict[str, Solver] = {
        "PBNG": PBNG(threads=threads),
        SINGLE: SingleVertices(acceleration=SOR(), dtype="float64", threads=threads),
        "two-grid": MultigridPBNG(threads=threads),
        "Newton": Newton(threads=threads),
    }
    for (name, order), (words, (dt, count)) in product(ORDERS.items(), STEPS.items()):
        out[f"{name}, {words}"] = WholeSteps(dt=dt, iterations=count, order=order, dtype="float64", threads=threads)
    return out


def look(problem: Problem, x: np.ndarray) -> Look:
    """The gap and the stretched layer of a state x (n_vert, 3) [m]."""
    weak, lower = problem.weak_energy, problem.bodies[1]
    assert weak is not None, "the blocks are bound"
    ends = weak.ends(x, problem.targets(problem.end))
    height = problem.X[lower.start : lower.stop, 1]
    levels = np.unique(height.round(9))[-2:]
    second, top = (x[lower.start : lower.stop, 1][np.abs(height - y) < 1e-6].mean() for y in levels)
    gap = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max()
    return Look(float(gap), float((top - second) / (levels[1] - levels[0])))


def _relative(c: Comparison, name: str) -> float:
    """The last residual over the force scale, the sum of the norms of all forces of elements and springs."""
    curve = c.curves[name]
    return float(curve.residuals[-1] / c.problem.evaluate(curve.x, c.start.targets)[1])


def _balanced(curve: Curve) -> int | None:
    return settled(curve.iterations, curve.residuals, BALANCED * WEIGHT)


def oscillates(curve: Curve) -> bool:
    """Whether the residual goes up and down at the later looks: up at a quarter of them or more, and by much."""
    later = curve.residuals[len(curve.residuals) // 2 :]
    return bool(len(later) > 3 and (np.diff(later) > 0).mean() >= 0.25 and later.max() > WAVES * later.min())


def _found(c: Comparison, looks: dict[str, Look]) -> str:
    ours = _balanced(c.curves["PBNG"])
    reached = float(c.curves["PBNG"].residuals[-1] / WEIGHT)
    words = (
        f"PBNG's residual falls to a thousandth of the weight of a block in {ours} iterations, to {reached:.0e} at last"
        if ours
        else f"PBNG's residual comes to {reached:.0e} of the weight of a block, not to a thousandth"
    )
    others = [f"{k} in {_balanced(c.curves[k])}" for k in ("two-grid", "Newton") if _balanced(c.curves[k])]
    words += f" ({', '.join(others)}). " if others else ". "
    words += "Here what springs tie is also moved as one, by compound nodes, which are ours and not the paper's"
    words += f" (docs/method.md). {_without_compounds(c, looks)} "
    true = looks[EQUILIBRIUM].layer
    stretched = [k for k in c.curves if k.startswith("XPBD-QS,") and looks[k].layer > STRETCHED * true]
    gaping = [k for k in c.curves if k.startswith("XPBD-QS flipped") and looks[k].gap > GAP]
    names = {k: [name for name in c.curves if name.startswith(k + ",")] for k in ORDERS}
    if stretched and gaping:
        most = max(looks[k].layer for k in stretched)
        widest = max(looks[k].gap for k in gaping)
        words += f"XPBD-QS depends on the order: elastic constraints first, the top layer is stretched up to {most:.2f}"
        words += f" times its height where equilibrium has {true:.2f}; weak constraints first, a gap of up to"
        words += f" {_m(widest)} is left. "
        fine = [k for name in names.values() for k in name if k not in stretched and k not in gaping]
        words += f"Neither is to be seen with {'; '.join(fine)} ({_errors(c, fine)} off). " if fine else ""
    else:
        words += "The order of the constraints of XPBD-QS leaves "
        words += "no stretched layer" if not stretched else "a stretched layer"
        words += " and " + ("no gap" if not gaping else "a gap") + " that would show. "
    waves = [k for name in names.values() for k in name if oscillates(c.curves[k])]
    total = sum(map(len, names.values()))
    if waves:
        words += f"Its residual oscillates in {len(waves)} of {total} runs, looked at after whole steps"
    else:
        words += "Its residual does not oscillate, looked at after whole steps and with kinetic damping: it stagnates"
    best = min(float(c.curves[k].residuals[-1]) for name in names.values() for k in name)
    return words + f"; the lowest that any of them ends at is {best / WEIGHT:.2g} times the weight."


def _errors(c: Comparison, names: list[str]) -> str:
    return ", ".join(_m(float(c.curves[k].errors[-1])) for k in names)


def _without_compounds(c: Comparison, looks: dict[str, Look]) -> str:
    """What sweeps over single vertices, the paper's, came to."""
    curve, seen = c.curves[SINGLE], looks[SINGLE]
    at = _balanced(curve)
    if at:
        return f"Sweeps over single vertices, the paper's, with its SOR, take {at} iterations to a thousandth."
    words = "Sweeps over single vertices, the paper's, with its SOR, leave"
    words += f" {curve.residuals[-1] / WEIGHT:.2g} times the weight"
    words += f" after {curve.iterations[-1]} iterations"
    if np.isfinite(curve.errors[-1]):
        words += f" and a vertex up to {_m(float(curve.errors[-1]))} from equilibrium"
    words += ", though no gap" if seen.gap <= GAP else f", and a gap of {_m(seen.gap)}"
    return words + ". With springs this stiff we do not find that they converge quickly, as the paper shows."


def _rows(c: Comparison, looks: dict[str, Look]) -> tuple[Row, ...]:
    rows = []
    for name, curve in c.curves.items():
        paper = "converges" if name == SINGLE else "-"
        if isinstance(c.solvers[name], XPBD):
            paper = "gap" if "flipped" in name else "stretched layer"
        at = _balanced(curve)
        seen = looks[name]
        remark = f"{curve.residuals[-1] / WEIGHT:.0e} of the weight after {curve.iterations[-1]} iterations and"
        remark += f" {curve.seconds[-1]:.2g} s, {_relative(c, name):.0e} of the force scale"
        remark += f"; a thousandth of the weight after {at}" if at else ""
        error = float(curve.errors[-1])
        remark += f"; position error {_m(error)}" if np.isfinite(error) else ""
        rows.append(Row(f"{name}: gap; stretch of the top layer", paper, _words(seen), remark))
    assert c.reference is not None
    rows.append(Row("equilibrium: gap; stretch of the top layer", "-", _words(looks[EQUILIBRIUM]), str(c.reference)))
    return tuple(rows)


def _words(seen: Look) -> str:
    return f"{_m(seen.gap)}; {seen.layer:.2f}"


def _m(length: float) -> str:
    for unit, size in (("m", 1.0), ("cm", 1e-2), ("mm", 1e-3)):
        if length >= 0.995 * size:
            return f"{length / size:.2g} {unit}"
    return f"{length * 1e6:.2g} µm" if length >= 1e-8 else "under 0.01 µm"


def _pictures(settings: Settings, c: Comparison, true: np.ndarray) -> tuple[Picture, ...]:
    from pbng.view import plot_residuals

    end = c.problem.end
    states = {name: State(c.problem, curve.x, end) for name, curve in c.curves.items()}
    states |= {START: State(c.problem, c.start.x, end), EQUILIBRIUM: State(c.problem, true, end)}
    shown = {name: name for name in (START, EQUILIBRIUM, "PBNG", SINGLE)}
    shown |= {f"{name}, {words}": f"{name}, {words[:6].strip(',')}" for name in ORDERS for words in (MORE, OWN)}
    wild = {EQUILIBRIUM: EQUILIBRIUM} | {f"{name}, {ROUGH}": f"{name}, 1 it." for name in ORDERS}
    tiles = []
    for file, names in (("blocks.png", shown), ("wild.png", wild)):
        chosen = {words: states[k] for k, words in names.items()}
        width = 230 * max(len(chosen), 6)  # [pixels]
        tiles.append(side_by_side(chosen, file_of(settings, file), width=width, azimuth=24.0, elevation=8.0))
    plots = []
    for what in ("iterations", "seconds"):
        series = {}
        for name, curve in c.curves.items():
            x = curve.iterations if what == "iterations" else curve.seconds
            series[name] = x[1:], curve.residuals[1:] / WEIGHT
        words = f"{what} (each method's own)" if what == "iterations" else "seconds of stepping"
        path, label = file_of(settings, f"{what}.png"), "residual / weight of a block"
        plots.append(plot_residuals(series, path, words, label, log_x=True, size=(7.6, 4.4)))
    return (
        Picture(
            tiles[0],
            "Final states, coloured by their largest principal stretch; green lines are springs. XPBD-QS with steps of"
            " 1/30 s and 10 iterations each, or of its own dt and 1 iteration.",
        ),
        Picture(
            tiles[1],
            "On a scale of their own: XPBD-QS with steps of 1/30 s and 1 iteration each.",
        ),
        Picture(plots[0], "Residual over the weight of a block, against iterations."),
        Picture(plots[1], "The same against seconds of stepping, set-up left out."),
    )
