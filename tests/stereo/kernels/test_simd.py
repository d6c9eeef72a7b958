"""Compiled, vectors do what their plain numpy does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numba import njit
from numba.core.errors import TypingError

from recon.stereo.kernels.simd import vectors as simd
from recon.stereo.kernels.simd.vectors import LANES

KINDS = (np.uint8, np.uint16)


@njit
def calculate(a: Any, b: Any, out: Any) -> None:
    x, y = simd.load(a, 2), simd.load(b, 0)
    simd.store(out, 1, x + y)
    simd.store(out, 1 + LANES, x - y)
    simd.store(out, 1 + 2 * LANES, simd.absolute_difference(x, y))


@njit
def compare(a: Any, b: Any, out: Any) -> None:
    x, y = simd.load(a, 2), simd.load(b, 0)
    simd.store(out, 0, simd.smaller(x, y))
    simd.store(out, LANES, simd.where_equal(x, y, x, simd.splat(a[0])))
    simd.store(out, 2 * LANES, simd.larger(x, y))
    simd.store(out, 3 * LANES, simd.where_less(x, y, y, x))


@njit
def look_beside(a: Any, b: Any, out: Any) -> None:
    x, y = simd.load(a, 2), simd.load(b, 0)
    simd.store(out, 0, simd.put_before(x, y))
    simd.store(out, LANES, simd.put_after(x, y))
    simd.store(out, 2 * LANES, simd.broadcast_smallest(x))


@njit
def compare_bytes(a: Any, b: Any, out: Any) -> None:
    x, y = simd.load(a, 2), simd.load(b, 0)
    simd.store(out, 0, simd.mean(x, y))
    simd.store(out, LANES, simd.differing_bits(x, y))


@njit
def lengthen(a: Any, b: Any, out: Any) -> None:
    simd.store(out, 0, simd.widen(simd.load(a, 2), out))
    simd.store(out, LANES, simd.widen(simd.splat(a[0]), out))


@njit
def scale(a: Any, b: Any, out: Any) -> None:
    product = simd.load(a, 2) * simd.load(b, 0)
    simd.store(out, 0, product)
    simd.store(out, LANES, product >> simd.splat(np.uint16(3)))
    simd.store(out, 2 * LANES, simd.ramp(a[0]))


@njit
def shorten(a: Any, b: Any, out: Any) -> None:
    simd.store(out, 2, simd.narrow(simd.load(a, 2)))


@njit
def move_rows(a: Any, b: Any, out: Any) -> None:
    simd.store_row(out, 2, 1, simd.load_row(a, 1, 3))


@njit
def move_block(a: Any, b: Any, out: Any) -> None:
    simd.transpose(a, 1, 2, out, 2, 3)


def assert_same(function: Callable[..., None], a: Any, b: Any, kind: Any) -> None:
    compiled, plain = np.zeros((2, 5 * LANES), kind)
    function(a, b, compiled)
    getattr(function, "py_func", function)(a, b, plain)
    np.testing.assert_array_equal(compiled, plain)


def arrays(kind: Any) -> st.SearchStrategy[Any]:
    # Few values make ties, the whole range makes overflows.
    values = st.one_of(st.integers(0, 3), st.integers(0, int(np.iinfo(kind).max)))
    return hnp.arrays(kind, LANES + 5, elements=values)


BYTES, WORDS = KINDS


@given(st.data())
@pytest.mark.parametrize(
    ("function", "kind", "made"),
    [
        *((f, kind, kind) for f in (calculate, compare, look_beside) for kind in KINDS),
        (compare_bytes, BYTES, BYTES),
        (lengthen, BYTES, WORDS),
        (scale, WORDS, WORDS),
        (shorten, WORDS, BYTES),
    ],
)
def test_compiled_vectors_do_as_numpy_does(
    function: Callable[..., None], kind: Any, made: Any, data: st.DataObject
) -> None:
    assert_same(function, data.draw(arrays(kind)), data.draw(arrays(kind)), made)


def test_means_are_rounded_up_and_bits_counted() -> None:
    a, b = np.array([[0, 1, 255], [1, 1, 254]], np.uint8)
    assert simd.mean(a, b).tolist() == [1, 1, 255]
    assert simd.differing_bits(a, b).tolist() == [1, 0, 1]


@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_read_and_written_where_they_are(kind: Any) -> None:
    a, out = np.arange(2 * (LANES + 5), dtype=kind).reshape(2, -1), np.zeros((3, LANES + 2), kind)
    move_rows(a, a, out)
    np.testing.assert_array_equal(out[2, 1:-1], a[1, 3 : 3 + LANES])
    assert np.count_nonzero(out) == LANES


def test_blocks_are_transposed_and_nothing_else_is_written() -> None:
    a = np.random.default_rng(0).integers(1, 256, (LANES + 3, LANES + 7), dtype=np.uint8)
    out = np.zeros((LANES + 4, LANES + 5), np.uint8)
    move_block(a, a, out)
    np.testing.assert_array_equal(out[2:-2, 3:-2], a[1:-2, 2:-5].T)
    assert np.count_nonzero(out) == LANES**2


def test_neighbours_of_the_ends_come_from_the_other_vector() -> None:
    a, b = np.arange(LANES, dtype=np.uint8), np.arange(100, 100 + LANES, dtype=np.uint8)
    assert simd.put_before(a, b).tolist() == [99 + LANES, *range(LANES - 1)]
    assert simd.put_after(a, b).tolist() == [*range(1, LANES), 100]


def test_rows_that_are_not_contiguous_are_refused_by_the_compiler() -> None:
    if not hasattr(move_rows, "py_func"):
        pytest.skip("the compiler is switched off")
    a, out = np.zeros((2, 2 * LANES + 10), np.uint8), np.zeros((3, LANES + 2), np.uint8)
    with pytest.raises(TypingError):
        move_rows(a[:, ::2], a, out)
