"""The commands of the tables: parts that several share."""

from __future__ import annotations

from typing import Final

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

OPENCV, FILLED = "opencv-bm,opencv-sgbm", "--set matching.opencv.fill=true"
MEASURED: Final = "--set matching.sad.fill=false --set matching.sgm.fill=false"
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
