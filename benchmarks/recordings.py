"""One row for each recording that there is: what camera, what our map is worth, and a peer's.

Each is mapped by `recon map` as anybody would, and judged by what is known of it: its path by true
poses, its cloud by a scan. Where nothing is known, what counts is how many frames are trusted;
recordings that are no rigid rig must be refused by `recon audit`. ORB-SLAM3 gets the rectified
frames, where it is there (`peer_programs.py`), else its poses in `benchmarks/peers` are read, as
are those of COLMAP.

Example: python benchmarks/recordings.py $RECON_DATA --only yard town_60
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from altered_drives import errors_of, write_calibration
from peer_programs import orbslam3, vocabulary

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.core.values import RectifiedCamera, Trajectory
from recon.io.images.image import write_image
from recon.io.trajectory import read_kitti_poses, read_trajectory
from recon.sources.registry import open_source
from recon.sources.settings import SourceSettings
from recon.sources.source import StereoSource
from recon.stereo.rectify.rectifier import Rectifier

PEERS: Final = Path(__file__).parent / "peers"
STREET: Final = "street.frames=60"


@dataclass(frozen=True)
class Recording:
    """What is at a place, and how it is mapped and judged."""

    place: str
    folder: str = ""  # below the folder of data; none: it is rendered
    options: tuple[str, ...] = ()
    truth: str = ""  # true poses that the source does not know (TUM), in its folder
    scan: str = ""  # a cloud, with poses.txt beside it
    refused: bool = False  # whether `recon audit` must find that this is no rig


RECORDINGS: Final = {
    "kitti_raw_0013": Recording("street", "driven/kitti_raw_0013", scan="lidar_map.ply"),
    "kitti_06_51": Recording("avenue", "driven/kitti_06_51"),
    "kitti_05_100": Recording("corner with hedges", "driven/kitti_05_100"),
    "town_60": Recording("parked cars", "driven/town_60"),
    "euroc_v1_sparse": Recording("room, flown", "rooms/euroc_v1_sparse",
                                 truth="left_camera_tum.txt"),
    "backyard": Recording("garden, by hand", "walked/backyard", ("--calib", "rig.yaml")),
    "yard": Recording("yard, rendered", "rendered/yard"),
    "street": Recording("street, rendered"),
    "two_phones": Recording("house, two phones", "walked/two_phones", refused=True),
}  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    found = {}
    for name in options.only or RECORDINGS:
        one, folder = RECORDINGS[name], options.data / RECORDINGS[name].folder
        if folder.is_dir():
            with tempfile.TemporaryDirectory() as out:
                judge = refused if one.refused else judged
                found[name] = {"place": one.place, **judge(one, folder, Path(out))}
        if not options.json:
            print(name, json.dumps(found.get(name, "is not there")), flush=True)
    if options.json:
        print(json.dumps(found, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("data", type=Path, help="folder of real data, as RECON_DATA")
    parser.add_argument("--only", nargs="+", choices=RECORDINGS, help="some recordings")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


def recon(*words: object) -> dict[str, Any]:
    """What a command prints as JSON; empty with the last line of its error where it fails."""
    line = [sys.executable, "-m", "recon", *map(str, words), "--json"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    try:
        return dict(json.loads(done.stdout))
    except json.JSONDecodeError:
        return {"error": " ".join(done.stderr.split())[-200:]}


def refused(one: Recording, folder: Path, out: Path) -> dict[str, Any]:
    """Whether the audit says that the cameras are not rigid to each other."""
    videos = ["--right", folder / "right.mp4", "--focal", 500, "--baseline", 0.1]
    said = recon("audit", folder / "left.mp4", *videos)
    codes = [each["code"] for each in said.get("findings", [])]
    verdict = f"{said.get('verdict', said.get('error'))}: {', '.join(codes)}"
    return {"camera": "640×368, no calibration", "product": verdict, "right": "nonrigid" in codes}


def judged(one: Recording, folder: Path, out: Path) -> dict[str, Any]:
    """The map of a recording, and what is known of it."""
    options = [folder / o if (folder / o).is_file() else o for o in one.options]
    if one.folder:
        said = recon("map", folder, *options, "--no-mesh", "--quiet", "--out", out / "map")
    else:
        said = recon("demo", "--set", STREET, "--quiet", "--out", out / "map")
    if "error" in said:
        return {"product": said["error"]}
    found = {
        "frames": said["frames"],
        "lost": said["frames_not_trusted"],
        "segments": len(said["segments"]),
        "length_m": said["path_length_m"],
        "seconds": said["seconds"],
    }
    for key in ("ate_m", "t_rel_percent"):
        found[key] = (said.get("trajectory") or {}).get(key)
    truth = None
    if one.truth:
        truth = read_trajectory(folder / one.truth)
        path = recon(
            "evaluate", "trajectory", out / "map" / "trajectory_tum.txt", folder / one.truth
        )
        found["ate_m"] = path.get("ate_m", path.get("error"))
    if one.scan:
        poses = ["--align-to", folder / "poses.txt", "--threshold", 0.2]
        scan = recon("evaluate", "map", out / "map", folder / one.scan, *poses)
        found |= {key: scan.get(key) for key in ("precision", "recall")}
    elif (cloud := said.get("cloud_error")) is not None:
        found |= {key: cloud.get(key) for key in ("precision", "recall")}
    rendered = demo_source(load_config(None, [STREET]))
    settings = SourceSettings(calibration=str(options[1])) if options else None
    source = open_source(folder, settings=settings) if one.folder else rendered
    return found | beside(source, folder.name, out, truth)


def beside(source: StereoSource, name: str, out: Path, truth: Trajectory | None) -> dict[str, Any]:
    """The camera of a recording, and what others make of its frames."""
    if source.truth is not None:
        truth = source.truth.trajectory
    camera, stamps_s = write_frames(source, out / "frames")
    usual_s = float(np.median(np.diff(stamps_s)))
    size = f"{camera.width_px}×{camera.height_px}"
    found: dict[str, Any] = {
        "camera": f"{size}, f {camera.focal_px:.0f} px, {camera.baseline_m:.3g} m"
        + (f", {1 / usual_s:.0f} Hz" if usual_s > 0 else "")
    }
    for program in ("orbslam3", "colmap"):
        poses = PEERS / program / name / "as_it_is.txt"
        if poses.is_file() and truth is not None:
            path = read_kitti_poses(poses, truth.timestamps_s)
            found[program] = errors_of(path, truth)
    if "orbslam3" not in found:
        words = vocabulary([out / "frames" / "image_0"], out / "words.txt")
        known = truth if truth is not None and len(truth) == len(stamps_s) else None
        found["orbslam3"] = orbslam3(out / "frames", words, len(stamps_s), known)
    return found


def write_frames(source: StereoSource, folder: Path) -> tuple[RectifiedCamera, list[float]]:
    """Write the rectified frames of a recording as a drive of KITTI; its camera and times."""
    rectifier = Rectifier(source.calibration, load_config(None, []).rectification)
    stamps_s: list[float] = []
    for side in ("image_0", "image_1"):
        (folder / side).mkdir(parents=True)
    for pair in source.frames():
        view = rectifier.rectify(pair)
        for side, image in (("image_0", view.left), ("image_1", view.right)):
            write_image(folder / side / f"{len(stamps_s):06d}.png", image)
        stamps_s.append(view.timestamp_s)
    write_calibration(rectifier.camera, folder / "calib.txt")
    np.savetxt(folder / "times.txt", stamps_s, fmt="%.9e")
    return rectifier.camera, stamps_s


if __name__ == "__main__":
    main()
