"""Tables as people write them: a header names the columns, in any order."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Final

from recon.core.errors import FormatError
from recon.core.text import parse_number
from recon.io.files import StrPath, read_lines, read_text

_NAMES: Final = {
    "time": "time t timestamp seconds", "lat": "lat latitude", "lon": "lon lng long longitude",
    "east": "east easting e x rechtswert", "north": "north northing n y hochwert",
    "height": "alt altitude height ele elev elevation h z up", "sigma": "sigma accuracy",
    "sigma_e": "sigma_e sigma_east sde", "sigma_n": "sigma_n sigma_north sdn",
    "sigma_u": "sigma_u sigma_up sdu", "name": "name point id pt p gcp label point_name",
    "image": "image file filename photo img image_name", "column": "column col u pixel_x",
    "row": "row v pixel_y", "check": "check",
}  # fmt: skip
"""Columns by what headers call them; x is east and y north, as in OpenDroneMap's list."""
_UNIT: Final = re.compile(r" *[\[(](m|metres?|meters?|deg|degrees|°|s|px)[\])]$|_(m|deg|s|px)$")
_COMMENT: Final = re.compile(r"(^|\s)(#|//).*")
_DECIMAL: Final = re.compile(r"([-+]?\d+),(\d+)", re.ASCII)
_FIELD: Final = r'(?:^|[;\t])[ "]*[-+]?{}[ "]*(?:$|[;\t])'
_DMS: Final = re.compile(
    r"([NSEW]?)\s*(-?)(\d+)\s*[°ºd:\s]\s*([0-5]?\d)\s*['\u2019\u2032:\s]\s*"
    r"([0-5]?\d(?:\.\d*)?)\s*(?:[\"\u201d\u2033]|['\u2019\u2032]{2})?\s*([NSEW]?)",
    re.ASCII | re.IGNORECASE,
)
Columns = dict[str, int]
Row = tuple[str, list[str]]  # where it is, and its fields


def read_rows(path: StrPath, begin: int = 0) -> tuple[Columns, list[Row]]:
    """Return the rows of a table from a line on, and its columns by `_NAMES`.

    The header is the first row, or a comment before it with as many fields; no columns = there is
    none. ``#`` and ``//`` begin comments.
    """
    lines = read_text(path).splitlines()
    if not any(mark in line for line in lines for mark in ";\t"):
        lines = read_lines(path)  # refuses decimal commas
    texts = [
        (f"{path}:{n}", text)
        for n, line in enumerate(lines, 1)
        if n > begin and (text := _COMMENT.sub("", line).strip())
    ]
    _refuse_thousands(texts)
    rows = [(where, fields(text)) for where, text in texts]
    if rows and not any(map(is_number, rows[0][1])) and (columns := columns_of(rows[0][1], path)):
        _refuse_more(rows[1:], len(rows[0][1]))
        return columns, rows[1:]
    for line in lines[begin:]:
        if _COMMENT.sub("", line).strip():
            break
        words = fields(line.lstrip("#/ "))
        if rows and len(words) == len(rows[0][1]) and len(named := columns_of(words, path)) > 2:
            return named, rows
    return {}, rows


def _refuse_thousands(texts: Sequence[tuple[str, str]]) -> None:
    """Refuse what may be thousands, as ``455,810``, where decimals have the other mark."""
    for mark, other in ((",", r"\."), (r"\.", ",")):
        either = re.compile(_FIELD.format(rf"[1-9]\d{{0,2}}{mark}\d{{3}}"), re.ASCII)
        decimal = re.compile(_FIELD.format(rf"\d+{other}\d+"), re.ASCII)
        found = next(((where, text) for where, text in texts if either.search(text)), None)
        if found and any(decimal.search(text) for _, text in texts):
            what, hint = "decimals or thousands", "write decimals with one mark, and no thousands"
            raise FormatError(what, where=found[0], got=found[1][:60], hint=hint)


def _refuse_more(rows: Sequence[Row], names: int) -> None:
    """Refuse rows with more fields than names, but for a text at the end that has commas."""
    for where, words in rows:
        if len(words) > names and any(map(is_number, words[names - 1 :])):
            got, hint = f"{len(words)} fields", "are commas in decimals? put ; between fields"
            what, expected = "a row has more fields than the header", f"{names}"
            raise FormatError(what, where=where, got=got, expected=expected, hint=hint)


def first_row(text: str) -> str:
    """Return the first line of a text that is no comment, without a comment behind it."""
    return next(filter(None, (_COMMENT.sub("", one).strip() for one in text.splitlines())), "")


def is_number(word: str) -> bool:
    """Return whether a field is a number."""
    with suppress(ValueError):
        return parse_number(word) is not None
    return False


def columns_of(words: Sequence[str], path: StrPath) -> Columns:
    """Return which columns a header names; two that may be the same are refused."""
    found: Columns = {}
    for n, word in enumerate(words):
        plain = _UNIT.sub("", word.strip("'").lower()).replace(" ", "_")
        for kind in (kind for kind, names in _NAMES.items() if plain in names.split()):
            if kind in found:
                got = f"{words[found[kind]]}, {word}"
                raise FormatError(f"two columns may be the {kind}", where=path, got=got)
            found[kind] = n
    return found


def pick(row: Row, columns: Columns, kinds: Sequence[str]) -> list[str]:
    """Return fields of a row by their kinds; degrees, minutes and seconds become degrees."""
    where, words = row
    if missing := [kind for kind in kinds if kind not in columns]:
        got, expected = f"no {', '.join(missing)}", ", ".join(kinds)
        hint = "positions have a time; control points image, column and row"
        what, file = "the header lacks a column", where.rpartition(":")[0]
        raise FormatError(what, where=file, got=got, expected=expected, hint=hint)
    if len(words) <= max(columns[kind] for kind in kinds):
        raise FormatError("a row lacks a field", where=where, got=" ".join(words)[:60])
    return [_in_degrees(words[columns[kind]], kind, where) for kind in kinds]


def fields(line: str) -> list[str]:
    """Return what lies between semicolons or tabs, and may have decimal commas; commas; spaces."""
    mark = next((mark for mark in ";\t," if mark in line), " ")
    words = next(csv.reader([line.strip()], delimiter=mark, skipinitialspace=True), [])
    plain = [word.strip() for word in words]
    while plain and not plain[-1]:
        plain.pop()
    return [_DECIMAL.sub(r"\1.\2", word) for word in plain] if mark in ";\t" else plain


def _in_degrees(word: str, kind: str, where: str) -> str:
    if kind not in ("lat", "lon") or not (dms := _DMS.fullmatch(word)):
        return word
    before, minus, *parts, after = dms.groups()
    side, (degrees, minutes, seconds) = (before or after).upper(), map(float, parts)
    if side not in ("", *("NS" if kind == "lat" else "EW")):
        raise FormatError(f"not a {kind}", where=where, got=word)
    value = degrees + minutes / 60 + seconds / 3600
    return repr(-value if minus or side in ("S", "W") else value)
