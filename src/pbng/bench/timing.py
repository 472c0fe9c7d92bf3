"""Timing on a noisy machine: contestants take turns, round after round, and the median and the best are kept."""

import platform
import resource
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pbng.compare.machine import machine as machine


def interleaved(contestants: dict[str, Callable[[], Any]], rounds: int, calls: int = 1) -> dict[str, np.ndarray]:
    """Seconds a call [s] of each contestant, (rounds,): each round runs all of them, ``calls`` times in a row."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for call in contestants.values():
        call()  # compile and warm up
    for _ in range(rounds):
        for name, call in contestants.items():
            start = time.perf_counter()
            for _ in range(calls):
                call()
            seconds[name].append((time.perf_counter() - start) / calls)
    return {name: np.array(s) for name, s in seconds.items()}


def peak_memory() -> float:
    """Largest memory this process has used [bytes]."""
    scale = 1 if platform.system() == "Darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale)
