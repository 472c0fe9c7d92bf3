"""How a kernel calls the functions of whatever elements and materials a problem holds.

A kernel is made for a tuple of functions, one a term (an element kind with a material model), which it knows by a
string, their key (see :mod:`pbng.jit`). Where it says ``call(key, k, arguments)``, Numba's overload resolution puts one
branch a function in place, and everything is inlined. One kernel thus serves a mesh of several materials, and a user's
material costs what a built-in of the same arithmetic costs.
"""

from collections.abc import Callable, Hashable
from functools import cache
from typing import Any

from numba.core.types import StringLiteral
from numba.extending import overload

from pbng.jit import FLAGS, fingerprint, inline

_FUNCTIONS: dict[str, tuple[Any, ...]] = {}


@cache
def specialised(make: Callable[..., Any], functions: tuple[Any, ...], *further: Hashable) -> Any:
    """The kernel ``make(key, *further)`` that calls these functions; compiled on first use, then loaded from the cache.

    ``further`` are constants of the kernel, such as the type of real numbers.
    """
    key = "-".join(fingerprint(f) for f in (make, *functions))
    _FUNCTIONS[key] = functions
    return make(key, *further)


def call(key, k, arguments):
    """The k-th function of the kernel's key, called with a tuple of arguments."""
    raise TypeError("called from compiled code only")


@overload(call, prefer_literal=True, jit_options={"forceinline": True, **FLAGS})
def _(key, k, arguments):
    if not isinstance(key, StringLiteral):
        return None  # Numba also tries the plain type when a function does not compile
    functions = _FUNCTIONS[key.literal_value]
    if len(functions) == 1:
        (only,) = functions
        return lambda key, k, arguments: only(*arguments)
    chosen = _chain(functions)
    return lambda key, k, arguments: chosen(k, arguments)


def _chain(functions: tuple[Any, ...]) -> Any:
    """``(k, arguments)`` that runs the k-th function: an if-chain, built from its end."""
    last = functions[-1]
    chosen = inline(lambda i, arguments: last(*arguments))
    for k, function in reversed(list(enumerate(functions[:-1]))):
        chosen = _link(k, function, chosen)
    return chosen


def _link(k: int, function: Any, otherwise: Any) -> Any:
    @inline
    def chosen(i, arguments):
        if i == k:
            return function(*arguments)
        return otherwise(i, arguments)

    return chosen
