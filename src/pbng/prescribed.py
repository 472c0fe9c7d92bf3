"""Prescribed vertices: what holds or moves them, until when, and where they are at a time."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from numbers import Real

import numpy as np

from pbng.errors import InputError
from pbng.motions import Motion


@dataclass(frozen=True, eq=False)
class Move:
    """What holds vertices from time 0 on until they are let go, and may move them.

    Attributes:
        who: What it is and of what, for messages: "pin of bar.where(x=0.0)".
        index: Its vertices, by number in the scene, ascending, (k,).
        motion: How they move; None if they do not.
        start: Time [s] at which they begin to.
        over: Seconds [s] that the motion takes; 0 at once.
        until: Time [s] at which they are let go, or, if something else holds them still, at which the motion stops.

    Raises:
        InputError: A time is no number, or is negative, or ``until`` is not after the start.
    """

    who: str
    index: np.ndarray
    motion: Motion | None
    start: float = 0.0
    over: float = 0.0
    until: float = math.inf

    def __post_init__(self) -> None:
        if not all(isinstance(s, Real) and 0 <= s < math.inf for s in (self.over, self.start)):
            raise InputError(
                f"{self.who}: over and start must be finite and not negative, not {self.over!r} and {self.start!r}"
            )
        if not (isinstance(self.until, Real) and self.until > self.start):
            wanted = f"later than its start, {self.start:g} s" if self.start > 0 else "positive"
            raise InputError(f"{self.who}: until must be {wanted}, not {self.until!r}")

    @property
    def end(self) -> float:
        """Time [s] after which it changes nothing."""
        own = 0.0 if self.motion is None else self.motion.end
        return self.until if self.until < math.inf else max(self.start + self.over, own)

    def at(self, x: np.ndarray, t: float) -> np.ndarray:
        """Where its vertices are at time t [s] that were at x (k, 3) [m] when it began."""
        t = min(t, self.until)
        if self.motion is None or t < self.start:
            return x
        s = 1.0 if self.over == 0 else min((t - self.start) / self.over, 1.0)
        return self.motion.at(x, x.mean(0), s, t)


def check_clash(move: Move, others: Iterable[Move]) -> None:
    """Moves of the same vertices follow upon each other; those that share only some must come one after the other.

    Raises:
        InputError: The move shares only some vertices with another, and neither lets go before the other starts.
    """
    mine = np.zeros(move.index.max() + 1, bool)
    mine[move.index] = True
    for other in others:
        if move.until <= other.start or other.until <= move.start:
            continue
        shared = int(mine[other.index[: np.searchsorted(other.index, len(mine))]].sum())
        if shared and not (shared == len(move.index) == len(other.index)):
            raise InputError(
                f"{move.who}: {shared} of its {len(move.index)} vertices are also of the {other.who}, which has"
                f" {len(other.index)}; select the same vertices, none in common, or let one go before the other starts"
            )


class Prescribed:
    """Positions of held vertices as a function of time [s]: ``(n_held, 3)`` [m], in order of index.

    Moves take place in order of their start, each from where those before have left its vertices.

    Args:
        X: Rest positions [m] of all vertices, (n, 3).
        moves: Those that hold them, and those that have let them go to others.
        held: Which vertices are held, (n,) bool.
    """

    def __init__(self, X: np.ndarray, moves: Sequence[Move], held: np.ndarray) -> None:
        self.X, self.index = X, np.flatnonzero(held)
        self.moves: list[Move] = []
        needed = held.copy()  # a move turns about the centroid of all its vertices, so where each is counts
        for move in sorted(moves, key=lambda m: m.start)[::-1]:
            if move.motion is not None and needed[move.index].any():
                needed[move.index] = True
                self.moves.insert(0, move)

    @property
    def end(self) -> float:
        """Time [s] after which nothing moves."""
        return max((m.end for m in self.moves), default=0.0)

    def __call__(self, t: float) -> np.ndarray:
        x = self.X.copy()
        for move in self.moves:
            x[move.index] = move.at(x[move.index], t)
        return x[self.index]


def phases(X: np.ndarray, moves: Sequence[Move]) -> list[tuple[float, np.ndarray, Prescribed]]:
    """From when on [s] which vertices (n,) are held, and where they are; the first phase begins at 0.

    Args:
        X: Rest positions [m], (n, 3).
        moves: What holds vertices.
    """
    found: list[tuple[float, np.ndarray, Prescribed]] = []
    for t in sorted({0.0, *(float(m.until) for m in moves if m.until < math.inf)}):
        held = np.zeros(len(X), bool)
        for move in moves:
            if move.until > t:
                held[move.index] = True
        if not found or (held != found[-1][1]).any():
            found.append((t, held, Prescribed(X, moves, held)))
    return found
