"""How vectors compile: each function of `vectors` as the LLVM instructions that stand for it.

A vector is a numba type whose values are LLVM vectors, so that it stays in a register. What this
relies on in numba and llvmlite, and what breaks it, is in ``docs/architecture.md``.

Ref: LLVM Language Reference Manual, "Vector Operations"; numba manual, "Low-level extension API".
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import config, types
from numba.core import cgutils, typing
from numba.core.codegen import get_host_cpu_features
from numba.extending import lower_builtin, models, register_model, type_callable

from recon.stereo.kernels.simd import vectors
from recon.stereo.kernels.simd.vectors import LANES, SUMS, WIDE


class _Vector(types.Type):  # type: ignore[misc]
    """Numba's type of a vector with elements of some integer type, or of float32."""

    def __init__(self, element: types.Number) -> None:
        self.element = element
        super().__init__(name=f"Vector({element})")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):  # type: ignore[misc]
    """Represents a vector by LLVM's vector type."""

    def __init__(self, manager: Any, vector: _Vector) -> None:
        super().__init__(manager, vector, _llvm_type_of(vector))


def _llvm_type(bits: int, lanes: int = LANES) -> ir.VectorType:
    return ir.VectorType(ir.IntType(bits), lanes)


_WHOLE, _FLOATS = _llvm_type(32, WIDE), ir.VectorType(ir.FloatType(), WIDE)


def _llvm_type_of(vector: _Vector) -> ir.VectorType:
    if vector.element == types.float32:
        return _FLOATS
    return _WHOLE if vector.element.bitwidth == 32 else _llvm_type(vector.element.bitwidth)


def _compiled_as(function: Callable[..., Any], typer: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function that emits LLVM instructions in place of a function of vectors.

    ``typer`` gives the type of its result, from those of its arguments.
    """
    type_callable(function)(lambda context: typer)
    return lower_builtin(function, types.VarArg(types.Any))  # type: ignore[no-any-return]


def _binary(function: Callable[..., Any], write: Callable[..., Any]) -> None:

    def typer(a: Any, b: Any) -> Any:
        return a if isinstance(a, _Vector) and a == b else None

    type_callable(function)(lambda context: typer)
    # For vectors alone: operators keep their other meanings.
    lower_builtin(function, _Vector, _Vector)(
        lambda context, builder, signature, arguments: write(builder, *arguments)
    )


def _intrinsic(name: str) -> Callable[..., Any]:

    def write(builder: Any, a: Any, b: Any) -> Any:
        kind = ir.FunctionType(a.type, [a.type, a.type])
        full_name = f"llvm.{name}.v{a.type.count}i{a.type.element.width}"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, full_name), [a, b])

    return write


def _either(of_integers: Callable[..., Any], of_floats: Callable[..., Any]) -> Callable[..., Any]:
    """Return what writes one or the other, by the type of the vectors."""
    return lambda builder, a, b: (of_floats if a.type == _FLOATS else of_integers)(builder, a, b)


def _write_smaller_float(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _write_float_difference(builder: Any, a: Any, b: Any) -> Any:
    kind, name = ir.FunctionType(_FLOATS, [_FLOATS]), f"llvm.fabs.v{WIDE}f32"
    size = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(size, [builder.fsub(a, b)])


def _write_difference(builder: Any, a: Any, b: Any) -> Any:
    # Saturating differences in either order: one of the two is zero.
    minus = _intrinsic("usub.sat")
    return builder.or_(minus(builder, a, b), minus(builder, b, a))


def _write_mean(builder: Any, a: Any, b: Any) -> Any:
    wide = _llvm_type(16)
    one = ir.Constant(wide, [1] * LANES)
    total = builder.add(builder.add(builder.zext(a, wide), builder.zext(b, wide)), one)
    return builder.trunc(builder.lshr(total, one), a.type)


def _write_differing(builder: Any, a: Any, b: Any) -> Any:
    kind, name = ir.FunctionType(a.type, [a.type]), f"llvm.ctpop.v{LANES}i8"
    count = cgutils.get_or_insert_function(builder.module, kind, name)
    return builder.call(count, [builder.xor(a, b)])


_write_smaller = _either(_intrinsic("umin"), _write_smaller_float)
_binary(operator.add, _either(ir.IRBuilder.add, ir.IRBuilder.fadd))
_binary(operator.sub, _either(ir.IRBuilder.sub, ir.IRBuilder.fsub))
_binary(operator.mul, _either(ir.IRBuilder.mul, ir.IRBuilder.fmul))
_binary(operator.rshift, lambda builder, a, b: builder.lshr(a, b))
_binary(vectors.mean, _write_mean)
_binary(vectors.differing_bits, _write_differing)
_binary(vectors.smaller, _write_smaller)
_binary(vectors.larger, _intrinsic("umax"))
_binary(vectors.absolute_difference, _either(_write_difference, _write_float_difference))


def _write_splat(builder: Any, value: Any, kind: ir.VectorType) -> Any:
    lanes = kind.count
    one = builder.insert_element(ir.Constant(kind, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(_llvm_type(32, lanes), [0] * lanes))


def _address(context: Any, builder: Any, signature: Any, arguments: Any, kind: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, arguments[0])
    return builder.bitcast(builder.gep(array.data, [arguments[1]]), kind.as_pointer())


def _address_in_row(context: Any, builder: Any, signature: Any, arguments: Any, kind: Any) -> Any:
    rows = context.make_array(signature.args[0])(context, builder, arguments[0])
    n, at = (
        context.cast(builder, value, given, types.intp)
        for value, given in zip(arguments[1:3], signature.args[1:3], strict=True)
    )
    start = builder.add(builder.mul(n, builder.extract_value(rows.shape, 1)), at)
    return builder.bitcast(builder.gep(rows.data, [start]), kind.as_pointer())


def _type_in_row(rows: Any, n: Any, at: Any) -> Any:
    # The address is computed for a C-ordered array.
    fits = isinstance(rows, types.Array) and rows.ndim == 1 + 1 and rows.layout == "C"
    return _Vector(rows.dtype) if fits else None


def _store_type(rows: Any, n: Any, at: Any, lanes: Any) -> Any:
    return types.none if lanes == _type_in_row(rows, n, at) else None


def _load_from(address: Callable[..., Any]) -> Callable[..., Any]:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = _llvm_type_of(signature.return_type)
        return builder.load(address(context, builder, signature, arguments, kind), align=1)

    return emit


def _store_at(address: Callable[..., Any]) -> Callable[..., Any]:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes = arguments[-1]
        where = address(context, builder, signature, arguments, lanes.type)
        builder.store(lanes, where, align=1)
        return context.get_dummy_value()

    return emit


_compiled_as(vectors.load, lambda array, at: _Vector(array.dtype))(_load_from(_address))
_compiled_as(vectors.store, lambda array, at, lanes: types.none)(_store_at(_address))
_compiled_as(vectors.load_row, _type_in_row)(_load_from(_address_in_row))
_compiled_as(vectors.store_row, _store_type)(_store_at(_address_in_row))


def _vector_of(value: types.Number) -> _Vector:
    # Not the class itself: numba reads the parameters of what it calls.
    return _Vector(value)


@_compiled_as(vectors.splat, _vector_of)
def _splat(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return _write_splat(builder, arguments[0], _llvm_type_of(signature.return_type))


@_compiled_as(vectors.splat_at, _type_in_row)
def _splat_at(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = _llvm_type_of(signature.return_type)
    place = _address_in_row(context, builder, signature, arguments, kind.element)
    return _write_splat(builder, builder.load(place), kind)


@_compiled_as(vectors.ramp, lambda first: _Vector(types.uint16))
def _ramp(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    start = _write_splat(builder, arguments[0], _llvm_type(16))
    return builder.add(start, ir.Constant(_llvm_type(16), list(range(LANES))))


def _select_where(sign: str) -> Callable[..., Any]:
    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        a, b, then, otherwise = arguments
        return builder.select(builder.icmp_unsigned(sign, a, b), then, otherwise)

    return emit


_compiled_as(vectors.where_equal, lambda a, b, then, otherwise: then)(_select_where("=="))
_compiled_as(vectors.where_less, lambda a, b, then, otherwise: then)(_select_where("<"))


@_compiled_as(vectors.widen, lambda lanes, array: _Vector(array.dtype))
def _widen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.zext(arguments[0], _llvm_type(signature.return_type.element.bitwidth))


@_compiled_as(vectors.narrow, lambda lanes: _Vector(types.uint8))
def _narrow(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    return builder.trunc(arguments[0], _llvm_type(8))


@_compiled_as(vectors.broadcast_smallest, lambda lanes: lanes)
def _broadcast_smallest(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    # A butterfly of exchanges between ever nearer lanes, which stays in registers.
    found, lanes = arguments[0], arguments[0].type.count
    turn = lanes // 2
    while turn:
        order = [lane ^ turn for lane in range(lanes)]
        found = _write_smaller(builder, found, _shuffle(builder, found, found, order))
        turn //= 2
    return found


def _shuffle(builder: Any, a: Any, b: Any, order: list[int]) -> Any:
    """Return lanes of two vectors in some order; ``LANES`` is the first lane of the second one."""
    return builder.shuffle_vector(a, b, ir.Constant(_llvm_type(32, len(order)), order))


_binary(
    vectors.put_before,
    lambda builder, lanes, before: _shuffle(
        builder, before, lanes, list(range(LANES - 1, 2 * LANES - 1))
    ),
)
_binary(
    vectors.put_after,
    lambda builder, lanes, after: _shuffle(builder, lanes, after, list(range(1, LANES + 1))),
)


def _transpose_type(rows: Any, n: Any, at: Any, out: Any, m: Any, to: Any) -> Any:
    fits = all(_type_in_row(*part) for part in ((rows, n, at), (out, m, to)))
    fits = fits and rows.dtype == out.dtype == types.uint8
    return types.none if fits else None


@_compiled_as(vectors.transpose, _transpose_type)
def _transpose(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    def address(row: int, part: slice) -> Any:
        """Return where a row of a block begins, given by array, first row and first column."""
        (array, n, at), (rows, kind, column) = arguments[part], signature.args[part]
        first = context.cast(builder, n, kind, types.intp)
        place = builder.add(first, first.type(row))
        types_of = typing.signature(types.none, rows, types.intp, column)
        return _address_in_row(context, builder, types_of, (array, place, at), _llvm_type(8))

    block = [builder.load(address(row, slice(3)), align=1) for row in range(LANES)]
    for row, lanes in enumerate(_write_transposed(builder, block)):
        builder.store(lanes, address(row, slice(3, 6)), align=1)
    return context.get_dummy_value()


def _write_transposed(builder: Any, block: list[Any]) -> list[Any]:
    # First the quarters of the square change places. Then the halves of all vectors are interleaved
    # lane by lane, each half by itself: no instruction has to move lanes between halves.
    half = LANES // 2
    low = [*range(half), *range(LANES, LANES + half)]
    pairs = list(zip(block[:half], block[half:], strict=True))
    block = [_shuffle(builder, a, b, low) for a, b in pairs]
    block += [_shuffle(builder, a, b, [lane + half for lane in low]) for a, b in pairs]
    dealt = [[n for i in range(8) for n in (part + i, LANES + part + i)] for part in (0, half)]
    first, second = dealt[0] + dealt[1], [n + 8 for n in dealt[0] + dealt[1]]
    return [
        lanes
        for part in (block[:half], block[half:])
        for lanes in _write_dealt(builder, part, first, second)
    ]


def _write_dealt(builder: Any, part: list[Any], first: list[int], second: list[int]) -> list[Any]:
    """Interleave one half of the vectors with the other until each holds one lane of all."""
    half = len(part) // 2
    for _ in range(half.bit_length()):
        pairs = zip(part[:half], part[half:], strict=True)
        part = [_shuffle(builder, a, b, order) for a, b in pairs for order in (first, second)]
    return part


# What multiplies int16 in pairs: the feature of a processor that has it, and lanes.
_PAIRS_ON_X86 = (
    ("avx512bw", "llvm.x86.avx512.pmaddw.d.512", 32),
    ("avx2", "llvm.x86.avx2.pmadd.wd", 16),
)
_FEATURES = config.CPU_FEATURES
if _FEATURES is None:
    _FEATURES = get_host_cpu_features()


def _sums_type(sums: Any, pairs: Any, rows: Any, n: Any, at: Any) -> Any:
    fits = _type_in_row(rows, n, at) == pairs == _Vector(types.int32)
    return sums if fits else None


def _write_products(builder: Any, a: Any, b: Any, total: Any) -> Any:
    """Add products of 16 bits in pairs, for which x86 has an instruction that LLVM rarely finds."""
    a, b = (builder.bitcast(pairs, _llvm_type(16)) for pairs in (a, b))
    for feature, name, lanes in _PAIRS_ON_X86:
        if f"+{feature}" in _FEATURES.split(","):
            kind, wide = _llvm_type(16, lanes), _llvm_type(32, lanes // 2)
            multiply = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(wide, [kind, kind]), name
            )
            parts = [
                builder.call(multiply, [_part(builder, one, n, lanes) for one in (a, b)])
                for n in range(0, LANES, lanes)
            ]
            return builder.add(total, _joined(builder, parts))
    for odd in (0, 1):
        order = list(range(odd, LANES, 2))
        one, other = (builder.sext(_shuffle(builder, each, each, order), _WHOLE) for each in (a, b))
        total = builder.add(total, builder.mul(one, other))
    return total


def _part(builder: Any, vector: Any, first: int, lanes: int) -> Any:
    return _shuffle(builder, vector, vector, list(range(first, first + lanes)))


def _joined(builder: Any, parts: list[Any]) -> Any:
    return parts[0] if len(parts) == 1 else _shuffle(builder, parts[0], parts[1], list(range(WIDE)))


def _add_each(of: Callable[..., Any]) -> Callable[..., Any]:
    """Return what emits sums with the products of pairs; ``of`` gives those for sum ``i``."""

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        sums, pairs, rows, n, at = arguments
        kinds = signature.args[2:]
        start = _address_in_row(
            context, builder, typing.signature(types.none, *kinds), (rows, n, at), _WHOLE.element
        )
        new = [
            _write_products(builder, pairs, of(builder, start, i), total)
            for i, total in enumerate(cgutils.unpack_tuple(builder, sums))
        ]
        return context.make_tuple(builder, signature.return_type, new)

    return emit


def _at_once(builder: Any, start: Any, i: int) -> Any:
    return _write_splat(builder, builder.load(builder.gep(start, [ir.IntType(64)(i)])), _WHOLE)


def _before(builder: Any, start: Any, i: int) -> Any:
    moved = builder.gep(start, [ir.IntType(64)(-i)])
    return builder.load(builder.bitcast(moved, _WHOLE.as_pointer()), align=1)


_compiled_as(vectors.add_products, _sums_type)(_add_each(_at_once))
_compiled_as(vectors.add_shifted, _sums_type)(_add_each(_before))


@_compiled_as(vectors.no_sums, lambda: types.UniTuple(_Vector(types.int32), SUMS))
def _no_sums(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    none = [ir.Constant(_WHOLE, [0] * WIDE)] * SUMS
    return context.make_tuple(builder, signature.return_type, none)


@_compiled_as(vectors.store_sums, lambda rows, n, at, sums: types.none)
def _store_sums(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    (rows, n, at, sums), (kind, first_kind, *_) = arguments, signature.args
    first = context.cast(builder, n, first_kind, types.intp)
    types_of = typing.signature(types.none, kind, types.intp, signature.args[2])
    for i, one in enumerate(cgutils.unpack_tuple(builder, sums)):
        place = rows, builder.add(first, first.type(i)), at
        builder.store(one, _address_in_row(context, builder, types_of, place, _WHOLE), align=1)
    return context.get_dummy_value()
