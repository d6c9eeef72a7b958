"""Whether the odometry knows its error: how often its 95 % intervals hold.

Short drives through rendered streets, each in other weather and with a rig that is calibrated as
well as `recon.odometry.health` assumes: its disparities, the angle between its cameras and
its baseline are off by a random amount of that size. A segment is covered if its end is as near to
the true one as ``expected_drift_percent`` says with 95 % probability. Segments with frames that the
odometry itself does not trust do not count.

With DRIVE, the drives of `altered_drives.py` are judged instead; their rigs are as they are.

Example: python benchmarks/drift_intervals.py --drives 12
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from altered_drives import Altered, alterations

from recon.commands.config import load_config
from recon.core.values import RectifiedCamera, StereoPair, Trajectory
from recon.core.values.arrays import Float64, UInt8
from recon.core.work import serial_algebra
from recon.evaluation.trajectory import TrajectoryRules, compare_paths
from recon.odometry.health import RIG_BASELINE, RIG_DISPARITY_PX, RIG_YAW_DEG, expected_drift
from recon.odometry.protocol import OdometryFrame
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.street.render import View
from recon.street.settings import StreetScene

FRAMES: Final = 36
"""At 1.5 m a frame: just long enough for segments of 50 m."""
RULES: Final = TrajectoryRules(lengths_m=(25.0, 50.0), step_frames=1)
SCENE: Final = {
    "width_px": 360,
    "height_px": 120,
    "focal_px": 200.0,
    "speed_m_per_frame": 1.5,
    "smooth_edges": False,
}
FOG_M: Final = 15.0
"""Distance at which fog leaves 37 % of the contrast."""
STREAKS: Final = 120

Depth = Callable[[], Float64]
Weather = Callable[[UInt8, Depth, np.random.Generator], UInt8]


def clear(grey: UInt8, depth_m: Depth, rng: np.random.Generator) -> UInt8:
    return grey


def fog(grey: UInt8, depth_m: Depth, rng: np.random.Generator) -> UInt8:
    """What is far fades to light grey."""
    left = np.exp(-np.nan_to_num(depth_m(), nan=np.inf) / FOG_M)
    return to_grey(left * grey + (1.0 - left) * 190.0, rng)


def rain(grey: UInt8, depth_m: Depth, rng: np.random.Generator) -> UInt8:
    """Bright streaks, other ones in each image."""
    streaked = grey.astype(np.float64)
    height, width = grey.shape
    for u, v, length in zip(
        rng.integers(0, width, STREAKS),
        rng.integers(-20, height, STREAKS),
        rng.integers(10, 40, STREAKS),
        strict=True,
    ):
        streaked[max(v, 0) : v + length, u] += 60.0
    return to_grey(streaked, rng)


def night(grey: UInt8, depth_m: Depth, rng: np.random.Generator) -> UInt8:
    """A sixth of the light, with the noise of a sensor at high gain."""
    return to_grey(grey / 6.0 + rng.normal(0.0, 2.0, grey.shape), rng)


def bare(grey: UInt8, depth_m: Depth, rng: np.random.Generator) -> UInt8:
    """Hardly any texture: contrast of a tenth."""
    return to_grey(110.0 + 0.1 * grey + rng.normal(0.0, 0.5, grey.shape), rng)


def to_grey(levels: Any, rng: np.random.Generator) -> UInt8:
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)


CONDITIONS: Final[dict[str, tuple[Weather, dict[str, Any]]]] = {
    "clear": (clear, {}),
    "fog": (fog, {}),
    "rain": (rain, {}),
    "night": (night, {}),
    "bare": (bare, {}),
    "far": (clear, {"baseline_m": 0.12}),
}


@dataclass(frozen=True, eq=False)
class RenderedDrive:
    """A street in some weather, with a rig that is not quite as it is said to be."""

    number: int
    condition: str

    def source(self) -> SyntheticSource:
        """The street."""
        _, changes = CONDITIONS[self.condition]
        return SyntheticSource(
            StreetScene(seed=self.number, frames=FRAMES, threads=1, **{**SCENE, **changes})
        )

    def camera(self, true: RectifiedCamera) -> RectifiedCamera:
        """The calibration: off by what the odometry assumes, drawn anew for each drive."""
        rng = np.random.default_rng([self.number, 1])
        yaw_px = true.focal_px * np.radians(RIG_YAW_DEG)
        off_px = rng.normal(0.0, np.hypot(RIG_DISPARITY_PX, yaw_px))
        return replace(
            true,
            cx_right_px=true.cx_right_px + float(off_px),
            baseline_m=true.baseline_m * float(1.0 + rng.normal(0.0, RIG_BASELINE)),
        )

    def pairs(self, source: SyntheticSource) -> Iterator[StereoPair]:
        """The images in this weather."""
        weather, _ = CONDITIONS[self.condition]
        for pair in source.frames():
            sides = zip((pair.left, pair.right), source.camera.views(pair.index), strict=True)
            images = []
            for side, (image, view) in enumerate(sides):
                rng = np.random.default_rng([self.number, 2, pair.index, side])
                grey = np.rint(image.mean(axis=2)).astype(np.uint8)

                def depth_m(view: View = view, shape: tuple[int, ...] = grey.shape) -> Float64:
                    rays = view.directions(view.pixels())
                    return source.camera.stage.depth(view.origin, rays).reshape(shape)

                images.append(weather(grey, depth_m, rng))
            yield replace(pair, left=images[0], right=images[1])


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.drive is not None:
        cases = alterations(open_source(options.drive))
        rows = [judge_altered(name, cases[name]) for name in options.only or cases]
    else:
        names = list(CONDITIONS)
        rows = []
        for number in range(options.drives):
            rows.append(judge_rendered(RenderedDrive(number, names[number % len(names)])))
            if not options.json:
                print(line(rows[-1]), flush=True)
    total = summary(rows)
    if options.json:
        print(json.dumps({"drives": rows, **total}, indent=2))
        return
    if options.drive is not None:
        print("\n".join(map(line, rows)))
    print(json.dumps(total))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path, nargs="?", help="drive with true poses to alter")
    parser.add_argument("--drives", type=int, default=40, help="number of rendered drives")
    parser.add_argument("--only", nargs="+", help="names of alterations of DRIVE")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


def judge_rendered(drive: RenderedDrive) -> dict[str, Any]:
    source = drive.source()
    camera = drive.camera(source.calibration)
    name = f"{drive.number} {drive.condition}"
    return judge(name, drive.pairs(source), camera, source.trajectory, RULES)


def judge_altered(name: str, altered: Altered) -> dict[str, Any]:
    return judge(name, altered.frames(), altered.calibration, altered.trajectory)


def judge(
    name: str,
    pairs: Iterator[StereoPair],
    camera: RectifiedCamera,
    truth: Trajectory,
    rules: TrajectoryRules | None = None,
) -> dict[str, Any]:
    """How far the path of a drive is off, beside how far it says it may be."""
    reconstructor = FrameReconstructor(camera, load_config(None, []), threads=1)
    odometry = make_odometry("visual")
    poses, health = [], []
    with serial_algebra():
        for pair in pairs:
            result = odometry.register(OdometryFrame(*reconstructor.match(pair)))
            poses.append(result.T_world_camera)
            health.append(result.health)
    path = Trajectory(np.stack(poses), truth.timestamps_s)
    expected = expected_drift(path, health, camera)
    found = compare_paths(path, truth, rules)
    trusted = np.array([record.ok for record in health])
    whole = np.array(
        [
            trusted[first + 1 : last + 1].all()
            for first, last in zip(found.segments.first, found.segments.last, strict=True)
        ]
    )
    percent = found.segment_percent[whole]
    limit = float("nan") if expected is None else 100.0 * expected.radius_ratio
    return {
        "drive": name,
        "segments": len(percent),
        "covered": int((percent <= limit).sum()),
        "t_rel_percent": round(float(percent.mean()), 3) if len(percent) else None,
        "limit_percent": round(limit, 3),
        "rig_percent": None if expected is None else round(expected.rig_percent, 3),
        "sigmas": round(float(percent.mean() / expected.percent), 2)
        if len(percent) and expected is not None
        else None,
        "scale": round(path.path_length_m / truth.path_length_m, 4),
        "untrusted_frames": int((~trusted).sum()),
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Fraction of covered segments: each drive counts as much as another."""
    ratios = [row["covered"] / row["segments"] for row in rows if row["segments"]]
    sizes = [row["sigmas"] for row in rows if row["sigmas"] is not None]
    return {
        "covered": round(float(np.mean(ratios)), 3),
        "rms_sigmas": round(float(np.sqrt(np.mean(np.square(sizes)))), 3),
        "drives_that_count": len(ratios),
    }


def line(row: dict[str, Any]) -> str:
    return "  ".join(f"{key} {value}" for key, value in row.items())


if __name__ == "__main__":
    main()
