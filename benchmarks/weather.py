"""A rendered street by day, at night, in rain, in fog and through a tunnel: what is lost of it.

Light is linear, and made by the true depth of each pixel of both cameras: headlights that fall off
by 1/r², air that hides what is far (Koschmieder), drops that fall between the cameras and the road
and others that stay on the lenses, a tunnel of plain walls with lamps. Then a sensor counts
electrons, with shot and read noise, and each camera exposes by itself, late.

The same frames go to ORB-SLAM3 where it is there (`peer_programs.py`).

Examples:
    python benchmarks/weather.py
    python benchmarks/weather.py --only night --pictures FOLDER
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from altered_drives import alterations, errors_of, path_of, write_kitti
from peer_programs import orbslam3, vocabulary

from recon.commands.config import load_config
from recon.core.values import SequenceTruth, StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.camera import disparity_from_depth
from recon.core.work import serial_algebra
from recon.io.images.image import write_image
from recon.odometry.protocol import OdometryFrame
from recon.odometry.registry import make_odometry
from recon.sources.source import DerivedSource
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.street.materials import GAMMA
from recon.street.render import View
from recon.street.settings import StreetScene

SCENE: Final = {
    "path": "straight", "width_px": 512, "height_px": 208, "focal_px": 288.0, "noise_dn": 0.0,
    "smooth_edges": False,
}  # fmt: skip
FRAMES: Final = 90
OFF_PX: Final = 2.0  # a disparity that is farther from the true one is wrong


@dataclass(frozen=True, eq=False)
class Shot:
    """What one camera has before it: light (H, W), by day, and the ray of each pixel."""

    index: int
    side: int
    light: Float64  # linear, 1 = white in the sun
    depth_m: Float64  # infinite: the sky
    view: View
    rng: np.random.Generator

    @property
    def xyz(self) -> Float64:
        """float64 (H, W, 3), what pixels show, axes of the camera; of the sky 10 km away."""
        sight = np.ones((*self.depth_m.shape, 3))
        pixels = self.view.pixels().reshape(*self.depth_m.shape, 2)
        sight[..., :2] = (pixels - self.view.centre_px) / self.view.focal_px
        return np.asarray(sight * np.minimum(self.depth_m, 1e4)[..., None])


@dataclass(frozen=True)
class Seen:
    """What reaches the sensor: its light, what lies where, and how many electrons white is."""

    light: Float64
    depth_m: Float64
    electrons: float = 10_000.0
    exposes: bool = False  # whether the camera chooses its own exposure


READ_ELECTRONS: Final = 4.0
Weather = Callable[[Shot], Seen]


def day(shot: Shot) -> Seen:
    return Seen(shot.light, shot.depth_m)


LAMPS_M: Final = ((-0.6, 0.9, 0.4), (0.6, 0.9, 0.4))  # of the car, axes of the camera
AMBIENT: Final = 0.01  # of daylight, from the sky over a town


def night(shot: Shot) -> Seen:
    """Dipped headlights, of which what is 8 m ahead has half of daylight."""
    light, xyz = np.full(shot.light.shape, AMBIENT), shot.xyz
    for lamp in LAMPS_M:
        ray = xyz - lamp
        across = np.degrees(np.arctan2(ray[..., 0], ray[..., 2]))
        up = np.degrees(np.arctan2(-ray[..., 1], np.hypot(ray[..., 0], ray[..., 2])))
        beam = np.exp(-((across / 25) ** 2)) * np.where(up > 0, 0.1, 1.0)
        light += 0.25 * 8.0**2 * beam / (ray**2).sum(axis=2)
    light[~np.isfinite(shot.depth_m)] = 0.1 * AMBIENT
    return Seen(light * shot.light, shot.depth_m, electrons=500.0)


def in_air(light: Float64, depth_m: Float64, visibility_m: float, air: float) -> Float64:
    """Contrast falls to 5 % at the visibility."""
    left = np.exp(-3.0 * depth_m / visibility_m)
    return np.asarray(left * light + (1 - left) * air)


def fog(shot: Shot) -> Seen:
    return Seen(in_air(shot.light, shot.depth_m, 60.0, 0.45), shot.depth_m)


DROPS: Final = 1500
FALL_M: Final = np.array([0.0, 0.08, -0.10])
"""Of a drop against the car in 10 ms."""
DROP_M: Final = 0.003


def rain(shot: Shot) -> Seen:
    """Streaks, where drops fell before both cameras; drops on the lens, others on each."""
    light = in_air(0.5 * shot.light, shot.depth_m, 250.0, 0.25)
    falling = np.random.default_rng([7, shot.index])
    depth = 8.0 * np.cbrt(falling.uniform(0.0005, 1, DROPS))
    half = np.array(shot.light.shape[::-1]) / 2 / shot.view.focal_px
    xyz = np.column_stack([falling.uniform(-1.2, 1.2, (DROPS, 2)) * half * depth[:, None], depth])
    xyz[:, 0] -= 0.54 * shot.side
    streaks = np.zeros(light.shape, np.uint8)
    for start, end in zip(xyz, xyz + FALL_M, strict=True):
        if end[2] < 0.2:
            continue
        ends = [p[:2] / p[2] * shot.view.focal_px + shot.view.centre_px for p in (start, end)]
        wide = shot.view.focal_px * DROP_M / start[2]
        one = np.zeros_like(streaks) if wide > 1 else None
        to = streaks if one is None else one
        points = [tuple(int(16 * c) for c in each) for each in ends]
        level = int(150 * min(1.0, wide))
        cv2.line(to, points[0], points[1], level, max(1, round(wide)), cv2.LINE_AA, 4)
        if one is not None:
            streaks = np.maximum(streaks, one)
    share = streaks / 255
    return Seen(on_lens((1 - share) * light + share * 0.5, shot), shot.depth_m, 4000.0)


def on_lens(light: Float64, shot: Shot) -> Float64:
    """Drops on a lens show, upside down and blurred, what is around them; some run off."""
    height, width = light.shape
    seen = cv2.GaussianBlur(light, (0, 0), 0.7)
    turned = cv2.GaussianBlur(light[::-1, ::-1], (0, 0), 6.0)
    v, u = np.mgrid[:height, :width]
    for number in range(14):
        age = (shot.index + 7 * number) // 40
        own = np.random.default_rng([11, shot.side, number, age])
        cu, cv, radius = own.uniform(0, width), own.uniform(0, height), own.uniform(6, 18)
        inside = np.clip((radius - np.hypot(u - cu, v - cv)) / 3, 0, 1)
        seen = (1 - inside) * seen + inside * own.uniform(0.7, 1.2) * turned
    return np.asarray(seen)


INSIDE_M: Final = (20.0, 65.0)  # where along the street the tunnel is
WIDE_M, HIGH_M = 4.2, 4.8
PERIOD_M: Final = 10.0  # of its lamps


def tunnel(shot: Shot) -> Seen:
    """Plain walls with joints and lamps, dark after the daylight, which blinds at the exit."""
    origin = shot.view.origin
    rays = shot.view.directions(shot.view.pixels()).reshape(*shot.light.shape, 3)
    depth, light, first, last = shot.depth_m, shot.light, *INSIDE_M
    with np.errstate(divide="ignore", invalid="ignore"):
        enters = np.maximum((first - origin[0]) / rays[..., 0], 0.0)
        at = origin + enters[..., None] * rays
        through = (np.abs(at[..., 1]) < WIDE_M) & (at[..., 2] < HIGH_M) & (at[..., 2] >= 0)
        planes = [((side * WIDE_M - origin[1]) / rays[..., 1]) for side in (-1, 1)]
        planes += [(high - origin[2]) / rays[..., 2] for high in (0.0, HIGH_M)]
    hits = np.stack([np.where(plane > enters + 1e-6, plane, np.inf) for plane in planes])
    wall = hits.min(axis=0)
    place = origin + np.minimum(wall, 1e4)[..., None] * rays
    ahead = origin[0] < last
    inside = through & (place[..., 0] > first) & (place[..., 0] < last) & ahead
    front = ~through & (origin[0] < first) & (enters < depth) & (np.abs(at[..., 1]) < 14)
    front &= (at[..., 2] >= 0) & (at[..., 2] < 9)
    there = np.where(front[..., None], at, place)
    grain = 1 + 0.06 * concrete(there)
    grain *= np.where(np.abs(there[..., 0] % 5.0 - 2.5) < 0.02, 0.7, 1.0)
    lamp = inside & (place[..., 2] > HIGH_M - 0.01) & (np.abs(place[..., 1]) < 0.3)
    lamp &= place[..., 0] % PERIOD_M < 1.5
    along = np.clip(place[..., 0], first, last)
    from_ends = np.exp((first - along) / 4) + np.exp((along - last) / 4)
    lit = 0.03 * (1 + 0.5 * np.cos(2 * np.pi * place[..., 0] / PERIOD_M)) + 0.6 * from_ends
    albedo = np.where(there[..., 2] < 0.01, 0.12, 0.35)
    light = np.where(inside, np.where(lamp, 3.0, albedo * grain * lit), light)
    light = np.where(front, 0.3 * grain, light)
    depth = np.where(inside, wall, np.where(front, enters, depth))
    return Seen(light, depth, exposes=True)


_GRAIN: Final = np.random.default_rng(5).normal(size=(512, 512)).astype(np.float32)


def concrete(place: Float64) -> Float64:
    """Grain (H, W) of a deviation of about 1, at 5 cm and 60 cm, of places (H, W, 3) on walls."""
    along, around = place[..., 0] + 0.7 * place[..., 1], place[..., 1] + place[..., 2]
    total = np.zeros(along.shape)
    for size in (0.05, 0.6):
        maps = [np.asarray(each / size % 500, np.float32) for each in (along, around)]
        total += cv2.remap(_GRAIN, maps[0], maps[1], cv2.INTER_LINEAR)
    return total


CASES: Final[dict[str, Weather]] = {
    "day": day, "night": night, "rain": rain, "fog": fog, "tunnel": tunnel,
}  # fmt: skip
TARGET: Final = 0.2  # mean light that a camera exposes for
FOLLOWS: Final = 0.3  # of what is lacking in a frame that the next one has


class Sensor:
    """One camera: counts electrons, and corrects its exposure from frame to frame."""

    def __init__(self) -> None:
        self._gain = 1.0

    def image(self, seen: Seen, rng: np.random.Generator) -> UInt8:
        """The grey levels of what a camera sees."""
        counted = rng.normal(0, READ_ELECTRONS, seen.light.shape)
        counted += rng.poisson(np.minimum(seen.light, 60.0) * seen.electrons)
        level = np.clip(self._gain * counted / seen.electrons, 0, 1)
        if seen.exposes:
            self._gain *= (TARGET / max(float(level.mean()), 1e-3)) ** FOLLOWS
            self._gain = float(np.clip(self._gain, 0.2, 40.0))
        return np.asarray(np.rint(255 * level ** (1 / GAMMA)), np.uint8)


class Weathered(DerivedSource):
    """A street in some weather, in memory; with the true disparity of each frame."""

    truth: SequenceTruth

    def __init__(self, source: SyntheticSource, weather: Weather, shots: list[list[Shot]]) -> None:
        super().__init__(source)
        self.truth, self.pairs = SequenceTruth(source.trajectory), list[StereoPair]()
        self.true_px = []
        sensors = Sensor(), Sensor()
        for both in shots:
            seen = [weather(shot) for shot in both]
            images = [
                sensor.image(one, shot.rng)
                for sensor, one, shot in zip(sensors, seen, both, strict=True)
            ]
            index = both[0].index
            name, time_s = f"{index:06d}", float(source.trajectory.timestamps_s[index])
            left, right = images
            self.pairs.append(StereoPair(left, right, time_s, index=index, name=name))
            depth = np.where(np.isfinite(seen[0].depth_m), seen[0].depth_m, np.nan)
            self.true_px.append(disparity_from_depth(depth.astype(np.float32), source.calibration))

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """The pairs from number ``start`` on."""
        return iter(self.pairs[start:])


def shots_of(source: SyntheticSource) -> list[list[Shot]]:
    """What both cameras have before them by day, of each frame."""
    shots = []
    for pair in source.frames():
        both = []
        views = source.camera.views(pair.index)
        for side, (image, view) in enumerate(zip((pair.left, pair.right), views, strict=True)):
            depth = source.camera.stage.depth(view.origin, view.directions(view.pixels()))
            both.append(
                Shot(
                    index=pair.index,
                    side=side,
                    light=(image.mean(axis=2) / 255) ** GAMMA,
                    depth_m=np.nan_to_num(depth, nan=np.inf).reshape(image.shape[:2]),
                    view=view,
                    rng=np.random.default_rng([3, pair.index, side]),
                )
            )
        shots.append(both)
    return shots


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    source = SyntheticSource(StreetScene(seed=options.seed, frames=options.frames, **SCENE))
    shots, found = shots_of(source), {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) if options.pictures is None else options.pictures
        for case in dict.fromkeys(["day", *(options.only or CASES)]):
            drive = Weathered(source, CASES[case], [[*map(fresh, both)] for both in shots])
            write_kitti(alterations(drive)["as it is"], folder / case)
            for index in range(0, len(drive), 10) if options.pictures else ():
                write_image(folder / f"{case}_{index:03d}.png", drive.pairs[index].left)
            if case == "day":
                words = vocabulary([folder / "day" / "image_0"], folder / "words.txt")
            if case in (options.only or CASES):
                peer = orbslam3(folder / case, words, len(drive), source.trajectory)
                found[case] = {"recon": ours(drive), "orbslam3": peer}
                if not options.json:
                    print(case, json.dumps(found[case]), flush=True)
    if options.json:
        print(json.dumps(found, indent=2))


def fresh(shot: Shot) -> Shot:
    return replace(shot, rng=np.random.default_rng([3, shot.index, shot.side]))


def ours(drive: Weathered) -> dict[str, Any]:
    """What `recon` loses of a drive, how far its path is off, and what it matches."""
    altered = alterations(drive)["as it is"]
    reconstructor = FrameReconstructor(altered.calibration, load_config(None, []), threads=2)
    odometry, results, valid, wrong = make_odometry("visual"), [], [], []
    with serial_algebra():
        for pair, true in zip(drive.frames(), drive.true_px, strict=True):
            frame = OdometryFrame(*reconstructor.match(pair))
            results.append(odometry.register(frame))
            values, known = frame.disparity.values, np.isfinite(true)
            given = np.isfinite(values) & known
            valid.append(given.sum() / known.sum())
            wrong.append((np.abs(values - true)[given] > OFF_PX).mean() if given.any() else 0.0)
    lost = [each.health for each in results if not each.health.ok or each.health.begins]
    return {
        "frames": len(drive),
        "lost": len(lost),
        "notes": sorted({note for each in lost for note in each.notes})[:3],
        **errors_of(path_of(results, altered), altered.trajectory),
        "valid_percent": round(100 * float(np.mean(valid)), 1),
        "wrong_percent": round(100 * float(np.mean(wrong)), 1),
    }


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", choices=CASES, help="some kinds of weather")
    parser.add_argument("--frames", type=int, default=FRAMES)
    parser.add_argument("--seed", type=int, default=3, help="of the street")
    parser.add_argument("--pictures", type=Path, help="keep drives and pictures in this folder")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
