"""The number of threads is found while running (solvers/threads.py)."""

import numba
import pytest

from pbng.solvers import threads
from pbng.solvers.threads import Threads


@pytest.fixture
def clock(monkeypatch):
    """A machine whose steps take the time that ``cost[count]`` says."""

    class Clock:
        def __init__(self):
            self.now, self.cost = 0.0, {}

        def run(self, team, steps):
            used = []
            for _ in range(steps):
                with team.timed_step():
                    used.append(numba.get_num_threads())
                    self.now += self.cost[used[-1]]
            return used

    c = Clock()
    monkeypatch.setattr(threads.time, "perf_counter", lambda: c.now)
    return c


needs_two = pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one thread only")


@needs_two
def test_all_threads_are_kept_where_they_are_fastest(clock):
    clock.cost = {1: 2.0, 2: 1.0}
    numba.set_num_threads(2)
    used = clock.run(Threads(), 300)
    assert used[0] == 2
    assert used.count(1) <= 6
    assert used[-1] == 2


@needs_two
def test_a_busy_core_is_noticed_and_its_return_too(clock):
    clock.cost = {1: 1.0, 2: 9.0}
    numba.set_num_threads(2)
    team = Threads()
    used = clock.run(team, 200)
    assert used[:2] == [2, 1]
    assert used.count(2) <= 6
    clock.cost = {1: 1.0, 2: 0.5}
    assert clock.run(team, 1000)[-1] == 2


@needs_two
def test_a_fixed_number_is_obeyed(clock):
    clock.cost = {1: 9.0, 2: 1.0}
    assert set(clock.run(Threads(1), 50)) == {1}


@needs_two
def test_the_number_outside_is_left_alone(clock):
    clock.cost = {1: 1.0, 2: 9.0}
    numba.set_num_threads(2)
    clock.run(Threads(), 5)
    assert numba.get_num_threads() == 2
