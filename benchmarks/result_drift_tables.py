"""The tables of drift on drives whose truth has an error of its own."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import result_drift_rows as rows_of
from result_commands import (
    CM,
    D13,
    DRIVES,
    PERCENT,
    REFINED,
    RIGS,
    SHARE,
    Table,
    against_lidar,
    map_drive,
    truth_of,
)
from result_drift_rows import OF_TRUTH, TRUTH

_DRIFT: Final = dict(
    zip(
        ("t_rel", TRUTH, "r_rel", "ATE", "length"),
        ("{:.3f} %", "{}", "{:.2f} °/100 m", CM, "{:.4f}"),
        strict=True,
    )
)
_TRUTHS: Final = {
    f"{name}, {how}{OF_TRUTH}": truth_of(drive, *options)
    for name, (drive, _) in RIGS.items()
    for how, options in REFINED.items()
}
DRIFT_TABLES: Final[dict[str, Table]] = {
    "kitti-drift": Table(
        {f"{name} visual": map_drive(drive, name[-2:]) for name, drive in DRIVES.items()}
        | {
            f"{name} kiss": f"python benchmarks/kiss_spread.py {drive} --json"
            for name, drive in DRIVES.items()
        }
        | {f"{name}{OF_TRUTH}": truth_of(drive) for name, drive in DRIVES.items()},
        {"t_rel": PERCENT, "least to most": "{}", TRUTH: "{}", "r_rel": "{:.2f} °/100 m"}
        | {"ATE": CM}
        | {"not trusted": "{}"},
        rows_of.drift,
    ),
    "kitti-lenses": Table(
        {
            f"{name}, {how}": map_drive(drive, f"{key}{how[:2]}", *options)
            for name, (drive, key) in RIGS.items()
            for how, options in REFINED.items()
        }
        | {
            f"kitti_raw_0013, {how}, F": against_lidar(
                f"13{how[:2]}", f"--align-to {D13}/poses.txt"
            )
            for how in REFINED
        }
        | _TRUTHS,
        {**_DRIFT, "F, own path": SHARE},
        rows_of.lenses,
    ),
    "kitti-sfm": Table(
        {
            f"{name}, {how}": map_drive(drive, f"sfm{key}{how[:2]}", "--odometry sfm", *options)
            for name, (drive, key) in RIGS.items()
            if name != "sequence 06"  # whose truth begins late
            for how, options in REFINED.items()
        }
        | {label: line for label, line in _TRUTHS.items() if "sequence 06" not in label},
        _DRIFT,
        rows_of.lenses,
    ),
    "kitti-altered": Table(
        {
            f"{name}, {how}": f"python benchmarks/altered_drives.py {drive} --json "
            f"--peer benchmarks/peers/orbslam3/{Path(drive).name} {' '.join(options)}"
            for name, (drive, _) in RIGS.items()
            for how, options in REFINED.items()
        }
        | {
            f"{name}{OF_TRUTH}": f"python benchmarks/three_paths.py {drive} --json"
            for name, (drive, _) in RIGS.items()
        },
        {"as calibrated": PERCENT, "refined": PERCENT, TRUTH: "{}", "length": "{:.4f}"}
        | {"ORB-SLAM3": PERCENT, "its length": "{:.4f}"},
        rows_of.altered,
    ),
    "three-paths": Table(
        _TRUTHS,
        {"segments": "{}", "side by side": "{}"}
        | dict.fromkeys(("truth", "ours", *rows_of.PEERS, "share errors", "ours to truth"), "{}")
        | {rows_of.alone(path, peer): "{}" for peer in rows_of.PEERS for path in ("truth", "ours")},
        rows_of.three_paths,
    ),
}
