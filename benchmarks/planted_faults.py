"""How much of a fault that is planted into the rig of a drive its motion takes away again.

The rig of the drive is refined first, until it stays as it is, and counts as right. Then one thing
is made wrong, and the drive refined again. `recovered` is the share that is gone of what features
move by, root mean square over the image, at 10 m; beside it what is left in pixels, and the drift
with the rig found, where the true path is known.

Example: python benchmarks/planted_faults.py DRIVE --json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from altered_drives import alterations, run

from recon.commands.config import load_config
from recon.core.values import StereoCalibration
from recon.look.fault import NAMES, RigFault, without_fault
from recon.look.fit import ROAD_DEPTH_M
from recon.look.look import refine_rig
from recon.look.rig import RefinedRig, RigChange, compare_rigs
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source
from recon.sources.source import StereoSource
from recon.stereo.rectify.epipolar import as_raw
from recon.stereo.rectify.rectifier import turns_of

SHIFT_PX: Final = 2.0
MOST_TIMES: Final = 4
FAULTS: Final = ("yaw 0.05°", "yaw 0.1°", "yaw 0.5°", "focal 0.2 %", "principal point", "k1")


def planted(name: str, rig: StereoCalibration) -> StereoCalibration:
    """Return a rig with one thing made wrong."""
    if name == "principal point":
        matrix = rig.right.matrix.copy()
        matrix[:2, 2] += SHIFT_PX
        return replace(rig, right=replace(rig.right, matrix=matrix))
    turns, values = turns_of(rig, load_config().rectification), np.zeros(len(NAMES))
    if name == "k1":
        at = NAMES.index("left_k1")
        values[at] = RigFault(turns.camera).sigmas[at]  # moves the corners by a pixel
    else:
        what, amount = name.split()[:2]
        ratio = what == "focal"
        at = NAMES.index("zoom" if ratio else "yaw")
        values[at] = 0.01 * float(amount) if ratio else np.radians(float(amount.rstrip("°")))
    return without_fault(rig, turns, values)


def measure(folder: Path, names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return what became of each fault, and first the drift of the rig as it is."""
    config, drive = load_config(), open_source(folder)
    rig = refine_rig(drive, config, config.rig).calibration
    for _ in range(MOST_TIMES):
        clean = refine_rig(drive.with_calibration(rig), config, config.rig)
        rig = clean.calibration
        if not clean.refined:
            break
    rig, clean = as_raw(rig), replace(clean, given=drive.calibration)
    found: dict[str, dict[str, Any]] = {"none": drift_of(drive, clean)}
    for name in names:
        wrong = planted(name, rig)
        again = refine_rig(drive.with_calibration(wrong), config, config.rig)
        before, after = (
            moved_px(compare_rigs(one, rig, ROAD_DEPTH_M, config.rectification))
            for one in (wrong, again.calibration)
        )
        found[name] = {
            "planted_px": before,
            "left_px": after,
            "recovered_percent": 100.0 * (1.0 - after / before),
            **drift_of(drive, replace(again, given=drive.calibration)),
        }
    return found


def drift_of(drive: StereoSource, rig: RefinedRig) -> dict[str, float]:
    """Return errors of the path of a drive; nothing where the true one is not known."""
    if drive.truth is None:
        return {}
    found = run(alterations(drive)["as it is"], {"": make_odometry("visual")}, rig)[""]
    return {name: found[name] for name in ("t_rel_percent", "scale")}


def moved_px(change: RigChange) -> float:
    return round(change.moved_px, 3)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--only", nargs="+", choices=FAULTS, default=FAULTS)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args(arguments)
    found = measure(options.drive, options.only)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    for name, row in found.items():
        cells = (f"{key} {value:.3f}" for key, value in row.items())
        print(f"{name:18s}" + "   ".join(cells))


if __name__ == "__main__":
    main()
