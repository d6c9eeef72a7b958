"""How much of a drift is the truth's, how much ours: the paths of several programs compared.

Our path as `recon map` finds it (rig refined), the true one and those of other programs differ
pairwise; where their errors are independent, that tells the error of each (`corners.py`, which says
what the truth's includes: all that the programs share, such as the calibration). By length of
segment, one from each frame on, and for the segments of `t_rel` as the evaluator chooses them;
translation along, across and up at the segment's start, and rotation apart. Root mean squares, so
a little more than `t_rel`, which is a mean. Intervals (95 %) by resampling blocks of the path.

Paths of other programs are poses (KITTI) of the left camera as the rig was given, one for each
frame, in FOLDER/PROGRAM/DRIVE/ROW.txt; rows are those of `altered_drives.py`, which writes the
drives (`--write`). How those in `benchmarks/peers` were made: `benchmarks/peers/README.md`.

Example: python benchmarks/three_paths.py $RECON_DATA/driven/kitti_06_51 --only "as it is"
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from altered_drives import Altered, alterations, file_name, follow, path_of, true_path
from corners import COMPONENTS, LEAST_INDEPENDENT, Split, differences, independent, split

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import ReconError
from recon.core.values import Trajectory
from recon.evaluation.trajectory import Segments, choose_segments, segments_of
from recon.io.trajectory import read_kitti_poses
from recon.look.look import refine_rig
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source

PEERS: Final = Path(__file__).parent / "peers"
NAMES: Final = {"orbslam3": "ORB-SLAM3", "colmap": "COLMAP"}
LENGTHS_M: Final = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 400.0, 800.0)
Found = dict[str, Any]


@dataclass(frozen=True)
class Row:
    """A drive or an alteration of it, with the paths of other programs in the axes of its rig."""

    altered: Altered
    peers: Mapping[str, Trajectory]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    try:
        config = load_config(None, options.set)
        rows = rows_of(options.drive, options.peers, options.only)
        found = {name: compared(paths_of(row, config)) for name, row in rows.items()}
    except ReconError as error:
        raise SystemExit(f"three_paths: {error}") from error
    lines = (line for name, one in found.items() for line in text(options.drive.name, name, one))
    print(json.dumps(found, indent=2) if options.json else "\n".join(lines))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path, help="rectified drive with true poses")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument("--only", nargs="+", help="names of alterations; all with poses of peers")
    parser.add_argument("--peers", type=Path, default=PEERS, help="PROGRAM/DRIVE/ROW.txt in there")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon map")
    return parser.parse_args(arguments)


def rows_of(drive: Path, folder: Path, only: Sequence[str] | None) -> dict[str, Row]:
    """The rows to compare; without ``only`` those of which poses of a peer are there.

    Raises:
        SystemExit: A row is not known or has no path of a peer, or there are none at all.
    """
    cases = alterations(open_source(drive))
    unknown = [name for name in only or () if name not in cases]
    if unknown:
        raise SystemExit(f"three_paths: no row {unknown[0]!r}; there are {', '.join(cases)}")
    rows = {
        name: Row(cases[name], peers_of(folder, drive, name, cases[name])) for name in only or cases
    }
    lacking = [name for name, row in rows.items() if not row.peers]
    if lacking and (only or len(lacking) == len(rows)):
        where = folder / "PROGRAM" / drive.name / f"{file_name(lacking[0])}.txt"
        raise SystemExit(f"three_paths: no poses of another program: expected {where}")
    if lacking:
        print(f"no poses of another program: {', '.join(lacking)}", file=sys.stderr, flush=True)
    return {name: row for name, row in rows.items() if row.peers}


def peers_of(folder: Path, drive: Path, name: str, altered: Altered) -> dict[str, Trajectory]:
    """The paths of other programs by name, those that are known first."""
    files = {
        program: folder / program / drive.name / f"{file_name(name)}.txt"
        for program in [*NAMES, *sorted({path.name for path in folder.glob("*/")} - NAMES.keys())]
    }
    stamps_s = true_path(altered).timestamps_s
    return {
        NAMES.get(program, program): read_kitti_poses(file, stamps_s)
        for program, file in files.items()
        if file.is_file()
    }


def paths_of(row: Row, config: ReconConfig) -> dict[str, Trajectory]:
    """Truth, ours and others, all in the axes of the refined rig; the truth is the first."""
    print(f"follow {len(row.altered)} frames", file=sys.stderr, flush=True)
    rig = refine_rig(row.altered, config, config.rig)
    odometry = make_odometry("visual", config.odometry)
    found = follow(row.altered, {"ours": odometry}, rig, config)["ours"]
    given = {"truth": true_path(row.altered), **row.peers}
    paths = {name: rig.poses(path, config.rectification) for name, path in given.items()}
    return {"truth": paths.pop("truth"), "ours": path_of(found, row.altered), **paths}


def compared(paths: Mapping[str, Trajectory]) -> Found:
    """The errors of each path, by length of segment (metres) and for the segments of ``t_rel``."""
    truth = next(iter(paths.values()))
    lengths = {f"{m:g}": segments_of(truth.distances_m, (m,), 1) for m in LENGTHS_M}
    lengths = {m: segments for m, segments in lengths.items() if len(segments.first)}
    return {
        "paths": list(paths),
        "frames": len(truth),
        "path_length_m": round(truth.path_length_m, 1),
        **{m: errors(paths, segments) for m, segments in lengths.items()},
        "t_rel": errors(paths, choose_segments(truth.distances_m)),
    }


def errors(paths: Mapping[str, Trajectory], segments: Segments) -> Found:
    """Errors of the paths by component, of all and by truth, ours and one other; differences."""
    names, path_m = list(paths), next(iter(paths.values())).path_length_m
    off = differences(list(paths.values()), segments)
    found: Found = {
        "segments": len(segments.first),
        "independent": independent(segments, path_m),
    }
    for key, columns in COMPONENTS.items():
        found[key] = shown(names, split(off[:, :, columns], segments, path_m))
        found[key]["by_three"] = {
            names[peer]: shown(
                [*names[:2], names[peer]], split(off[[0, 1, peer]][:, :, columns], segments, path_m)
            )["errors"]
            for peer in range(2, len(names))
        }
    return found


def shown(names: Sequence[str], found: Split) -> Found:
    """Roots of the mean squares; an error that is not resolved is None, and its square stays."""
    return {
        "errors": {
            name: {**rooted(square), "mean_square": round(float(square[0]), 6)}
            for name, square in zip(names, found.squares, strict=True)
        },
        "differences": {
            f"{names[a]}, {names[b]}": rooted(square)
            for (a, b), square in zip(found.pairs, found.between, strict=True)
        },
        "not_independent": [f"{names[a]}, {names[b]}" for a, b in found.shared()],
    }


def rooted(square: Any) -> Found:
    """The root of a mean square and of its interval, which begins at zero at the least."""
    estimate, low, high = (float(value) for value in square)
    known = not np.isnan(low) and high > 0.0
    ends = [round(float(np.sqrt(max(0.0, end))), 4) for end in (low, high)] if known else None
    return {
        "error": round(float(np.sqrt(estimate)), 4) if estimate > 0.0 else None,
        "interval": ends,
    }


def text(drive: str, name: str, found: Found) -> Iterator[str]:
    """A row as a table."""
    yield f"{drive}, {name}: {found['frames']} frames, {found['path_length_m']} m"
    yield "errors if independent, rms, % of length and deg/100 m (95 %)"
    yield f"{'':14s}" + "".join(f"{path:>22s}" for path in found["paths"])
    for length in [key for key, one in found.items() if isinstance(one, dict)]:
        one = found[length]
        few = "" if one["independent"] >= LEAST_INDEPENDENT else ": too few for intervals"
        what = length if length == "t_rel" else f"{length} m"
        yield f"{what}: {one['segments']} segments, {one['independent']} side by side{few}"
        for key in COMPONENTS:
            yield f"  {key:12s}" + "".join(f"{cell(e):>22s}" for e in one[key]["errors"].values())
            for pair in one[key]["not_independent"]:
                yield f"    {pair}: not independent, what they share counts as the truth's"
        three = one["translation"]["by_three"] if len(found["paths"]) > 3 else {}
        for peer, each in three.items():
            yield f"  by {peer} alone: truth {cell(each['truth'])}, ours {cell(each['ours'])}"
        apart = one["translation"]["differences"]
        yield "  apart: " + "; ".join(f"{pair} {cell(each)}" for pair, each in apart.items())


def cell(one: Found) -> str:
    """An error and its interval; one that is not resolved is below the end of the interval."""
    ends, error = one["interval"], one["error"]
    if error is None:
        return "not resolved" if ends is None else f"< {ends[1]:.2f}, not resolved"
    return f"{error:.3f}" if ends is None else f"{error:.3f} ({ends[0]:.2f}–{ends[1]:.2f})"


if __name__ == "__main__":
    main()
