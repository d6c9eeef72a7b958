"""What an inertial unit measured, in EuRoC's files; damaged ones are used as far as they go."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import FormatError
from recon.core.geometry.se3 import invert, orthonormalise
from recon.core.text import counted, parse_numbers
from recon.core.values import ImuRecord
from recon.core.values.arrays import Bool, Float64
from recon.io.cameras.ros import NS
from recon.io.fields import Fields, read_yaml
from recon.io.files import read_lines, reader

_COLUMNS: Final = 7  # time, three rates of turn, three forces
_LEAST: Final = 2  # rows
_MOST: Final = 2e4  # of a rate or force: the widest range of a gyro, in degrees per second
_RIGID_TOLERANCE: Final = 1e-3  # files print three to seven digits


@reader
def read_imu(path: Path) -> ImuRecord:
    """Read ``data.csv``: time [ns], rates [rad/s], forces [m/s²]; more columns are not looked at.

    Rows that are no measurement, or not later than those before (or all are sorted), are noted.
    """
    lines = enumerate(read_lines(path), start=1)
    rows = [(n, _row(line)) for n, line in lines if line.partition("#")[0].strip()]
    table = np.array([row for _, row in rows]).reshape(-1, _COLUMNS)
    return imu_of(table, [f"{path.name}:{n}" for n, _ in rows], str(path))


def _row(line: str) -> list[float]:
    """Return the numbers of a row; NaN where it is none."""
    try:
        values = parse_numbers(line.partition("#")[0].replace(",", " ").split()[:_COLUMNS])
    except ValueError:
        values = []
    return values if len(values) == _COLUMNS else [np.nan] * _COLUMNS


def imu_of(table: Float64, places: Sequence[str], where: str) -> ImuRecord:
    """Return the record of rows (N, 7): nanoseconds, rates, forces; ``places`` name the rows."""
    possible = np.isfinite(table[:, 0]) & (np.abs(table[:, 1:]) <= _MOST).all(axis=1)
    order, notes = np.flatnonzero(possible), []
    kept = _in_order(table[order, 0])
    if 2 * kept.sum() < len(np.unique(table[order, 0])):
        notes.append("IMU: its rows are not in order of time: sorted")
        order = order[np.argsort(table[order, 0], kind="stable")]
        kept = _in_order(table[order, 0])
    order = order[kept]
    if len(order) < _LEAST:
        got = f"{counted(len(table), 'row')}, of which {len(order)} can be used"
        raise FormatError("IMU has no measurements", where=where, got=got)
    unused = np.setdiff1d(np.arange(len(table)), order)
    if len(unused):
        first, rows = places[unused[0]], f"{counted(len(unused), 'row')} of {len(table)}"
        notes.append(f"IMU: {rows} are no measurement after the one before (first {first}): unused")
    times_s, gyro, accel = table[order, 0] * NS, table[order, 1:4], table[order, 4:7]
    return ImuRecord(times_s, gyro, accel, None, where, tuple(notes))


def _in_order(times: Float64) -> Bool:
    """Return the most times (N,) that increase, without those too late or those too early."""
    most = np.maximum.accumulate(np.concatenate([[-np.inf], times[:-1]]))
    least = np.minimum.accumulate(np.concatenate([times[1:], [np.inf]])[::-1])[::-1]
    return max(times > most, times < least, key=np.count_nonzero)


@reader
def read_body(path: Path) -> Float64:
    """Read ``T_BS`` (4, 4) of a ``sensor.yaml``: from axes of the sensor to those of the body."""
    return _rigid(Fields(read_yaml(path)).below("T_BS").numbers("data", (4, 4)))


@reader
def read_kalibr_imu(path: Path) -> Float64 | None:
    """Read ``T_cam_imu`` (4, 4) of the left camera of kalibr's chain; None = it has none."""
    left = Fields(read_yaml(path)).below("cam0")
    return _rigid(left.numbers("T_cam_imu", (4, 4))) if "T_cam_imu" in left else None


def _rigid(T: Float64) -> Float64:
    if np.abs(orthonormalise(T) - T).max() > _RIGID_TOLERANCE:
        raise FormatError("not a rigid transform", expected="a rotation and a translation")
    return orthonormalise(T)


def read_axes(imu: Path, camera: Path, chain: Path | None) -> tuple[Float64 | None, str]:
    """Return ``T_camera_imu`` (4, 4), None = no file says it; and what is wrong with the files.

    ``imu`` and ``camera`` are the ``sensor.yaml`` of the unit and of the left camera; ``chain`` is
    the calibration of both cameras, where that has none.
    """
    try:
        if camera.is_file():
            T_body_imu = np.eye(4)
            note = f"IMU: {imu} is missing: taken as the body that T_BS of the cameras means"
            if imu.is_file():
                T_body_imu, note = read_body(imu), ""
            return invert(read_body(camera)) @ T_body_imu, note
        found = None if chain is None else read_kalibr_imu(chain)
    except FormatError as error:
        return None, f"IMU: {error}; its axes are those that the drive shows"
    if found is None:
        return None, f"IMU: {imu} states no axes: they are those that the drive shows"
    return found, ""
