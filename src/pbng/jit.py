"""How pbng compiles: flags, inlined helpers, cached kernels and kernels specialised to the materials of a problem.

Numba caches a compiled kernel on disk, but its cache has two gaps that matter here: it does not notice a change in a
function that the kernel calls from another file, and it never hits when a kernel receives or closes over another
compiled function. Both are closed by giving a kernel one string in place of functions: a *key* that names what to call
and carries a fingerprint of everything reachable. A string in a closure is part of Numba's cache index and a literal
type at compile time, so that :func:`pbng.dispatch.call` can find the functions by it.
"""

import hashlib
import logging
import os
import sys
import time
import types
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numba.core import event

log = logging.getLogger("pbng")

# Numba stores this name for functions made in no module, and imports it when it loads a cached kernel.
sys.modules.setdefault("<dynamic>", types.ModuleType("<dynamic>"))

# GNU OpenMP spins for long at the barrier behind every colour; on a core that other work wants, that costs a slice of
# the scheduler each time. It reads this when the first parallel kernel runs.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

# Reassociation and contraction let LLVM vectorise sums; NaN and infinity keep their meaning (no "nnan", "ninf").
FLAGS: dict[str, Any] = {
    "fastmath": {"nsz", "arcp", "contract", "afn", "reassoc"},
    "error_model": "numpy",
}

# A helper that vanishes into the kernel that calls it; Python cannot call it, which makes it compile faster by a fifth.
inline = njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **FLAGS)
# The same, cached: only for helpers that call none from other files, whose changes Numba's cache would not notice.
leaf = njit(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, cache=True, **FLAGS)
function = njit(forceinline=True, **FLAGS)  # an inlined helper that Python can call too
kernel = njit(parallel=True, cache=True, **FLAGS)  # a module-level parallel loop, cached on disk
serial = njit(cache=True, error_model="numpy")  # a module-level serial loop, cached on disk


_FOREIGN = ("numba", "numpy", "math", "builtins")  # what Numba compiles by name


def fingerprint(*functions: Callable[..., Any]) -> str:
    """Hash of the byte code and constants of functions and of everything of pbng's or the user's that they call."""
    digest = hashlib.sha256()
    seen: set[int] = set()
    for function in functions:
        _feed(digest, function, seen)
    return digest.hexdigest()[:16]


def _feed(digest: Any, value: Any, seen: set[int]) -> None:
    value = getattr(value, "py_func", value)
    if isinstance(value, types.FunctionType):
        if id(value) in seen or (value.__module__ or "").partition(".")[0] in _FOREIGN:
            return
        seen.add(id(value))
        module = value.__module__ or ""
        digest.update(module.encode())  # Numba imports the module that a cached kernel came from
        if module.partition(".")[0] == "pbng":  # its file may hold overloads, which no byte code refers to
            digest.update(_file_hash(value.__code__.co_filename))
        _feed(digest, value.__code__, seen)
        names = sorted(_names(value.__code__))
        for name in names:
            _feed_named(digest, value.__globals__.get(name), names, seen)
        for cell in value.__closure__ or ():
            _feed(digest, cell.cell_contents, seen)
    elif isinstance(value, types.CodeType):
        digest.update(value.co_code)
        digest.update(repr(value.co_names).encode())
        for constant in value.co_consts:
            _feed(digest, constant, seen)
    elif isinstance(value, tuple):
        for item in value:
            _feed(digest, item, seen)
    elif isinstance(value, np.ndarray):
        digest.update(repr((value.dtype, value.shape)).encode() + value.tobytes())
    elif isinstance(value, bool | int | np.generic | float | complex | str | bytes | type(None) | frozenset):
        digest.update(repr(sorted(value, key=repr) if isinstance(value, frozenset) else value).encode())
    # Classes are named by the code that uses them.


def _feed_named(digest: Any, value: Any, names: list[str], seen: set[int]) -> None:
    """Feed a value, or of a module whatever the code may mean by ``module.name``."""
    if not isinstance(value, types.ModuleType):
        _feed(digest, value, seen)
    elif value.__name__.partition(".")[0] not in _FOREIGN and id(value) not in seen:
        seen.add(id(value))
        for name in names:
            _feed_named(digest, getattr(value, name, None), names, seen)


@cache
def _file_hash(path: str) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


def _names(code: types.CodeType) -> set[str]:
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            names |= _names(constant)
    return names


class _Announcer(event.Listener):
    """Logs when pbng kernels are really compiled (a load from the cache raises no event), with the time it took."""

    def __init__(self) -> None:
        self.depth = 0
        self.announced = False
        self.start = 0.0
        self.seconds = 0.0

    def on_start(self, event: Any) -> None:
        if self.depth == 0:
            self.start = time.perf_counter()
            if not self.announced and _is_kernel(event):
                log.warning("pbng: compiling kernels (once; the result is cached) ...")
                self.announced = True
        self.depth += 1

    def on_end(self, event: Any) -> None:
        self.depth -= 1
        if self.depth == 0:
            self.seconds += time.perf_counter() - self.start


def _is_kernel(event: Any) -> bool:
    function = getattr(event.data.get("dispatcher"), "py_func", None)
    return getattr(function, "__module__", "").startswith("pbng")


_announcer = _Announcer()
event.register("numba:compile", _announcer)


def compile_seconds() -> float:
    """Seconds [s] that this process has spent compiling kernels so far."""
    return _announcer.seconds
