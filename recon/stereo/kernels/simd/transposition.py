"""Transposition of square blocks of bytes in registers: how `vectors.transpose` compiles."""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import types
from numba.core import typing

from recon.stereo.kernels.simd.instructions import (
    address_in_row,
    compiled_as,
    llvm_type,
    shuffle,
    type_in_row,
)
from recon.stereo.kernels.simd.vectors import LANES, transpose


def _transpose_type(rows: Any, n: Any, at: Any, out: Any, m: Any, to: Any) -> Any:
    fits = all(type_in_row(*part) for part in ((rows, n, at), (out, m, to)))
    fits = fits and rows.dtype == out.dtype == types.uint8
    return types.none if fits else None


@compiled_as(transpose, _transpose_type)
def _transpose(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind, places = llvm_type(8), range(LANES)
    given = signature.args
    source = _Part(arguments[:3], given[:3])
    goal = _Part(arguments[3:], given[3:])
    block = [builder.load(source.address(context, builder, row, kind), align=1) for row in places]
    for row, lanes in enumerate(_write_transposed(builder, block)):
        builder.store(lanes, goal.address(context, builder, row, kind), align=1)
    return context.get_dummy_value()


class _Part(NamedTuple):
    """A block of an array of rows: the array, its first row and column, and their types."""

    arguments: Any
    types: Any

    def address(self, context: Any, builder: Any, row: int, kind: Any) -> Any:
        """Return where a row of the block begins."""
        array, n, at = self.arguments
        first = context.cast(builder, n, self.types[1], types.intp)
        place = builder.add(first, first.type(row))
        signature = typing.signature(types.none, self.types[0], types.intp, self.types[2])
        return address_in_row(context, builder, signature, (array, place, at), kind)


def _write_transposed(builder: Any, block: list[Any]) -> list[Any]:
    """Transpose a square of bytes."""
    # First the quarters of the square change places. Then the halves of all vectors are interleaved
    # lane by lane, each half by itself: no instruction has to move lanes between halves.
    half = LANES // 2
    low = [*range(half), *range(LANES, LANES + half)]
    pairs = list(zip(block[:half], block[half:], strict=True))
    block = [shuffle(builder, a, b, low) for a, b in pairs]
    block += [shuffle(builder, a, b, [lane + half for lane in low]) for a, b in pairs]
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
        part = [shuffle(builder, a, b, order) for a, b in pairs for order in (first, second)]
    return part
