"""How near to the truth the products of a survey are, by positions as receivers write them.

The drive is mapped once. Its true positions are put into a zone of UTM and written as NMEA, as OXTS
and as NavSatFix of a bag, as they are and with faults; `recon export --to dsm --georeference`
places the map by them. ``held``: the path was bent to run through them first, by `recon merge`.
Its surface model is compared with the highest point of the reference in each cell: ``height`` is
the median of the differences, ``absolute`` that of their absolute values, ``moved`` the shift by
whole cells with which it fits best: by what stands on the ground, as a road fits everywhere.

Example: python benchmarks/survey.py DRIVE lidar_map.ply poses.txt --json
"""

from __future__ import annotations

import argparse
import json
import tempfile
from itertools import product
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
import rasterio

from recon.commands.config import load_config
from recon.commands.export import run_export
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.commands.merge import run_merge
from recon.core.errors import ReconError
from recon.core.geometry.se3 import apply, exp_so3, make_transform
from recon.core.values.arrays import Float64
from recon.io.models.ply import read_ply
from recon.io.trajectory import read_kitti_poses, read_tum
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.sessions.measured import Survey
from recon.sources.registry import open_source
from tests.scenery.receivers import GEOID_M, degrees_of, write_nmea, write_oxts
from tests.sources.bags import Recording, recorder

CRS: Final = "EPSG:25832"
PLACE_M: Final = np.array([455_800.0, 5_429_300.0, 115.0])
TURN_RAD: Final = 0.7
REACH_CELLS: Final = 5
STANDS_M: Final = 1.0
KINDS: Final = ("NMEA", "OXTS", "NavSatFix")
FAULTS: Final = ("held", "jumps", "late", "swapped")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("reference", type=Path, help="cloud in the axes of the poses, PLY")
    parser.add_argument("poses", type=Path, help="true poses of the left camera")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(given.drive, given.reference, given.poses, Path(folder))
    if given.json:
        print(json.dumps(found))
        return
    for name, figures in found.items():
        print(f"{name:20}", figures)


def measure(drive: Path, reference: Path, poses: Path, folder: Path) -> dict[str, dict[str, Any]]:
    run = folder / "run"
    run_map(open_source(drive), load_config(None), MapOptions(out=run, mesh=False, audit=False))
    T_survey_true = make_transform(exp_so3(np.array([0.0, 0.0, TURN_RAD])), PLACE_M)
    T_survey_true = T_survey_true @ make_transform(AXES_MAP_WORLD, np.zeros(3))
    times_s = read_tum(run / "trajectory_tum.txt").timestamps_s
    places = apply(T_survey_true, read_kitti_poses(poses).positions_m)
    true = apply(T_survey_true, read_ply(reference).xyz.astype(np.float64))
    found = {}
    for kind, fault in [*((kind, "") for kind in KINDS), *(("NMEA", fault) for fault in FAULTS)]:
        file = written(kind, fault, times_s, places, folder / f"{kind}{fault}")
        name, survey = f"{kind}, {fault}" if fault else kind, Survey(file, crs=CRS)
        source, out = run, folder / f"out {name}"
        if fault == "held":
            source = folder / "held"
            run_merge([run], options=MapOptions("merge", source, mesh=False), survey=survey)
        try:
            told = run_export(source, products=("dsm",), out=out, survey=survey).to_json()
        except ReconError as error:
            found[name] = {"said": error.what}
            continue
        figures = {"left out": told["positions_left_out"], "misfit": told["misfit_rms_m"]}
        said = "; ".join(line for line in told["warnings"] if "position" in line)
        found[name] = {
            **compared(out / "map/dsm.tif", true), **figures, "said": said
        }  # fmt: skip
    return found


def written(kind: str, fault: str, times_s: Float64, places: Float64, path: Path) -> Path:
    random, places, times_s = np.random.default_rng(4), places.copy(), times_s.copy()
    if fault == "jumps":
        jumped = random.choice(len(places), len(places) // 10, replace=False)
        angle = random.uniform(0.0, 2 * np.pi, len(jumped))
        places[jumped, :2] += 5.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    if fault == "late":
        times_s += 0.5
    degrees = degrees_of(places, CRS)
    if fault == "swapped":
        degrees = degrees[:, [1, 0, 2]]
    if kind == "OXTS":
        write_oxts(path, times_s, degrees)
    elif kind == "NMEA":
        write_nmea(path, times_s, degrees + np.array([0.0, 0.0, GEOID_M]))
    else:
        with recorder(path, Recording("mcap")) as bag:
            for time_s, place in zip(times_s, degrees, strict=True):
                time_ns = round(1e9 * time_s)
                bag.write("/fix", time_ns, bag.fix(time_ns, place, (0.02, 0.02, 0.03)))
        return Path(Recording("mcap").path(path))
    return path


def compared(dsm: Path, true: Float64) -> dict[str, Any]:
    with rasterio.open(dsm) as file:
        ours, to_cell, cell_m = file.read(1), ~file.transform, file.res[0]
        ours[file.read(2) != 1] = np.nan  # the ground, where no point is
    column, row = (np.floor(each).astype(int) for each in to_cell @ (true[:, 0], true[:, 1]))
    inside = (column >= 0) & (row >= 0) & (column < ours.shape[1]) & (row < ours.shape[0])
    theirs = np.full(ours.shape, -np.inf)
    np.maximum.at(theirs, (row[inside], column[inside]), true[inside, 2])
    theirs[np.isinf(theirs)] = np.nan
    off = ours - theirs
    shifts = [*product(range(-REACH_CELLS, REACH_CELLS + 1), repeat=2)]
    stands = theirs > np.nanmedian(theirs) + STANDS_M
    spread = [
        np.nanmean(np.minimum(np.abs(np.roll(ours, shift, (0, 1)) - theirs)[stands], STANDS_M))
        for shift in shifts
    ]
    best = np.array(shifts[int(np.argmin(spread))])
    return {
        "height": float(np.nanmedian(off)),
        "absolute": float(np.nanmedian(np.abs(off))),
        "moved": float(np.linalg.norm(best) * cell_m),
    }


if __name__ == "__main__":
    main()
