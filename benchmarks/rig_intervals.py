"""Whether a rig that is refined knows its error: how often its 95 % intervals hold.

Short drives through rendered streets are given calibrations that are off by random amounts: each
term of both lenses by three times what `recon.look.fault` expects, the right camera by
0.3° and 0.5 % of its focal length. Images get noise of their own in each case. An interval holds if
what is left of the disparity error at a place of the image, of the yaw, or of the length of the
path that the windows show is within 1.96 of its standard deviations.

Example: python benchmarks/rig_intervals.py --drives 12
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import load_config
from recon.core.values import RectifiedCamera, Rig, StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.look.fault import NAMES, TURN, RigFault, spread_pixels, without_fault
from recon.look.fit import ROAD_DEPTH_M, FittedFault
from recon.look.look import refine_rig
from recon.look.rig import compare_rigs
from recon.odometry.protocol import OdometryFrame
from recon.odometry.registry import make_odometry
from recon.odometry.settings import RigSettings
from recon.sources.source import StereoSource
from recon.sources.synthetic import SyntheticSource
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.rectifier import turns_of
from recon.street.settings import StreetScene

FRAMES: Final = 48
STREETS: Final = 4
TURN_SIGMAS: Final = np.array([*np.radians([0.3, 0.3, 0.3]), 0.005])
TIMES: Final = 3.0  # what is expected of each term of a lens
NOISE_DN: Final = 1.5
SIGMAS: Final = 1.96
PLACES: Final = {
    "corner": (1.0, 1.0), "left": (0.5, 0.07), "right": (0.5, 1.0), "top": (0.0, 0.5),
    "centre": (0.5, 0.5),
}  # fmt: skip
"""Where disparities are judged, as fractions of height and width; the right image sees all of
it."""


class Noisy(StereoSource):
    """A rendered drive with a calibration, and noise of its own."""

    calibration: Rig

    def __init__(self, pairs: Sequence[StereoPair], calibration: Rig, number: int) -> None:
        self.pairs, self.calibration, self.number = pairs, calibration, number

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        for pair in self.pairs[start:]:
            rng = np.random.default_rng([self.number, pair.index])
            yield replace(pair, left=noisy(pair.left, rng), right=noisy(pair.right, rng))


def noisy(image: UInt8, rng: np.random.Generator) -> UInt8:
    levels = image + rng.normal(0.0, NOISE_DN, image.shape)
    return np.asarray(np.clip(np.rint(levels), 0, 255), np.uint8)


@cache
def street(seed: int) -> tuple[list[StereoPair], RectifiedCamera]:
    size = {"width_px": 400, "height_px": 136, "focal_px": 225.0, "smooth_edges": False}
    source = SyntheticSource(StreetScene(seed=seed, frames=FRAMES, **size))
    return list(source.frames()), source.calibration


@dataclass(frozen=True, eq=False)
class Planted:
    """A drive whose rig is off by a known fault."""

    number: int

    @property
    def street(self) -> tuple[list[StereoPair], RectifiedCamera]:
        return street(self.number % STREETS)

    @property
    def fault(self) -> Float64:
        """The parameters (P,) of what is wrong."""
        sigmas = TIMES * RigFault(self.street[1]).sigmas
        sigmas[: len(TURN)] = TURN_SIGMAS
        return sigmas * np.random.default_rng([self.number, -1 % 2**32]).normal(size=len(sigmas))


def judge(drive: Planted) -> dict[str, Any] | None:
    """Return errors of a refined rig in its standard deviations, and what was planted and left.

    None if the drive is lost with the rig given.
    """
    config = load_config()
    pairs, true = drive.street
    given = without_fault(true, turns_of(true, config.rectification), drive.fault)
    source = Noisy(pairs, given, drive.number)
    rig = refine_rig(source, config, RigSettings())
    if (fitted := rig.fitted) is None or (length_ratio := rig.length_ratio) is None:
        return None
    planted, left = (
        compare_rigs(one, true, ROAD_DEPTH_M, config.rectification)
        for one in (given, rig.calibration)
    )
    camera = turns_of(rig.calibration, config.rectification).camera
    parameters = (fitted.values + drive.fault) / np.sqrt(np.diag(fitted.covariance))
    longer = path_ratio(source, rig.calibration) / length_ratio
    return {
        "drive": drive.number,
        "planted_px": round(planted.rms_px, 3),
        "left_px": round(left.rms_px, 3),
        "sigmas": {**sigmas_of(camera, fitted, left.off_px), "length": round(longer, 2)},
        "parameters": dict(zip(NAMES, parameters.round(2).tolist(), strict=True)),
    }


def path_ratio(source: Noisy, rig: Rig) -> float:
    """Return by what ratio the path of a rig is longer than that of the true one."""
    lengths_m = []
    for calibration in (rig, street(source.number % STREETS)[1]):
        odometry = make_odometry("visual")
        reconstructor = FrameReconstructor(calibration, load_config(), threads=1)
        poses = [
            odometry.register(OdometryFrame(*reconstructor.match_roughly(pair))).T_world_camera
            for pair in source.frames()
        ]
        lengths_m.append(np.linalg.norm(np.diff(np.stack(poses)[:, :3, 3], axis=0), axis=1).sum())
    return float(lengths_m[0] / lengths_m[1] - 1.0)


def sigmas_of(camera: RectifiedCamera, fitted: FittedFault, off_px: Float64) -> dict[str, float]:
    """Return disparity errors (rows, columns) at some places, in their standard deviations."""
    rows, columns = off_px.shape
    uv = spread_pixels(camera, (columns, rows))
    seen = RigFault(camera).correct(uv, uv, np.zeros(len(NAMES)))
    by = (seen.by_left - seen.by_right)[..., 0, :]
    sigma_px = np.sqrt(np.einsum("...i,ij,...j->...", by, fitted.covariance, by))
    ratios = off_px / sigma_px
    at = {name: (int(v * (rows - 1)), int(u * (columns - 1))) for name, (v, u) in PLACES.items()}
    mean = by.reshape(-1, len(NAMES)).mean(axis=0)
    return {
        **{name: round(float(ratios[place]), 2) for name, place in at.items()},
        "mean": round(float(np.nanmean(off_px) / np.sqrt(mean @ fitted.covariance @ mean)), 2),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--drives", type=int, default=40, help="number of drives")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args(arguments)
    rows = []
    for number in range(options.drives):
        row = judge(Planted(number))
        rows += [] if row is None else [row]
        if row is not None and not options.json:
            print({k: v for k, v in row.items() if k != "parameters"}, flush=True)
    print(json.dumps({"drives": rows, **summary(rows)} if options.json else summary(rows)))


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the fractions of intervals that hold, and of the disparity error that is left."""
    names = list(rows[0]["sigmas"])
    held = {name: np.abs([row["sigmas"][name] for row in rows]) <= SIGMAS for name in names}
    known = np.abs([list(row["parameters"].values()) for row in rows]) <= SIGMAS
    held |= {"yaw": known[:, NAMES.index("yaw")], "parameters": known}
    left = [row["left_px"] / row["planted_px"] for row in rows]
    return {
        "held": {name: round(float(one.mean()), 3) for name, one in held.items()},
        "not_recovered": round(float(np.mean(left)), 3),
    }


if __name__ == "__main__":
    main()
