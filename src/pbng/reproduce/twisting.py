"""What experiments with the twisting block share: its frames, equal seconds, pictures of states that may be lost."""

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numba
import numpy as np

from pbng.drivers import simulate
from pbng.gallery.twisting import DENSITY, NU, E, twisting_block
from pbng.materials.base import Material
from pbng.materials.corotated import Corotated
from pbng.problem import Problem
from pbng.reproduce.common import State
from pbng.reproduce.section import Settings
from pbng.solvers.base import Budget, Solver, Status
from pbng.solvers.loop import run
from pbng.solvers.multigrid import MultigridPBNG

DURATION = 2.0  # seconds that the motion of the twisting block takes
SELDOM = 10**9  # iterations between looks at the residual: at the start and the end of a frame only
SLACK = 1.05  # by which a budget of seconds may be overdrawn, the clock being no better
HOPELESS = 1 / 3  # part of the elements that is inverted where a run is given up
LOST = 0.01  # part of the elements that is inverted in a state that is no block any more
ROOM = 0.12  # of the size: how far around what is expected a picture reaches
CUT = 0.06  # of the size: what has flown off farther is drawn there
TILE, UNIT = (560, 420), 0.9  # a tile [pixels], and the size of its words


def block(n: int, model: type[Material] = Corotated) -> Problem:
    """The twisting block of the gallery with n³ vertices, of a material."""
    problem = twisting_block(n).scene.compile()
    if model is Corotated:
        return problem
    material = model(E=E, nu=NU, density=DENSITY)
    return replace(problem, groups=tuple(replace(group, material=material) for group in problem.groups))


def frames_at(fps: float) -> int:
    """Frames of the whole motion, the one at time 0 included."""
    return round(DURATION * fps) + 1


@lru_cache(maxsize=2)
def equilibria(n: int, fps: float, threads: int | None, model: type[Material] = Corotated) -> np.ndarray:
    """The converged frames (frames, n_vert, 3) [m] of :func:`block`; the last experiments' are kept."""
    budget = Budget(rtol=1e-6, iterations=60)
    frames = simulate(block(n, model), MultigridPBNG(threads=threads), budget, frames=frames_at(fps), fps=fps)
    return np.array([frame.x for frame in frames])


def unsolved(problem: Problem, truth: np.ndarray, fps: float) -> float:
    """Residual [N] of a frame that begins at the equilibrium of the one before, (frames, n_vert, 3) [m]: the median."""
    starts = [problem.residual(problem.constrain(x, (k + 1) / fps)) for k, x in enumerate(truth[:-1])]
    return float(np.median(starts))


def distances(positions: Mapping[int, np.ndarray], truth: np.ndarray) -> dict[int, float]:
    """Frame -> largest distance [m] of a vertex from where it belongs."""
    return {k: float(np.linalg.norm(x - truth[k], axis=1).max()) for k, x in positions.items()}


@dataclass(frozen=True)
class Pace:
    """How long a frame takes a method: ``start`` and ``each`` iteration [s]."""

    start: float
    each: float

    def seconds(self, iterations: int) -> float:
        """Time of a frame of so many iterations [s]."""
        return self.start + self.each * iterations

    def fit(self, seconds: float) -> int:
        """How many iterations fit into a frame of so many seconds [s], one at least."""
        return max(1, int((SLACK * seconds - self.start) / max(self.each, 1e-9)))


def paces(
    problem: Problem, solvers: Mapping[str, tuple[Solver, int, int]], truth: np.ndarray, fps: float, rounds: int
) -> dict[str, Pace]:
    """Time the methods in turn, round after round, on frames of the motion; medians.

    Args:
        problem: The block.
        solvers: Label -> solver and two numbers of iterations, between which its pace is found.
        truth: Converged frames (frames, n_vert, 3) [m]: each timed frame begins at one of them.
        fps: Frames a second [1/s].
        rounds: How many frames to time.
    """
    methods = {label: solver.set_up(replace(problem)) for label, (solver, _, _) in solvers.items()}
    spent: dict[str, list[tuple[float, float]]] = {label: [] for label in solvers}
    places = np.linspace(0, len(truth) - 2, rounds + 2)[1:-1].round().astype(int)
    for place in (places[0], *places):  # the first compiles and warms up
        x = problem.constrain(truth[place], (place + 1) / fps)
        for label, (_, few, more) in solvers.items():
            times = []
            for count in (few, more):
                done = run(methods[label], x, Budget(iterations=count, every=SELDOM), before=truth[place])
                times.append(done.seconds - done.monitor_seconds)
            spent[label].append((times[0], times[1]))
    out = {}
    for label, (_, few, more) in solvers.items():
        first, second = np.median(spent[label][1:], axis=0)
        each = max(float(second - first), 0.0) / (more - few) or float(second) / more
        out[label] = Pace(float(first) - few * each, each)
    return out


@dataclass(frozen=True, eq=False)
class Ride:
    """The frames after the first by one method, n of them: times ``t`` and ``seconds`` spent [s], ``starts`` and
    ``residuals`` [N] at their beginning and end, ``inverted`` elements, each (n,), and the last finite ``x``
    (n_vert, 3) [m]. It ends where the method diverges or leaves more than a third of the elements inverted, from where
    there is no way back.
    """

    t: np.ndarray
    seconds: np.ndarray
    starts: np.ndarray
    residuals: np.ndarray
    inverted: np.ndarray
    x: np.ndarray
    diverged: bool

    @property
    def ratios(self) -> np.ndarray:
        """Residuals over the median of those that frames begin with, (n,)."""
        return self.residuals / float(np.median(self.starts))


def ride(problem: Problem, solver: Solver, iterations: int, fps: float) -> Ride:
    """The whole motion, or what a method can do of it, in so many iterations a frame."""
    told, x, diverged = [], problem.X, False
    budget = Budget(iterations=iterations, every=SELDOM)
    for frame in simulate(problem, solver, budget, frames=frames_at(fps), fps=fps):
        r = frame.result
        if frame.index:
            told.append((frame.t, r.seconds - r.monitor_seconds, r.residuals[0], r.residual, r.inverted))
        x = frame.x if np.isfinite(frame.x).all() else x
        diverged = r.status is Status.DIVERGED or r.inverted > HOPELESS * problem.n_elem
        if diverged:
            break
    t, seconds, starts, residuals, inverted = np.array(told).T
    return Ride(t, seconds, starts, residuals, inverted.astype(int), np.asarray(x, float), diverged)


def converged(problem: Problem, x: np.ndarray, threads: int | None) -> np.ndarray:
    """The equilibrium near a state at the end of the motion, (n_vert, 3) [m]."""
    method = MultigridPBNG(dtype="float64", threads=threads).set_up(replace(problem))
    start = problem.residual(problem.constrain(problem.X, DURATION))  # of the whole motion in one step
    return run(method, problem.constrain(x, DURATION), Budget(atol=1e-9 * start, iterations=80)).x


def length(metres: float) -> str:
    """A length [m] in words."""
    return f"{metres * 1e3:.2g} mm" if metres < 0.0995 else f"{metres:.2g} m"


def ms(seconds: float) -> str:
    """A time [s] in words: milliseconds, or seconds where there are many."""
    if seconds < 0.9995:
        return f"{seconds * 1e3:.3g} ms"
    return f"{seconds:.2f} s" if seconds < 9.995 else f"{seconds:.0f} s"


def threads_of(settings: Settings) -> str:
    """On how many threads methods run."""
    return f"{settings.threads} threads" if settings.threads else f"up to {numba.get_num_threads()} threads"


def larger(fps: float) -> str:
    """A sentence on the steps between frames, where they are not the paper's."""
    return f" Steps between frames are {30 / fps:g} times as large as at 30 frames a second." if fps < 30 else ""


def sentence(words: str) -> str:
    """Words that begin with a capital letter."""
    return words[:1].upper() + words[1:]


def listed(words: Sequence[str]) -> str:
    """Several words as in a sentence."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


@dataclass(frozen=True, eq=False)
class Portrait:
    """A state to be shown.

    Attributes:
        words: What is written under it.
        problem: Whose state it is.
        x: Positions [m], (n_vert, 3); they need not be finite.
        fit: A state that is as expected, (n_vert, 3) [m]: it sets camera and colours.
        t: Time [s].
    """

    words: str
    problem: Problem
    x: np.ndarray
    fit: np.ndarray
    t: float = 0.0


def portraits(shown: Sequence[Portrait], path: Path, columns: int = 3) -> Path:
    """States side by side, in one frame and one scale of colours; returns the path.

    What has flown off is cut at the edge of the picture.
    """
    from PIL import Image

    from pbng.view.plots import caption, over
    from pbng.view.render import BAR, Artist, faded
    from pbng.view.surface import Motion

    low, high = (f([f(p.fit, axis=0) for p in shown], axis=0) for f in (np.min, np.max))
    size = float((high - low).max())
    room = ROOM * size * np.concatenate([np.eye(3), -np.eye(3)])
    artists: dict[int, Artist] = {}
    for p in shown:
        if id(p.problem) not in artists:
            motion = Motion.of([State(p.problem, p.fit + d) for d in room])
            artists[id(p.problem)] = Artist(motion, "stretch", None, 28.0, 20.0)
    bars = [a.paint.bar for a in artists.values() if a.paint.bar]
    scale = min(b[0] for b in bars), max(b[1] for b in bars)
    columns = min(columns, len(shown))
    width, height = TILE
    page = np.full((-(-len(shown) // columns) * height, columns * width + round(BAR * UNIT), 3), 255, np.uint8)
    with ExitStack() as stack:
        stages = {key: stack.enter_context(artist.stage(TILE, tile=True)) for key, artist in artists.items()}
        for k, p in enumerate(shown):
            artist, stage = artists[id(p.problem)], stages[id(p.problem)]
            artist.paint.bar = scale
            x = np.clip(np.where(np.isfinite(p.x), p.x, p.fit), low - CUT * size, high + CUT * size)
            image = faded(artist.draw(stage, State(p.problem, x, p.t), bar=False))
            row, column = k // columns * height, k % columns * width
            page[row : row + height, column : column + width] = over(image, caption(TILE, p.words, UNIT))
    artist = artists[id(shown[0].problem)]
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(artist.with_bar(page, UNIT)).save(path)
    return path
