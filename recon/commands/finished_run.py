"""The record and configuration of a finished run, read from its folder."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.core.errors import FormatError, SettingsError
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64, freeze
from recon.io.files import read_text, reader, reading
from recon.map.ground.axes import check_rigid
from recon.run.directory import RECORD
from recon.run.run import CONFIG, SUMMARY

RECORD_BYTES: Final = 1 << 26
"""Larger than any record: it lists the files of a run."""
GRID: Final = "map/grid.yaml"
OCTOMAP: Final = "map/octomap.ot"
CLOUD: Final = "map/cloud.ply"
PAIR_CLOUD: Final = "clouds/cloud.ply"
MAPPED_BY: Final = "mapped_by"
"""Record key of a run made from another run: the command that mapped the drive."""
UNTRUSTED: Final = "untrusted_frames"
"""Record key of the numbers of frames whose pose is not to be trusted."""


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A finished run with maps.

    Attributes:
        folder: Its folder.
        mapped_by: The command that mapped the drive, such as ``demo``.
        config: Its configuration.
        T_map_world: float64 (4, 4), from world to map axes.
        untrusted: Numbers of the frames whose pose is not to be trusted.
    """

    folder: Path
    mapped_by: str
    config: ReconConfig
    T_map_world: Float64
    untrusted: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "T_map_world", np.float64, (4, 4))


def open_run(folder: Path) -> FinishedRun:
    """Read the record and the configuration of a run with maps.

    Raises:
        FormatError: The folder does not contain a finished run, or one without maps.
        SettingsError: Its configuration is not valid in this version.
    """
    path = folder / RECORD
    record = _read_record(path)
    if "T_map_world" not in record:
        raise FormatError("the run made no map: its record has no T_map_world", where=folder)
    with reading(path):
        T_map_world = np.array(record["T_map_world"], dtype=np.float64)
    check_rigid("T_map_world", T_map_world, path)
    mapped_by = record.get(MAPPED_BY, record.get("command"))
    untrusted = record.get(UNTRUSTED, [])
    if not isinstance(untrusted, list) or not all(type(n) is int for n in untrusted):
        raise FormatError(f"record of the run has no valid {UNTRUSTED}", where=folder / RECORD)
    return FinishedRun(
        folder, str(mapped_by), _read_config(folder / CONFIG), T_map_world, tuple(untrusted)
    )


def _read_config(path: Path) -> ReconConfig:
    """The settings of a run; those of another version may not be known or valid in this one."""
    try:
        return load_config(path)
    except SettingsError as error:
        raise SettingsError(
            f"the settings of this run are not valid in this version: {error.what}",
            where=error.where,
            got=error.got,
            hint="map the drive again",
        ) from error


def check_changes(
    run: FinishedRun, config: ReconConfig | None, sections: Collection[str]
) -> ReconConfig:
    """The settings to make something of a run with; those of the run if None are given.

    Raises:
        SettingsError: They differ from those of the run in another section, which has no effect.
    """
    if config is None:
        return run.config
    for name in type(config).model_fields:
        if name not in sections and getattr(config, name) != getattr(run.config, name):
            raise SettingsError(
                "this setting has no effect here: the drive is not mapped again",
                got=name,
                expected=f"settings of {', '.join(sections)}",
                hint="recon map takes it",
            )
    return config


def settings_of(folder: Path, file: Path | None, overrides: Sequence[str]) -> ReconConfig:
    """The settings of a run of map, demo or pair, with changes.

    Args:
        folder: Folder of the run.
        file: YAML file of settings, applied before the overrides; None = none.
        overrides: ``key=value`` settings.

    Raises:
        FormatError: The folder does not contain such a run.
        SettingsError: A setting is invalid.
    """
    if is_pair_run(folder):
        return load_config(file, overrides, PAIR_DEFAULTS)
    return load_config(file, overrides, open_run(folder).config.model_dump(mode="json"))


def is_pair_run(folder: Path) -> bool:
    """Whether a folder holds a finished run of `recon pair`.

    Raises:
        FormatError: The folder does not contain a finished run.
    """
    return _read_record(folder / RECORD).get("command") == "pair"


def camera_of_pair(folder: Path) -> RectifiedCamera:
    """The rectified camera of a run of `recon pair`, from its summary.

    Raises:
        FormatError: The summary cannot be read, or names no camera.
        CalibrationError: It is none that could have measured anything.
    """
    summary = _read_record(folder / SUMMARY)
    names = ("focal_px", "cx_px", "cy_px", "doffs_px", "baseline_m", "width_px", "height_px")
    try:
        focal, cx, cy, doffs, baseline, width, height = (float(summary[name]) for name in names)
        return RectifiedCamera(focal, cx, cy, cx + doffs, baseline, int(width), int(height))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(
            "the summary of the run does not describe its camera",
            where=folder / SUMMARY,
            expected=", ".join(names),
            hint="run recon pair again",
        ) from error


def refuse_as_target(run: Path, out: Path | None) -> None:
    """Refuse to write derived results into the folder of the run, which would replace it.

    Raises:
        SettingsError: ``out`` is the folder of the run.
    """
    if out is not None and out.resolve() == run.resolve():
        raise SettingsError("the results would replace the run", where=out, hint="another --out")


@reader
def _read_record(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FormatError(
            "folder does not contain a finished run", where=path.parent, expected=f"a {path.name}"
        )
    record = json.loads(read_text(path, RECORD_BYTES))
    if not isinstance(record, dict):
        raise FormatError("record of the run cannot be read", where=path)
    return record
