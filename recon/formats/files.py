"""Reads whole files, with a clear error if that fails."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import numpy as np

from recon.errors import FormatError, ReconError
from recon.structures.arrays import Float64

StrPath = str | PathLike[str]


def read_bytes(path: StrPath) -> bytes:
    """Read a file that must not be empty.

    Raises:
        FormatError: The file does not exist, cannot be read or is empty.
    """
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError as error:
        raise FormatError("file does not exist", where=path) from error
    except OSError as error:
        raise FormatError("cannot read the file", where=path, got=error.strerror) from error
    if not content:
        raise FormatError("file is empty", where=path)
    return content


def read_text(path: StrPath) -> str:
    """Read a UTF-8 text file that must not be empty.

    Raises:
        FormatError: The file does not exist, cannot be read, is empty or is not text.
    """
    try:
        return read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FormatError(
            "not a text file", where=path, got=f"byte {error.start} is not UTF-8"
        ) from error


@contextmanager
def naming(path: StrPath) -> Iterator[None]:
    """Add the file to errors raised by values built from its content."""
    try:
        yield
    except ReconError as error:
        if error.where is not None:
            raise
        raise type(error)(
            error.what, where=path, got=error.got, expected=error.expected, hint=error.hint
        ) from error


def read_table(path: StrPath, columns: tuple[int, ...]) -> tuple[Float64, list[int]]:
    """Read rows of numbers separated by spaces or commas; ``#`` starts a comment.

    Args:
        path: The text file.
        columns: The permitted numbers of columns; all rows must have the same.

    Returns:
        float64 (N, C), finite, N ≥ 1, and the line number of each row, counted from 1.

    Raises:
        FormatError: A row has the wrong number of columns or a value that is not a finite number;
            the line is named.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        rows.append(_parse_row(words, columns, f"{path}:{number}"))
        lines.append(number)
        columns = (len(words),)
    if not rows:
        raise FormatError("file contains no numbers", where=path)
    return np.array(rows, dtype=np.float64), lines


def _parse_row(words: list[str], columns: tuple[int, ...], where: str) -> list[float]:
    if len(words) not in columns:
        expected = " or ".join(str(count) for count in columns)
        raise FormatError(
            "wrong number of columns", where=where, got=str(len(words)), expected=expected
        )
    try:
        row = [float(word) for word in words]
    except ValueError as error:
        raise FormatError("not a number", where=where, got=" ".join(words)[:60]) from error
    if not np.isfinite(row).all():
        raise FormatError("number is not finite", where=where, got=" ".join(words)[:60])
    return row
