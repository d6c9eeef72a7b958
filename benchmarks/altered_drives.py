"""Robustness of odometry: one drive, altered in many ways.

The ground truth of an altered drive follows from that of the original, so any drive with true
poses will do. ``scale`` is the length of the estimated path relative to the true one: it shows a
disparity error common to all frames, and grows with the speed of the drive.

Without DRIVE, a rendered street is altered.

A peer is another program on the same frames: ``--write`` gives it the altered drives, ``--peer``
reads its poses, which are evaluated like ours.

Example: python benchmarks/altered_drives.py DRIVE --json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np

from recon.commands.config import ReconConfig, load_config
from recon.commands.demo import demo_source
from recon.core.geometry import se3
from recon.core.values import RectifiedCamera, SequenceTruth, StereoPair, Trajectory
from recon.core.values.arrays import Float64, UInt8
from recon.core.work import serial_algebra
from recon.evaluation.trajectory import evaluate_trajectory
from recon.io.images.image import write_image
from recon.io.trajectory import read_kitti_poses, write_kitti_poses
from recon.look.look import refine_rig
from recon.look.rig import RefinedRig
from recon.odometry.protocol import Odometry, OdometryFrame, OdometryResult
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

NOISE_DN = 4.0
EXPOSURE_RATIO = 0.15
RIGHT_GAIN = 0.93
KEPT_WIDTH = 0.6
NOD_DEG = 4.0
NOD_RAD_PER_FRAME = 0.9

Change = Callable[[int, UInt8, UInt8], tuple[UInt8, UInt8]]


@dataclass(frozen=True, eq=False)
class Altered(StereoSource):
    """A drive derived from another by changing its frames, images or poses.

    Attributes:
        drive: The original drive.
        calibration: Calibration of the altered images.
        order: Frames of the original drive, in playback order.
        T_world_camera: float64 (N, 4, 4), true poses of these frames.
        change: Makes the left and right image of a frame from the original ones.
    """

    drive: StereoSource
    calibration: RectifiedCamera = field()
    order: list[int]
    T_world_camera: Float64
    change: Change

    name = "altered"
    description = "altered drive"

    @cached_property
    def truth(self) -> SequenceTruth:
        """The true path alone."""
        return SequenceTruth(self.trajectory)

    @property
    def trajectory(self) -> Trajectory:
        """The true path; the first camera is its origin."""
        poses = se3.invert(self.T_world_camera[0]) @ self.T_world_camera
        return Trajectory(poses, self.stamps_s)

    @cached_property
    def stamps_s(self) -> Float64:
        """float64 (N,): timestamps of the original drive, ascending regardless of ``order``."""
        return true_path(self.drive).timestamps_s[sorted(self.order)]

    def __len__(self) -> int:
        return len(self.order)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """The altered pairs, from frame ``start`` on."""
        for index in range(start, len(self)):
            pair = cast("StereoPair", next(self.drive.frames(self.order[index])))
            left, right = self.change(self.order[index], pair.left, pair.right)
            stamp_s = float(self.stamps_s[index])
            yield StereoPair(left, right, stamp_s, index=index, name=pair.name)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.peer is not None and not options.peer.is_dir():
        raise SystemExit(f"altered_drives: {options.peer} is no folder of poses")
    rendered = demo_source(load_config(None, options.set))
    drive = rendered if options.drive is None else open_source(options.drive)
    cases = alterations(drive)
    chosen = options.only or list(cases)
    if options.write is not None:
        for name in chosen:
            write_kitti(cases[name], options.write / file_name(name))
        return
    result = {name: figures(cases[name], options) for name in chosen}
    if options.peer is not None:
        for name in chosen:
            result[name].update(peer_figures(options.peer, name, cases[name]))
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "drive", type=Path, nargs="?", help="rectified drive with true poses; a rendered street"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--odometry", default="visual", help="visual or kiss")
    parser.add_argument("--only", nargs="+", help="names of alterations")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon map")
    parser.add_argument("--write", type=Path, help="only write the altered drives there (KITTI)")
    parser.add_argument(
        "--peer",
        type=Path,
        help="folder of another program's poses (KITTI), every_3rd_frame.txt and so on",
    )
    return parser.parse_args(arguments)


def alterations(drive: StereoSource) -> dict[str, Altered]:
    """The original drive and its alterations, by name."""
    camera = drive.calibration
    if not isinstance(camera, RectifiedCamera):
        raise SystemExit(f"{drive.name}: expected a rectified drive")
    order = list(range(len(drive)))
    plain = Altered(drive, camera, order, true_path(drive).T_world_camera, lambda _, *both: both)
    return {
        "as it is": plain,
        "every 2nd frame": thinned(plain, 2),
        "every 3rd frame": thinned(plain, 3),
        "every 4th frame": thinned(plain, 4),
        "backwards": replace(
            plain, order=order[::-1], T_world_camera=plain.T_world_camera[::-1].copy()
        ),
        "half size": halved(plain),
        "mirrored": mirrored(plain),
        "narrow": narrowed(plain),
        "noisy": replace(plain, change=noisy),
        "nodding": nodding(plain),
    }


def true_path(drive: StereoSource | Altered) -> Trajectory:
    if drive.truth is None or drive.truth.trajectory is None:
        raise SystemExit(f"{drive.name}: has no true poses")
    return drive.truth.trajectory


def thinned(plain: Altered, step: int) -> Altered:
    """Every ``step``-th frame: a faster drive, or a lower frame rate."""
    return replace(
        plain, order=plain.order[::step], T_world_camera=plain.T_world_camera[::step].copy()
    )


def halved(plain: Altered) -> Altered:
    """Images of half the size."""
    camera = plain.calibration
    width, height = camera.width_px // 2, camera.height_px // 2

    def half(_: int, *both: UInt8) -> tuple[UInt8, UInt8]:
        left, right = (
            cv2.resize(
                image[: 2 * height, : 2 * width], (width, height), None, 0, 0, cv2.INTER_AREA
            )
            for image in both
        )
        return left, right

    # The first pixel has its centre at 0 and its corner at -0.5.
    smaller = replace(
        camera,
        focal_px=camera.focal_px / 2,
        cx_px=(camera.cx_px + 0.5) / 2 - 0.5,
        cy_px=(camera.cy_px + 0.5) / 2 - 0.5,
        cx_right_px=(camera.cx_right_px + 0.5) / 2 - 0.5,
        width_px=width,
        height_px=height,
    )
    return replace(plain, calibration=smaller, change=half)


def mirrored(plain: Altered) -> Altered:
    """The mirrored world: left turns become right turns, and the cameras swap places."""
    camera, mirror = plain.calibration, np.diag([-1.0, 1.0, 1.0, 1.0])
    T_left_right = se3.make_transform(np.eye(3), np.array([camera.baseline_m, 0.0, 0.0]))
    last = camera.width_px - 1
    return replace(
        plain,
        calibration=replace(
            camera, cx_px=last - camera.cx_right_px, cx_right_px=last - camera.cx_px
        ),
        T_world_camera=mirror @ plain.T_world_camera @ T_left_right @ mirror,
        change=lambda _, left, right: (right[:, ::-1].copy(), left[:, ::-1].copy()),
    )


def narrowed(plain: Altered) -> Altered:
    """Images cropped to their middle: a narrow field of view."""
    camera = plain.calibration
    width = round(KEPT_WIDTH * camera.width_px)
    first = (camera.width_px - width) // 2
    cut = replace(
        camera,
        cx_px=camera.cx_px - first,
        cx_right_px=camera.cx_right_px - first,
        width_px=width,
    )
    columns = slice(first, first + width)
    return replace(
        plain,
        calibration=cut,
        change=lambda _, left, right: (left[:, columns].copy(), right[:, columns].copy()),
    )


def noisy(index: int, left: UInt8, right: UInt8) -> tuple[UInt8, UInt8]:
    """Image noise, varying exposure and a darker right camera."""
    random = np.random.default_rng(index)
    gain = 1.0 + EXPOSURE_RATIO * np.sin(index / 7.0)
    seen = (gain * left, gain * RIGHT_GAIN * right)
    dark, darker = (
        np.clip(np.rint(image + random.normal(0.0, NOISE_DN, image.shape)), 0, 255).astype(np.uint8)
        for image in seen
    )
    return dark, darker


def nodding(plain: Altered) -> Altered:
    """A rig that pitches from frame to frame, as on a rough road: rotation about the baseline."""
    camera = plain.calibration
    angles = np.radians(NOD_DEG) * np.sin(NOD_RAD_PER_FRAME * np.arange(len(plain.order)))
    turns = np.stack([se3.exp_so3(np.array([angle, 0.0, 0.0])) for angle in angles])
    views = [replace(camera, cx_px=cx) for cx in (camera.cx_px, camera.cx_right_px)]

    def nod(index: int, *both: UInt8) -> tuple[UInt8, UInt8]:
        left, right = (
            cv2.warpPerspective(
                image,
                view.matrix @ turns[index] @ np.linalg.inv(view.matrix),
                (camera.width_px, camera.height_px),
                flags=cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_CONSTANT,
            )
            for image, view in zip(both, views, strict=True)
        )
        return left, right

    T_camera_nodded = np.tile(np.eye(4), (len(turns), 1, 1))
    T_camera_nodded[:, :3, :3] = turns.transpose(0, 2, 1)
    return replace(plain, T_world_camera=plain.T_world_camera @ T_camera_nodded, change=nod)


def figures(altered: Altered, options: argparse.Namespace) -> dict[str, float]:
    """Errors of the path of an altered drive."""
    config, name = load_config(None, options.set), options.odometry
    rig = refine_rig(altered, config, config.rig)
    found = run(altered, {name: make_odometry(name, config.odometry)}, rig)
    return {"frames": len(altered), **found[name]}


def run(
    altered: Altered, odometries: Mapping[str, Odometry], rig: RefinedRig | None = None
) -> dict[str, dict[str, Any]]:
    """Errors of each odometry on the same frames, with the rig as it is or as refined."""
    config, given = load_config(None, []), altered.calibration
    rig = RefinedRig(given, given, given) if rig is None else rig
    truth, found = rig.poses(true_path(altered), config.rectification), {}
    for name, results in follow(altered, odometries, rig, config).items():
        untrusted = sum(not each.health.ok for each in results)
        found[name] = {**errors_of(path_of(results, altered), truth), "untrusted": untrusted}
    return found


def follow(
    altered: Altered, odometries: Mapping[str, Odometry], rig: RefinedRig, config: ReconConfig
) -> dict[str, list[OdometryResult]]:
    """What each odometry finds on the same frames, in the axes of the refined rig."""
    reconstructor = FrameReconstructor(rig.calibration, config, threads=1)
    results: dict[str, list[OdometryResult]] = {name: [] for name in odometries}
    with serial_algebra():
        for pair in altered.frames():
            frame = OdometryFrame(*reconstructor.match(pair))
            for name, odometry in odometries.items():
                results[name].append(odometry.register(frame))
    return results


def path_of(results: Sequence[OdometryResult], altered: Altered) -> Trajectory:
    return Trajectory(np.stack([each.T_world_camera for each in results]), altered.stamps_s)


def errors_of(path: Trajectory, truth: Trajectory) -> dict[str, float]:
    """Errors of a path, and its length relative to the true one."""
    found = evaluate_trajectory(path, truth)
    return {
        "t_rel_percent": round(found.t_rel_percent, 3),
        "r_rel_deg_per_100m": round(found.r_rel_deg_per_100m, 3),
        "ate_m": round(found.ate_m, 3),
        "scale": round(path.path_length_m / truth.path_length_m, 4),
    }


def peer_figures(peer: Path, name: str, altered: Altered) -> dict[str, float]:
    """What another program reached, by the same evaluator; empty where it has no such row."""
    poses = peer / f"{file_name(name)}.txt"
    if not poses.is_file():
        return {}
    true = true_path(altered)
    found = errors_of(read_kitti_poses(poses, true.timestamps_s), true)
    return {f"peer_{key}": value for key, value in found.items()}


def file_name(name: str) -> str:
    return name.replace(" ", "_")


def write_kitti(altered: Altered, folder: Path) -> None:
    """Write an altered drive in the layout of KITTI's odometry benchmark."""
    for side in ("image_0", "image_1"):
        (folder / side).mkdir(parents=True, exist_ok=True)
    for pair in altered.frames():
        for side, image in (("image_0", pair.left), ("image_1", pair.right)):
            write_image(folder / side / f"{pair.index:06d}.png", image)
    write_calibration(altered.calibration, folder / "calib.txt")
    np.savetxt(folder / "times.txt", altered.stamps_s, fmt="%.9e")
    write_kitti_poses(folder / "poses.txt", altered.trajectory)


def write_calibration(camera: RectifiedCamera, file: Path) -> None:
    lines = []
    for number, (cx, shift) in enumerate(
        ((camera.cx_px, 0.0), (camera.cx_right_px, -camera.focal_px * camera.baseline_m))
    ):
        P = np.array([[camera.focal_px, 0, cx, shift], [0, camera.focal_px, camera.cy_px, 0]])
        rows = np.vstack([P, [0, 0, 1, 0]]).ravel()
        lines.append(f"P{number}: {' '.join(f'{value:.9e}' for value in rows)}\n")
    file.write_text("".join(lines))


def table(result: dict[str, dict[str, Any]]) -> str:
    """One line per row; columns of a peer where there is one."""
    columns = {
        "t_rel %": "t_rel_percent",
        "r_rel deg/100 m": "r_rel_deg_per_100m",
        "ATE m": "ate_m",
        "scale": "scale",
        "peer t_rel %": "peer_t_rel_percent",
        "peer scale": "peer_scale",
    }
    shown = {
        head: key for head, key in columns.items() if any(key in row for row in result.values())
    }
    lines = [f"{'':18s}" + "".join(f"{head:>17s}" for head in shown)]
    for name, row in result.items():
        cells = (f"{row[key]:.4g}" if key in row else "-" for key in shown.values())
        lines.append(f"{name:18s}" + "".join(f"{cell:>17s}" for cell in cells))
    return "\n".join(lines)


if __name__ == "__main__":
    main()
