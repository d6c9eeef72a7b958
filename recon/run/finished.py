"""What a finished run has left in its folder, for the commands that go on from there."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import check_rigid
from recon.core.text import is_count
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64, freeze
from recon.io.files import StrPath, read_text, reader, reading, resolved
from recon.run.directory import RECORD, RECORD_BYTES, refuse_links
from recon.run.run import SUMMARY

GRID: Final = "map/grid.yaml"
OCTOMAP: Final = "map/octomap.ot"
CLOUD: Final = "map/cloud.ply"
PAIR_CLOUD: Final = "clouds/cloud.ply"
MAPPED_BY: Final = "mapped_by"
"""Record key of a run made from another run: the command that mapped the drive."""
DOUBTS: Final = "doubts"
"""Record key of a run made from another run, without a map of its own: what was doubted there."""


@dataclass(frozen=True, eq=False)
class FinishedRun:
    """A finished run with maps.

    Attributes:
        folder: Its folder.
        mapped_by: The command that mapped the drive, such as ``demo``.
        T_map_world: float64 (4, 4), from world to map axes.
        doubts: What was doubted in the map that a run without one was made from.
    """

    folder: Path
    mapped_by: str
    T_map_world: Float64
    doubts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "T_map_world", np.float64, (4, 4))

    @property
    def path_file(self) -> Path:
        """The path of the drive, or of the one that began the map; it may be missing."""
        alone = self.folder / "trajectory_tum.txt"
        drives = self.folder.glob("sessions/*/trajectory_tum.txt")
        return alone if alone.is_file() else min(drives, key=_session_of, default=alone)


def _session_of(path_file: Path) -> int:
    """Return the number of the drive whose folder a file is in."""
    return int(path_file.parent.name) if is_count(path_file.parent.name) else sys.maxsize


def open_run(folder: Path) -> FinishedRun:
    """Read the record of a run with maps."""
    path = folder / RECORD
    record = _read_record(path)
    if "T_map_world" not in record:
        raise FormatError("the run made no map: its record has no T_map_world", where=folder)
    with reading(path):
        T_map_world = np.array(record["T_map_world"], dtype=np.float64)
    check_rigid("T_map_world", T_map_world, path)
    mapped_by = record.get(MAPPED_BY, record.get("command"))
    doubts = record.get(DOUBTS, [])
    if not isinstance(doubts, list) or not all(isinstance(line, str) for line in doubts):
        raise FormatError(f"record of the run has no valid {DOUBTS}", where=path)
    return FinishedRun(folder, str(mapped_by), T_map_world, tuple(doubts))


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
