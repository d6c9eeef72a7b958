"""Check what `recon diff` wrote without any code of recon: numpy, and what the files say.

Arguments: result folder of the diff, run folders of the days before and after, and a JSON with the
truth: ``boxes`` of what came and went (``change``, lowest and highest corner in street axes),
``T_street_world`` of both days, and the camera. Whatever differs ends it with an error.

Not in any file, and so not checked: where the drives of the second run lie in the axes of the
first (the truth stands in, to what poses err by), and the deviations of points, of which the volume
of an object has its own.
"""

import csv
import json
import math
import re
import sys
import zlib
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

out, *runs, truth = map(Path, sys.argv[1:])
summary, truth = json.loads((out / "summary.json").read_text()), json.loads(truth.read_text())
SAME, CAME, WENT, NOT_COMPARED = range(4)
KINDS = {"came": CAME, "went": WENT}
OFF_M = 0.3  # by how much a box may miss the true one: a voxel, and the error of path and depth


def near(found, expected, off, what):
    if not abs(found - expected) <= off:
        sys.exit(f"{what}: {found}, by hand {expected}")


def must(true, what):
    if not true:
        sys.exit(what)


def read_ply(path):
    head, _, body = path.read_bytes().partition(b"end_header\n")
    types = {"float": "<f4", "double": "<f8", "uchar": "u1", "uint": "<u4", "int": "<i4",
             "ushort": "<u2", "short": "<i2", "char": "i1"}  # fmt: skip
    words = [line.split() for line in head.decode().splitlines()]
    first = next(n for n, line in enumerate(words) if line[0] == "element")
    count = int(words[first][2])
    own = next((n for n in range(first + 1, len(words)) if words[n][0] == "element"), len(words))
    kinds = [(name, types[kind]) for _, kind, name in words[first + 1 : own]]
    return np.frombuffer(body, np.dtype(kinds), count)


def xyz_of(table):
    return np.stack([table[axis] for axis in "xyz"], axis=1).astype(float)


def cells_of(points, size_m):
    """Return one number for each cell, and the three of each."""
    at = np.floor(np.asarray(points, np.float32) / np.float32(size_m)).astype(np.int64)
    return (at + (1 << 20)) @ np.array([1 << 42, 1 << 21, 1]), at


def distances(points, others, reach_m):
    """Return how far the nearest of others is; infinite beyond the reach."""
    keys, _ = cells_of(others, reach_m)
    order = np.argsort(keys, kind="stable")
    keys, others, found = keys[order], others[order], np.full(len(points), np.inf)
    mine, _ = cells_of(points, reach_m)
    for step in np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), axis=-1).reshape(-1, 3):
        there = mine + step @ np.array([1 << 42, 1 << 21, 1])
        first, last = np.searchsorted(keys, there), np.searchsorted(keys, there, "right")
        for n in range(int((last - first).max(initial=0))):
            rows = np.flatnonzero(first + n < last)
            off = points[rows] - others[first[rows] + n]
            found[rows] = np.minimum(found[rows], np.linalg.norm(off, axis=1))
    return np.where(found <= reach_m, found, np.inf)


def read_png(path):
    """Return red, green, blue and opacity of 8 bits (H, W, 4)."""
    data, begin, packed = path.read_bytes(), 8, b""
    while begin < len(data):
        size, kind = int.from_bytes(data[begin : begin + 4]), data[begin + 4 : begin + 8]
        content, begin = data[begin + 8 : begin + 8 + size], begin + size + 12
        if kind == b"IHDR":
            width, height = int.from_bytes(content[:4]), int.from_bytes(content[4:8])
            must(content[8:10] == b"\x08\x06", f"{path} has other channels")
        packed += content if kind == b"IDAT" else b""
    raw, wide, many = zlib.decompress(packed), 4 * width, 4
    image = np.zeros((height + 1, wide + many), int)  # what is beside it is 0
    for n in range(height):
        how, *line = raw[n * (wide + 1) : (n + 1) * (wide + 1)]
        for x, value in enumerate(line, many):
            left, up, corner = image[n + 1, x - many], image[n, x], image[n, x - many]
            off = [abs(up - corner), abs(left - corner), abs(left + up - 2 * corner)]
            guess = 0, left, up, (left + up) // 2, (left, up, corner)[off.index(min(off))]
            image[n + 1, x] = (value + guess[how]) % 256
    return image[1:, many:].reshape(height, width, many)


def smallest_rectangle(plan):
    """Return length, width and middle of the rectangle of least area around points (N, 2)."""
    ordered, hull = sorted(set(map(tuple, plan.tolist()))), []
    for points in (ordered, ordered[::-1]):  # both sides of the convex hull
        side = []
        for x, y in points:
            while len(side) > 1 and (side[-1][0] - side[-2][0]) * (y - side[-2][1]) <= (
                side[-1][1] - side[-2][1]
            ) * (x - side[-2][0]):
                side.pop()
            side.append((x, y))
        hull += side[:-1]
    hull, best = np.array(hull), None
    for edge in np.roll(hull, -1, axis=0) - hull:
        along = edge / np.linalg.norm(edge)
        turned = hull @ np.array([[along[0], -along[1]], [along[1], along[0]]])
        low, high = turned.min(axis=0), turned.max(axis=0)
        area = float(np.prod(high - low))
        if best is None or area < best[0]:
            best = area, sorted((high - low).tolist(), reverse=True)
    return best


def axes_of(one):
    """Return the axes of a box, along, across and up (3, 3), as rows."""
    turn = math.radians(one["heading_deg"])
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def poses_of(run):
    """Return stamps and T_world_camera (N, 4, 4) of a run of one drive."""
    rows = np.loadtxt(run / "trajectory_tum.txt", ndmin=2)
    found = np.tile(np.eye(4), (len(rows), 1, 1))
    for pose, (*place, x, y, z, w) in zip(found, rows[:, 1:].tolist(), strict=True):
        pose[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        pose[:3, 3] = place
    return rows[:, 0], found


def moved(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


# The cloud by class, and how much of it could not be compared.
cloud = read_ply(out / "changes.ply")
cloud_xyz = np.stack([cloud[axis] for axis in "xyz"], axis=1)  # float32, as cells are cut by it
xyz, change, day = xyz_of(cloud), cloud["change"], cloud["day"]
must({*np.unique(change)} <= {*range(4)} and {*np.unique(day)} <= {0, 1}, "other classes or days")
must(not (day[change == CAME] == 0).any(), "the day before has points that came")
must(not (day[change == WENT] == 1).any(), "the day after has points that went")
for n, name in enumerate(("before", "after")):
    ratio = float(np.mean(change[day == n] == NOT_COMPARED))
    near(summary["not_compared_ratio"][name], ratio, 1e-12, f"not compared, {name}")

# Both runs: paths, clouds, and where the second lies in the axes of the first.
paths, T_map_world, clouds = [], [], []
for run in runs:
    paths.append(poses_of(run))
    T_map_world.append(np.array(json.loads((run / "summary.json").read_text())["T_map_world"]))
    clouds.append(read_ply(run / "map/cloud.ply"))
near(np.abs(T_map_world[0] - summary["T_map_world"]).max(), 0.0, 1e-9, "T_map_world")
T_street_map = [
    np.array(T) @ np.linalg.inv(map_)
    for T, map_ in zip(truth["T_street_world"], T_map_world, strict=True)
]
T_first_map = [np.eye(4), np.linalg.inv(T_street_map[0]) @ T_street_map[1]]
exported = [moved(T, xyz_of(one)) for T, one in zip(T_first_map, clouds, strict=True)]

# Same points have a point of the other day near; those that came and went have none: no surface in
# this street is displaced by less than that.
settings = (runs[0] / "config.yaml").read_text()
voxel_m, doublings = (
    float(re.search(rf"^ *{name}: (\S+)", settings, re.MULTILINE)[1])
    for name in ("voxel_m", "doublings")
)
largest_m = voxel_m * 2**doublings
sigmas = [one["sigma"].astype(float) for one in clouds]
worst_m = 2 * math.hypot(*(float(sigma.max()) for sigma in sigmas))
usual_m = 2 * math.hypot(*(float(np.percentile(sigma, 99)) for sigma in sigmas))
for n in (0, 1):
    mine, others = xyz[day == n], xyz[day == 1 - n]
    away_m, kinds = distances(mine, others, 2 * largest_m + worst_m), change[day == n]
    must(np.isfinite(away_m[kinds == SAME]).all(), f"day {n}: same, but nothing is near")
    must((away_m[kinds != SAME] > 2 * largest_m).all(), f"day {n}: the other day is near")
    # Of what the other run has exported, too, but for what its poses and the truth differ by.
    gone = mine[np.isin(kinds, (CAME, WENT))]
    away_m = distances(gone, exported[1 - n], 2 * largest_m)
    few = float(np.mean(away_m < 2 * largest_m - (0.0 if n else truth["pose_error_m"])))
    must(few <= 0.02, f"day {n}: {few:.0%} of what changed is near the cloud of the other run")

# From above.
described = (out / "changes.yaml").read_text()
cell_m = float(re.search(r"resolution: (\S+)", described)[1])
origin = [
    float(word) for word in re.search(r"origin:((\s*- \S+){3})", described)[1].split("- ")[1:]
]
occupied, free = (
    float(re.search(rf"{name}_thresh: (\S+)", described)[1]) for name in ("occupied", "free")
)
image = read_png(out / "changes.png")[::-1]
darkness = 1.0 - image[:, :, 0] / 255  # the rule of Nav2's map server in the mode scale
values = np.rint(100 * np.clip((darkness - free) / (occupied - free), 0.0, 1.0))
values[image[:, :, 3] == 0] = -1
expected = np.full(values.shape, -1.0)
# Points are not in changes.yaml: they are counted from the least of them.
low = np.floor(xyz[:, :2].min(axis=0).astype(np.float32) / np.float32(cell_m))
near(np.abs(low * cell_m - origin[:2]).max(), 0.0, 1e-5, "origin of the map from above")
i, j = (np.floor(cloud_xyz[:, :2] / np.float32(cell_m)) - low).astype(int).T
for kind, value in ((NOT_COMPARED, -1), (SAME, 0), (WENT, 50), (CAME, 100)):
    expected[j[change == kind], i[change == kind]] = value
must(np.array_equal(values, expected), "the map from above has other cells than the cloud")

# The objects, each with the points of its kind that hang together.
rows, objects = [*csv.DictReader((out / "changes.csv").open())], summary["objects"]
near(len(rows), len(objects), 0, "rows of the table")
for kind in KINDS:
    near(summary["changes"][kind], sum(one["change"] == kind for one in objects), 0, kind)
must([one["number"] for one in objects] == [*range(1, len(objects) + 1)], "numbers of objects")
counts = [one["points"] for one in objects]
must(counts == sorted(counts, reverse=True), "objects are not in the order of their points")
matched, pieces = set(), {}
for row, one in zip(rows, objects, strict=True):
    label = f"object {one['number']} ({one['change']})"
    for name, value in one.items():
        parts = {"": value}
        if isinstance(value, list):
            parts = dict(zip("xyz", value, strict=True))
        elif isinstance(value, dict):
            parts = value
        for part, x in parts.items():
            key = f"{name}_{part}" if part else name
            must(row[key] == ("" if x is None else str(x)), f"{label}: {key} in changes.csv")
    kind = KINDS[one["change"]]
    own = int(kind == CAME)
    points = xyz[(change == kind) & (day == own)]
    keys, at = cells_of(points, cell_m)
    _, chosen, home = np.unique(keys, return_index=True, return_inverse=True)
    home = home.ravel()
    middles = np.stack([np.bincount(home, axis) for axis in points.T], axis=1)
    middles /= np.bincount(home)[:, None] * cell_m
    away = np.linalg.norm(middles[:, None] - middles[None], axis=2) <= 2.5
    piece, left = np.full(len(middles), -1), {*range(len(middles))}
    while left:
        todo = [min(left)]
        name = todo[0]
        while todo:
            n = todo.pop()
            if n in left:
                left.discard(n)
                piece[n] = name
                todo += [m for m in np.flatnonzero(away[n]).tolist() if m in left]
    sizes = {name: int((piece[home] == name).sum()) for name in {*piece.tolist()}}
    fits = []
    for name in (name for name, size in sizes.items() if size == one["points"]):
        its = points[piece[home] == name]
        low, high = its.min(axis=0), its.max(axis=0)
        if abs(high[2] + low[2] - 2 * one["centre_m"][2]) < 1e-4:
            fits.append((name, its, int((piece == name).sum())))
    must(len(fits) == 1, f"{label}: {len(fits)} pieces of {one['points']} points at its height")
    pieces[one["number"]] = fits[0][1]
    name, its, cells = fits[0]
    must((kind, name) not in matched, f"{label}: another object has the same points")
    matched.add((kind, name))
    must(cells >= 10, f"{label}: {cells} voxels, and ten are the least")
    near(one["height_m"], float(np.ptp(its[:, 2])), 1e-4, f"{label}: height")
    area, (length, width) = smallest_rectangle(its[:, :2])
    near(one["length_m"] * one["width_m"], area, 1e-3 * max(1.0, area), f"{label}: area of its box")
    must(one["length_m"] >= one["width_m"], f"{label}: longer than wide")
    off = (its - one["centre_m"]) @ axes_of(one).T
    off = off[:, :2]
    beyond = np.abs(off).max(axis=0) - np.array([one["length_m"], one["width_m"]]) / 2
    must((beyond < 1e-3).all(), f"{label}: its points are {beyond.max():.3f} m out of its box")

    # The volume: columns between its highest points and the lowest of the other day.
    top, ground = {}, {}
    other = xyz[day == 1 - own]
    for heights, choose, which in ((top, max, its), (ground, min, other)):
        for (x, y, _), z in zip(
            cells_of(which, cell_m)[1].tolist(), which[:, 2].tolist(), strict=True
        ):
            place = x, y
            heights[place] = choose(heights.get(place, z), z)
    beside = [(1, 0), (-1, 0), (0, 1), (0, -1)]
    volume = border = squares = 0.0
    for place in top.keys() & ground.keys():
        whole = all((place[0] + x, place[1] + y) in top for x, y in beside)
        height = max(0.0, top[place] - ground[place])
        volume += height * (1.0 if whole else 0.5) * cell_m**2
        squares += 1.0 if whole else 0.25
        border += 0.0 if whole else height**2 / 12
    if not top.keys() & ground.keys():
        must(one["volume_m3"] is None, f"{label}: a volume without ground")
    else:
        near(one["volume_m3"], volume, 1e-3 * max(volume, 0.1), f"{label}: volume")
        rest = (one["volume_sigma_m3"] / cell_m**2) ** 2 - border
        must(rest >= -1e-6 * border, f"{label}: sigma of the volume is less than its border has")
        each_m = math.sqrt(max(0.0, rest) / squares)
        must(each_m <= worst_m, f"{label}: heights with {each_m:.2f} m; points have {worst_m:.2f}")

    # The frames that saw it first and last.
    times_s, poses = paths[own]
    first, last = one["first_seen"], one["last_seen"]
    must(first["frame"] <= last["frame"], f"{label}: seen last before it was seen first")
    for seen in (first, last):
        must(0 <= seen["frame"] < len(times_s), f"{label}: no frame {seen['frame']}")
        must(seen["drive"] == truth["names"][own], f"{label}: another drive, {seen['drive']}")
        near(seen["time_s"], times_s[seen["frame"]], 1e-6, f"{label}: time")
        stamp = datetime.fromtimestamp(seen["time_s"], timezone.utc)
        must(seen["date"] == stamp.strftime("%Y-%m-%dT%H:%M:%SZ"), f"{label}: date")
        T = T_first_map[own] @ T_map_world[own] @ poses[seen["frame"]]
        ahead = moved(np.linalg.inv(T), its)
        camera, (x, y, z) = truth["camera"], ahead[ahead[:, 2] > 0.1].T
        u = camera["focal_px"] * x / z + camera["cx_px"]
        v = camera["focal_px"] * y / z + camera["cy_px"]
        inside = (u > -1) & (u < camera["width_px"]) & (v > -1) & (v < camera["height_px"])
        must(inside.any(), f"{label}: frame {seen['frame']} does not see it")

    # The picture.
    if one["picture"] is not None:
        must((out / one["picture"]).read_bytes()[:2] == b"\xff\xd8", f"{label}: no picture")


# What there is in truth.
found = {
    number: (street.min(axis=0), street.max(axis=0))
    for number, street in ((n, moved(T_street_map[0], its)) for n, its in pieces.items())
}
hits = []
for box in truth["boxes"]:
    low, high = np.array(box["low_m"]), np.array(box["high_m"])
    here = [
        one
        for one in objects
        if one["change"] == box["change"]
        and (found[one["number"]][0] < high + OFF_M).all()
        and (found[one["number"]][1] > low - OFF_M).all()
    ]
    if box.get("must_be_found"):
        must(len(here) == 1, f"{box['change']} at {low.round(1)}: {len(here)} objects")
    for one in here:
        hits.append(one["number"])
        beyond = np.maximum(low - found[one["number"]][0], found[one["number"]][1] - high).max()
        must(beyond < OFF_M + usual_m, f"object {one['number']} is {beyond:.2f} m too large")
        size = float(np.prod(high - low))
        must(one["volume_m3"] is None or one["volume_m3"] - 2 * one["volume_sigma_m3"] <= size,
             f"object {one['number']} has more volume than its box")  # fmt: skip
for one in objects:
    must(one["number"] in hits, f"object {one['number']} ({one['change']}) is none in truth: {one}")
sys.stdout.write(f"checked {len(objects)} objects, {len(xyz)} points\n")
