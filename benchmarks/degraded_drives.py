"""What is left of the path where features fail: by each odometry, on the same frames.

Some frames of a drive are black, blurred, overexposed or covered, its steps are long, its surfaces
nearly bare, or the rig turns on the spot.

Example: python benchmarks/degraded_drives.py DRIVE
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from altered_drives import Altered, Change, alterations, run, thinned

from recon.core.geometry import se3
from recon.core.values import SequenceTruth, StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.odometry.registry import ODOMETRIES, make_odometry
from recon.sources.registry import open_source
from recon.sources.source import DerivedSource
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene, StreetSettings
from recon.street.street import StreetWorld, build_street

SCENE: Final = {"seed": 3, "frames": 72, "width_px": 400, "height_px": 136, "focal_px": 225.0}
TURN_DEG: Final = 10.0
"""How much the rig that turns on the spot turns from frame to frame; one whole turn."""


def black(image: UInt8) -> UInt8:
    return np.zeros_like(image)


def blurred(image: UInt8) -> UInt8:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 8.0), np.uint8)


def overexposed(image: UInt8) -> UInt8:
    return np.asarray(np.clip(4.0 * image + 60.0, 0, 255), np.uint8)


def covered(image: UInt8) -> UInt8:
    """All but a strip of a seventh of the height, at the bottom."""
    seen: UInt8 = image.copy()
    seen[: 6 * len(image) // 7] = 90
    return seen


def bare(image: UInt8) -> UInt8:
    """A tenth of the contrast."""
    return np.asarray(np.rint(110.0 + 0.1 * image), np.uint8)


def spoiled(plain: Altered, what: Callable[[UInt8], UInt8], count: int) -> Altered:
    """The drive with ``count`` frames spoiled from its middle on."""
    first = len(plain) // 2

    def change(index: int, *both: UInt8) -> tuple[UInt8, UInt8]:
        left, right = (what(image) if first <= index < first + count else image for image in both)
        return left, right

    return replace(plain, change=change)


def everywhere(what: Callable[[UInt8], UInt8]) -> Change:
    return lambda _, left, right: (what(left), what(right))


def degradations(plain: Altered) -> dict[str, Altered]:
    cases = {"as it is": plain}
    for count in (1, 3, 5, 10, 20):
        cases[f"{count} black"] = spoiled(plain, black, count)
    for what in (blurred, overexposed, covered):
        for count in (5, 20):
            cases[f"{count} {what.__name__}"] = spoiled(plain, what, count)
    cases["every 5th frame"] = thinned(plain, 5)
    cases["bare surfaces"] = replace(plain, change=everywhere(bare))
    return cases


def turning() -> Altered:
    """A rendered street seen turning on the spot, and driving on afterwards."""
    source = SyntheticSource(StreetScene(**SCENE))
    poses = np.array(source.world.T_street_camera)
    after = 20 + round(360.0 / TURN_DEG)
    poses[after:] = poses[20 : 20 + len(poses) - after]
    for index in range(20, after):
        angle = np.radians(TURN_DEG * (index - 19))
        poses[index] = poses[20] @ se3.make_transform(
            se3.exp_so3(np.array([0.0, angle, 0.0])), np.zeros(3)
        )
    return kept(TurningSource(source.settings, poses))


class TurningSource(SyntheticSource):
    """A street seen along another path."""

    def __init__(self, settings: StreetSettings, T_street_camera: Float64) -> None:
        super().__init__(settings)
        self._poses = T_street_camera

    @cached_property
    def world(self) -> StreetWorld:
        """The street, with the path."""
        return replace(build_street(self.settings), T_street_camera=self._poses)


def kept(source: SyntheticSource) -> Altered:
    """A rendered drive whose images are kept, because each degradation wants them again."""
    return alterations(Kept(source))["as it is"]


class Kept(DerivedSource):
    """A rendered drive in memory."""

    truth: SequenceTruth

    def __init__(self, source: SyntheticSource) -> None:
        super().__init__(source)
        self.pairs, self.truth = list(source.frames()), SequenceTruth(source.trajectory)

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """The pairs from number ``start`` on."""
        return iter(self.pairs[start:])


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.drive is None:
        cases = degradations(kept(SyntheticSource(StreetScene(**SCENE))))
        if options.only is None or "turning on the spot" in options.only:
            cases["turning on the spot"] = turning()
    else:
        cases = degradations(alterations(open_source(options.drive))["as it is"])
    result = {}
    for name in options.only or cases:
        result[name] = run(cases[name], {each: make_odometry(each) for each in ODOMETRIES})
        if not options.json:
            print(line(name, result[name]), flush=True)
    if options.json:
        print(json.dumps(result, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "drive", type=Path, nargs="?", help="rectified drive with true poses; a rendered street"
    )
    parser.add_argument("--only", nargs="+", help="names of degradations")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


def line(name: str, found: dict[str, dict[str, Any]]) -> str:
    cells = (
        f"{odometry}: {row['t_rel_percent']:.3f} %, ATE {row['ate_m']:.2f} m, "
        f"{row['untrusted']} untrusted"
        for odometry, row in found.items()
    )
    return f"{name:18s}" + "   ".join(cells)


if __name__ == "__main__":
    main()
