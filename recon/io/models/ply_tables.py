"""The PLY container: a header and one table per element.

Ref: G. Turk, "The PLY polygon file format", 1994.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import SEEK_END
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import FormatError
from recon.core.text import counted, parse_numbers
from recon.io.atomic import atomic_path
from recon.io.files import StrPath, reader, reading

#: A structured array with one field per property. Lists are supported only with three entries, as
#: a field of shape (3,) that follows a field with the length (`list_length`).
Table = NDArray[Any]

_TYPES: Final[dict[str, str]] = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_NAMES: Final = {code: name for name, code in list(_TYPES.items())[:8]}
_ORDERS: Final = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "<"}
_BINARY: Final = "binary_little_endian"
_LONGEST_HEADER_LINES: Final = 1000
_LONGEST_NUMBER: Final = 20


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file.

    Attributes:
        encoding: ``ascii``, ``binary_little_endian`` or ``binary_big_endian``.
        elements: Name, number of rows and dtype of each element, in the order of the file.
        comments: The comment lines, without the keyword.
    """

    encoding: str
    elements: tuple[tuple[str, int, np.dtype[Any]], ...]
    comments: tuple[str, ...]


def list_length(name: str) -> str:
    """Return the name of the field with the length of the list property ``name``."""
    return f"{name} length"


@reader
def read_tables(path: StrPath, wanted: Sequence[str]) -> tuple[PlyHeader, dict[str, Table]]:
    """Read the wanted elements of a PLY file.

    Args:
        path: The file.
        wanted: Names of the elements; whatever follows the last of them is not read.

    Returns:
        The header, and a table for each wanted element that the file has.
    """
    with Path(path).open("rb") as stream:
        header = _read_header(stream, path)
        return header, _read_body(stream, header, wanted, path)


def read_table_pieces(
    path: StrPath, wanted: str, rows_each: int
) -> Iterator[tuple[PlyHeader, Table]]:
    """Read an element of a PLY file piece by piece, each with the header.

    Args:
        path: The file.
        wanted: Name of the element; nothing is yielded if the file lacks it.
        rows_each: Largest number of rows per piece.
    """
    with reading(path), Path(path).open("rb") as stream:
        header = _read_header(stream, path)
        for element in header.elements:
            for table in _pieces(stream, header, element, rows_each, path):
                if element[0] == wanted:
                    yield header, table
            if element[0] == wanted:
                return


def write_tables(
    path: StrPath,
    tables: Mapping[str, Table],
    comments: Sequence[str] = (),
    *,
    ascii: bool = False,  # noqa: A002 - what the format calls it
) -> None:
    """Write tables as a PLY file, binary little endian unless ``ascii``, atomically."""
    elements = [(name, len(table), table.dtype) for name, table in tables.items()]
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(_header(elements, comments, "ascii" if ascii else _BINARY))
        for table in tables.values():
            if ascii:
                _write_rows(stream, table)
            else:
                stream.write(table.tobytes())


def write_table_parts(path: StrPath, elements: Mapping[str, tuple[int, Iterable[Table]]]) -> None:
    """Write elements whose rows arrive in parts, binary little endian, atomically.

    Args:
        path: The file.
        elements: For each element the total number of rows, and its tables, all of one dtype;
            one is held at a time. The first of each is taken before the header is written.
    """
    begun = {name: iter(tables) for name, (_, tables) in elements.items()}
    first = {name: next(tables) for name, tables in begun.items()}
    head = _header([(name, rows, first[name].dtype) for name, (rows, _) in elements.items()])
    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        stream.write(head)
        for name, rest in begun.items():
            stream.write(first.pop(name).tobytes())
            for table in rest:
                stream.write(table.tobytes())


def write_table_stream(
    path: StrPath, name: str, tables: Iterable[Table], comments: Sequence[str], empty: Table
) -> int:
    """Write one element whose rows arrive in parts, binary little endian, atomically.

    Args:
        path: The file.
        name: The element.
        tables: Its rows; one table is held at a time, and all get the dtype of the first.
        comments: Comment lines.
        empty: What is written if there is no table.

    Returns:
        The number of rows, which is filled into the header at the end.
    """
    dtype: np.dtype[Any] | None = None
    rows = 0

    def head() -> bytes:
        # Padded with a comment to the same length for every number of rows.
        number = str(rows)
        padded = [*comments, "." * (_LONGEST_NUMBER - len(number))]
        return _header([(name, number, empty.dtype if dtype is None else dtype)], padded)

    with atomic_path(path) as temporary, temporary.open("wb") as stream:
        for table in tables:
            if dtype is None:
                dtype = table.dtype
                stream.write(head())
            stream.write(table.astype(dtype, copy=False).tobytes())
            rows += len(table)
        stream.seek(0)
        stream.write(head())
    return rows


def _header(
    elements: Sequence[tuple[str, int | str, np.dtype[Any]]],
    comments: Sequence[str] = (),
    encoding: str = _BINARY,
) -> bytes:
    """Return the header of elements, each with its name, number of rows and dtype."""
    lines = ["ply", f"format {encoding} 1.0", *(f"comment {comment}" for comment in comments)]
    for name, rows, dtype in elements:
        lines += [f"element {name} {rows}", *_property_lines(dtype)]
    return "\n".join([*lines, "end_header", ""]).encode()


def _property_lines(dtype: np.dtype[Any]) -> list[str]:
    lines = []
    for name, field in _fields(dtype):
        code = _NAMES[field.base.str[1:]]
        if field.shape:
            lines.append(f"property list uchar {code} {name}")
        elif list_length(name.removesuffix(" length")) != name:
            lines.append(f"property {code} {name}")
    return lines


def _fields(dtype: np.dtype[Any]) -> list[tuple[str, np.dtype[Any]]]:
    """Return names and dtypes of the fields of a table."""
    return [(name, dtype[name]) for name in dtype.names or ()]


def _write_rows(stream: IO[bytes], table: Table) -> None:
    """Write rows of text; nine digits reproduce a float32 exactly."""
    columns, formats = [], []
    for name, field in _fields(table.dtype):
        column = table[name].reshape(len(table), int(np.prod(field.shape)))
        columns.append(column.astype(np.float64))
        formats += ["%.9g" if field.base.kind == "f" else "%d"] * column.shape[1]
    np.savetxt(stream, np.concatenate(columns, axis=1), fmt=formats)


def _read_header(stream: IO[bytes], path: StrPath) -> PlyHeader:
    """Parse the header and leave the stream just after it."""
    if stream.readline(8).strip() != b"ply":
        raise FormatError("not a PLY file: it does not start with 'ply'", where=path)
    encoding, comments = "", []
    elements: list[tuple[str, int, list[tuple[Any, ...]]]] = []
    for _ in range(_LONGEST_HEADER_LINES):
        line = stream.readline(4096).decode("ascii", errors="replace").strip()
        match line.split():
            case ["end_header"]:
                break
            case ["format", encoding, *_] if encoding in _ORDERS:
                pass
            case ["comment" | "obj_info", *_]:
                comments.append(line.partition(" ")[2])
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", *words] if elements and _is_property(words):
                elements[-1][2].extend(_property_fields(words, _ORDERS.get(encoding, "<")))
            case _:
                raise FormatError("cannot read the PLY header", where=path, got=repr(line[:60]))
    else:
        raise FormatError("the PLY header does not end", where=path)
    if not encoding:
        raise FormatError("the PLY header has no format line", where=path)
    try:
        typed = tuple((name, count, np.dtype(fields)) for name, count, fields in elements)
    except ValueError as error:
        raise FormatError("the PLY header names a property twice", where=path) from error
    return PlyHeader(encoding, typed, tuple(comments))


def _is_property(words: list[str]) -> bool:
    is_list = words[:1] == ["list"]
    types = words[is_list:-1]
    return len(types) == 1 + is_list and set(types) <= _TYPES.keys()


def _property_fields(words: list[str], order: str) -> list[tuple[Any, ...]]:
    """Return the fields of one property line."""
    name = words[-1]
    if words[0] == "list":
        length, entry = (order + _TYPES[word] for word in words[1:-1])
        return [(list_length(name), length), (name, entry, (3,))]
    return [(name, order + _TYPES[words[0]])]


def _read_body(
    stream: IO[bytes], header: PlyHeader, wanted: Sequence[str], path: StrPath
) -> dict[str, Table]:
    """Read element by element until all wanted ones are found."""
    tables: dict[str, Table] = {}
    missing = {name for name, _, _ in header.elements} & set(wanted)
    for name, count, dtype in header.elements:
        if not missing:
            break
        [tables[name]] = _pieces(stream, header, (name, count, dtype), count, path)
        missing.discard(name)
    return {name: table for name, table in tables.items() if name in wanted}


def _pieces(
    stream: IO[bytes],
    header: PlyHeader,
    element: tuple[str, int, np.dtype[Any]],
    rows_each: int,
    path: StrPath,
) -> Iterator[Table]:
    """Yield the rows of an element in pieces; at least one table."""
    name, count, dtype = element
    read = _read_text if header.encoding == "ascii" else _read_binary
    rows = 0
    while True:
        expected = min(rows + rows_each, count)
        table = _checked_lists(read(stream, expected - rows, dtype), path)
        rows += len(table)
        if rows < expected:
            raise FormatError(
                f"the file is truncated in its element {name!r}",
                where=path,
                got=counted(rows, "row"),
                expected=f"{count}",
            )
        yield table
        if rows == count:
            return


def _read_binary(stream: IO[bytes], count: int, dtype: np.dtype[Any]) -> Table:
    """Read at most ``count`` rows, fewer if the file ends early."""
    here = stream.tell()
    left = stream.seek(0, SEEK_END) - here
    stream.seek(here)
    # A damaged header may announce more rows than fit in memory.
    content = stream.read(min(count * dtype.itemsize, left))
    return np.frombuffer(content, dtype, len(content) // max(dtype.itemsize, 1))


def _read_text(stream: IO[bytes], count: int, dtype: np.dtype[Any]) -> Table:
    """Read rows of text up to the first that is missing or malformed."""
    width = sum(int(np.prod(field.shape)) for _, field in _fields(dtype))
    rows = []
    for _ in range(count):
        line = stream.readline()
        if not line:
            break
        try:
            numbers = parse_numbers(line.split())
        except ValueError:
            break
        if len(numbers) != width:
            break
        rows.append(numbers)
    values = np.array(rows, dtype=np.float64).reshape(len(rows), width)
    table = np.zeros(len(rows), dtype)
    start = 0
    for name, field in _fields(dtype):
        stop = start + int(np.prod(field.shape))
        table[name] = values[:, start:stop].reshape(len(rows), *field.shape)
        start = stop
    return table


def _checked_lists(table: Table, path: StrPath) -> Table:
    for name, field in _fields(table.dtype):
        if field.shape and (table[list_length(name)] != 3).any():
            raise FormatError(
                "a face is not a triangle", where=path, hint="triangulate the mesh first"
            )
    return table
