"""One equilibrium, with what touches found anew in rounds until it no longer changes."""

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pbng.contact.contacts import Contacts
from pbng.contact.detection import Beginning, Detector
from pbng.errors import InputError
from pbng.problem import Problem
from pbng.solvers.base import Budget, Method, Monitor, Result, Solver, Status
from pbng.solvers.loop import SAFETY, run
from pbng.solvers.pbng import PackedMethod

ROUNDS, LATELY = 100, 10  # in which contacts are found anew; of these, how many may bring nothing
SLOWEST = 0.9  # rate at which rounds are supposed to move less and less, at most
HOLD, MOST_HOLD, EASE = 1e-3, 0.1, 0.5  # of k_n: how contacts hold on at first, at most; by how much less each round
TIGHTEN = 10.0  # by how much more where a round begins farther from rest than the one before


@dataclass(frozen=True, eq=False)
class ContactReport:
    """What touched at the end of a frame.

    Attributes:
        pairs: Contacts between surfaces that resisted.
        walls: Vertices that touched a collider.
        deepest, mean: Penetration of those contacts [m]: what is missing of the distance that is kept.
        size: Diagonal of the bounding box of the scene at rest [m], to compare these with.
        vertices: Vertices in contact, ascending, (n,).
        recolored: Nodes that got another colour in the frame.
        repacked: Nodes laid out anew in the frame, in contact or beside those.
        detect_seconds, pack_seconds: Time [s] of the frame that finding contacts took, and colouring and packing.
        seconds: That of the whole frame [s].
    """

    pairs: int
    walls: int
    deepest: float
    mean: float
    size: float
    vertices: np.ndarray
    recolored: int
    repacked: int
    detect_seconds: float
    pack_seconds: float
    seconds: float


class Toucher:
    """Finds contacts for a method, step by step, and reports on them.

    Args:
        problem: A problem with contact.
        method: What solves it.
        before: Who did so until now, and knows what colliders bear.
    """

    def __init__(self, problem: Problem, method: Method, before: "Toucher | None" = None) -> None:
        assert problem.contact is not None
        if not isinstance(method, PackedMethod):
            raise InputError(f"scene {problem.name!r}: contact needs PBNG or MultigridPBNG")
        self.problem, self.method = problem, method
        self.detector = Detector(problem.contact, problem.X, problem.fixed)
        self.contacts = Contacts()
        self.size = float(np.linalg.norm(np.ptp(problem.X, axis=0)))
        self.checked = False
        self.inherited = before.method.borne() if before is not None else None
        self.began()

    def began(self) -> None:
        """A frame begins."""
        self.since, self.seconds = time.perf_counter(), 0.0
        self.before = self._work()

    def find(self, x0: np.ndarray, x1: np.ndarray, t0: float, t1: float, **options: Any) -> Contacts:
        """As :meth:`pbng.contact.detection.Detector.find`, timed."""
        start = time.perf_counter()
        with self.method.threads.used():
            if not self.checked:
                self.detector.check(x0, t0)
                self.checked = True
            borne = None
            if self.detector.rubs:
                borne = self.method.borne() if self.inherited is None else self.inherited
                self.inherited = None
            self.contacts = self.detector.find(x0, x1, t0, t1, borne=borne, **options)
        self.seconds += time.perf_counter() - start
        return self.contacts

    def start_of(self, contacts: Contacts, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Where a step begins: at x (n_vert, 3), or with what overlaps there moved apart, if that has less energy."""
        parted, x = contacts.parted(x, self.problem.fixed), contacts.put_outside(x)
        if parted is None:
            return x
        self.method.start(x, targets, contacts)
        return parted if self.method.lower(parted, x) else x

    def report(self, x: np.ndarray) -> ContactReport:
        """What touches at x (n_vert, 3), and what the frame took."""
        c = self.contacts
        clearance = c.clearance(x)
        touching = clearance < 0
        depth = -clearance[touching]
        walls = c.height(x) <= 1e-6 * self.size
        vertices = np.unique(np.concatenate([c.vertices[touching].ravel(), c.vertex[walls]]))
        recolored, repacked, packing = (b - a for a, b in zip(self.before, self._work()))
        return ContactReport(
            pairs=len(depth),
            walls=len(np.unique(c.vertex[walls])),
            deepest=float(depth.max(initial=0.0)),
            mean=float(depth.mean()) if len(depth) else 0.0,
            size=self.size,
            vertices=vertices,
            recolored=int(recolored),
            repacked=int(repacked),
            detect_seconds=self.seconds,
            pack_seconds=packing,
            seconds=time.perf_counter() - self.since,
        )

    def _work(self) -> tuple[float, float, float]:
        nodes = list(self.method.contact_nodes.values())
        return (
            sum(n.recolored for n in nodes), sum(n.repacked for n in nodes), sum(n.seconds for n in nodes)
        )  # fmt: skip


class Equilibria:
    """Equilibria at one time after another, each from the one before.

    Args:
        problem: What is solved, or what comes after it.
        solver: What solves it.
        x: Where to start from, (n_vert, 3) [m].
    """

    def __init__(self, problem: Problem, solver: Solver, x: np.ndarray) -> None:
        self.solver, self.x, self.t = solver, x, 0.0
        self.toucher: Toucher | None = None
        self._take(problem)

    def _take(self, problem: Problem) -> None:
        self.problem, self.method = problem, self.solver.set_up(problem)
        self.toucher = Toucher(problem, self.method, self.toucher) if problem.contact else None

    def at(self, t: float, budget: Budget, monitor: Monitor | None) -> tuple[Result, ContactReport | None]:
        """The equilibrium at time t [s], and what touches there."""
        if (problem := self.problem.at(t)) is not self.problem:
            self._take(problem)
        if self.toucher:
            self.toucher.began()
        result = equilibrium(self.method, self.toucher, self.x, self.t, t, budget, monitor)
        if result.status is not Status.INTERRUPTED:
            self.x, self.t = np.asarray(result.x, float), t
        return result, self.toucher.report(self.x) if self.toucher else None


def equilibrium(
    method: Method,
    toucher: Toucher | None,
    x: np.ndarray,
    t0: float,
    t: float,
    budget: Budget,
    monitor: Monitor | None = None,
) -> Result:
    """The equilibrium at time t [s], from the state x (n_vert, 3) at time t0.

    With contact, the solve goes in rounds: contacts are found at the state that the last round left, and their stencils
    and normals are those of that state until the next, which begins when vertices have moved farther than contacts were
    sought, or when the residual is met. It has converged when a round begins with a residual that meets the tolerance,
    or moves nothing by as much as the error that is asked for.
    """
    problem = method.problem
    placed, targets = problem.constrain(x, t), problem.targets(t)
    if toucher is None:
        return run(method, placed, budget, monitor, before=x, targets=targets)
    results: list[Result] = []
    left, state, start = budget, placed, x
    before: np.ndarray | None = x
    since: Beginning | None = None
    ahead, far, moved = toucher.size, toucher.detector.reach, [0.0]  # at first anything may come to touch
    hold = HOLD
    for _ in range(ROUNDS):
        contacts = toucher.find(start, state, t0, t, ahead=ahead, hold=hold, since=since)
        since = since or Beginning(x, t0, contacts)
        state = begun = contacts.put_outside(state)

        def leave(x: np.ndarray, begun: np.ndarray = begun) -> bool:
            return _most(begun, x) > far

        told = monitor and results and _continued(monitor, results)
        result = run(method, state, left, told or monitor, before, targets, contacts, bool(results), leave)
        results.append(result)
        left = _left(budget, results)
        settled = result.iterations == 0 and result.status is not Status.ITERATIONS
        now = np.asarray(result.x, float)
        if budget.error is not None and result.status is Status.CONVERGED:
            settled |= _most(state, now) <= budget.error / SAFETY
        if not result.status.ok or settled or result.status is Status.SECONDS or left.cap == 0:
            break
        if _stagnates([r.residuals[0] for r in results]):
            results[-1] = replace(result, status=Status.CONTACTS)
            break
        farther = len(results) > 2 and result.residuals[0] > results[-2].residuals[0]
        hold = min(TIGHTEN * hold, MOST_HOLD) if farther else EASE * hold
        moved.append(_most(state, now))
        state = start = now
        t0, before, ahead = t, None, far
    else:
        results[-1] = replace(results[-1], status=Status.CONTACTS)
    return joined(results, moved)


def _continued(monitor: Monitor, results: list[Result]) -> Monitor:
    """Tells a monitor of one round as of a part of the whole solve."""
    done, first, seconds = sum(r.iterations for r in results), results[0].residuals[0], sum(r.seconds for r in results)
    return lambda p: monitor(replace(p, iteration=done + p.iteration, first=first, seconds=seconds + p.seconds))


def _stagnates(first: list[float]) -> bool:
    """Whether the residuals that rounds began with no longer fall: contacts come and go."""
    recent, before = first[-LATELY:], first[1:-LATELY]
    return len(before) >= LATELY and min(recent) > 0.7 * min(before)


def _most(x: np.ndarray, now: np.ndarray) -> float:
    """How far the vertex has moved that moved most, from x (n_vert, 3) [m]."""
    return math.sqrt(((now - x) ** 2).sum(1).max(initial=0.0))


def _left(budget: Budget, results: list[Result]) -> Budget:
    """What rounds so far have left of a budget, its relative tolerance made absolute."""
    tolerance = budget.tolerance(results[0].residuals[0])
    seconds = None if budget.seconds is None else max(budget.seconds - sum(r.seconds for r in results), 0.0)
    return replace(
        budget,
        iterations=budget.cap - sum(r.iterations for r in results),
        seconds=seconds,
        rtol=None,
        atol=tolerance if tolerance >= 0 else None,
    )


def joined(results: list[Result], moved: list[float]) -> Result:
    """The results of successive rounds as one, of which each but the last has ``moved`` vertices by so much [m].

    To the error comes what further rounds may move, if they go on as the last did.
    """
    last = results[-1]
    if len(results) == 1:
        return last
    done = np.cumsum([0] + [r.iterations for r in results])
    unknown = SLOWEST if last.iterations else 0.0
    rate = min(moved[-1] / moved[-2], SLOWEST) if moved[-2] > 0 else unknown
    return replace(
        last,
        error=moved[-1] * rate / (1 - rate) + (last.error if last.iterations else results[-2].error),
        iterations=int(done[-1]),
        residuals=np.concatenate([r.residuals for r in results]),
        energies=np.concatenate([r.energies for r in results]),
        monitored=np.concatenate([r.monitored + d for r, d in zip(results, done)]),
        correction=next((r.correction for r in reversed(results) if r.iterations), 0.0),
        seconds=sum(r.seconds for r in results),
        monitor_seconds=sum(r.monitor_seconds for r in results),
    )
