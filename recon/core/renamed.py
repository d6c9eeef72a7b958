"""Names of settings from before 1.0, in files, options and maps: all of them, to be dropped as one.

A name that has a new one is read under that, for one version. What became a constant is read if it
has the value of that constant, and refused else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, NamedTuple

from recon.core.errors import SettingsError


class Renamed(NamedTuple):
    """What a setting is called now, and the default that says nothing."""

    to: str
    default: Any = ...  # that it had, dropped where it is found; ... = none says nothing
    length: bool = False  # whether the default is that on a road, to be multiplied by the scale
    values: Mapping[str, str] = {}  # names of its values that are others now


_COMMON: Final = {
    "sad": {"ndisp": None, "min_disparity_px": 0, "window_px": 11, "uniqueness_percent": 2},
    "sgm": {"ndisp": None, "min_disparity_px": 0, "window_px": 5, "uniqueness_percent": 0},
    "fine": {"ndisp": None, "min_disparity_px": 0, "uniqueness_percent": 0},
    "opencv": {"ndisp": None, "min_disparity_px": 0},
}
RENAMED: Final[dict[str, Renamed]] = {
    **{
        f"matching.{matcher}.{name}": Renamed(f"matching.{name}", default)
        for matcher, settings in _COMMON.items()
        for name, default in settings.items()
    },
    **{f"matching.{matcher}.fill": Renamed("matching.fill") for matcher in _COMMON},
    "matching.opencv.block_px": Renamed("matching.window_px", None),
    "mesh.pair_surface": Renamed("mesh.surface", "grid"),
    "mesh.map_surface": Renamed("mesh.surface", "voxels", values={"voxels": "grid"}),
    "ground.reach_m": Renamed("occupancy.max_range_m", 25.0, length=True),
    "robot.clearance_m": Renamed("grid.max_height_m", 2.0),
    "capture.side_by_side": Renamed("source.side_by_side", "left-right"),
}
CONSTANTS: Final[dict[str, Any]] = {
    "matching.sgm.p1": 16.0,
    "matching.sgm.p2": 50.0,
    "matching.onnx.time_limit_s": 600.0,
    "cloud.stride": 1,
    "odometry.prior.max_gap_s": 1.0,
    "grid.min_blob_cells": 3,
    "mesh.cell_spacings": 1.5,
    "mesh.max_depth": 10,
    "street.baseline_m": 0.54,
    "street.pitch_deg": 1.0,
}
_IN_A_ROOM: Final[dict[str, Any]] = {"street.baseline_m": 0.12, "street.pitch_deg": 8.0}
_SINCE: Final = "1.0"


def current_names(values: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return nested values of settings under the names of today, and what to say of old ones.

    Raises:
        SettingsError: A constant of today has another value, or old names of one setting differ.
    """
    found = {name: value for name in (*RENAMED, *CONSTANTS) if (value := _at(values, name)) != ...}
    if not found:
        return dict(values), []
    scale = _at(values, "scene.scale")
    scale = scale if isinstance(scale, int | float) else 1.0
    kept, notes, moved = _without(values, found), list[str](), dict[str, tuple[str, Any]]()
    for name, value in found.items():
        if name in CONSTANTS:
            in_a_room = _at(values, "street.path") == "room"
            _check_constant(name, value, {**CONSTANTS, **(_IN_A_ROOM if in_a_room else {})}[name])
            notes.append(f"{name} is a constant since {_SINCE}: remove it")
            continue
        new = RENAMED[name]
        notes.append(f"{name} is {new.to} since {_SINCE}")
        default = scale * new.default if new.length else new.default
        if default is ... or not _same(value, default):
            meant = new.values.get(str(value), value)
            moved.setdefault(new.to, (name, meant))
            given = _at(kept, new.to)
            first, other = moved[new.to] if given is ... else (new.to, given)
            if not _same(meant, other):
                raise SettingsError(
                    f"{name} and {first} are one setting since {_SINCE}, and differ",
                    got=f"{meant} and {other}",
                    hint=f"give {new.to} alone",
                )
    for to, (_, value) in moved.items():
        group, _, name = to.rpartition(".")
        kept[group] = {**kept.get(group, {}), name: value}
    return kept, notes


def _at(values: Any, name: str) -> Any:
    """Return the value of a dotted name in nested values; ... = it is not there."""
    for part in name.split("."):
        if not isinstance(values, Mapping) or part not in values:
            return ...
        values = values[part]
    return values


def _without(values: Mapping[str, Any], names: Mapping[str, Any], prefix: str = "") -> Any:
    """Return nested values without those of some dotted names, and without what is empty then."""
    kept = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if name in names:
            continue
        inner = _without(value, names, f"{name}.") if isinstance(value, Mapping) else value
        if inner != {} or value == {}:
            kept[key] = inner
    return kept


def _check_constant(name: str, value: Any, constant: Any) -> None:
    if not _same(value, constant):
        raise SettingsError(
            f"setting {name!r} is a constant since {_SINCE}",
            got=value,
            expected=constant,
            hint="remove it, or use an earlier version",
        )


def _same(value: Any, other: Any) -> bool:
    value = None if value == "none" else value
    if isinstance(value, int | float) and isinstance(other, int | float):
        return abs(value - other) <= 1e-6 * abs(other)
    return bool(value == other)
