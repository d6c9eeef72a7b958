"""What a table is, and parts of commands and formats that several share."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from result_drift_rows import Rows


@dataclass(frozen=True)
class Table:
    """One table."""

    commands: dict[str, str]  # shell lines, by name
    columns: dict[str, str]  # format of the cells, by heading
    # What makes the cells of the printed JSON of all commands, by label and heading.
    rows: Callable[[dict[str, Any]], Rows]
    timed: bool = False  # whether it depends on what else the machine does
    scenes: str = ""  # what the rows that name no scene are of, as in `tuned_on.py`

    def lacking(self) -> str:
        """What is needed and not there; empty if nothing is."""
        words = " ".join(self.commands.values()).split()
        data = [word for word in words if word.startswith("$RECON_DATA")]
        if data and not os.environ.get("RECON_DATA"):
            return "RECON_DATA is not set"
        missing = [word for word in data if not Path(os.path.expandvars(word)).exists()]
        return f"there is no {missing[0]}" if missing else ""


PERCENT: Final = "{:.2f} %"
SHARE: Final = "{:.3f}"
CM: Final = "{:.1f} cm"
MB: Final = "{:.0f} MB"

DRIVES: Final = {
    "kitti_raw_0013": "$RECON_DATA/driven/kitti_raw_0013",
    "sequence 06": "$RECON_DATA/driven/kitti_06_51",
}
D13, D06 = DRIVES.values()

MIDDLEBURY: Final = "recon evaluate middlebury $RECON_DATA/middlebury/MiddEval3/trainingQ --json"
HALF_SIZE: Final = (
    "recon evaluate middlebury $RECON_DATA/middlebury/MiddEval3/trainingH --json "
    "--truth $RECON_DATA/middlebury/MiddEval3/trainingQ"
)
RIGS: Final = {
    "kitti_raw_0013": (D13, "13"),
    "sequence 06": (D06, "06"),
    "kitti_05_100": ("$RECON_DATA/driven/kitti_05_100", "05"),
}
REFINED: Final = {
    "as calibrated (`rig.refine=off`)": ("--set rig.refine=off",),
    "refined (default)": (),
}

OPENCV, FILLED = "opencv-bm,opencv-sgbm", "--set matching.fill=true"
MEASURED: Final = "--set matching.fill=false"
PADDED: Final = "--set matching.opencv.pad=true"
ON_KEYFRAMES: Final = "--set matching.keyframe_matcher=fine"
KNOWN_POSES: Final = {
    "": "",
    ", what moved kept": "--set fusion.remove_moving=false",
    ", `fine` on keyframes": ON_KEYFRAMES,
    ", `sgm`, `fine` on keyframes": f"--matcher sgm {ON_KEYFRAMES}",
    ", `fine`": "--matcher fine",
}


def map_drive(drive: str, name: str, *options: str) -> str:
    return " ".join(
        ["recon map", drive, *options, "--no-mesh --json --quiet --out", f"$OUT/{name}"]
    )


def against_lidar(name: str, *options: str) -> str:
    words = ["recon evaluate map", f"$OUT/{name}", f"{D13}/lidar_map.ply --threshold 0.2 --json"]
    return " ".join([*words, *options])


def scored(scenes: str, name: str, matchers: str, *options: str) -> str:
    return " ".join([scenes, "--matcher", matchers, *options, f"--out $OUT/{name}"])


def truth_of(drive: str, *options: str) -> str:
    """What other programs say of the truth of a drive: each table with drift runs it, once."""
    return " ".join(
        [f'python benchmarks/three_paths.py {drive} --only "as it is" --json', *options]
    )
