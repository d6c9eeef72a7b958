"""Disparities of a drive against those of LiDAR points, by depth and by part of the image.

The medians of measured minus true disparity, in pixels, where both are known: with the rig as it is
calibrated and as its motion shows it. Where the LiDAR stands relative to the camera is calibrated
too: a road changes its disparity by a third of a pixel from row to row, so that a twentieth of a
degree counts. `aligned` has the LiDAR moved and turned to where disparities fit best, six numbers
for all frames.

With ``--matchers`` these are compared instead, with the refined rig and the LiDAR as it fits the
first of them: in each range of depth, how many points of the LiDAR have a disparity, how many have
one that is right to 1 px, and how many of those that are given are wrong; and how many would be, if
each matcher gave only as many as the one that gives the fewest, its surest.

Examples:
    python benchmarks/lidar_disparity.py DRIVE LIDAR_MAP.ply --json
    python benchmarks/lidar_disparity.py DRIVE LIDAR_MAP.ply --matchers sad,sgm,fine
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from altered_drives import true_path

from recon.commands.config import load_config
from recon.core.geometry.se3 import apply, as_transform, invert
from recon.core.values import Disparity, RectifiedCamera
from recon.core.values.arrays import Float64
from recon.core.values.camera import project
from recon.io.models.ply import read_ply
from recon.look.look import refine_rig
from recon.look.rig import RefinedRig
from recon.odometry.settings import RigSettings
from recon.sources.registry import open_source
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

DEPTHS_M: Final = (4, 8, 12, 16, 22, 30, 45)
RIGS: Final = {"as calibrated": False, "refined": True}
PARTS: Final = (3, 6)  # of the image, down and across
FEWEST: Final = 1000  # disparities that are worth a median
OUTLIER_PX: Final = 3.0
WRONG_PX: Final = 1.0
KERNEL_PX: Final = 0.3
HIDING_PX: Final = 13  # what is much nearer, and no farther aside, hides a point
STEPS: Final = np.repeat([0.005, 0.0003], 3)  # for derivatives by metres and radians


@dataclass(frozen=True, eq=False)
class Seen:
    """Frames with the LiDAR points that they see."""

    camera: RectifiedCamera
    frames: list[tuple[Float64, Disparity]]  # points (N, 3) in camera axes

    def compared(self, step: Float64) -> tuple[Float64, Float64]:
        """Column, row, depth (N, 3) with the LiDAR moved; measured minus true disparity (N,)."""
        places, errors_px = [], []
        for xyz, disparity in self.frames:
            moved = apply(as_transform(step), xyz)
            u, v, true = project(moved, self.camera)
            at = (np.float32(u)[None], np.float32(v)[None])
            seen = cv2.remap(disparity.values, *at, cv2.INTER_LINEAR, borderValue=float("nan"))[0]
            places.append(np.stack([u, v, moved[:, 2]], axis=1))
            errors_px.append(seen - true)
        return np.concatenate(places), np.concatenate(errors_px)

    def confidence(self, step: Float64) -> Float64:
        """float64 (N,), of the pixels nearest to the points of `compared`."""
        found = []
        for xyz, disparity in self.frames:
            u, v, _ = project(apply(as_transform(step), xyz), self.camera)
            at = (np.float32(np.rint(u))[None], np.float32(np.rint(v))[None])
            found.append(cv2.remap(disparity.confidence, *at, cv2.INTER_NEAREST)[0])
        return np.concatenate(found).astype(np.float64)

    def aligned(self, rounds: int = 8) -> Float64:
        """The motion (6,) of the LiDAR, metres and radians, with which disparities fit best."""
        step = np.zeros(6)
        for _ in range(rounds):
            error = self.compared(step)[1]
            by = [
                (self.compared(step + one)[1] - self.compared(step - one)[1]) / (2.0 * one.max())
                for one in np.diag(STEPS)
            ]
            J = np.stack(by, axis=1)
            good = np.isfinite(error) & np.isfinite(J).all(axis=1) & (np.abs(error) < OUTLIER_PX)
            # Beyond, the disparity jumps from one surface to the next.
            good &= np.abs(J[:, 3:]).max(axis=1) * STEPS[-1] < OUTLIER_PX / 5
            weighed = J[good] / (1.0 + (error[good, None] / KERNEL_PX) ** 2)
            step = step - np.linalg.solve(weighed.T @ J[good], weighed.T @ error[good])
        return step


def see(
    source: StereoSource, xyz_world: Float64, every: int, rig: RefinedRig, matcher: str = "sad"
) -> Seen:
    """Match every so-manyth frame, and find the points in its view that nothing hides."""
    config = load_config(overrides=[f"matching.matcher={matcher}"])
    reconstructor = FrameReconstructor(rig.calibration, config)
    path = rig.poses(true_path(source), config.rectification).T_world_camera

    def frames() -> Iterator[tuple[Float64, Disparity]]:
        for k in range(every // 2, len(source), every):
            _, disparity = reconstructor.match(next(source.frames(k)))
            xyz = apply(invert(path[k]), xyz_world)
            yield visible(xyz, reconstructor.camera), disparity

    return Seen(reconstructor.camera, list(frames()))


def visible(xyz: Float64, camera: RectifiedCamera) -> Float64:
    """The points (N, 3) in the image that none in front of them hides."""
    xyz = xyz[(xyz[:, 2] > DEPTHS_M[0]) & (xyz[:, 2] < DEPTHS_M[-1])]
    u, v, _ = project(xyz, camera)
    at = np.rint([v, u]).astype(np.int64)
    size = np.array([[camera.height_px], [camera.width_px]])
    inside = ((at >= 0) & (at < size)).all(axis=0)
    xyz, at = xyz[inside], at[:, inside]
    z = xyz[:, 2]
    nearest = np.full((camera.height_px, camera.width_px), np.inf, np.float32)
    np.minimum.at(nearest, tuple(at), z.astype(np.float32))
    nearest = cv2.erode(nearest, np.ones((HIDING_PX, HIDING_PX)))
    return np.asarray(xyz[z <= 1.05 * nearest[tuple(at)] + 0.1])


def summary(seen: Seen, step: Float64) -> dict[str, Any]:
    """Medians by depth and by part of the image; None where there are few."""
    places, error = seen.compared(step)
    good = np.isfinite(error) & (np.abs(error) < OUTLIER_PX)
    (u, v, z), error = places[good].T, error[good]
    rows, columns = PARTS
    part = np.int64(v * rows / seen.camera.height_px), np.int64(u * columns / seen.camera.width_px)

    def middle(there: Any) -> float | None:
        return round(float(np.median(error[there])), 3) if there.sum() >= FEWEST else None

    by_part = [
        [middle((part[0] == r) & (part[1] == c)) for c in range(columns)] for r in range(rows)
    ]
    known = [abs(one) for row in by_part for one in row if one is not None]
    return {
        "by_depth_m": {
            f"{near} to {far}": middle((z >= near) & (z < far)) for near, far in pairwise(DEPTHS_M)
        },
        "by_part": by_part,
        "parts_rms": float(np.sqrt(np.mean(np.square(known)))),
        "largest_of_parts": max(known),
        "moved_mm": np.round(1000.0 * step[:3], 1).tolist(),
        "turned_deg": np.round(np.degrees(step[3:]), 3).tolist(),
    }


def by_matcher(seen: Mapping[str, Seen]) -> dict[str, dict[str, dict[str, float]]]:
    """What matchers give of the same points, in each range of depth; shares."""
    step = next(iter(seen.values())).aligned()
    compared = {name: (*one.compared(step), one.confidence(step)) for name, one in seen.items()}
    found: dict[str, dict[str, dict[str, float]]] = {name: {} for name in seen}
    for near, far in pairwise(DEPTHS_M):
        inside = {
            name: (error[there], sure[there])
            for name, (places, error, sure) in compared.items()
            for there in [(places[:, 2] >= near) & (places[:, 2] < far)]
        }
        fewest = min(np.isfinite(error).sum() for error, _ in inside.values())
        for name, (error, sure) in inside.items():
            given = np.isfinite(error)
            wrong = np.abs(error[given]) > WRONG_PX
            surest = np.argsort(-sure[given], kind="stable")[:fewest]
            found[name][f"{near} to {far}"] = {
                "given": float(given.mean()),
                "right": float((~wrong).sum() / len(error)),
                "wrong of given": float(wrong.mean()),
                "wrong of surest": float(wrong[surest].mean()),
            }
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("cloud", type=Path, help="LiDAR map, in the axes of the first true pose")
    parser.add_argument("--every", type=int, default=9, help="frames from one to the next")
    parser.add_argument("--matchers", help="compare these, with commas between them")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args(arguments)
    source, xyz_world = open_source(options.drive), np.float64(read_ply(options.cloud).xyz)
    look = partial(see, source, xyz_world, options.every)
    rigs = {
        name: refine_rig(source, load_config(), RigSettings(refine=refine))
        for name, refine in RIGS.items()
        if refine or not options.matchers
    }
    result: dict[str, Any] = {}
    if options.matchers:
        names = options.matchers.split(",")
        result = by_matcher({name: look(rigs["refined"], name) for name in names})
    else:
        for name, rig in rigs.items():
            seen = look(rig)
            result[name] = summary(seen, np.zeros(6))
            result[f"{name}, aligned"] = summary(seen, seen.aligned())
    print(json.dumps(result, indent=2) if options.json else "\n".join(map(str, result.items())))


if __name__ == "__main__":
    main()
