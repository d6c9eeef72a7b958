"""Measured positions: of receivers (NMEA, RTKLIB, KITTI's OXTS, tables), and of control points."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import EvaluationError, FormatError, require
from recon.core.text import counted, parse_numbers
from recon.core.values.arrays import Float64
from recon.io.files import StrPath, parse_row, read_lines, read_text, reader, seconds_of_date
from recon.io.models.las import check_crs
from recon.io.named_table import (
    Columns,
    Row,
    columns_of,
    fields,
    first_row,
    is_number,
    pick,
    read_rows,
)
from recon.io.trajectory import UNIT_TOLERANCE, check_positions

_OF_TUM: Final = 8
_COUNTS: Final = (4, 5, 7, _OF_TUM)  # columns of a table without a header
_SIGMAS: Final = ("sigma", "sigma_e", "sigma_n", "sigma_u")
# Standard deviations of a horizontal coordinate in metres at a dilution of precision of 1, by the
# quality that NMEA 0183 states in GGA: autonomous, differential, RTK fixed, RTK floating.
_NMEA_SIGMA_M: Final = {1: 5.0, 2: 1.0, 4: 0.02, 5: 0.3}
_USUAL_SIGMA_M: Final = 10.0  # of other qualities: estimated, simulated
_UP: Final = 1.5  # how many times less a receiver knows its height
# GPS time does not have the leap seconds of UTC. Ref: IERS Bulletin C.
_LEAPS: Final = ((2017, 1, 18), (2015, 7, 17), (2012, 7, 16), (2009, 1, 15), (2006, 1, 14))
_GPS_EPOCH: Final = datetime(1980, 1, 6, tzinfo=timezone.utc)
_ELLIPSOID: Final = "the ellipsoid"
_ON_EARTH: Final = ("latitude(deg)", "longitude(deg)", "height(m)", "sde(m)", "sdn(m)", "sdu(m)")
_FROM_CENTRE: Final = (
    *("x-ecef(m)", "y-ecef(m)", "z-ecef(m)", "sdx(m)", "sdy(m)", "sdz(m)"),
    *("sdxy(m)", "sdyz(m)", "sdzx(m)"),
)
_RTKLIB: Final = (_ON_EARTH, _FROM_CENTRE)
"""Columns of its solutions that are read."""
_NMEA: Final = re.compile(r"\$?..(GGA|RMC|ZDA|GST),")
_FARTHEST_DEG: Final = (90.0, 360.0)
_HIGHEST_M: Final = 1e6  # no receiver of a rig is farther from the ground
_NO_PLACE_DEG: Final = 1e-6  # latitude and longitude of a receiver without a position


@dataclass(frozen=True, eq=False)
class Positions:
    """Positions in the order of time.

    ``places`` (N, 3) are degrees of latitude and longitude, or eastings and northings in metres,
    and heights in metres; ``sigma_m`` (N, 3) standard deviations east, north and up, NaN = unknown.
    """

    times_s: Float64
    places: Float64
    sigma_m: Float64
    degrees: bool = False
    heights: str = ""  # what they are above, if the format says

    def projected(self, crs: str | None, where: StrPath) -> tuple[Float64, str | None]:
        """Return metres east, north and up (N, 3), and their system: UTM's where none is given.

        Heights stay as they are: between the ellipsoid and the geoid lies a grid of tens of metres
        that must not be guessed.
        """
        if not self.degrees:
            return self.places, crs
        lat, lon = np.median(self.places[:, :2], axis=0)
        zone = int((lon + 180.0) // 6.0) % 60 + 1
        system = crs or f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"
        pyproj = require("pyproj", extra="survey")
        flat = check_crs(system)
        flat = flat.sub_crs_list[0] if flat.sub_crs_list else flat
        east = north = np.array([np.nan])
        with suppress(pyproj.exceptions.ProjError):  # such as a system of the Moon
            convert = pyproj.Transformer.from_crs("EPSG:4326", flat, always_xy=True)
            east, north = convert.transform(self.places[:, 1], self.places[:, 0])
        if not (np.isfinite(east).all() and np.isfinite(north).all()):
            what, expected = "positions cannot be converted", "latitude and longitude in its area"
            got = f"latitude {lat:g}, longitude {lon:g} in {system}"
            raise EvaluationError(what, where=where, got=got, expected=expected)
        return np.column_stack([east, north, self.places[:, 2]]), system


@reader
def read_positions(path: StrPath) -> Positions:
    """Read positions in the format that the file, or a folder of OXTS, shows itself to be in.

    Times are seconds on the clock of the file, since 1970 (UTC) where it has dates. Rows without a
    position are left out; sentences with a wrong checksum, too.

    Raises:
        FormatError: There is no position, or a row is not what its format says.

    Ref: NMEA 0183 (GGA, RMC, ZDA, GST); T. Takasu, "RTKLIB manual 2.4.2", appendix B; A. Geiger et
    al., "Vision meets robotics: the KITTI dataset", IJRR 32, 2013 (OXTS).
    """
    place = Path(path)
    if place.is_dir():
        return in_order(_read_oxts(place), place)
    first = next((line.strip() for line in read_text(place).splitlines() if line.strip()), "")
    if _NMEA.match(first) or first.startswith("$"):
        return in_order(_read_nmea(place), place)
    if first.startswith("%"):
        return in_order(_read_rtklib(place), place)
    return in_order(_read_table(place), place)


def in_order(found: Positions, path: StrPath) -> Positions:
    """Return positions in the order of time; those without a place are left out."""
    good = np.isfinite(found.places).all(axis=1) & np.isfinite(found.times_s)
    if found.degrees:
        good &= np.abs(found.places[:, :2]).max(axis=1, initial=0.0) > _NO_PLACE_DEG
        good &= np.abs(found.places[:, 2]) < _HIGHEST_M
        beyond = good & (np.abs(found.places[:, :2]) > _FARTHEST_DEG).any(axis=1)
        if beyond.any():
            lat, lon = found.places[beyond][0, :2]
            what, expected = "no such place", "latitude within 90 degrees, then longitude"
            got, hint = f"latitude {lat:g}, longitude {lon:g}", "are the two swapped?"
            raise FormatError(what, where=path, got=got, expected=expected, hint=hint)
    if not good.any():
        raise FormatError("the file has no position", where=path)
    known = (found.sigma_m > 0) & (found.sigma_m < np.inf)
    sigma_m = np.where(known, found.sigma_m, np.nan)
    order = np.flatnonzero(good)[np.argsort(found.times_s[good], kind="stable")]
    arrays = found.times_s[order], found.places[order], sigma_m[order]
    return Positions(*arrays, degrees=found.degrees, heights=found.heights)


def _read_table(path: Path) -> Positions:
    """Read rows of time, easting, northing, height, and perhaps one or three deviations.

    A header may name them in any order, also latitude and longitude.
    """
    columns, rows = read_rows(path)
    degrees, count = {"lat", "lon"} <= {*columns}, len(rows[0][1]) if rows else 0
    place = ("time", "lat", "lon", "height") if degrees else ("time", "east", "north", "height")
    if not columns:
        named = {5: _SIGMAS[:1], 7: _SIGMAS[1:]}.get(count, ())
        columns = {kind: n for n, kind in enumerate((*place, *named))}
        counts = (count,) if count in _COUNTS else _COUNTS
        numbers = [(at, parse_row(row, counts, at)) for at, row in rows]
        for at, row in numbers:
            norm = np.linalg.norm(row[4:]) if count == _OF_TUM else 1.0
            if abs(norm - 1.0) > UNIT_TOLERANCE:
                what, hint = "quaternion is not of unit length", "are commas in decimals?"
                raise FormatError(what, where=at, got=f"{norm:g}", hint=hint)
        rows = [(at, [str(x) for x in row]) for at, row in numbers]
    kinds = (*place, *(kind for kind in _SIGMAS if kind in columns))
    every = range(len(kinds))
    table = np.array([_numbers(pick(row, columns, kinds), every, row[0]) for row in rows])
    if not rows:
        raise FormatError("the file has no position", where=path)
    if not degrees:
        check_positions(table[:, 1:4], [int(at.rpartition(":")[2]) for at, _ in rows], path)
    sigma_m = np.full((len(table), 3), np.nan)
    if table.shape[1] > 4:
        sigma_m[:] = table[:, 4:]
        if not (degrees or (sigma_m > 0.0).all()):
            raise FormatError("a standard deviation is not above 0", where=path)
    return Positions(table[:, 0], table[:, 1:4], sigma_m, degrees=degrees)


def _numbers(words: Sequence[str], columns: Sequence[int], path: StrPath) -> list[float]:
    try:
        return [float(number) for number in parse_numbers([words[n] for n in columns])]
    except (IndexError, ValueError) as error:
        got = " ".join(words)[:60]
        raise FormatError("not a row of numbers", where=path, got=got) from error


def _read_oxts(folder: Path) -> Positions:
    folder = folder / "oxts" if (folder / "oxts").is_dir() else folder
    files = sorted((folder / "data").glob("*.txt"))
    if not files:
        expected = "data/*.txt and timestamps.txt"
        raise FormatError("the folder is not one of OXTS", where=folder, expected=expected)
    lines = [line for line in read_text(folder / "timestamps.txt").splitlines() if line.strip()]
    if len(lines) != len(files):
        got, expected = counted(len(lines), "time"), counted(len(files), "time")
        raise FormatError("wrong number of times", where=folder, got=got, expected=expected)
    times_s = [seconds_of_date(line, folder / "timestamps.txt") for line in lines]
    # Latitude, longitude, altitude; accuracy of the position (1 sigma) is number 23.
    rows = np.array([_numbers(read_text(one).split(), (0, 1, 2, 23), one) for one in files])
    sigma_m = np.repeat(rows[:, 3:], 3, axis=1)
    return Positions(np.array(times_s), rows[:, :3], sigma_m, degrees=True, heights=_ELLIPSOID)


def _read_rtklib(path: Path) -> Positions:
    lines = read_lines(path)
    heads = [line.lstrip("% ") for line in lines if line.startswith("%")]
    names = heads[-1].split() if heads else []
    kind = next((kind for kind in _RTKLIB if {*kind} <= {*names}), None)
    if kind is None:
        what = "not a solution with places on earth"
        expected = "RTKLIB's out-solformat=llh or xyz"
        raise FormatError(what, where=path, got=" ".join(names)[:60], expected=expected)
    gps = names[0].upper() == "GPST"
    # A time is two words, and has one name.
    used = [names.index(name) + 1 for name in kind]
    rows, times_s = [], []
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("%"):
            continue
        times_s.append(_rtklib_time(words[:2], path, gps=gps))
        rows.append(_numbers(words, used, path))
    if not rows:
        raise FormatError("the file has no position", where=path)
    table, above = np.array(rows), " ".join(heads)
    if kind == _FROM_CENTRE:
        return Positions(np.array(times_s), *_on_ellipsoid(table), degrees=True, heights=_ELLIPSOID)
    heights = _ELLIPSOID if "ellipsoidal" in above else "the geoid" if "geodetic" in above else ""
    return Positions(np.array(times_s), table[:, :3], table[:, 3:], degrees=True, heights=heights)


def _on_ellipsoid(table: Float64) -> tuple[Float64, Float64]:
    """Return latitude, longitude and height, and standard deviations east, north and up (N, 3).

    ``table`` (N, 9) is RTKLIB's: coordinates from the centre of the earth, their deviations, and
    signed roots of the covariances of x and y, y and z, z and x.
    """
    pyproj = require("pyproj", extra="survey")
    convert = pyproj.Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)
    lon, lat, height = convert.transform(*table[:, :3].T)
    xx, yy, zz, xy, yz, zx = (np.sign(table[:, 3:]) * table[:, 3:] ** 2).T
    covariance = np.array([[xx, xy, zx], [xy, yy, yz], [zx, yz, zz]])
    (se, ce), (sn, cn), zero = (
        *((np.sin(angle), np.cos(angle)) for angle in np.radians([lon, lat])),
        np.zeros(len(lon)),
    )
    axes = np.array([[-se, ce, zero], [-sn * ce, -sn * se, cn], [cn * ce, cn * se, sn]])
    variance = np.einsum("ijn,jkn,ikn->ni", axes, covariance, axes)
    return np.column_stack([lat, lon, height]), np.sqrt(np.maximum(variance, 0.0))


def _rtklib_time(words: Sequence[str], path: Path, *, gps: bool) -> float:
    if "/" in words[0]:
        seconds = seconds_of_date(" ".join(words), path)
    else:  # week and seconds
        week, of_week = _numbers(words, (0, 1), path)
        seconds = (_GPS_EPOCH + timedelta(weeks=week, seconds=of_week)).timestamp()
    at = datetime.fromtimestamp(seconds, timezone.utc)
    leaps = next((n for year, month, n in _LEAPS if (at.year, at.month) >= (year, month)), 0)
    return seconds - leaps if gps else seconds


def _read_nmea(path: Path) -> Positions:
    """Read sentences of a receiver: GGA for positions, RMC or ZDA for the date, GST for sigma."""
    rows: list[list[float]] = []
    day_s, before_s = 0.0, 0.0
    deviations: dict[str, list[float]] = {}
    for kind, words in _sentences(path):
        if kind == "RMC" and len(words) > 8 and len(words[8]) == 6:
            day_s = _day(words[8][4:], words[8][2:4], words[8][:2], path)
        elif kind == "ZDA" and len(words) > 3 and words[3]:
            day_s = _day(words[3], words[2], words[1], path)
        elif kind == "GST" and len(words) > 7 and all(words[5:8]):
            north, east, up = _numbers(words, (5, 6, 7), path)
            deviations[words[0]] = [east, north, up]
        elif kind == "GGA" and len(words) > 8 and words[5] not in ("", "0"):
            clock = words[0][:2], words[0][2:4], words[0][4:]
            hours, minutes, seconds = _numbers(clock, (0, 1, 2), path)
            time_s = 3600.0 * hours + 60.0 * minutes + seconds
            # Midnight may come before the new date.
            time_s += day_s + (86400.0 if day_s + time_s < before_s - 43200.0 else 0.0)
            before_s = time_s
            lat = _degrees(words[1], words[2], path)
            lon = _degrees(words[3], words[4], path)
            quality, dilution, height = _numbers([w or "1" for w in words], (5, 7, 8), path)
            each = _NMEA_SIGMA_M.get(int(quality), _USUAL_SIGMA_M) * dilution
            sigma_m = deviations.get(words[0], [each, each, _UP * each])
            rows.append([time_s, lat, lon, height, *sigma_m])
    if not rows:
        what, hint = "no sentence has a position", "GGA with a quality above 0, and a checksum"
        raise FormatError(what, where=path, hint=hint)
    table = np.array(rows)
    if day_s:
        dated = table[:, 0] >= 86400.0
        table[~dated, 0] += 86400.0 * np.floor(table[dated, 0].min(initial=day_s) / 86400.0)
    above = "the geoid of the receiver"
    return Positions(table[:, 0], table[:, 1:4], table[:, 4:], degrees=True, heights=above)


def _sentences(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield kind and fields of the sentences whose checksum is right."""
    for line in read_text(path).splitlines():
        content, star, checksum = line.strip().lstrip("$").partition("*")
        if not star or f"{reduce(xor, content.encode(), 0):02X}" != checksum.strip().upper():
            continue
        kind, *words = content.split(",")
        yield kind[2:], words


def _day(year: str, month: str, day: str, path: Path) -> float:
    century = 0 if len(year) == 4 else 1900 if int(year) >= 70 else 2000
    return seconds_of_date(f"{century + int(year)}-{month}-{day} 00:00:00", path)


def _degrees(text: str, side: str, path: Path) -> float:
    point = text.find(".") if "." in text else len(text)
    degrees, minutes = _numbers([text[: point - 2] or "0", text[point - 2 :]], (0, 1), path)
    return (degrees + minutes / 60.0) * (-1.0 if side in ("S", "W") else 1.0)


_UTM: Final = re.compile(r"WGS84 UTM (0?[1-9]|[1-5]\d|60)([NS])$", re.IGNORECASE)
_SYSTEM: Final = re.compile(r"(EPSG:\d+|\+proj|WGS84 UTM )", re.IGNORECASE)
_CHECK: Final = "check"
_SAME_SYSTEM_M: Final = 10.0  # datums of today differ by metres, zones and older datums by more


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
    """Return whether a file begins with a coordinate system, or a header that names images."""
    if not Path(path).is_file():
        return False
    with Path(path).open("rb") as file, suppress(FormatError):
        first = first_row(file.read(4000).decode("utf-8-sig", errors="replace"))
        return bool(_SYSTEM.match(first)) or "image" in columns_of(fields(first), path)
    return False


@reader
def read_control(path: StrPath, crs: str | None = None) -> ControlPoints:
    """Read a list of control points as OpenDroneMap has it.

    The first line is a coordinate system; the others are ``x y z column row image [name]``, in
    degrees longitude and latitude if the system has those, else metres; ``check`` behind the name
    makes it a check point. A name may come first, and a header names columns in any order. Rows of
    one name, or without one of one place, are one point. ``crs`` is the system to convert degrees
    to (None = that of UTM), or for the system of the file, which a header may do without.

    Raises:
        FormatError: A row is not as above, or rows of one name have different places.

    Ref: https://docs.opendronemap.org/gcp/
    """
    lines = read_text(path).splitlines()
    begin = next((n for n, line in enumerate(lines, 1) if _SYSTEM.match(line.strip())), 0)
    columns, rows = read_rows(path, begin)
    system = first_row(lines[begin - 1]) if begin else crs
    if utm := _UTM.match(system or ""):
        system = f"EPSG:{(32600 if utm[2] in 'Nn' else 32700) + int(utm[1])}"
    degrees = {"lat", "lon"} <= {*columns}
    system = "EPSG:4326" if degrees and not begin else system
    if system is None:
        what, expected = "no coordinate system", "a first line such as EPSG:25832, or --crs"
        raise FormatError(what, where=path, expected=expected)
    named: dict[str, list[_Row]] = {}
    for each in rows:
        row = _row(_as_listed(each, columns), each[0])
        named.setdefault(row.name or f"{row.numbers[:3]}", []).append(row)
    if not named:
        raise FormatError("the file has no control point", where=path)
    for name, (first, *others) in named.items():
        if any(row.numbers[:3] != first.numbers[:3] for row in others):
            got = f"{first.numbers[:3]} and others"
            raise FormatError("one point has several places", where=f"{path}: {name}", got=got)
    firsts = np.array([found[0].numbers[:3] for found in named.values()], np.float64)
    places_m, system = _in_metres(firsts, system, crs, path, degrees=degrees)
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


def _as_listed(row: Row, columns: Columns) -> list[str]:
    """Return a row in the order of OpenDroneMap's list."""
    words = row[1]
    if not columns:
        named = len(words) > 6 and not is_number(words[0])
        return [*words[1:7], words[0], *words[7:]] if named else words
    plane = ("lon", "lat") if {"lat", "lon"} <= {*columns} else ("east", "north")
    listed = pick(row, columns, (*plane, "height", "column", "row", "image"))
    name, check = (
        "".join(words[at : at + 1])
        for at in (columns.get(kind, len(words)) for kind in ("name", "check"))
    )
    if check.lower() not in ("", _CHECK):
        expected = f"{_CHECK}, or nothing"
        raise FormatError("not a check point, nor none", where=row[0], got=check, expected=expected)
    return [*listed, name, *([_CHECK] if check else [])]


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


def _in_metres(
    places: Float64, system: str, crs: str | None, path: StrPath, *, degrees: bool
) -> tuple[Float64, str]:
    pyproj = require("pyproj", extra="survey")
    try:
        geographic = pyproj.CRS.from_user_input(system).is_geographic
    except pyproj.exceptions.CRSError as error:
        raise FormatError("unknown coordinate system", where=path, got=system) from error
    if not geographic:
        stated = check_crs(system, path)
        if not degrees:
            if crs is not None:
                there = pyproj.Transformer.from_crs(stated, check_crs(crs), always_xy=True)
                moved_m = np.array(there.transform(*places[:, :2].T)).T - places[:, :2]
                # Names of one system, perhaps with heights; also of datums that are nearly one.
                if not np.linalg.norm(moved_m, axis=1).max() < _SAME_SYSTEM_M:
                    what, hint = "the list has another coordinate system", "drop --crs"
                    raise FormatError(what, where=path, got=system, expected=crs, hint=hint)
            return places, crs or system
        crs = crs or system
    found = Positions(np.zeros(len(places)), places[:, [1, 0, 2]], np.zeros((0, 3)), degrees=True)
    metres, chosen = found.projected(crs, path)
    return metres, str(chosen)
