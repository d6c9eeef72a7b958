"""What `recon diff` finds between weeks of the rendered year, against what was parked there.

A car has changed if it stands in the street in one of the two weeks only. It counts if its drive
saw 30 % of its longer side, by the true depth of every sixth frame, up to where the clouds of the
maps end (``reach_m``); and if the other drive saw at least half of those places from within 25 m,
or what is beyond them. It was `replaced` if another car stands there on the other day, else its bay
is `free` then. It is found if the box of an object of its kind overlaps its own; of one that was
replaced, of either kind. An object is false if its box overlaps nothing that changed: cars,
hoarding, fence, the growing tree; crowns of trees, where leaves are of another season.

WEEKS has the weeks as folders (image_0, image_1, calib.txt, times.txt, T_street_first.npy), as
`benchmarks/year.py` writes them, or they are rendered; RUNS their maps, which are made where they
are missing.

Of HALVES, two runs of one drive, nothing but what drives may be found; all objects are counted.

Example: python benchmarks/changes.py RUNS --weeks WEEKS --pairs 0-1,50-51 --json
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import load_config
from recon.commands.diff import run_diff
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.sources.registry import open_source
from recon.street.shapes import Material
from tests.scenery.year import (
    FENCE_GOES,
    HOARDING,
    WeekDrive,
    fence,
    growing_tree,
    hoarding,
    parked_cars,
    season,
)

EVERY, CELL_M = 6, 0.2
RANGE_M = 25.0  # of occupancy: how far the other drive may be from what it looks through
LEAST_SIDE, LEAST_SEEN = 0.3, 0.5
OFF_M = 0.3  # by how much boxes may miss each other: a voxel, and the error of the path


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path, help="folder of the maps of weeks, and of the results")
    parser.add_argument("--weeks", type=Path, help="folder of rendered weeks")
    parser.add_argument("--pairs", default="0-1", help="weeks to compare, such as 0-1,50-51")
    parser.add_argument("--halves", type=Path, nargs=2, help="two runs in which nothing changed")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    if options.halves is not None:
        before, after = options.halves
        found = run_diff(before, after, MapOptions("diff", options.runs / "halves"))
        rows = [{"objects": len(found.objects), "not_compared": found.not_compared_ratio}]
    else:
        pairs = [[*map(int, pair.split("-"))] for pair in options.pairs.split(",")]
        rows = [weeks(one, other, options.runs, options.weeks) for one, other in pairs]
    print(json.dumps(rows, indent=2) if options.json else "\n".join(map(str, rows)))


def weeks(before: int, after: int, runs: Path, rendered: Path | None) -> dict[str, Any]:
    """Compare two weeks, and count what was found of their cars."""
    out = runs / f"diff-{before:02d}-{after:02d}"
    both = mapped(before, runs, rendered), mapped(after, runs, rendered)
    if not (out / "summary.json").is_file():
        run_diff(both[0], both[1], MapOptions("diff", out))
    summary = json.loads((out / "summary.json").read_text())
    first = drive(before).world.T_street_camera[0]
    boxes = [(one, street_box(one, first @ np.linalg.inv(summary["T_map_world"])))
             for one in summary["objects"]]  # fmt: skip
    reach_m = min(json.loads((run / "summary.json").read_text())["reach_m"] for run in both)
    cars = [
        *changed_cars(before, after, "went", reach_m),
        *changed_cars(after, before, "came", reach_m),
    ]
    counted = {"free": [0, 0], "replaced": [0, 0]}
    missed = []
    for kind, how, name, box in cars:
        if how is not None:
            # Of two cars in one bay, the smaller one may be within the other.
            kinds = [kind] if how == "free" else ["came", "went"]
            hit = any(one["change"] in kinds and overlap(box, its) for one, its in boxes)
            counted[how][0] += hit
            counted[how][1] += 1
            if not hit:
                missed.append((kind, how, name, box.mean(axis=0).round(1).tolist()))
    real = [box for *_, box in cars] + [*other_changes(before, after)]
    false = [one["number"] for one, its in boxes if not any(overlap(its, box) for box in real)]
    path_m = drive(before).trajectory.path_length_m
    return {"weeks": (before, after), "found_of": counted, "missed": missed, "objects": len(boxes),
            "false": false, "false_per_100_m": round(100 * len(false) / path_m, 2),
            "seconds": summary["seconds"],
            "not_compared": summary["not_compared_ratio"]}  # fmt: skip


@cache
def drive(week: int) -> WeekDrive:
    return WeekDrive(week)


def mapped(week: int, runs: Path, rendered: Path | None) -> Path:
    """Return the run of a week, which is made if it is missing."""
    folder = runs / f"{week:02d}"
    if not (folder / "summary.json").is_file():
        source = drive(week) if rendered is None else open_source(rendered / folder.name)
        run_map(source, load_config(), MapOptions(out=folder, mesh=False))
    return folder


def changed_cars(
    week: int, other: int, kind: str, reach_m: float
) -> Iterator[tuple[str, str | None, Any, Any]]:
    """Yield the cars of a week that are not there in another, and whether both drives saw them."""
    there = {car.name: car.box_m for car in parked_cars(other)}
    for car in parked_cars(week):
        if car.name not in there:
            taken = any(overlap(car.box_m, box) for box in there.values())
            how = "replaced" if taken else "free"
            seen = both_saw(car.box_m, week, other, reach_m)
            yield kind, how if seen else None, car.name, car.box_m


def both_saw(box: np.ndarray, week: int, other: int, reach_m: float) -> bool:
    """Return whether one drive saw enough of a car, and the other one its place."""
    cells = np.zeros((0, 3), np.int64)
    for T, points, _ in views(week):
        street = points[points[:, 2] < reach_m] @ T[:3, :3].T + T[:3, 3]
        near = ((street > box[0] - 0.05) & (street < box[1] + 0.05)).all(axis=1)
        cells = np.unique(np.vstack([cells, np.floor(street[near] / CELL_M).astype(int)]), axis=0)
    length, width, height = box[1] - box[0]
    if len(cells) < LEAST_SIDE * max(length, width) * height / CELL_M**2:
        return False
    places = (cells + 0.5) * CELL_M
    looked = np.zeros(len(places), bool)
    for T, _, depth in views(other):
        ahead = (places - T[:3, 3]) @ T[:3, :3]
        z = np.maximum(ahead[:, 2], 0.1)
        camera = drive(other).calibration
        u = np.rint(camera.focal_px * ahead[:, 0] / z + camera.cx_px).astype(int)
        v = np.rint(camera.focal_px * ahead[:, 1] / z + camera.cy_px).astype(int)
        inside = (ahead[:, 2] > 0.5) & (z < RANGE_M) & (u >= 0) & (v >= 0)
        rows = np.flatnonzero(inside & (u < depth.shape[1]) & (v < depth.shape[0]))
        looked[rows[depth[v[rows], u[rows]] > z[rows] - 0.5]] = True
    return bool(looked.mean() >= LEAST_SEEN)


@cache
def views(week: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return pose in the street, points within range, and true depth of every sixth frame."""
    one, found = drive(week), []
    camera = one.calibration
    for frame in range(0, len(one), EVERY):
        depth = np.nan_to_num(one.camera.depth(frame), nan=1e6).astype(float)
        v, u = np.nonzero(depth < RANGE_M)
        z = depth[v, u]
        x, y = (u - camera.cx_px) * z / camera.focal_px, (v - camera.cy_px) * z / camera.focal_px
        found.append((one.world.T_street_camera[frame], np.stack([x, y, z], axis=1), depth))
    return found


def other_changes(before: int, after: int) -> Iterator[np.ndarray]:
    """Yield the boxes of what else has changed."""
    if (before in HOARDING) != (after in HOARDING):
        yield box_of(hoarding().vertices)
    if (before < FENCE_GOES) != (after < FENCE_GOES):
        yield box_of(fence().vertices)
    yield box_of(growing_tree(max(before, after)).vertices)
    if season(before) != season(after):
        soup = drive(before).world.soup
        leaves = soup.vertices[soup.material == Material.LEAVES]
        for x in np.unique(np.floor(leaves[:, 0, 0] / 2)):
            for side in (leaves[:, 0, 1] < 0, leaves[:, 0, 1] >= 0):
                chosen = side & (np.floor(leaves[:, 0, 0] / 2) == x)
                if chosen.any():
                    yield box_of(leaves[chosen])


def box_of(vertices: np.ndarray) -> np.ndarray:
    corners = vertices.reshape(-1, 3)
    return np.stack([corners.min(axis=0), corners.max(axis=0)])


def street_box(changed: dict[str, Any], T_street_map: np.ndarray) -> np.ndarray:
    """Return the lowest and highest corner of the box of an object, street axes."""
    turn = math.radians(changed["heading_deg"])
    c, s = math.cos(turn), math.sin(turn)
    half = np.array([changed["length_m"], changed["width_m"], changed["height_m"]]) / 2
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = np.array(changed["centre_m"]) + (signs * half) @ np.array(
        [[c, s, 0], [-s, c, 0], [0, 0, 1]]
    )
    street = corners @ T_street_map[:3, :3].T + T_street_map[:3, 3]
    return np.stack([street.min(axis=0), street.max(axis=0)])


def overlap(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(((one[0] < other[1] + OFF_M) & (other[0] < one[1] + OFF_M)).all())


if __name__ == "__main__":
    main()
