"""Positions as receivers write them: NMEA, KITTI's OXTS, RTKLIB and a table of degrees."""

from datetime import datetime, timezone
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np

GEOID_M = 47.6
DAY_S = datetime(2011, 9, 26, tzinfo=timezone.utc).timestamp()


def moment(time_s: float) -> datetime:
    return datetime.fromtimestamp(round(time_s, 3), timezone.utc)


def degrees_of(position_m, crs: str):
    """float64 (N, 3), latitude, longitude and height of eastings, northings and heights."""
    import pyproj

    convert = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    lon, lat = convert.transform(position_m[:, 0], position_m[:, 1])
    return np.column_stack([lat, lon, position_m[:, 2]])


def _sentence(content: str) -> str:
    return f"${content}*{reduce(xor, content.encode(), 0):02X}\r\n"


def _minutes(degrees: float, digits: int, sides: str) -> str:
    whole, side = int(abs(degrees)), sides[int(degrees < 0)]
    return f"{whole:0{digits}d}{60 * (abs(degrees) - whole):011.8f},{side}"


def write_nmea(path: Path, times_s, degrees, quality: int = 4) -> Path:
    lines = []
    for time_s, (lat, lon, height) in zip(times_s, degrees, strict=True):
        clock = moment(time_s)
        at = clock.strftime("%H%M%S") + f".{clock.microsecond // 1000:03d}"
        place = f"{_minutes(lat, 2, 'NS')},{_minutes(lon, 3, 'EW')}"
        lines += [
            _sentence(f"GPRMC,{at},A,{place},0.0,0.0,{clock:%d%m%y},,,A"),
            _sentence(
                f"GPGGA,{at},{place},{quality},12,0.8,{height - GEOID_M:.4f},M,{GEOID_M},M,,"
            ),
        ]
    path.write_text("".join(lines), encoding="utf-8")
    return path


def write_oxts(folder: Path, times_s, degrees, sigma_m: float = 0.05) -> Path:
    (folder / "data").mkdir(parents=True)
    lines = []
    for number, (time_s, row) in enumerate(zip(times_s, degrees, strict=True)):
        words = [*(f"{v:.14g}" for v in row), *["0"] * 20, f"{sigma_m}", *["0"] * 6]
        (folder / f"data/{number:010d}.txt").write_text(" ".join(words), encoding="utf-8")
        lines.append(f"{moment(time_s):%Y-%m-%d %H:%M:%S.%f}000\n")
    (folder / "timestamps.txt").write_text("".join(lines), encoding="utf-8")
    return folder


def write_rtklib(path: Path, times_s, degrees, leap_s: int = 15) -> Path:
    names = "latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) age(s) ratio"
    lines = [
        "% program   : RTKLIB ver.2.4.2\n",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,ns=# of satellites)\n",
        f"%  GPST          {names}\n",
    ]
    for time_s, (lat, lon, height) in zip(times_s, degrees, strict=True):
        at = f"{moment(time_s + leap_s):%Y/%m/%d %H:%M:%S.%f}"[:-3]
        lines.append(f"{at} {lat:.9f} {lon:.9f} {height:.4f} 1 9 0.01 0.02 0.03 0 0 10\n")
    path.write_text("".join(lines), encoding="utf-8")
    return path


def write_ecef(path: Path, times_s, degrees) -> Path:
    """A solution of RTKLIB in coordinates from the centre of the earth, known best to the north."""
    import pyproj

    convert = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    lat, lon, height = degrees.T
    names = "x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s)"
    lines = ["% (x/y/z-ecef=WGS84,Q=1:fix,2:float,ns=# of satellites)\n", f"%  UTC {names}\n"]
    for time_s, n, e, xyz in zip(
        times_s, np.radians(lat), np.radians(lon), np.stack(convert.transform(lon, lat, height), 1),
        strict=True,
    ):  # fmt: skip
        east = np.array([-np.sin(e), np.cos(e), 0.0])
        north = np.array([-np.sin(n) * np.cos(e), -np.sin(n) * np.sin(e), np.cos(n)])
        axes = np.stack([east, north, np.cross(east, north)], axis=1)
        spread = axes @ np.diag(np.square([0.02, 0.01, 0.03])) @ axes.T
        signed = np.sign(spread) * np.sqrt(np.abs(spread))
        sigma = [signed[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0))]
        at = f"{moment(time_s):%Y/%m/%d %H:%M:%S.%f}"[:-3]
        numbers = " ".join(f"{v:.5f}" for v in xyz), " ".join(f"{v:.7f}" for v in sigma)
        lines.append(f"{at} {numbers[0]} 1 9 {numbers[1]} 0.0\n")
    path.write_text("".join(lines), encoding="utf-8")
    return path


def write_degrees(path: Path, times_s, degrees, names: str = "time,lat,lon,alt") -> Path:
    rows = [
        f"{time_s:.3f},{','.join(f'{v:.10f}' for v in row)}\n"
        for time_s, row in zip(times_s, degrees, strict=True)
    ]
    path.write_text("".join([names + "\n", *rows]), encoding="utf-8")
    return path
