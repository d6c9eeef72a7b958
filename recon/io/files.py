"""Reads whole files; `reading` turns whatever a parser raises into an error that names the file."""

from __future__ import annotations

import codecs
import errno
import hashlib
import os
import re
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from functools import wraps
from itertools import chain
from os import PathLike
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar, cast

import numpy as np

from recon.core.errors import FormatError, ReconError
from recon.core.text import parse_number, parse_numbers
from recon.core.values.arrays import Float64

StrPath = str | PathLike[str]
_P = ParamSpec("_P")
_R = TypeVar("_R")

SMALL_FILE_BYTES: Final = 1 << 22  # more than any calibration or configuration has
_LONGEST_REASON: Final = 120
_NO_DATA: Final = "begin lines that are no data with #"
#: A number with a decimal comma beside another word; alone in its line, it may be two columns.
_DECIMAL_COMMA: Final = re.compile(r"[\s;][-+]?\d+,\d+(?![^\s;])|^[-+]?\d+,\d+[\s;]", re.ASCII)
FOLDER: Final = "a folder"
_LOOP: Final = "a loop of symbolic links"
_KINDS: Final = (
    (stat.S_ISDIR, FOLDER),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


@contextmanager
def naming(path: StrPath) -> Iterator[None]:
    """Add the file to errors raised by values built from its content."""
    try:
        yield
    except ReconError as error:
        if error.where is not None:
            raise
        raise error.copy_with(where=path) from error


@contextmanager
def reading(path: StrPath) -> Iterator[None]:
    """Name the file in every error that is raised while its content is parsed.

    Content from outside can make a parser raise anything: around parsing, and only there, every
    exception is a fault of the file. Pipes and devices, whose reading may never end, are refused.
    """
    try:
        refuse_special(path)
        with naming(path), np.errstate(all="ignore"):
            yield
    except (ReconError, ImportError):  # a package that is missing is no fault of the file
        raise
    except FileNotFoundError as error:
        raise FormatError("file does not exist", where=error.filename or path) from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise FormatError("cannot read the file", where=path, got=reason) from error
    except MemoryError as error:
        raise FormatError("content does not fit in memory", where=path) from error
    except RecursionError as error:
        raise FormatError("content is nested too deeply", where=path) from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"[:_LONGEST_REASON]
        raise FormatError("content cannot be read", where=path, got=reason) from error


def reader(read: Callable[_P, _R]) -> Callable[_P, _R]:
    """Decorate a function that reads the file given by its first argument; see `reading`."""

    @wraps(read)
    def named(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        path = args[0] if args else next(iter(kwargs.values()))
        with reading(cast("StrPath", path)):
            return read(*args, **kwargs)

    return named


def resolved(path: StrPath) -> Path:
    """Return the absolute path that a path leads to; a loop of links is refused."""
    if special_kind(path) == _LOOP:
        raise FormatError("not a path", where=path, got=_LOOP)
    return Path(os.path.realpath(path))


def special_kind(path: StrPath) -> str | None:
    """Return what a path leads to, such as ``a device``; None = a regular file, or nothing."""
    try:
        mode = Path(path).stat().st_mode
    except (OSError, ValueError) as error:
        # what is missing, or no path, is found when it is opened
        return _LOOP if getattr(error, "errno", None) == errno.ELOOP else None
    return next((name for test, name in _KINDS if test(mode)), None)


def refuse_special(path: StrPath) -> None:
    """Refuse a pipe or device, which may never end, or wait for ever to be opened."""
    if (kind := special_kind(path)) not in (None, FOLDER):
        raise FormatError("not a regular file", where=path, got=kind)


@reader
def read_bytes(path: StrPath, at_most: int | None = None) -> bytes:
    """Read a file that must not be empty, nor have more than that many bytes."""
    with Path(path).open("rb") as file:
        if at_most is not None and os.fstat(file.fileno()).st_size > at_most:
            expected = f"at most {at_most / 1e6:.0f} MB"
            raise FormatError("file is too large for its kind", where=path, expected=expected)
        content = file.read()
    if not content:
        raise FormatError("file is empty", where=path)
    return content


def read_text(path: StrPath, at_most: int | None = None) -> str:
    """Read a UTF-8 text file that must not be empty, nor have more than that many bytes."""
    try:
        return read_bytes(path, at_most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        utf_16 = error.object[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        is_text = utf_16 or b"\0" not in error.object
        got, hint = f"byte {error.start} is not UTF-8", "save it as UTF-8" if is_text else None
        raise FormatError("not a text file", where=path, got=got, hint=hint) from error


def read_lines(path: StrPath) -> list[str]:
    """Read the lines of a text table; one whose numbers have decimal commas is refused."""
    lines = read_text(path).splitlines()
    for number, line in enumerate(lines, start=1):
        if _DECIMAL_COMMA.search(line.partition("#")[0].strip()):
            what, got = "decimals are written with a comma", line.strip()[:60]
            raise FormatError(what, where=f"{path}:{number}", got=got, expected="a point, as 0.5")
    return lines


@reader
def read_table(path: StrPath, columns: tuple[int, ...]) -> tuple[Float64, list[int]]:
    """Read rows of numbers separated by spaces or commas; ``#`` starts a comment.

    Returns float64 (N, C), finite, N ≥ 1, C one of ``columns``, and the line of each row, from 1.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, line in enumerate(read_lines(path), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        rows.append(parse_row(words, columns, f"{path}:{number}"))
        lines.append(number)
        columns = (len(words),)
    if not rows:
        raise FormatError("file contains no numbers", where=path)
    return np.array(rows, dtype=np.float64), lines


def seconds_of_date(text: str, where: StrPath) -> float:
    """Return seconds since 1970 of a date and time in UTC, with more digits than Python reads."""
    whole, _, part = text.strip().replace("T", " ").replace("/", "-").partition(".")
    try:
        whole.encode("ascii")
        moment = datetime.strptime(whole, "%Y-%m-%d %H:%M:%S").replace(tzinfo=timezone.utc)
        return moment.timestamp() + parse_number(f"0.{part or 0}")
    except ValueError as error:
        what, expected = "not a time", "2011-09-26 13:02:25.964389445"
        raise FormatError(what, where=where, got=text[:40], expected=expected) from error


def parse_row(words: list[str], columns: tuple[int, ...], where: str) -> list[float]:
    """Return the numbers of a row with one of so many ``columns``."""
    if len(words) not in columns:
        expected = " or ".join(str(count) for count in columns)
        what, got = "wrong number of columns", str(len(words))
        raise FormatError(what, where=where, got=got, expected=expected)
    try:
        row = parse_numbers(words)
    except ValueError as error:
        got = " ".join(words)[:60]
        raise FormatError("not a number", where=where, got=got, hint=_NO_DATA) from error
    if not np.isfinite(row).all():
        raise FormatError("number is not finite", where=where, got=" ".join(words)[:60])
    return row


def refuse_links(folder: Path, *, below: Path | None = None) -> None:
    """Refuse a folder of ours that has links in it, or is below a link in the folder ``below``."""
    way = [] if below is None else [folder, *folder.parents][: -len(below.parents) - 1]
    inside = (
        Path(place, name)
        for place, folders, files in os.walk(folder)
        for name in sorted((*folders, *files))
    )
    for path in chain(reversed(way), inside):
        if path.is_symlink():
            hint = "remove it; what it leads to stays"
            raise FormatError("a link in a result folder is not followed", where=path, hint=hint)


_PIECE_BYTES: Final = 1 << 20
_SAMPLE_BYTES: Final = 1 << 12


def digest_of(path: Path, kind: str = "sha256") -> str:
    """Return the hash of a file's bytes in hexadecimal, as ``sha256sum`` prints it."""
    digest = hashlib.new(kind, usedforsecurity=False)
    with path.open("rb") as content:
        while piece := content.read(_PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def fingerprint(files: Iterable[Path], *, samples: int | None = None) -> dict[str, Any]:
    """Return the number and size of a list of files, and one SHA-256 of names and bytes, in order.

    To tell sources apart without reading a large drive, only ``samples`` pieces of 4 KiB are read
    of each larger file, evenly spread from its first byte to its last. A pipe is a `FormatError`.
    """
    digest, count, size = hashlib.sha256(), 0, 0
    for path in files:
        refuse_special(path)
        length = path.stat().st_size
        digest.update(os.fsencode(path.name) + b"\0" + length.to_bytes(8, "little"))
        with path.open("rb", buffering=0) as content:
            for start, many in _pieces(length, samples):
                content.seek(start)
                digest.update(content.read(many))
        count, size = count + 1, size + length
    return {"files": count, "bytes": size, "sha256": digest.hexdigest()}


def _pieces(length: int, samples: int | None) -> list[tuple[int, int]]:
    """Return first byte and number of bytes of what is hashed of a file: all of it, or samples."""
    if samples is None or length <= samples * _SAMPLE_BYTES:
        # In pieces: a recording may be larger than memory.
        return [(start, _PIECE_BYTES) for start in range(0, length, _PIECE_BYTES)]
    last, steps = length - _SAMPLE_BYTES, max(1, samples - 1)
    return [(number * last // steps, _SAMPLE_BYTES) for number in range(samples)]
