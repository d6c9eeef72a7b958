"""How vectors compile: each function of `vectors` as the LLVM instructions that stand for it.

A vector is a numba type whose values are LLVM vectors, so that it stays in a register. Vectors
exist in compiled code alone: no function that Python calls takes or returns one. What this relies
on in numba and llvmlite, and what breaks it, is in ``docs/simd.md``.

Ref: LLVM Language Reference Manual, "Vector Operations"; numba manual, "Low-level extension API".
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from recon.stereo.kernels.simd.vectors import (
    LANES,
    absolute_difference,
    broadcast_smallest,
    differing_bits,
    larger,
    load,
    load_row,
    mean,
    narrow,
    put_after,
    put_before,
    ramp,
    smaller,
    splat,
    store,
    store_row,
    where_equal,
    where_less,
    widen,
)


class _Vector(types.Type):  # type: ignore[misc]
    """Numba's type of a vector with elements of some integer type."""

    def __init__(self, element: types.Integer) -> None:
        self.element = element
        super().__init__(name=f"Vector({element} x {LANES})")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    """Represents a vector by LLVM's vector type."""

    def __init__(self, manager: Any, vector: _Vector) -> None:
        super().__init__(manager, vector, llvm_type(vector.element.bitwidth))


def llvm_type(bits: int, lanes: int = LANES) -> ir.VectorType:
    """Return LLVM's type of a vector of so many bits a lane."""
    return ir.VectorType(ir.IntType(bits), lanes)


def compiled_as(function: Callable[..., Any], typer: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function that emits LLVM instructions in place of a function of vectors.

    Args:
        function: The function in plain numpy.
        typer: Gives the type of its result, from those of its arguments.
    """
    type_callable(function)(lambda context: typer)
    return lower_builtin(function, types.VarArg(types.Any))  # type: ignore[no-any-return]


def _binary(function: Callable[..., Any], write: Callable[..., Any]) -> None:
    """Register a function of two vectors of one kind."""

    def typer(a: Any, b: Any) -> Any:
        return a if isinstance(a, _Vector) and a == b else None

    type_callable(function)(lambda context: typer)
    # For vectors alone: operators keep their other meanings.
    lower_builtin(function, _Vector, _Vector)(
        lambda context, builder, signature, arguments: write(builder, *arguments)
    )


def _intrinsic(name: str) -> Callable[..., Any]:
    """Emits a call of one of LLVM's intrinsic functions of two vectors."""

    def write(builder: Any, a: Any, b: Any) -> Any:
        kind = ir.FunctionType(a.type, [a.type, a.type])
        full_name = f"llvm.{name}.v{a.type.count}i{a.type.element.width}"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, full_name), [a, b])

    return write


def _write_difference(builder: Any, a: Any, b: Any) -> Any:
    # Saturating differences in either order: one of the two is zero.
    minus = _intrinsic("usub.sat")
    return builder.or_(minus(builder, a, b), minus(builder, b, a))


def _write_mean(builder: Any, a: Any, b: Any) -> Any:
    wide = llvm_type(16)
    one = ir.Constant(wide, [1] * LANES)
    total = builder.add(builder.add(builder.zext(a, wide), builder.zext(b, wide)), one)
    return builder.trunc(builder.lshr(total, one), a.type)


def _write_differing(builder: Any, a: Any, b: Any) -> Any:
    kind, name = ir.FunctionType(a.type, [a.type]), f"llvm.ctpop.v{LANES}i8"
    count = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(count, [builder.xor(a, b)])


_binary(operator.add, lambda builder, a, b: builder.add(a, b))
_binary(operator.sub, lambda builder, a, b: builder.sub(a, b))
_binary(operator.mul, lambda builder, a, b: builder.mul(a, b))
_binary(operator.rshift, lambda builder, a, b: builder.lshr(a, b))
_binary(mean, _write_mean)
_binary(differing_bits, _write_differing)
_binary(smaller, _intrinsic("umin"))
_binary(larger, _intrinsic("umax"))
_binary(absolute_difference, _write_difference)


def _write_splat(builder: Any, value: Any, lanes: int) -> Any:
    kind = llvm_type(value.type.width, lanes)
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(llvm_type(32, lanes), [0] * lanes))


def _address(context: Any, builder: Any, signature: Any, arguments: Any, kind: Any) -> Any:
    """Return address, as of some type, of an element: arguments are the array and the index."""
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.bitcast(builder.gep(array.data, [arguments[1]]), kind.as_pointer())


def address_in_row(context: Any, builder: Any, signature: Any, arguments: Any, kind: Any) -> Any:
    """Address, as of some type, of an element: arguments are the array, the row and the column."""
    rows = context.make_array(signature.args[0])(context, builder, arguments[0])
    n, at = (
        context.cast(builder, value, given, types.intp)
        for value, given in zip(arguments[1:3], signature.args[1:3], strict=True)
    )
    start = builder.add(builder.mul(n, builder.extract_value(rows.shape, 1)), at)
    return builder.bitcast(builder.gep(rows.data, [start]), kind.as_pointer())


def type_in_row(rows: Any, n: Any, at: Any) -> Any:
    """Return the type of a vector in an array of rows; None = the array does not fit."""
    # The address is computed for a C-ordered array.
    fits = isinstance(rows, types.Array) and rows.ndim == 1 + 1 and rows.layout == "C"
    return _Vector(rows.dtype) if fits else None


def _store_type(rows: Any, n: Any, at: Any, lanes: Any) -> Any:
    return types.none if lanes == type_in_row(rows, n, at) else None


@compiled_as(load_row, type_in_row)
def _load_row(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = llvm_type(signature.return_type.element.bitwidth)
    return builder.load(address_in_row(context, builder, signature, arguments, kind), align=1)


@compiled_as(store_row, _store_type)
def _store_row(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    lanes = arguments[3]
    address = address_in_row(context, builder, signature, arguments, lanes.type)
    builder.store(lanes, address, align=1)
    return context.get_dummy_value()


@compiled_as(load, lambda array, at: _Vector(array.dtype))
def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = llvm_type(signature.return_type.element.bitwidth)
    return builder.load(_address(context, builder, signature, arguments, kind), align=1)


@compiled_as(store, lambda array, at, lanes: types.none)
def _store(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    lanes = arguments[2]
    address = _address(context, builder, signature, arguments, lanes.type)
    builder.store(lanes, address, align=1)
    return context.get_dummy_value()


def _vector_of(value: types.Integer) -> _Vector:
    # Not the class itself: numba reads the parameters of what it calls.
    return _Vector(value)


@compiled_as(splat, _vector_of)
def _splat(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return _write_splat(builder, arguments[0], LANES)


@compiled_as(ramp, lambda first: _Vector(types.uint16))
def _ramp(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    start = _write_splat(builder, arguments[0], LANES)
    return builder.add(start, ir.Constant(llvm_type(16), list(range(LANES))))


@compiled_as(where_equal, lambda a, b, then, otherwise: then)
def _where_equal(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    a, b, then, otherwise = arguments
    return builder.select(builder.icmp_unsigned("==", a, b), then, otherwise)


@compiled_as(where_less, lambda a, b, then, otherwise: then)
def _where_less(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    a, b, then, otherwise = arguments
    return builder.select(builder.icmp_unsigned("<", a, b), then, otherwise)


@compiled_as(widen, lambda lanes, array: _Vector(array.dtype))
def _widen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.zext(arguments[0], llvm_type(signature.return_type.element.bitwidth))


@compiled_as(narrow, lambda lanes: _Vector(types.uint8))
def _narrow(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.trunc(arguments[0], llvm_type(8))


@compiled_as(broadcast_smallest, lambda lanes: lanes)
def _broadcast_smallest(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    # A butterfly of exchanges between ever nearer lanes, which stays in registers.
    found, turn = arguments[0], LANES // 2
    while turn:
        order = [lane ^ turn for lane in range(LANES)]
        found = _intrinsic("umin")(builder, found, shuffle(builder, found, found, order))
        turn //= 2
    return found


def shuffle(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    """Return lanes of two vectors in some order; ``LANES`` is the first lane of the second one."""
    return builder.shuffle_vector(a, b, ir.Constant(llvm_type(32), order))


_binary(
    put_before,
    lambda builder, lanes, before: shuffle(
        builder, before, lanes, list(range(LANES - 1, 2 * LANES - 1))
    ),
)
_binary(
    put_after,
    lambda builder, lanes, after: shuffle(builder, lanes, after, list(range(1, LANES + 1))),
)
