"""Localisation: a map of the even frames of a drive, and its odd ones found in it, in many ways.

The map is made at the true poses of the drive, so that errors are those of localisation alone.
`elsewhere` is another drive, of which nothing may be found. `naive` is kiss-icp from a pose 0.5 m
and 2 degrees off against the fused cloud, frame by frame: the figure to beat. `growth` is the time
of a first fix in maps of 1, 10 and 100 drives of the same length, with random features in all but
one.

Without DRIVE, a rendered street is mapped.

Example: python benchmarks/localize.py DRIVE --elsewhere OTHER --json
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from altered_drives import Altered, Change, alterations

from recon.commands.config import ReconConfig, load_config
from recon.commands.demo import demo_source
from recon.core.geometry import se3
from recon.core.settings import scaled
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64, UInt8
from recon.map.drive.drive import Workspace
from recon.map.drive.sequence import map_sequence
from recon.map.localize.sequence import localize_sequence
from recon.map.localize.surroundings import Surroundings
from recon.map.map import Map
from recon.map.store.map_file import MapViews
from recon.odometry.kiss import RANGE_M, select_points
from recon.odometry.protocol import OdometryFrame
from recon.places.detector import KnownPlaces, KnownView
from recon.places.keyframe import Keyframe, make_keyframe
from recon.sources.registry import open_source
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

WRONG_M = 0.5
OFF_M, OFF_DEG = 0.5, 2.0
SESSIONS = (1, 10, 100)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    config = load_config(None, options.set)
    drive = demo_source(config) if options.drive is None else open_source(options.drive)
    odd, plain = cases(drive)
    with Map.temporary() as map_:
        even = taken(plain, slice(0, None, 2))
        poses = Trajectory(even.T_world_camera, even.stamps_s)
        map_sequence(even, config, known_poses=poses, workspace=Workspace(map_))
        result = {
            name: found(case, map_, config)
            for name, case in odd.items()
            if options.only is None or name in options.only
        }
        if options.elsewhere is not None:
            other = open_source(options.elsewhere)
            result["elsewhere"] = figures_of(other, map_, config, None)
        if options.only is None:
            result["naive"] = naive(odd["odd frames"], map_, config)
            result["growth"] = growth(odd["odd frames"], map_, config)
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "drive", type=Path, nargs="?", help="rectified drive with true poses; a rendered street"
    )
    parser.add_argument("--elsewhere", type=Path, help="a drive of another place")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--only", nargs="+", help="names of cases")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon localize")
    return parser.parse_args(arguments)


def cases(drive: StereoSource) -> tuple[dict[str, Altered], Altered]:
    """The odd frames in many ways, and the whole drive."""
    altered = alterations(drive)
    plain = altered["as it is"]
    odd = taken(plain, slice(1, None, 2))
    return {
        "odd frames": odd,
        "from the middle": taken(odd, slice(len(odd) // 2, None)),
        "backwards": taken(odd, slice(None, None, -1)),
        "every 2nd of them": taken(odd, slice(None, None, 2)),
        "every 3rd of them": taken(odd, slice(None, None, 3)),
        "half size": taken(altered["half size"], slice(1, None, 2)),
        "gain 0.6": replace(odd, change=each(lambda image: 0.6 * image)),
        "gain 1.4": replace(odd, change=each(lambda image: 1.4 * image)),
        "gamma 0.6": replace(odd, change=each(lambda image: 255 * (image / 255) ** 0.6)),
        "gamma 1.6": replace(odd, change=each(lambda image: 255 * (image / 255) ** 1.6)),
        "noise 8": replace(odd, change=noisy),
        "blur 1.5": replace(odd, change=each(lambda image: cv2.GaussianBlur(image, (0, 0), 1.5))),
    }, plain


def taken(drive: Altered, which: slice) -> Altered:
    """Some frames of a drive."""
    return replace(
        drive, order=drive.order[which], T_world_camera=drive.T_world_camera[which].copy()
    )


def each(change: Callable[[Float64], Any]) -> Change:
    """A change of both images, rounded to grey levels."""

    def changed(image: UInt8) -> UInt8:
        return np.asarray(np.clip(np.rint(change(image.astype(np.float64))), 0, 255), np.uint8)

    return lambda _, left, right: (changed(left), changed(right))


def noisy(index: int, left: UInt8, right: UInt8) -> tuple[UInt8, UInt8]:
    random = np.random.default_rng(index)
    return each(lambda image: image + random.normal(0.0, 8.0, image.shape))(index, left, right)


def found(case: Altered, map_: Map, config: ReconConfig) -> dict[str, Any]:
    """Figures of a drive in the map."""
    return figures_of(case, map_, config, case.T_world_camera)


def figures_of(source: Any, map_: Map, config: ReconConfig, truth: Any) -> dict[str, Any]:
    drive = localize_sequence(source, Workspace(map_), config)
    figures = {
        "frames": len(drive.frames),
        "tracking": len(drive.tracked) / len(drive.frames),
        "coasting": (len(drive.placed) - len(drive.tracked)) / len(drive.frames),
        "first_fix_frame": drive.figures().first_fix_frame,
        "ms_per_frame": 1e3 * drive.figures().seconds_per_frame.median,
    }
    if truth is None or not drive.placed:
        return figures
    poses = truth[[frame.index for frame in drive.placed]]
    return figures | errors(se3.invert(poses) @ drive.trajectory.T_world_camera)


def errors(off: Any) -> dict[str, Any]:
    """Of transforms (N, 4, 4) from the found to the true camera."""
    error_m = np.linalg.norm(off[:, :3, 3], axis=1)
    error_deg = np.degrees(se3.angle_rad(off))
    return {
        "median_m": float(np.median(error_m)),
        "p90_m": float(np.percentile(error_m, 90)),
        "p95_m": float(np.percentile(error_m, 95)),
        "max_m": float(error_m.max()),
        "median_deg": float(np.median(error_deg)),
        "wrong": int((error_m > WRONG_M).sum()),
    }


def naive(case: Altered, map_: Map, config: ReconConfig) -> dict[str, Any]:
    """kiss-icp from a pose that is off, without a filter."""
    random = np.random.default_rng(0)
    range_m = scaled(RANGE_M, config.scale)
    around = Surroundings(map_, range_m)
    reconstructor = FrameReconstructor(case.calibration, config)
    off = []
    for T_true, pair in zip(case.T_world_camera, case, strict=True):
        axis = random.normal(size=(2, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        step = np.concatenate([OFF_M * axis[0], np.radians(OFF_DEG) * axis[1]])
        frame = OdometryFrame(*reconstructor.match(pair))
        xyz = select_points(frame, range_m).xyz
        T = around.align(xyz.astype(np.float64), T_true @ se3.as_transform(step)).T_world_camera
        off.append(se3.invert(T_true) @ T)
    return {"frames": len(off), **errors(np.stack(off))}


def growth(case: Altered, map_: Map, config: ReconConfig) -> dict[str, Any]:
    """Milliseconds of a frame that is searched, by the number of drives in the map."""
    reconstructor = FrameReconstructor(case.calibration, config)
    pairs = [next(case.frames(index)) for index in range(0, len(case), max(1, len(case) // 8))]
    frames = [OdometryFrame(*reconstructor.match(pair)) for pair in pairs]
    views = list(MapViews(map_))
    milliseconds = {}
    for sessions in SESSIONS:
        others = [shuffled(view, n) for n in range(1, sessions) for view in views]
        known = KnownPlaces([*others, *views])
        times = []
        for number, frame in enumerate(frames):
            keyframe = make_keyframe(number, frame.pair, frame.disparity)
            start = time.perf_counter()
            known.recognise(keyframe, frame.pair.camera)
            times.append(time.perf_counter() - start)
        milliseconds[str(sessions)] = {
            "views": len(known),
            "ms": 1e3 * float(np.median(times)),
        }
    return milliseconds


def shuffled(view: KnownView, seed: int) -> KnownView:
    """The view with random descriptors, a kilometre away."""
    random = np.random.default_rng([seed, view.keyframe.frame])
    old = view.keyframe
    descriptors = random.integers(0, 256, old.descriptors.shape).astype(np.uint8)
    T = view.T_world_camera.copy()
    T[0, 3] += 1e3 * seed
    return replace(
        view, keyframe=Keyframe(old.frame, old.uvd, descriptors, old.coarse), T_world_camera=T
    )


def table(result: dict[str, Any]) -> str:
    columns = (
        "tracking",
        "coasting",
        "median_m",
        "p95_m",
        "max_m",
        "median_deg",
        "wrong",
        "ms_per_frame",
    )
    lines = ["case".ljust(18) + "".join(name.rjust(13) for name in columns)]
    for name, figures in result.items():
        if name == "growth":
            continue
        cells = (f"{figures[key]:.3f}" if key in figures else "" for key in columns)
        lines.append(name.ljust(18) + "".join(cell.rjust(13) for cell in cells))
    lines += [
        f"first fix, {n} drives, {at['views']} views: {at['ms']:.1f} ms"
        for n, at in result.get("growth", {}).items()
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
