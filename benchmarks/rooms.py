"""Rendered rooms: how far the path is off, and whether loops are closed, none of them wrong.

Each seed is a room with white walls, mirrors and windows, through which a rig is carried by hand,
for somewhat more than a lap: images are blurred as it turns, and its path is known exactly.

Example: python benchmarks/rooms.py --rooms 2 --json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import load_config
from recon.core.geometry import se3
from recon.core.geometry.alignment import fit_points
from recon.core.values import StereoPair
from recon.look.look import refine_rig
from recon.map.drive.sequence import map_sequence
from recon.places.places import Loop
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene

WRONG_M, WRONG_DEG = 0.15, 3.0
"""Errors of a motion beyond which a loop is wrong."""


class Walk(SyntheticSource):
    """A room whose images are rendered once."""

    @cached_property
    def pairs(self) -> list[StereoPair]:
        """All stereo pairs."""
        return [self.camera.pair(index) for index in range(len(self))]

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """The pairs, from frame ``start`` on."""
        return iter(self.pairs[start:])


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    rooms = []
    for seed in range(options.first, options.first + options.rooms):
        rooms.append(measured(scene_of(seed, options)))
        if not options.json:
            print(json.dumps(rooms[-1]), flush=True)
    if options.json:
        print(json.dumps({"rooms": rooms}))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="JSON of all rooms at the end")
    parser.add_argument("--rooms", type=int, default=20, help="how many")
    parser.add_argument("--first", type=int, default=0, help="seed of the first")
    parser.add_argument("--frames", type=int, default=200, help="a lap takes 130 to 175")
    parser.add_argument("--width", type=int, default=320, help="of the images, whose height is 5/8")
    return parser.parse_args(arguments)


def scene_of(seed: int, options: argparse.Namespace) -> StreetScene:
    width = options.width
    size = {"width_px": width, "height_px": width * 5 // 8, "focal_px": width * 0.5625}
    return StreetScene.parse(
        {"path": "room", "seed": seed, "frames": options.frames, "smooth_edges": False} | size
    )


def measured(scene: StreetScene) -> dict[str, Any]:
    """Map a room; how well."""
    source, config = Walk(scene), load_config()
    rig = refine_rig(source, config, config.rig)
    mapped = map_sequence(rig.applied(source), config)
    truth, placed = source.trajectory, mapped.map.placed[mapped.session.number]
    ours_m, true_m = (path.positions_m[placed] for path in (mapped.trajectory, truth))
    off_m = np.linalg.norm(se3.apply(fit_points(ours_m, true_m).T_to_from, ours_m) - true_m, axis=1)
    closed = () if mapped.loops is None else mapped.loops.closure.closed
    return {
        "seed": scene.seed,
        "path_m": round(truth.path_length_m, 2),
        "frames": len(truth),
        "frames_placed": int(placed.sum()),
        "sessions": len(mapped.segments),
        "ate_percent": 100.0 * float(np.sqrt(np.mean(off_m**2))) / truth.path_length_m,
        "largest_error_m": float(off_m.max()),
        "loops": len(closed),
        "laps_closed": any(loop.last - loop.first > len(truth) // 2 for loop in closed),
        "wrong": sum(is_wrong(loop, truth.T_world_camera) for loop in closed),
    }


def is_wrong(loop: Loop, T_world_camera: np.ndarray) -> bool:
    truth = se3.invert(T_world_camera[loop.first]) @ T_world_camera[loop.last]
    off = se3.invert(truth) @ loop.T_first_last
    far = float(np.linalg.norm(off[:3, 3])) > WRONG_M
    return far or float(np.rad2deg(se3.angle_rad(off))) > WRONG_DEG


if __name__ == "__main__":
    main()
