"""How many threads to use: results do not depend on it, so it can be found out while running."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numba

from pbng.errors import InputError
from pbng.jit import compile_seconds

FIRST_PROBE, LAST_PROBE = 16, 512  # steps between trials of another number; doubled whenever a trial brings nothing
GAIN = 0.9  # a trial must be faster by this factor to be adopted


def check_threads(who: str, count: int | None) -> None:
    """InputError if there are not so many threads."""
    most = numba.config.NUMBA_NUM_THREADS
    if count is not None and not 1 <= count <= most:
        raise InputError(f"{who}: threads must lie between 1 and {most}, not {count}")


class Threads:
    """Runs steps with the number of threads that proves fastest, or with a fixed one.

    Every colour of a sweep ends in a barrier, so that one busy core makes all threads wait for a slice of the
    scheduler: two threads can then be ten times slower than one. Trials go up and down by factors of two.
    """

    def __init__(self, fixed: int | None = None, first: int = FIRST_PROBE) -> None:
        self.most = numba.get_num_threads() if fixed is None else fixed
        self.adaptive = fixed is None and self.most > 1
        self.count = self.most
        self.seconds = 0.0  # of a recent step with that many
        self.first = first  # steps before the first trial that follows a success
        self.wait, self.every = 1, first
        self.up = False

    @contextmanager
    def used(self, count: int | None = None) -> Iterator[None]:
        """Inside, Numba uses ``count`` threads, by default the number found best so far."""
        before = numba.get_num_threads()
        numba.set_num_threads(self.count if count is None else count)
        try:
            yield
        finally:
            numba.set_num_threads(before)

    @contextmanager
    def timed_step(self) -> Iterator[None]:
        """As :meth:`used`, for one of many like steps: now and then with another number, kept if it is faster."""
        trial = self._trial() if self.adaptive else self.count
        start, compiled = time.perf_counter(), compile_seconds()
        with self.used(trial):
            yield
        if self.adaptive and compile_seconds() == compiled:
            self._learn(trial, time.perf_counter() - start)

    def _trial(self) -> int:
        self.wait -= 1
        if self.wait >= 0 or self.seconds == 0.0:
            return self.count
        self.up = self.count == 1 or (self.count < self.most and not self.up)
        return min(2 * self.count, self.most) if self.up else max(self.count // 2, 1)

    def _learn(self, count: int, seconds: float) -> None:
        if count == self.count:
            self.seconds = seconds
        else:
            better = seconds < GAIN * self.seconds
            self.every = self.first if better else min(2 * self.every, LAST_PROBE)
            self.wait = self.every
            if better:
                self.count, self.seconds = count, seconds
