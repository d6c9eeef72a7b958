"""What a finished run has left in its folder, for the commands that go on from there."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import check_rigid
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.io.files import StrPath, read_text, reader, reading, refuse_links, resolved
from recon.run.directory import RECORD, RECORD_BYTES, state_folder
from recon.run.run import SUMMARY

STATES: Final = "states.csv"  # of the frames of a drive that was located
GRID: Final = "map/grid.yaml"
OCTOMAP: Final = "map/octomap.ot"
CLOUD: Final = "map/cloud.ply"
# Record keys of a run made from another run: the command that mapped the drive; of one without a
# map of its own, what was doubted there.
MAPPED_BY: Final = "mapped_by"
DOUBTS: Final = "doubts"


def command_of_map(folder: Path) -> str:
    """Return the command that mapped the drive of a finished run, such as ``demo``."""
    record = _record_of_map(folder)
    command = record.get(MAPPED_BY, record.get("command"))
    if not isinstance(command, str):
        raise FormatError("record of the run does not name its command", where=folder / RECORD)
    return command


def made_from(folder: Path) -> tuple[Float64, list[str]]:
    """Return ``T_map_world`` and doubts of the map that a run without a map was made from."""
    path, record = folder / RECORD, _record_of_map(folder)
    with reading(path):
        T_map_world = np.array(record["T_map_world"], dtype=np.float64)
    check_rigid("T_map_world", T_map_world, path)
    doubts = record.get(DOUBTS, [])
    if not isinstance(doubts, list) or not all(isinstance(line, str) for line in doubts):
        raise FormatError(f"record of the run has no valid {DOUBTS}", where=path)
    return T_map_world, doubts


def states_of(folder: Path) -> Path:
    """Return the table of a run that located a drive, or as far as it has, if it still does."""
    growing = state_folder(folder) / STATES
    return growing if growing.is_file() else folder / STATES


def is_pair_run(folder: Path) -> bool:
    """Return whether a folder holds a finished run of `recon pair`."""
    return _read_record(folder / RECORD).get("command") == "pair"


def camera_of_pair(folder: Path) -> RectifiedCamera:
    """Return the rectified camera of a run of `recon pair`, from its summary."""
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


def figure_of(folder: Path, name: str) -> float | None:
    """Return a figure of a run, such as ``camera_height_m``, from its summary; None = unknown."""
    figure = _read_record(folder / SUMMARY).get(name)
    if figure is None or (type(figure) in (int, float) and math.isfinite(figure)):
        return figure
    raise FormatError(f"the summary of the run has no valid {name}", where=folder / SUMMARY)


def refuse_as_target(run: Path, out: StrPath | None) -> None:
    """Refuse to write derived results into the folder of the run, which would replace it."""
    if out is not None and resolved(out) == resolved(run):
        raise SettingsError("the results would replace the run", where=out, hint="another --out")


def _record_of_map(folder: Path) -> dict[str, Any]:
    record = _read_record(folder / RECORD)
    if "T_map_world" not in record:
        raise FormatError("the run made no map: its record has no T_map_world", where=folder)
    return record


@reader
def _read_record(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise FormatError(
            "folder does not contain a finished run", where=path.parent, expected=f"a {path.name}"
        )
    refuse_links(path.parent)
    record = json.loads(read_text(path, RECORD_BYTES))
    if not isinstance(record, dict):
        raise FormatError("record of the run cannot be read", where=path)
    return record
