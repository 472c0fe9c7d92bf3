"""How a kernel calls the functions of whatever elements and materials a problem holds.

A *term* is an element kind together with a material model. A kernel is made for a tuple of terms, which it knows by a
string, its key (see :mod:`pbng.jit`); where it calls ``term_sweep(key, k, ...)``, Numba's overload resolution replaces
the call by one branch a term, and everything is inlined. One kernel thus serves a mesh of several materials, and a
user's material costs what a built-in of the same arithmetic costs.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from numba.extending import overload

from pbng.elements.base import ElementKind
from pbng.jit import FLAGS, fingerprint, inline
from pbng.materials.base import Model


class Term(NamedTuple):
    """An element kind with a material model."""

    kind: ElementKind
    model: Model


_TERMS: dict[str, tuple[Term, ...]] = {}


@cache
def specialised(make: Callable[[str], Any], terms: tuple[Term, ...]) -> Any:
    """The kernel ``make(key)`` for these terms; compiled on first use, then loaded from Numba's cache."""
    parts = [fingerprint(make)]
    for kind, model in terms:
        parts.append(f"{kind.name}:{model.name}:{model.fingerprint}:{kind.fingerprint(model)}")
    key = "|".join(parts)
    _TERMS[key] = terms
    return make(key)


def _chain(functions: list[Any]) -> Any:
    """``call(k, arguments)`` that runs the k-th function: an if-chain, built from its end."""
    call = None
    for k, function in reversed(list(enumerate(functions))):
        call = _link(k, function, call)
    return call


def _link(k: int, function: Any, otherwise: Any) -> Any:
    if otherwise is None:
        return inline(lambda i, arguments: function(*arguments))

    @inline
    def call(i, arguments):
        if i == k:
            return function(*arguments)
        return otherwise(i, arguments)

    return call


def term_pack(key, k, arguments):
    """Write one incidence into the packed layout; see ``ElementKind.pack``."""
    raise TypeError("called from compiled code only")


def term_sweep(key, k, arguments):
    """Add rows of incidences to a block's forces and Hessians; see ``ElementKind.sweep``."""
    raise TypeError("called from compiled code only")


def term_energy(key, k, arguments):
    """Energy of a block of elements; see ``ElementKind.energy``."""
    raise TypeError("called from compiled code only")


def term_forces(key, k, arguments):
    """Energy and corner forces of a block of elements; see ``ElementKind.forces``."""
    raise TypeError("called from compiled code only")


def _overload(stub: Any, name: str) -> None:
    @overload(stub, prefer_literal=True, jit_options={"forceinline": True, **FLAGS})
    def resolve(key, k, arguments):
        functions = [getattr(kind, name)(model) for kind, model in _TERMS[key.literal_value]]
        if len(functions) == 1:
            (only,) = functions
            return lambda key, k, arguments: only(*arguments)
        call = _chain(functions)
        return lambda key, k, arguments: call(k, arguments)


for _stub, _name in ((term_pack, "pack"), (term_sweep, "sweep"), (term_energy, "energy"), (term_forces, "forces")):
    _overload(_stub, _name)
