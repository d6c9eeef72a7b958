"""Control points: places of a survey, and where images show them (``gcp_list.txt``)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import FormatError, require
from recon.core.text import parse_numbers
from recon.core.values.arrays import Float64
from recon.io.files import StrPath, read_lines, reader
from recon.io.models.las import check_crs
from recon.io.positions import Positions

_UTM: Final = re.compile(r"WGS84 UTM (0?[1-9]|[1-5]\d|60)([NS])$", re.IGNORECASE)
_SYSTEM: Final = re.compile(r"(EPSG:\d+|\+proj|WGS84 UTM )", re.IGNORECASE)
_CHECK: Final = "check"


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A point of a survey, and its pixels: columns and rows from the centre of the first one."""

    name: str
    place_m: Float64  # (3,), east, north and up
    seen: tuple[tuple[str, Float64], ...]  # name of an image and pixel (2,) in it, for each
    check: bool = False  # whether it is only compared with


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """The points of a file, in the coordinate system ``system``."""

    points: tuple[ControlPoint, ...]
    system: str


def is_control(path: StrPath) -> bool:
    """Return whether a file begins with a coordinate system, as lists of control points do."""
    if not Path(path).is_file():
        return False
    with Path(path).open("rb") as file:
        return bool(_SYSTEM.match(file.read(200).decode("utf-8-sig", errors="replace").lstrip()))


@reader
def read_control(path: StrPath, crs: str | None = None) -> ControlPoints:
    """Read a list of control points as OpenDroneMap has it.

    The first line is a coordinate system; the others are ``x y z column row image [name]``, in
    degrees longitude and latitude if the system has those, else metres; ``check`` behind the name
    makes it a check point. Rows of one name, or without one of one place, are one point. ``crs`` is
    the system to convert degrees to (None = that of UTM), or for the system of the file.

    Raises:
        FormatError: A row is not as above, or rows of one name have different places.

    Ref: https://docs.opendronemap.org/gcp/
    """
    lines = [line.split() for line in read_lines(path)]
    rows = [(n, words) for n, words in enumerate(lines, 1) if words and words[0][0] != "#"]
    system = _system_of(" ".join(rows[0][1]))
    named: dict[str, list[_Row]] = {}
    for number, words in rows[1:]:
        row = _row(words, f"{path}:{number}")
        named.setdefault(row.name or " ".join(words[:3]), []).append(row)
    if not named:
        raise FormatError("the file has no control point", where=path)
    for name, (first, *others) in named.items():
        if any(row.numbers[:3] != first.numbers[:3] for row in others):
            got = f"{first.numbers[:3]} and others"
            raise FormatError("one point has several places", where=f"{path}: {name}", got=got)
    firsts = np.array([found[0].numbers[:3] for found in named.values()], np.float64)
    places_m, system = _in_metres(firsts, system, crs, path)
    points = (
        ControlPoint(
            found[0].name or f"point {number}",
            place_m,
            tuple((row.image, np.array(row.numbers[3:])) for row in found),
            any(row.check for row in found),
        )
        for number, (found, place_m) in enumerate(zip(named.values(), places_m, strict=True), 1)
    )
    return ControlPoints(tuple(points), system)


class _Row(NamedTuple):
    numbers: list[float]  # place, column and row
    image: str
    name: str  # empty if there is none
    check: bool


def _row(words: list[str], where: str) -> _Row:
    name, *more = words[6:] or [""]
    if len(words) < 6 or more not in ([], [_CHECK]):
        expected = "x y z column row image [name [check]]"
        raise FormatError("not a control point", where=where, expected=expected)
    try:
        numbers = parse_numbers(words[:5])
    except ValueError:
        numbers = []
    if not (numbers and np.isfinite(numbers).all()):
        raise FormatError("not five numbers", where=where, got=" ".join(words[:5]))
    return _Row(numbers, words[5], name, bool(more))


def _system_of(text: str) -> str:
    utm = _UTM.match(text)
    return f"EPSG:{(32600 if utm[2] in 'Nn' else 32700) + int(utm[1])}" if utm else text


def _in_metres(places: Float64, system: str, crs: str | None, path: StrPath) -> tuple[Float64, str]:
    pyproj = require("pyproj", extra="survey")
    try:
        geographic = pyproj.CRS.from_user_input(system).is_geographic
    except pyproj.exceptions.CRSError as error:
        raise FormatError("unknown coordinate system", where=path, got=system) from error
    if not geographic:
        check_crs(system, path)
        return places, crs or system
    degrees = Positions(np.zeros(len(places)), places[:, [1, 0, 2]], np.zeros((0, 3)), degrees=True)
    metres, chosen = degrees.projected(crs, path)
    return metres, str(chosen)
