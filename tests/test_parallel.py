"""The one parallel driver: every index once, ranges in turn, and scratch on a cache line."""

import numba
import numpy as np
import pytest

from pbng import parallel
from pbng.parallel import array, body, rows, run, scratch


@body
def _count(arguments, low, high):
    """Count the visits of each index, and note the length of the piece that it came with."""
    count, length = array(arguments, 0, np.int64), array(arguments, 1, np.int32)
    for i in range(low, high):
        count[i] += 1
        length[i] = high - low


@body
def _after(arguments, low, high):
    """What the range before has left, plus one."""
    x, n = array(arguments, 0, np.float64), array(arguments, 1, np.int64)[0]
    for i in range(low, high):
        mirror = (i // n) * n - 1 - i % n  # in the range before, and in another piece of it
        x[i] = x[mirror] + 1


@body
def _through_scratch(arguments, low, high):
    """Copy rows by way of the stack, and note where that is."""
    source, target = rows(arguments, 0, 3, np.float32), rows(arguments, 1, 3, np.float64)
    address = array(arguments, 2, np.int64)
    real, whole = scratch(3, np.float32), scratch(5, np.int64)
    for i in range(low, high):
        for k in range(3):
            real[k] = source[i, k]
        for k in range(5):
            whole[k] = i
        for k in range(3):
            target[i, k] = real[k] + whole[k]
        address[2 * i], address[2 * i + 1] = real.ctypes.data, whole.ctypes.data


@pytest.fixture(params=[1, 2])
def threads(request):
    if request.param > numba.config.NUMBA_NUM_THREADS:
        pytest.skip("one thread only")
    before = numba.get_num_threads()
    numba.set_num_threads(request.param)
    yield request.param
    numba.set_num_threads(before)


@pytest.mark.parametrize("grain", [1, 2, 7, 64, 1000])
def test_each_index_once(threads, grain):
    """Every index of the chosen ranges is visited once, in pieces of at most the grain; no other one is."""
    start = np.array([0, 0, 1, 40, 40, 247, 300])
    for sets in ([0, 1, 2, 3, 4, 5], [4], [5, 2], [3], []):
        count, length = np.zeros(300, np.int64), np.zeros(300, np.int32)
        run(_count, (count, length), np.array(sets, np.int64), start, grain)
        expected = np.zeros(300, np.int64)
        for s in sets:
            expected[start[s] : start[s + 1]] = 1
        np.testing.assert_array_equal(count, expected)
        assert length.max(initial=0) <= grain
        for s in sets:
            size = start[s + 1] - start[s]
            whole = size // grain * grain
            np.testing.assert_array_equal(length[start[s] :][:whole], grain)
            np.testing.assert_array_equal(length[start[s] :][whole:size], size - whole)


def test_a_range_may_be_taken_twice(threads):
    count = np.zeros(10, np.int64)
    run(_count, (count, np.zeros(10, np.int32)), np.array([0, 1, 0]), np.array([0, 4, 10]))
    np.testing.assert_array_equal(count, [2] * 4 + [1] * 6)


def test_ranges_follow_upon_each_other(threads):
    """A range sees all that the one before it has written, also what other threads have."""
    n, m = 1000, 50
    x = np.zeros(n * (m + 1))
    run(_after, (x, np.array([n])), np.arange(m), n * np.arange(1, m + 2), 10)
    np.testing.assert_array_equal(x.reshape(m + 1, n), np.repeat(np.arange(m + 1.0)[:, None], n, axis=1))


def test_scratch_is_each_calls_own(threads):
    """Threads do not share scratch, arrays of it do not overlap, and each begins at a cache line."""
    n = 5000
    source = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    target, address = np.zeros((n, 3)), np.zeros((n, 2), np.int64)
    run(_through_scratch, (source, target, address), np.array([0]), np.array([0, n]), 100)
    np.testing.assert_array_equal(target, source + np.arange(n)[:, None])
    np.testing.assert_array_equal(address % 64, 0)
    assert np.abs(address[:, 0] - address[:, 1]).min() >= 40


def test_addresses_are_those_of_the_data():
    for a in (np.arange(5.0), np.arange(6.0).reshape(2, 3)[1:], np.empty(0), np.zeros((3, 0), np.int32)):
        assert parallel._word(id(a) + parallel._HEAD).value == a.__array_interface__["data"][0]
