"""Check an accuracy report without any code of recon: numpy, and what the files say.

Arguments: result folder with accuracy.json, list of control points, run folder of the map, of
rectified images as they are. Whatever differs ends it with an error.
"""

import hashlib
import json
import math
import sys
from pathlib import Path

import numpy as np

out, control, run = map(Path, sys.argv[1:])
report = json.loads((out / "accuracy.json").read_text())
points = report["survey"]["control"]


def near(found, expected, off, what):
    if not abs(found - expected) <= off:
        sys.exit(f"{what}: {found}, by hand {expected}")


# The list of control points.
listed = {}
for line in control.read_text().splitlines()[1:]:
    east, north, up, column, row, image, name, *check = line.split()
    place = listed.setdefault(name, ([float(east), float(north), float(up)], [], bool(check)))
    place[1].append((int(image), float(column), float(row)))
if listed.keys() != points.keys():
    sys.exit("other points than in the list")

# Root mean squares and means.
kinds = {"check": [], "control": []}
for name, one in points.items():
    if one["check"] != listed[name][2] or (one["check"] and one["used"]):
        sys.exit(f"{name} is not used as the list says")
    if one["east_m"] is not None and (one["check"] or one["used"]):
        kinds["check" if one["check"] else "control"].append(
            [one["east_m"], one["north_m"], one["up_m"]]
        )
for kind, off in [*kinds.items(), ("tested", kinds["check"])]:
    survey = report["surveyed_m"] ** 2 if kind == "tested" else 0.0
    square = [sum(each[n] ** 2 for each in off) / len(off) + survey for n in range(3)]
    near(report["errors"][kind]["points"], len(off), 0, f"number of {kind} points")
    for n, axis in enumerate(("east", "north", "up")):
        near(
            report["errors"][kind]["rmse_m"][axis],
            math.sqrt(square[n]),
            1e-12,
            f"RMSE {axis} of {kind}",
        )
        mean = sum(each[n] for each in off) / len(off)
        near(report["errors"][kind]["mean_m"][axis], mean, 1e-12, f"mean {axis} of {kind}")
    near(
        report["errors"][kind]["rmse_m"]["horizontal"],
        math.sqrt(square[0] + square[1]),
        1e-12,
        kind,
    )
    near(report["errors"][kind]["rmse_m"]["3d"], math.sqrt(sum(square)), 1e-12, kind)

# Where rays of two images meet, beside what was measured with disparities.
summary, (drive,) = json.loads((run / "summary.json").read_text()), report["drives"]
T_survey_world = np.array(report["survey"]["T_survey_map"]) @ np.array(summary["T_map_world"])
poses = {}
for number, words in enumerate(np.loadtxt(run / "trajectory_tum.txt")):
    x, y, z, w = words[4:]
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    poses[number] = turn, words[1:4]
triangulated = 0
for name, (place, seen, _) in listed.items():
    if len(seen) < 2 or points[name]["east_m"] is None:
        continue
    left, right = np.zeros((3, 3)), np.zeros(3)
    for image, column, row in seen:
        turn, centre = poses[image]
        ray = turn @ [
            (column - drive["cx_px"]) / drive["focal_px"],
            (row - drive["cy_px"]) / drive["focal_px"],
            1.0,
        ]
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        left, right = left + across, right + across @ centre
    there = T_survey_world[:3, :3] @ np.linalg.solve(left, right) + T_survey_world[:3, 3]
    for n, axis in enumerate(("east", "north", "up")):
        off = 4 * points[name][f"sigma_{axis}_m"]
        near(points[name][f"{axis}_m"], there[n] - place[n], off, f"{name} {axis}")
    triangulated += 1

# The files that it is about.
for name, digest in report["sha256"]["products"].items():
    if hashlib.sha256((out / name).read_bytes()).hexdigest() != digest:
        sys.exit(f"{name} is another file")
sys.stdout.write(f"triangulated {triangulated}\n")
