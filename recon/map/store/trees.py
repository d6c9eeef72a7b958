"""Trees of arrays and plain values as JSON and bytes, and values made of them."""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import lru_cache
from typing import Any, Final, NamedTuple, TypeVar, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from recon.core.errors import FormatError, ShapeError

Bytes = bytes | bytearray | memoryview
_RAW: Final = "raw"
_ZLIB: Final = "zlib"
_ARRAY: Final = "array"
_TREE: Final = "tree"
_KINDS: Final = "biuf"
_NARROW: Final = 16  # arrays with at most this many columns are compressed column by column
_INFLATED_PER_CHARACTER: Final = 32
"""Bytes of packed arrays for each character of the JSON, which names each frame and link."""


def to_bytes(tree: Mapping[str, Any], *, compress: bool) -> tuple[str, list[Bytes]]:
    """Return a tree as JSON, and the bytes of its arrays, to be written one after the other.

    In the JSON, ``{"tree": …}`` is a mapping and ``{"array": …}`` an array: its dtype as numpy
    spells it, its shape, ``C`` or ``F`` for the axis that varies fastest (the last, the first),
    ``raw`` or ``zlib``, and where its bytes begin and end.

    Compressed, the bytes of equal significance lie together: first of column 0 all lowest bytes,
    then all second ones and so on, then of column 1 (arrays with more than two axes or 16 columns
    count as one column). That makes measurements smaller by a fifth.
    """
    content: list[Bytes] = []
    size = 0

    def plain(value: Any) -> Any:
        nonlocal size
        if isinstance(value, np.ndarray):
            head, packed = _pack(value, compress=compress)
            content.append(packed)
            size += len(packed)
            return {_ARRAY: [*head, size - len(packed), size]}
        if isinstance(value, Mapping):
            if not all(isinstance(name, str) for name in value):
                raise TypeError("the names in a tree are texts")
            return {_TREE: {name: plain(item) for name, item in value.items()}}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    return json.dumps(plain(tree)), content


def from_bytes(text: str, read: Callable[[int], bytearray], most: int) -> dict[str, Any]:
    """Return the tree of `to_bytes`, its tuples as lists; ``read`` gives the next bytes.

    Each array takes over its own bytes, so that a tree takes no more memory than its arrays.
    Compressed arrays may take ``most`` bytes together, beside what the length of the JSON explains.
    """
    position, left = 0, most + _INFLATED_PER_CHARACTER * len(text)

    def restored(value: Any) -> Any:
        nonlocal position, left
        if isinstance(value, list):
            return [restored(item) for item in value]
        if not isinstance(value, dict):
            return value
        if _ARRAY in value:
            *head, begin, end = value[_ARRAY]
            if begin != position:
                raise FormatError("the arrays of a record of the map are not in order")
            position = end
            claim = _Claim(np.dtype(head[0]), *head[1:])
            left -= claim.nbytes if claim.codec == _ZLIB else 0
            if left < 0:
                raise FormatError("a record of the map claims more than it can hold")
            return _unpack(claim, read(end - begin))
        return {name: restored(item) for name, item in value[_TREE].items()}

    tree = restored(json.loads(text))
    if not isinstance(tree, dict):
        raise FormatError("a record of the map is no tree")
    return tree


class _Claim(NamedTuple):
    """What a record says of an array, before anything is made of it."""

    dtype: np.dtype[Any]
    shape: list[int]
    layout: str
    codec: str

    @property
    def nbytes(self) -> int:
        """Bytes of the array."""
        if self.dtype.kind not in _KINDS or min(self.shape, default=0) < 0:
            raise FormatError("an array of the map has an impossible type or shape")
        return math.prod(self.shape) * self.dtype.itemsize


def _pack(array: NDArray[Any], *, compress: bool) -> tuple[list[Any], bytes | memoryview]:
    # Products of matrices round differently in another order of axes.
    layout = "F" if array.flags.f_contiguous and not array.flags.c_contiguous else "C"
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    if little.dtype.kind not in _KINDS:
        raise TypeError(f"an array of {array.dtype} cannot be stored")
    flat = np.ascontiguousarray(little.T if layout == "F" else little)
    content: bytes | memoryview = flat.reshape(-1).view(np.uint8).data
    codec = _RAW
    if compress and array.size:
        # Runs and single bytes: as small as with a search for repeats, in half the time.
        packer = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
        packed = packer.compress(_planes(flat).tobytes()) + packer.flush()
        if len(packed) < len(content):
            content, codec = packed, _ZLIB
    return [little.dtype.str, list(array.shape), layout, codec], content


def _unpack(claim: _Claim, packed: bytearray) -> NDArray[Any]:
    """Return the array of these bytes, which it takes over where they are not compressed."""
    dtype, shape, layout, codec = claim
    axes = shape[::-1] if layout == "F" else shape
    content: bytes | bytearray = packed  # compiled kernels take only arrays that can be written
    if codec == _ZLIB:
        content = zlib.decompressobj().decompress(packed, claim.nbytes + 1)
    if len(content) != claim.nbytes:
        raise FormatError("an array of the map is truncated")
    numbers: NDArray[Any] = np.frombuffer(content, np.uint8)
    if codec == _ZLIB:
        planes = numbers.reshape(_columns(axes), dtype.itemsize, -1).transpose(2, 0, 1)
        numbers = np.array(planes, order="C").reshape(-1)
    array: NDArray[Any] = numbers.view(dtype).reshape(axes)
    return array.T if layout == "F" else array


def _columns(shape: Sequence[int]) -> int:
    return shape[1] if len(shape) == 2 and 0 < shape[1] <= _NARROW else 1


def _planes(array: NDArray[Any]) -> NDArray[np.uint8]:
    """Return uint8 (columns, bytes of a number, N)."""
    size = array.dtype.itemsize
    columns = array.reshape(-1, _columns(array.shape))
    split = columns.view(np.uint8).reshape(-1, columns.shape[1], size)
    return np.asarray(split.transpose(1, 2, 0))


Value = TypeVar("Value")


def value_in(kind: type[Value], tree: Mapping[str, Any]) -> Value:
    """Return a dataclass of a tree of its fields; each part is checked against its type."""
    return kind(**{name: _part(kind, name, part) for name, part in tree.items()})


def _part(kind: Any, name: str, part: Any) -> Any:
    adapter: TypeAdapter[Any] | None = _adapters(kind).get(name)
    if adapter is None:
        if not isinstance(part, np.ndarray):
            raise ShapeError(f"{kind.__name__}.{name} is not an array", got=part)
        return part
    try:
        return adapter.validate_python(part)
    except ValidationError as error:
        (first, *_), what = error.errors(), f"{kind.__name__}.{name} is wrong"
        raise ShapeError(what, got=part, expected=first["msg"]) from error


@lru_cache
def _adapters(kind: Any) -> dict[str, TypeAdapter[Any]]:
    """Return what checks each field that is no array."""
    hints = get_type_hints(kind)
    plain = (one.name for one in fields(kind) if get_origin(hints[one.name]) is not np.ndarray)
    return {name: TypeAdapter(hints[name]) for name in plain}
