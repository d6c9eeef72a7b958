"""Names from before 1.0, of settings and of keys in JSON: all of them, to be dropped as one.

A name that has a new one is read under that, for one version. What became a constant is read if it
has the value of that constant, and refused else.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

from recon.core.errors import SettingsError
from recon.core.settings import merge


class Renamed(NamedTuple):
    """What a setting is called now, and the default that says nothing."""

    to: str
    default: Any = ...  # that it had, dropped where it is found; ... = none says nothing
    values: Mapping[str, str] = {}  # names of its values that are others now


class OnRoad(NamedTuple):
    """A length on a road, that follows from the size of the scene."""

    road_m: float


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
    "odometry.prior.sigma_share": Renamed("odometry.prior.sigma_ratio", 0.03),
    "matching.opencv.block_px": Renamed("matching.window_px", None),
    "mesh.pair_surface": Renamed("mesh.surface", "grid"),
    "mesh.map_surface": Renamed("mesh.surface", "voxels", values={"voxels": "grid"}),
    "ground.reach_m": Renamed("occupancy.max_range_m", OnRoad(25.0)),
    "robot.clearance_m": Renamed("grid.max_height_m", 2.0),
    "capture.side_by_side": Renamed("source.side_by_side", "left-right"),
}
CONSTANTS: Final[dict[str, Any]] = {
    "matching.sgm.p1": 16.0,
    "matching.sgm.p2": 50.0,
    "matching.onnx.time_limit_s": 600.0,
    "matching.onnx.tile_megapixels": 1.0,
    "cloud.stride": 1,
    "odometry.max_range_m": OnRoad(30.0),
    "odometry.prior.max_gap_s": 1.0,
    "filters.radius_m": None,
    "map_filters.voxel_m": None,
    "map_filters.statistical_neighbours": None,
    "grid.min_blob_cells": 3,
    "mesh.cell_spacings": 1.5,
    "mesh.max_depth": 10,
    "mesh.trim_density_quantile": 0.01,
    "mesh.free_space": True,
    "mesh.point_weight": (4.0, 16.0),  # of a map and of a pair
    "paper.as_printed": False,
    "paper.patches_px": [*range(3, 22, 2)],
    "street.baseline_m": 0.54,
    "street.pitch_deg": 1.0,
}
JOINED: Final = {
    f"{group}.size_px": (f"{group}.width_px", f"{group}.height_px")
    for group in ("matching.onnx", "capture")
}
"""New settings, each of two values, of which each was one."""
_IN_A_ROOM: Final[dict[str, Any]] = {"street.baseline_m": 0.12, "street.pitch_deg": 8.0}
_SINCE: Final = "1.0"
_LARGE: Final = 1e300  # whole numbers may be too large for what is compared
_NOTES: Final = {
    **{name: f"{name} is {new.to} since {_SINCE}" for name, new in RENAMED.items()},
    **{n: f"{n} is a part of {to} since {_SINCE}" for to, names in JOINED.items() for n in names},
    **{name: f"{name} is a constant since {_SINCE}: remove it" for name in CONSTANTS},
}


def current_names(
    values: Mapping[str, Any], changed: Mapping[str, Any] | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Return nested values of settings under the names of today, and what to say of old ones.

    ``changed`` are settings that the values change, which are a wish then: what is as it was by
    default says something, too.

    Raises:
        SettingsError: A constant of today has another value, or names of one setting differ.
    """
    found = {name: value for name in _NOTES if (value := _at(values, name)) is not ...}
    if not found:
        return dict(values), []
    whole = merge(changed or {}, values)
    scale = _at(whole, "scene.scale")
    scale = scale if isinstance(scale, int | float) else 1.0
    constants = {**CONSTANTS, **(_IN_A_ROOM if _at(whole, "street.path") == "room" else {})}
    for name in found.keys() & constants.keys():
        if not _same(found[name], constants[name], scale):
            raise SettingsError(
                f"setting {name!r} is a constant since {_SINCE}",
                got=found[name],
                expected=_written(constants[name], scale),
                hint="remove it, or use an earlier version",
            )
    kept, notes = _without(values, found), {name: _NOTES[name] for name in found}
    idle = _idle(_at(values, "matching"))
    for to, name, value in _moved(found, scale, every=changed is not None):
        if name.startswith(idle):
            continue
        given = _at(kept, to)
        if given is not ... and not _same(value, given, scale):
            if changed is None and _at(values, to) is not ...:  # runs of before have both
                notes[name] = f"{notes[name]}: {_shown(given)} is used, not {_shown(value)}"
                continue
            raise SettingsError(
                f"{name} is {to} since {_SINCE}, which has another value here",
                got=f"{_shown(value)} and {_shown(given)}",
                hint=f"give {to} alone",
            )
        inner: Any = value
        for part in reversed(to.split(".")):
            inner = {part: inner}
        kept = merge(kept, inner)
    return kept, [*notes.values()]


def _idle(matching: Any) -> tuple[str, ...]:
    """Return how old names begin that are of matchers which are not used, where that is said."""
    if not isinstance(matching, Mapping) or not matching.get("matcher"):
        return ()
    names = (matching["matcher"], matching.get("keyframe_matcher"))
    used = {str(name).partition("-")[0] for name in names}
    return tuple(f"matching.{name}." for name in _COMMON if name not in used)


def _moved(
    found: Mapping[str, Any], scale: float, *, every: bool
) -> Iterator[tuple[str, str, Any]]:
    """Yield new name, old name and value of what is not as it is by default, or of ``every``."""
    for name, new in RENAMED.items():
        idle = not every and new.default is not ... and _same(found.get(name), new.default, scale)
        if name in found and not idle:
            yield new.to, name, new.values.get(str(found[name]), found[name])
    for to, names in JOINED.items():
        parts = [found.get(name) for name in names]
        if any(part not in (None, "none") for part in parts):
            yield to, names[0], parts


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


def _same(value: Any, other: Any, scale: float) -> bool:
    if isinstance(other, tuple) and not isinstance(other, OnRoad):
        return any(_same(value, one, scale) for one in other)
    value, other = None if value == "none" else value, _written(other, scale)
    if isinstance(value, int | float) and isinstance(other, int | float):
        return math.isclose(value, other, rel_tol=1e-6) if abs(value) < _LARGE else False
    return bool(value == other)


def _shown(value: Any) -> str:
    return "none" if value is None else str(value)


def _written(value: Any, scale: float) -> Any:
    return scale * value.road_m if isinstance(value, OnRoad) else value


_OF_ERRORS: Final = (
    "", "mean_", "spread_", "rms_", "median_", "95_", "before_", "after_", "held_out_",
)  # fmt: skip
FORMER_KEYS: Final = {
    **{
        f"{group}.{key}": former
        for group in ("rig", "rig_by_motion")
        for key, former in (("epipolar_error_px", "rows_px"), ("right_time_offset", "right_late"))
    },
    "imu.time_offset_ms": "late_ms",
    "imu.time_offset_sigma_ms": "late_sigma_ms",
    "loops.dense_ratio": "dense_share",
    ".segments": "drive_sessions",
    "time_offset_frames": "lag_frames",
    "repaired": "mended",
    "repair_pitch_deg": "mend_pitch_deg",
    "repair_roll_deg": "mend_roll_deg",
    "epipolar_noise_px": "row_noise_px",
    **{f"epipolar_error_{part}px": f"row_error_{part}px" for part in _OF_ERRORS},
    **{
        f"{name}ratio": f"{name}share"
        for name in ("", *["valid_", "swapped_", "tilted_", "calibration_", "matching_", "icp_"])
    },
    "grid_size": "occupancy_size",
}
"""Keys of summaries and events, and what they were called: both are written, for one version.

Before the dot is the group that a key is in; nothing = it is one of the whole.
"""


def without_former_keys(value: Any, group: str = "") -> Any:
    """Return what `with_former_keys` was given."""
    if isinstance(value, list):
        return [without_former_keys(item, group) for item in value]
    if not isinstance(value, Mapping):
        return value
    former = {_former_key(group, key) for key in value}
    return {k: without_former_keys(v, k) for k, v in value.items() if k not in former}


def with_former_keys(value: Any, group: str = "") -> Any:
    """Return what is ready for JSON, each key that was renamed under its former name, too."""
    if isinstance(value, list):
        return [with_former_keys(item, group) for item in value]
    if not isinstance(value, Mapping):
        return value
    found: dict[str, Any] = {}
    for key, item in value.items():
        found[key] = with_former_keys(item, key)
        former = _former_key(group, key)
        if former is not None and former not in value:
            found[former] = found[key]
    return found


def _former_key(group: str, key: str) -> str | None:
    return FORMER_KEYS.get(f"{group}.{key}", FORMER_KEYS.get(key))
