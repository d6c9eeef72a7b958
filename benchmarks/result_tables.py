"""The tables of README and docs/results.md: their commands, and which figures they show.

In a command, ``$RECON_DATA`` is the folder of real data and ``$OUT`` a temporary one that the
commands of a table share; the last command of a line prints JSON.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import result_pair_rows as pair_rows_of
import result_rows as rows_of
from result_commands import (
    CM,
    D06,
    D13,
    DRIVES,
    FILLED,
    HALF_SIZE,
    KNOWN_POSES,
    MB,
    MEASURED,
    MIDDLEBURY,
    OPENCV,
    PADDED,
    PERCENT,
    RIGS,
    SHARE,
    Table,
    against_lidar,
    map_drive,
    scored,
    truth_of,
)
from result_drift_rows import OF_TRUTH, TRUTH
from result_drift_tables import DRIFT_TABLES

TABLES: Final[dict[str, Table]] = {
    **DRIFT_TABLES,
    "kitti-lidar": Table(
        {
            f"known poses{how}": map_drive(D13, f"known{n}", f"--poses {D13}/poses.txt", options)
            + f" && {against_lidar(f'known{n}')}"
            for n, (how, options) in enumerate(KNOWN_POSES.items())
        }
        | {
            "own path, `--align-to`": f"{map_drive(D13, 'own')} && "
            + against_lidar("own", f"--align-to {D13}/poses.txt"),
            "own path, `--align icp`": against_lidar(
                "own", f"--align-to {D13}/poses.txt --align icp"
            ),
        },
        dict.fromkeys(("precision", "recall", "F", "precision in reach", "F in reach"), SHARE),
        rows_of.lidar,
    ),
    "kitti-disparity": Table(
        {"": f"python benchmarks/lidar_disparity.py {D13} {D13}/lidar_map.ply --json"},
        {f"{depths} m": "{:+.2f} px" for depths in ("4 to 8", "8 to 12", "12 to 16", "16 to 22")}
        | {f"{depths} m": "{:+.2f} px" for depths in ("22 to 30", "30 to 45")}
        | {"parts, rms": "{:.2f} px", "largest": "{:.2f} px"}
        | {"LiDAR moved": "{:.0f} mm", "turned": "{:.2f}°"},
        rows_of.disparities,
    ),
    "kitti-depth": Table(
        {
            "": f"python benchmarks/lidar_disparity.py {D13} {D13}/lidar_map.ply --json "
            "--matchers sgm,sad,fine"
        },
        dict.fromkeys(("4 to 8 m", "8 to 12 m", "12 to 16 m", "16 to 22 m"), "{}")
        | dict.fromkeys(("22 to 30 m", "30 to 45 m"), "{}"),
        rows_of.depths,
    ),
    "planted": Table(
        {
            Path(folder).name: f"python benchmarks/planted_faults.py $RECON_DATA/{folder} --json"
            for folder in (
                "driven/kitti_raw_0013",
                "driven/kitti_06_51",
                "driven/kitti_05_100",
                "walked/backyard",
            )
        }
        | {f"{Path(drive).name}{OF_TRUTH}": truth_of(drive) for drive, _ in RIGS.values()},
        {"planted": "{:.2f} px", "left": "{:.2f} px", "recovered": "{:.0f} %"}
        | {"t_rel": PERCENT, "without it": PERCENT, TRUTH: "{}"},
        rows_of.planted,
    ),
    "kitti-localize": Table(
        {"drive": f"python benchmarks/localize.py {D13} --elsewhere {D06} --json"},
        {"tracked": "{:.1f} %", "median": CM, "95 %": CM, "largest": CM, "angle": "{:.2f}°"}
        | {"off by 0.5 m": "{}"},
        rows_of.localized,
    ),
    "kitti-halves": Table(
        {"halves": f"python benchmarks/merge.py --parts halves --drive {D13} --json"}
        | {"truth": truth_of(D13)},
        {
            "t_rel, one run": "{:.3f} %",
            "merged": "{:.3f} %",
            TRUTH: "{}",
            "paths apart": "{:.0f} mm",
        }
        | {"cells that differ": PERCENT, "free against occupied": PERCENT},
        rows_of.halves,
    ),
    "kitti-speed": Table(
        {
            name: f"python benchmarks/mapping.py --json --no-rays --drive {drive}"
            for name, drive in DRIVES.items()
        }
        | {
            "kitti_raw_0013, voxels of 5 cm": "python benchmarks/mapping.py --json --no-rays "
            f"--drive {D13} --set fusion.voxel_m=0.05"
        },
        {"frames per second": "{:.1f}", "whole run": "{:.0f} s", "processor": "{:.0f} s"}
        | {"memory": MB},
        rows_of.mapping,
        timed=True,
    ),
    "kitti-live": Table(
        {"drive": f"python benchmarks/live.py {D13} --rates 1 2 --only-live --json"}
        | {"truth": truth_of(D13)},
        {"p50": "{:.0f} ms", "p95": "{:.0f} ms", "largest": "{:.0f} ms", "dropped": "{}"}
        | {"tracked, not matched": "{}", "t_rel": PERCENT, TRUTH: "{}", "memory": MB},
        rows_of.live,
        timed=True,
    ),
    "ros2": Table(
        {"drive": f"python benchmarks/ros2.py {D13} --json"},
        {"p50": "{:.1f} ms", "p95": "{:.1f} ms", "max": "{:.1f} ms", "dropped": "{}"}
        | {"cores": "{:.1f}", "memory": MB},
        rows_of.ros2,
        timed=True,
    ),
    "middlebury": Table(
        {
            "": scored(MIDDLEBURY, "plain", "sad,sgm,fine,opencv-bm,opencv-sgbm"),
            ", as measured": scored(MIDDLEBURY, "measured", "sad,sgm", MEASURED),
            ", padded": scored(MIDDLEBURY, "padded", OPENCV, PADDED),
            ", padded, filled": scored(MIDDLEBURY, "padded-filled", OPENCV, PADDED, FILLED),
            ", half size": scored(HALF_SIZE, "half", "sgm,fine"),
            ", half size, as measured": scored(HALF_SIZE, "half-measured", "sgm", MEASURED),
            ", half size, padded": scored(HALF_SIZE, "half-padded", "opencv-sgbm", PADDED),
        },
        {"bad 1": "{:.1f} %", "bad 2": "{:.1f} %", "bad 4": "{:.1f} %", "mean error": "{:.1f} px"},
        pair_rows_of.middlebury,
        scenes="MiddEval3",
    ),
    "pairs": Table(
        {"": "python benchmarks/pairs.py --json"},
        dict.fromkeys(pair_rows_of.PAIRS, "{:.1f} %")
        | {"ECE": "{}", "AUSE at steps": SHARE}
        | {"seconds": "{:.1f}"},
        pair_rows_of.pairs,
        timed=True,
    ),
    "confidence": Table(
        {
            folder: f"recon evaluate middlebury $RECON_DATA/middlebury/{folder} "
            f"--matcher {matchers} --json --out $OUT/{Path(folder).name}"
            for folder, matchers in {
                "MiddEval3/trainingQ": "sad,sgm,fine",
                # `fine` was trained on scenes of the others.
                **dict.fromkeys(("2003", "2005", "2006"), "sad,sgm"),
            }.items()
        },
        {"calibration error": SHARE, "AUSE": SHARE}
        | {"within one sigma": "{:.0f} %", "within two": "{:.0f} %"},
        pair_rows_of.confidence,
    ),
    "pair-meshes": Table(
        {
            "scenes": "python benchmarks/pair_meshes.py --json "
            + " ".join(
                f"$RECON_DATA/middlebury/MiddEval3/trainingQ/{name}"
                for name in ("Motorcycle", "Playroom", "Piano", "Recycle", "Pipes")
            )
            + f" {D13} $RECON_DATA/rendered/yard"
        },
        {"covered": SHARE, "within 1 px": SHARE, "mean": "{:.2f} px", "95 %": "{:.1f} px"}
        | {"on points": SHARE, "over 10 %": PERCENT, "over 20 %": PERCENT}
        | {"faces": "{:,}", "not manifold": "{}", "seconds": "{:.1f}"},
        pair_rows_of.pair_meshes,
        timed=True,
    ),
    "drive-meshes": Table(
        {
            drive: f"python benchmarks/drive_meshes.py $RECON_DATA/driven/{drive} "
            f"$RECON_DATA/driven/{drive}/lidar_map.ply $RECON_DATA/driven/{drive}/poses.txt --json"
            for drive in ("kitti_raw_0013",)
        },
        {"mesh / mapping": "{:.2f}", "precision": SHARE, "recall": SHARE, "F": SHARE}
        | {"faces": "{:,}", "border": "{:,.0f} m", "edges not manifold": "{}", "seconds": "{:.1f}"},
        rows_of.drive_meshes,
        timed=True,
    ),
    "textures": Table(
        {
            "rendered street": "python benchmarks/textures.py --street --json",
            "kitti_05_100": "python benchmarks/textures.py $RECON_DATA/driven/kitti_05_100 --json",
        },
        {"covered": SHARE, "PSNR, vertices": "{:.1f} dB", "PSNR, texture": "{:.1f} dB"}
        | {"within, vertices": "{:.1f} dB", "within, texture": "{:.1f} dB"}
        | {"SSIM, vertices": SHARE, "SSIM, texture": SHARE},
        lambda found: found,
    ),
    "esdf": Table(
        {
            f"rendered street, seed {seed}": f"python benchmarks/esdf.py --seed {seed} --json"
            for seed in (0, 1)
        },
        {"places": "{:,}", "off": "{:.2f} m", "off, 95 %": "{:.2f} m", "nearer": "{:.2f} m"}
        | {"too far": "{:.1f} %", "seconds": "{:.1f}", "memory": "{:.0f} MB"},
        lambda found: found,
        timed=True,
    ),
    "orthophoto": Table(
        {
            "orthophoto": "python benchmarks/orthophoto.py "
            "--drive $RECON_DATA/driven/kitti_raw_0013 --json"
        },
        {"cell": "{:.3f} m", "patches": "{}", "median": "{:.3f} m", "95 %": "{:.3f} m"}
        | {"median in cells": "{:.2f}", "95 % in cells": "{:.2f}"},
        lambda found: found["orthophoto"],
    ),
    "survey": Table(
        {
            "kitti_raw_0013": "python benchmarks/survey.py $RECON_DATA/driven/kitti_raw_0013 "
            "$RECON_DATA/driven/kitti_raw_0013/lidar_map.ply "
            "$RECON_DATA/driven/kitti_raw_0013/poses.txt --json"
        },
        {"height": "{:+.3f} m", "absolute": "{:.3f} m", "moved": "{:.1f} m", "misfit": "{:.3f} m"}
        | {"left out": "{}", "said": "{}"},
        lambda found: found["kitti_raw_0013"],
    ),
    "view": Table(
        {"kitti_raw_0013": "python benchmarks/view.py $RECON_DATA/driven/kitti_raw_0013 --json"},
        {"unseen": SHARE, "seen": SHARE, "first picture": "{:.1f} s", "points": "{:,}"},
        lambda found: found,
        timed=True,
    ),
    "movers": Table(
        {
            "seed 4": "python benchmarks/movers.py --seed 4",
            "seed 7": "python benchmarks/movers.py --seed 7",
            "seed 7, slower": "python benchmarks/movers.py --seed 7 --pace 0.6",
            "seed 11, faster": "python benchmarks/movers.py --seed 11 --pace 1.6",
            "fences alone, seed 4": "python benchmarks/movers.py --seed 4 --fences",
        },
        {"moving points": "{}", "of them gone": "{:.1f} %", "of static ones lost": PERCENT}
        | {"of posts and lamps": "{:.1f} %"},
        rows_of.movers,
    ),
    "second-day": Table(
        {
            "2 m aside": "python benchmarks/merge.py --parts second",
            "opposite lane, positions of 2 cm": "python benchmarks/merge.py --parts second "
            "--lane opposite --measured 0.02",
        },
        {"precision": SHARE, "recall": SHARE, "F": SHARE, "points on cars that left": "{}"},
        rows_of.second_day,
    ),
    "occupancy": Table(
        {"streets": "python benchmarks/occupancy.py --json"},
        dict.fromkeys(
            (
                *("voxels.precision", "voxels.recall", "voxels_exact.precision"),
                *("voxels_exact.recall", "grid.iou_occupied", "grid_exact.iou_occupied"),
                *("grid_exact.iou_free", "grid.occupied_called_free"),
            ),
            SHARE,
        ),
        rows_of.occupancy,
    ),
    "traversability": Table(
        {"courses": "python benchmarks/traversability.py --json"},
        dict.fromkeys(
            ("0 to 4 m", "4 to 8 m", "8 to 12 m", "12 to 20 m", "over, free", "over, to 50"), "{}"
        )
        | dict.fromkeys(("over, above 50", "ramps, obstacle"), "{}"),
        rows_of.traversability,
    ),
    "costs-lidar": Table(
        {
            "kitti_raw_0013": f"python benchmarks/costs_lidar.py {D13} {D13}/lidar_map.ply "
            f"{D13}/poses.txt --json"
        },
        {"cells": "{:,}", "0 to 99": "{:.1f} %"}
        | dict.fromkeys(("free", "graded", "obstacle", "unsure", "unknown"), "{:,}"),
        rows_of.costs_lidar,
    ),
    "loops": Table(
        {
            "block 1": "python benchmarks/loops.py --json",
            "block 2": "python benchmarks/loops.py --json --seed 2",
        },
        {"loops": "{}"}
        | {
            f"{what} {when}": SHARE if what == "F" else "{:.2f} m"
            for what in ("end", "ATE", "F")
            for when in ("before", "after")
        },
        rows_of.loops,
    ),
    "rooms": Table(
        {"rooms": "python benchmarks/rooms.py --json"},
        {
            "frames in the map": "{:.1f} %",
            "ATE, median": PERCENT,
            "ATE, worst": PERCENT,
            "laps closed": "{}",
            "loops": "{}",
            "wrong": "{}",
        },
        rows_of.rooms,
    ),
    "degraded": Table(
        {"street": "python benchmarks/degraded_drives.py --json"},
        {
            f"`{odometry}` {what}": form
            for odometry in ("visual", "kiss")
            for what, form in (("t_rel", PERCENT), ("not trusted", "{}"))
        },
        rows_of.degraded,
    ),
    "recordings": Table(
        {"recordings": "python benchmarks/recordings.py $RECON_DATA --json"},
        dict.fromkeys(("camera", "map", "not trusted", "ATE"), "{}")
        | {"precision": SHARE, "recall": SHARE}
        | dict.fromkeys(("ORB-SLAM3", "COLMAP"), "{}"),
        rows_of.recordings,
    ),
    "year": Table(
        {"year": "python benchmarks/year.py --json"},
        {"weeks": "{}", "map after the first": "{:.1f} MB", "after the last": "{:.1f} MB"}
        | {"second added in": "{:.0f} s", "last in": "{:.0f} s"}
        | {"last found at 3 cm": "{:.0f} %", "off": CM},
        rows_of.year,
    ),
    "changes": Table(
        {"changes": "python benchmarks/changes.py --pairs 0-1,50-51,0-51,12-14,25-26,0-26 --json"},
        {"cars that came or went": "{}", "replaced": "{}", "objects": "{}", "false": "{}"}
        | {"not compared": "{:.0f} %"},
        rows_of.changes,
    ),
    "unchanged": Table(
        {
            "changes": "python benchmarks/changes.py --pairs none --drives "
            f"{D06} {D13} $RECON_DATA/driven/town_60 $RECON_DATA/driven/kitti_05_100 --json"
        },
        {"path": "{:.0f} m", "objects": "{}", "not compared": "{:.0f} %", "volume": "{}"}
        | {"height": "{:.1f} mm", "area": "{:.0f} m²", "cut": "{:.1f} m³", "fill": "{:.1f} m³"},
        rows_of.unchanged,
    ),
    "surfaces": Table(
        {
            "as it comes": "python benchmarks/surfaces.py $RECON_DATA/rendered/yard --json",
            "`scene.scale=0.5`": "python benchmarks/surfaces.py $RECON_DATA/rendered/yard "
            "--set scene.scale=0.5 --json",
        },
        {"points": "{:,}", "reach": "{:.1f} m", "precision": PERCENT}
        | dict.fromkeys(("recall 0 to 2 m", "2 to 4 m", "4 to 6 m"), "{:.1f} %"),
        rows_of.surfaces,
    ),
    "weather": Table(
        {"street": "python benchmarks/weather.py --json"},
        {"frames": "{}", "lost": "{}", "ATE": CM, "t_rel": PERCENT, "matched": "{:.0f} %"}
        | {"of it wrong": "{:.0f} %", "ORB-SLAM3 lost": "{}", "its ATE": CM, "its t_rel": PERCENT},
        rows_of.weather,
    ),
    "light": Table(
        {
            "pairs": "python benchmarks/light.py $RECON_DATA/middlebury/MiddEval3/trainingQ "
            "--matcher sad,sgm,fine,opencv-sgbm --json"
        },
        dict.fromkeys(("`sad`", "`sgm`", "`fine`", "`opencv-sgbm`"), "{:.1f} %"),
        rows_of.light,
        scenes="MiddEval3",
    ),
    "drift-intervals": Table(
        {"streets": "python benchmarks/drift_intervals.py --drives 40 --json"},
        {"drives": "{}", "segments within their 95 % interval": "{:.1f} %"}
        | {"error over stated deviation, rms": "{:.2f}"},
        rows_of.intervals,
    ),
    "rig-intervals": Table(
        {"streets": "python benchmarks/rig_intervals.py --drives 40 --json"},
        dict.fromkeys(("corner", "left", "right", "top", "centre", "mean"), "{:.0f} %")
        | dict.fromkeys(("yaw", "parameters", "length", "not recovered"), "{:.0f} %"),
        rows_of.rig_intervals,
    ),
    "matching": Table(
        {
            f"{n} thread{'s'[: n - 1]}": f"python benchmarks/matching.py --json --threads {n}"
            for n in (1, 2)
        },
        dict.fromkeys(
            (
                *("opencv-bm / sad", "opencv-bm / sad-upright"),
                *("opencv-sgbm-hh / sgm", "opencv-sgbm-3way / sgm"),
            ),
            "{:.2f}",
        ),
        rows_of.matching,
        timed=True,
    ),
    "rays": Table(
        {"rays": "python benchmarks/mapping.py --json --no-drive"},
        {"times as fast": "{:.1f}", "same occupied cells": PERCENT, "same free cells": PERCENT},
        rows_of.rays,
        timed=True,
    ),
    "memory": Table(
        {
            "street": "python benchmarks/memory.py --json --frames 1000 --frames 4000 "
            "--again merge --again localize"
        },
        {"recon map": MB, "recon merge": MB, "recon localize": MB},
        rows_of.memory,
    ),
    "scheduler": Table(
        {"sleeping": "python benchmarks/fleet.py scheduler --workers 10 100 --jobs 1000 2000"},
        {"ms per job": "{:.1f}", "jobs per second at most": "{}"},
        rows_of.scheduler,
        timed=True,
    ),
}
