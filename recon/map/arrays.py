"""Arrays as bytes in a map, and trees of them as JSON."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError

RAW: Final = "raw"
ZLIB: Final = "zlib"
_ARRAY: Final = "array"
_TREE: Final = "tree"
_KINDS: Final = "biuf"
_NARROW: Final = 16
"""Arrays with at most this many columns are compressed column by column."""
_MOST_INFLATED: Final = 1040
"""Deflate makes nothing more than 1032 times smaller."""


@dataclass(frozen=True)
class PackedArray:
    """An array as bytes.

    Attributes:
        dtype: As numpy spells it, little-endian, such as ``<f4``.
        shape: Its lengths.
        layout: ``C``, or ``F`` where the first axis varies fastest.
        codec: ``raw``, or ``zlib``: a zlib stream of byte planes, see `pack`.
        content: The bytes.
    """

    dtype: str
    shape: tuple[int, ...]
    layout: str
    codec: str
    content: bytes


def pack(array: NDArray[Any], *, compress: bool) -> PackedArray:
    """Turn an array into bytes.

    Compressed, the bytes of equal significance lie together: first of column 0 all lowest bytes,
    then all second ones and so on, then of column 1 (arrays with more than two axes or 16 columns
    count as one column). That makes measurements smaller by a fifth.
    """
    # Products of matrices round differently in another order of axes.
    layout = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    if little.dtype.kind not in _KINDS:
        raise TypeError(f"an array of {array.dtype} cannot be stored")
    flat = np.ascontiguousarray(little.T if layout == "F" else little)
    content, codec = flat.tobytes(), RAW
    if compress and array.size:
        # Runs and single bytes: as small as with a search for repeats, in half the time.
        packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
        packed = packer.compress(_planes(flat).tobytes()) + packer.flush()
        if len(packed) < len(content):
            content, codec = packed, ZLIB
    return PackedArray(little.dtype.str, array.shape, layout, codec, content)


def unpack(packed: PackedArray) -> NDArray[Any]:
    """The array again, in its order of axes; read-only.

    Raises:
        FormatError: The bytes are no such array.
    """
    dtype, size = np.dtype(packed.dtype), math.prod(packed.shape)
    if dtype.kind not in _KINDS or min(packed.shape, default=0) < 0:
        raise FormatError("an array of the map has an impossible type or shape")
    shape = packed.shape[::-1] if packed.layout == "F" else packed.shape
    wanted = size * dtype.itemsize
    content = packed.content
    if packed.codec == ZLIB:
        if wanted > _MOST_INFLATED * (len(content) + 1):
            raise FormatError("an array of the map is truncated")
        content = zlib.decompressobj().decompress(content, wanted + 1)
    if len(content) != wanted:
        raise FormatError("an array of the map is truncated")
    if packed.codec == ZLIB:
        columns = _columns(shape)
        planes = np.frombuffer(content, np.uint8).reshape(columns, dtype.itemsize, -1)
        content = np.ascontiguousarray(planes.transpose(2, 0, 1)).tobytes()
    array = np.frombuffer(content, dtype).reshape(shape)
    return array.T if packed.layout == "F" else array


def to_text(tree: Mapping[str, Any]) -> tuple[str, list[NDArray[Any]]]:
    """A tree as JSON, and its arrays, which the text numbers ``{"array": n}``.

    Raises:
        TypeError: It holds something else than mappings with names, sequences, arrays, numbers,
            texts and None.
    """
    arrays: list[NDArray[Any]] = []
    return json.dumps(_plain(tree, arrays), ensure_ascii=True), arrays


def from_text(text: str, array: Callable[[int], NDArray[Any]]) -> dict[str, Any]:
    """The tree of a JSON text, with the arrays that a function gives. Tuples are lists now.

    Raises:
        FormatError: The text is no tree.
    """
    tree = _restored(json.loads(text), array)
    if not isinstance(tree, dict):
        raise FormatError("a record of the map is no tree")
    return tree


def _plain(value: Any, arrays: list[NDArray[Any]]) -> Any:
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    if isinstance(value, Mapping):
        if not all(isinstance(name, str) for name in value):
            raise TypeError("the names in a tree are texts")
        return {_TREE: {name: _plain(item, arrays) for name, item in value.items()}}
    if isinstance(value, list | tuple):
        return [_plain(item, arrays) for item in value]
    return value


def _restored(value: Any, array: Callable[[int], NDArray[Any]]) -> Any:
    if isinstance(value, list):
        return [_restored(item, array) for item in value]
    if not isinstance(value, dict):
        return value
    if _ARRAY in value:
        return array(value[_ARRAY])
    return {name: _restored(item, array) for name, item in value[_TREE].items()}


def _columns(shape: Sequence[int]) -> int:
    return shape[1] if len(shape) == 2 and 0 < shape[1] <= _NARROW else 1


def _planes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """uint8 (columns, bytes of a number, N)."""
    size = array.dtype.itemsize
    columns = array.reshape(-1, _columns(array.shape))
    split = columns.view(np.uint8).reshape(-1, columns.shape[1], size)
    return np.asarray(split.transpose(1, 2, 0))
