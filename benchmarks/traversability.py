"""Where a robot can drive: costmaps of rendered courses against what stands and gapes there.

A course has ramps, kerbs, holes, ditches and boughs in three lanes ahead of a short drive, in an
order and at distances that follow from the seed. Cells on them are counted by their distance from
the last frame: free (cost 0), graded (below that of an obstacle), obstacle, or unknown. What is
over the limit of the robot must not be free within 12 m, nor have a cost up to 50, that of what is
as probably below; and no ramp up to 15 % may be an obstacle.

Example: python benchmarks/traversability.py --json --seeds 0 1
"""

from __future__ import annotations

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise, product
from typing import Any, Final, NamedTuple

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import load_config
from recon.core.geometry import se3
from recon.core.values import FREE, OCCUPIED, OccupancyGrid
from recon.core.values.arrays import Float64
from recon.export.costmap import make_costmap
from recon.map.drive.sequence import map_sequence
from recon.sources.synthetic import SyntheticSource
from recon.street.path import R_STREET_LEVEL
from recon.street.settings import StreetScene
from recon.street.shapes import Material, Paint, TriangleSoup, boxes, merge, quads
from recon.street.street import StreetWorld, rig

BANDS_M: Final = (0, 4, 8, 12, 20)
WIDE_M: Final = 2.4
"""Width of what is in a lane."""
LANES_M: Final = (-3.2, 0.0, 3.2)
AHEAD_M: Final = (2.6, 6.2, 9.8, 13.4)
NOD_DEG: Final = 0.2  # by which the rig pitches while it drives
ROAD: Final = Paint(Material.ASPHALT, (0.40, 0.40, 0.41))
STONE: Final = Paint(Material.KERB, (0.58, 0.57, 0.55))
LEAVES: Final = Paint(Material.LEAVES, (0.30, 0.40, 0.20), 9)
BRICK: Final = Paint(Material.BRICK, (0.64, 0.44, 0.36))


class Vehicle(NamedTuple):
    """A rig, and the robot that its map is for."""

    scene: dict[str, float]
    robot: dict[str, float]
    height_m: float  # of the robot


VEHICLES: Final = {
    "car": Vehicle(
        {"baseline_m": 0.54, "camera_height_m": 1.65, "pitch_deg": 4.0, "speed_m_per_frame": 0.5},
        {"wheel_radius_m": 0.15, "width_m": 0.6},
        2.0,
    ),
    "small robot": Vehicle(
        {"baseline_m": 0.12, "camera_height_m": 0.6, "pitch_deg": 6.0, "speed_m_per_frame": 0.2},
        {"wheel_radius_m": 0.1, "width_m": 0.5},
        1.0,
    ),
}
#: What can stand in a lane, with its size; and the least step (m) or slope that it is over.
RAMPS: Final = {f"ramp {percent} %": percent / 100 for percent in (5, 10, 15, 25)}
KERBS: Final = {f"kerb {cm} cm": cm / 100 for cm in (5, 10, 15, 20)}
OTHERS: Final = ("flat", "hole", "ditch", "bough", "high bough")
KINDS: Final = (*RAMPS, *KERBS, *OTHERS)
PITS: Final = {"hole": (0.3, 1.0, 1.0), "ditch": (0.4, 0.6, WIDE_M)}
"""Depth, length and width."""
Box = tuple[float, float, float, float]


class Course(SyntheticSource):
    """A rendered drive along a course; ``marks`` are the places (N, 2) of each thing."""

    settings: StreetScene

    def __init__(self, seed: int, vehicle: Vehicle, frames: int) -> None:
        size = {"width_px": 640, "height_px": 360, "focal_px": 360.0, "smooth_edges": False}
        super().__init__(StreetScene(seed=seed, frames=frames, **size, **vehicle.scene))
        self.name, self._clearance_m = f"course {seed}", vehicle.height_m
        self.marks: list[tuple[str, Float64]] = []
        self._pits: list[Box] = []

    @cached_property
    def world(self) -> StreetWorld:
        """The course, and the path before it."""
        s, random = self.settings, np.random.default_rng([self.settings.seed, 7])
        end_m = (s.frames - 1) * s.speed_m_per_frame
        things: list[str] = []
        parts: list[TriangleSoup] = []
        for lane, ahead in product(LANES_M, AHEAD_M):
            things = things or list(random.permutation(KINDS))
            at = (end_m + ahead + random.uniform(0, 0.8), lane + random.uniform(-0.2, 0.2))
            parts += self._thing(str(things.pop()), *at, random)
        soup = merge([*parts, *ground(self._pits), *walls(end_m + 24.0)])
        steps = range(s.frames)
        nods = [s.pitch_deg + NOD_DEG * np.sin(1.3 * k + s.seed) for k in steps]
        poses = [pose(k * s.speed_m_per_frame, s.camera_height_m, nods[k]) for k in steps]
        sun = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
        return StreetWorld(s, soup, rig(s), np.array(poses), sun)

    def _thing(
        self, kind: str, x: float, y: float, random: np.random.Generator
    ) -> Iterator[TriangleSoup]:
        right, left = y - WIDE_M / 2, y + WIDE_M / 2
        along, across = np.arange(x, x + 2.0, 0.1), np.arange(right + 0.35, left - 0.35, 0.1)
        if kind in RAMPS:
            yield from ramp(x, right, RAMPS[kind])
            # Away from its sides and its end, which are steps.
            along, across = np.arange(x + 0.6, x + 1.2, 0.1), np.arange(y - 0.3, y + 0.3, 0.1)
        elif kind in KERBS:
            yield boxes([x, right, 0.0], [x + 2.0, left, KERBS[kind]], STONE)
            along = np.array([x])
        elif kind in PITS:
            depth, long, wide = PITS[kind]
            self._pits.append((x, x + long, y - wide / 2, y + wide / 2))
            yield from pit(self._pits[-1], depth)
            along = np.arange(x, x + long, 0.1)
            across = np.arange(y - wide / 2 + 0.1, y + wide / 2 - 0.05, 0.1)
        elif kind != "flat":
            under = random.uniform(0.55, 0.85) if kind == "bough" else 1.2
            low = under * self._clearance_m
            yield boxes([x, right, low], [x + 0.3, left, low + 0.2], LEAVES)
            along = np.arange(x + 0.05, x + 0.3, 0.1)
        self.marks.append((kind, np.stack(np.meshgrid(along, across), -1).reshape(-1, 2)))


def ramp(x: float, right: float, slope: float) -> Iterator[TriangleSoup]:
    """A slope with sides of steps, and its back."""
    long, pieces = 2.2, 11
    yield quads([x, right, 0.0], [long, 0.0, slope * long], [0.0, WIDE_M, 0.0], ROAD)
    yield quads([x + long, right, 0.0], [0.0, WIDE_M, 0.0], [0.0, 0.0, slope * long], STONE)
    begins = x + long / pieces * np.arange(pieces)
    high = slope * (begins + long / pieces / 2 - x)
    for side in (right, right + WIDE_M - 0.01):
        low = np.column_stack([begins, np.full(pieces, side), np.zeros(pieces)])
        yield boxes(low, low + np.column_stack([np.full((pieces, 1), long / pieces), np.full(
            (pieces, 1), 0.01), high]), STONE)  # fmt: skip


def pit(place: Box, depth: float) -> Iterator[TriangleSoup]:
    x0, x1, y0, y1 = place
    long, wide, up = [x1 - x0, 0.0, 0.0], [0.0, y1 - y0, 0.0], [0.0, 0.0, depth]
    yield quads([x0, y0, -depth], long, wide, STONE)
    for corner, side in (((x0, y0), wide), ((x1, y0), wide), ((x0, y0), long), ((x0, y1), long)):
        yield quads([*corner, -depth], side, up, STONE)


def ground(pits: Sequence[Box]) -> Iterator[TriangleSoup]:
    """The road without its pits."""
    xs = np.unique([-10.0, 60.0, *(end for pit in pits for end in pit[:2])])
    ys = np.unique([-20.0, 20.0, *(end for pit in pits for end in pit[2:])])
    for (x0, x1), (y0, y1) in product(pairwise(xs), pairwise(ys)):
        x, y = (x0 + x1) / 2, (y0 + y1) / 2
        if not any(a < x < b and c < y < d for a, b, c, d in pits):
            yield quads([x0, y0, 0.0], [x1 - x0, 0.0, 0.0], [0.0, y1 - y0, 0.0], ROAD, (x0, y0))


def walls(end_m: float) -> Iterator[TriangleSoup]:
    yield quads([end_m, -20.0, 0.0], [0.0, 40.0, 0.0], [0.0, 0.0, 7.0], BRICK)
    for side in (-9.0, 9.0):
        yield quads([-10.0, side, 0.0], [70.0, 0.0, 0.0], [0.0, 0.0, 5.0], BRICK)


def pose(along_m: float, height_m: float, pitch_deg: float) -> Float64:
    down = se3.exp_so3(np.array([-np.radians(pitch_deg), 0.0, 0.0]))
    return se3.make_transform(R_STREET_LEVEL @ down, np.array([along_m, 0.27, height_m]))


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    found = {name: measured(vehicle, options) for name, vehicle in VEHICLES.items()}
    print(json.dumps(found, indent=2) if options.json else table(found))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--seeds", type=int, nargs="+", default=[*range(100, 108)], help="courses")
    parser.add_argument("--frames", type=int, default=8, help="frames of each")
    parser.add_argument("--set", action="append", default=[], help="a setting, as recon takes it")
    return parser.parse_args(arguments)


def measured(vehicle: Vehicle, options: argparse.Namespace) -> dict[str, Any]:
    """Cells of each kind in each band, and what must not be."""
    counts: dict[str, dict[str, Counter[str]]] = defaultdict(lambda: defaultdict(Counter))
    robot = {f"robot.{name}": value for name, value in vehicle.robot.items()}
    robot["grid.max_height_m"] = vehicle.height_m
    config = load_config(None, [robot, "loops.enabled=false", *options.set])
    for seed in options.seeds:
        source = Course(seed, vehicle, options.frames)
        mapped = map_sequence(source, config)
        costs, _ = make_costmap(mapped.map, mapped.placed)
        T_map_street, end_m = mapped.T_map_world @ source.world.T_world_street, mapped.path_m[-1]
        for kind, places in source.marks:
            xy = se3.apply(T_map_street, np.pad(places, ((0, 0), (0, 1))))[:, :2]
            away = np.linalg.norm(xy - end_m[:2], axis=1)
            for (near, far), name in zip(pairwise(BANDS_M), bands(), strict=True):
                inside = (away >= near) & (away < far)
                counts[kind][name] += Counter(states(costs, xy[inside]))
    over, ramps = over_limit(config.robot.step_m), ("ramp 5 %", "ramp 10 %", "ramp 15 %")
    return {
        "cells": {kind: counts[kind] for kind in KINDS},
        "over the limit, free within 12 m": total(counts, over, "free", bands()[:3]),
        "over the limit, cost to 50 within 12 m": total(counts, over, "low", bands()[:3]),
        "over the limit, cost above 50 within 12 m": total(counts, over, "high", bands()[:3]),
        "ramps up to 15 %, obstacle": total(counts, ramps, "obstacle", bands()),
    }


def bands() -> list[str]:
    return [f"{near} to {far} m" for near, far in pairwise(BANDS_M)]


def states(costs: OccupancyGrid, xy: Float64) -> list[str]:
    """What the cells at places (N, 2) are."""
    column, row = np.floor((xy - costs.origin_m) / costs.resolution_m).astype(int).T
    values = costs.cells[row, column].tolist()
    return [state(value) for value in values]


def state(cost: int) -> str:
    if cost < FREE or cost >= OCCUPIED:
        return "unknown" if cost < FREE else "obstacle"
    return "free" if cost == FREE else "low" if cost <= OCCUPIED // 2 else "high"


def over_limit(step_m: float) -> list[str]:
    """Things that the robot cannot pass; its steepest slope is 20 %."""
    return ["ramp 25 %", "hole", "ditch", "bough", *(k for k, h in KERBS.items() if h > step_m)]


def total(counts: Any, kinds: Sequence[str], state: str, names: Sequence[str]) -> int:
    return sum(counts[kind][name][state] for kind, name in product(kinds, names))


def table(found: dict[str, Any]) -> str:
    lines = [
        f"{'free / graded / obstacle / unknown':34s}" + "".join(f"{name:>18s}" for name in bands())
    ]
    for vehicle, one in found.items():
        for kind, cells in one["cells"].items():
            texts = [ratios(cells[name]) for name in bands()]
            lines.append(f"{vehicle + ', ' + kind:34s}" + "".join(f"{t:>18s}" for t in texts))
        lines += [f"{vehicle}: {name}: {n}" for name, n in one.items() if name != "cells"]
    return "\n".join(lines)


def ratios(cells: Counter[str]) -> str:
    graded = cells.get("low", 0) + cells.get("high", 0)
    counted = [cells.get("free", 0), graded, cells.get("obstacle", 0), cells.get("unknown", 0)]
    return " / ".join(f"{100 * n / sum(counted):.0f}" for n in counted) if sum(counted) else ""


if __name__ == "__main__":
    main()
