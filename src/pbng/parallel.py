"""Parallel loops over compiled functions: one driver for all, so that a new function is compiled as serial code only.

Numba spends about as long on a parallel loop as on the code inside it. A *body* is therefore a serial function
``(arguments, low, high)`` that does the work of a range; the driver, compiled once and cached, calls it by its address.
Arrays go as addresses too: :func:`array` and :func:`rows` make them arrays again inside the body.

A body that is not made by :func:`pbng.dispatch.specialised`, and what is ``serial``, is cached by its own file alone:
after a change of helpers in another file, as this one, ``linalg``, ``spectral`` or those of contact, ``make clean``
removes what is stale.
"""

import ctypes
from functools import cache
from typing import Any

import numpy as np
from llvmlite import ir
from numba import carray, njit, prange, types
from numba.core import cgutils
from numba.extending import intrinsic, overload
from numba.np.arrayobj import populate_array

from pbng.jit import FLAGS, kernel

body = njit(cache=True, no_cpython_wrapper=True, **FLAGS)
_SIGNATURE = types.CPointer(types.intp), types.intp, types.intp
_ENDLESS = 1 << 40  # lengths are not passed: bodies know how far they may go
# In NumPy's C interface the address of the data follows the head of the object: read there it costs a seventh of asking
# the array for it, and a small scene asks a thousand times a step.
_HEAD, _word = object.__basicsize__, ctypes.c_ssize_t.from_address
_ONLY_SET = np.zeros(1, np.int64)


def run(body: Any, arrays: tuple[np.ndarray, ...], sets: np.ndarray, start: np.ndarray, grain: int = 1) -> None:
    """Call a body for the ranges ``start[s] .. start[s + 1]`` with s from ``sets`` in turn, each range in parallel.

    Args:
        body: The compiled function.
        arrays: What it works on, contiguous and of just the types that it declares: nobody checks.
        sets, start: Which ranges; nothing may be written that another call of the same range reads or writes.
        grain: Length of the pieces of a range that are given to threads.
    """
    assert all(a.flags.c_contiguous for a in arrays), "arrays of parallel bodies must be contiguous"
    _run(address(body), np.array([_word(id(a) + _HEAD).value for a in arrays]), sets, start, grain)


def each(body: Any, arrays: tuple[np.ndarray, ...], n: int, grain: int = 1) -> None:
    """Call a body for the range 0 .. n, in parallel; as :func:`run`."""
    run(body, arrays, _ONLY_SET, np.array([0, n]), grain)


@cache
def address(body: Any) -> int:
    """Where the machine code of a body is, for :func:`call_at`; compiled if need be."""
    compiled = body.overloads.get(_SIGNATURE)
    if compiled is None:
        body.compile(_SIGNATURE)
        compiled = body.overloads[_SIGNATURE]
    return int(compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name))


@intrinsic
def array(typing, arguments, j, dtype):
    """Argument j of a body as a flat array."""
    return _view(dtype, 1)(arguments, j, dtype), lambda context, builder, signature, values: _make(
        context, builder, signature.return_type, values, ()
    )


@intrinsic
def rows(typing, arguments, j, columns, dtype):
    """Argument j of a body as an array of rows."""
    return _view(dtype, 2)(arguments, j, columns, dtype), lambda context, builder, signature, values: _make(
        context, builder, signature.return_type, values, (values[2],)
    )


def _view(dtype: Any, dimensions: int) -> types.Array:
    return types.Array(dtype.instance_type, dimensions, "C")


def _make(context: Any, builder: Any, kind: types.Array, values: Any, columns: tuple[Any, ...]) -> Any:
    """Code for an array of a type at the address that is the argument; an intrinsic compiles faster than carray."""
    size = context.get_abi_sizeof(context.get_data_type(kind.dtype))
    word = context.get_value_type(types.intp)
    address = builder.load(builder.gep(values[0], [values[1]]))
    made = context.make_array(kind)(context, builder)
    shape = (ir.Constant(word, _ENDLESS), *columns)
    strides = (*(builder.mul(c, ir.Constant(word, size)) for c in columns), ir.Constant(word, size))
    data = builder.inttoptr(address, made.data.type)
    populate_array(made, data=data, shape=shape, strides=strides, itemsize=ir.Constant(word, size), meminfo=None)
    return made._getvalue()


def scratch(n, dtype):
    """n numbers on the stack of a body, at a cache line, not initialised; n must be a constant.

    On the stack, LLVM knows that nothing else points there; and asking for a whole line makes it align the stack, where
    it puts what registers cannot hold, which otherwise straddles lines in some processes and not in others.
    """
    raise TypeError("called from compiled code only")


@overload(scratch, prefer_literal=True, jit_options={"forceinline": True, **FLAGS})
def _(n, dtype):
    if not isinstance(n, types.IntegerLiteral):
        return None
    length, real = n.literal_value, dtype.instance_type

    @intrinsic
    def allocate(typing):
        def generate(context, builder, signature, values):
            place = cgutils.alloca_once(builder, ir.ArrayType(context.get_data_type(real), length))
            place.align = 64
            return builder.bitcast(place, context.get_value_type(types.CPointer(real)))

        return types.CPointer(real)(), generate

    return lambda n, dtype: carray(allocate(), (length,))


@intrinsic
def call_at(typing, function, arguments, low, high):
    """Call a body at an address; ``arguments`` is the address of the addresses of its arrays."""

    def generate(context, builder, signature, values):
        word = ir.IntType(context.address_size)
        pointer = ir.FunctionType(ir.VoidType(), [word, word, word]).as_pointer()
        builder.call(builder.inttoptr(values[0], pointer), values[1:])
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, types.intp, types.intp), generate


@kernel
def _run(function, arguments, sets, start, grain):
    for n in range(sets.size):
        low, high = start[sets[n]], start[sets[n] + 1]
        for piece in prange((high - low + grain - 1) // grain):
            first = low + piece * grain
            call_at(function, arguments.ctypes.data, first, min(high, first + grain))
