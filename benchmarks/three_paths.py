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
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from altered_drives import Altered, alterations, file_name, follow, path_of, true_path
from corners import COMPONENTS, LEAST_INDEPENDENT, Split, differences, independent, split
from result_drift_rows import cell_of

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import EvaluationError, ReconError
from recon.core.text import metres
from recon.core.values import Trajectory
from recon.evaluation.trajectory import MIN_PATH_M, Segments, choose_segments, segments_of
from recon.io.trajectory import read_kitti_poses
from recon.look.look import refine_rig
from recon.odometry.registry import make_odometry
from recon.sources.registry import open_source

PEERS: Final = Path(__file__).parent / "peers"
NAMES: Final = {"orbslam3": "ORB-SLAM3", "colmap": "COLMAP"}
LENGTHS_M: Final = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 400.0, 800.0)
Found = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    try:
        config, cases = load_config(None, options.set), alterations(open_source(options.drive))
        peers = peers_of(cases, options)
        found = {name: compared(paths_of(cases[name], peers[name], config)) for name in peers}
    except ReconError as error:
        raise SystemExit(f"three_paths: {error}") from error
    lines = (
        line
        for name, one in found.items()
        for line in text(options.drive.resolve().name, name, one)
    )
    print(json.dumps(found, indent=2) if options.json else "\n".join(lines))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path, help="rectified drive with true poses")
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")
    parser.add_argument("--only", nargs="+", help="names of alterations; all with poses of peers")
    parser.add_argument("--peers", type=Path, default=PEERS, help="PROGRAM/DRIVE/ROW.txt in there")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon map")
    return parser.parse_args(arguments)


def peers_of(
    cases: Mapping[str, Altered], options: argparse.Namespace
) -> dict[str, dict[str, Trajectory]]:
    """Paths of other programs by row; without ``--only`` of those rows that have one.

    Raises:
        SystemExit: A row is not known or has no path of a peer, or there are none at all.
    """
    chosen, drive = options.only or list(cases), options.drive.resolve().name
    unknown = [name for name in chosen if name not in cases]
    if unknown:
        raise SystemExit(f"three_paths: no row {unknown[0]!r}; there are {', '.join(cases)}")
    found = {name: read_peers(options.peers, f"{drive}/{file_name(name)}.txt", cases[name])
             for name in chosen}  # fmt: skip
    lacking = [name for name in chosen if not found[name]]
    if lacking and (options.only or lacking == chosen):
        where = options.peers / "PROGRAM" / drive / f"{file_name(lacking[0])}.txt"
        raise SystemExit(f"three_paths: no poses of another program: expected {where}")
    if lacking:
        print(f"no poses of another program: {', '.join(lacking)}", file=sys.stderr, flush=True)
    return {name: peers for name, peers in found.items() if peers}


def read_peers(folder: Path, file: str, altered: Altered) -> dict[str, Trajectory]:
    """The paths of other programs by name, those that are known first."""
    others = sorted({path.name for path in folder.glob("*/")} - NAMES.keys())
    return {
        NAMES.get(program, program): read_kitti_poses(path, true_path(altered).timestamps_s)
        for program in [*NAMES, *others]
        if (path := folder / program / file).is_file()
    }


def paths_of(
    altered: Altered, peers: Mapping[str, Trajectory], config: ReconConfig
) -> dict[str, Trajectory]:
    """Truth, ours and others (given in the axes of the rig as given), in the refined rig's axes."""
    print(f"follow {len(altered)} frames", file=sys.stderr, flush=True)
    rig = refine_rig(altered, config, config.rig)
    odometry = make_odometry("visual", config.odometry)
    ours = path_of(follow(altered, {"ours": odometry}, rig, config)["ours"], altered)
    truth, *others = (
        rig.poses(path, config.rectification) for path in (true_path(altered), *peers.values())
    )
    return {"truth": truth, "ours": ours, **dict(zip(peers, others, strict=True))}


def compared(paths: Mapping[str, Trajectory]) -> Found:
    """The errors of each path, by length of segment (metres) and for the segments of ``t_rel``."""
    truth = next(iter(paths.values()))
    if truth.path_length_m < MIN_PATH_M:
        raise EvaluationError("true path is too short", got=metres(truth.path_length_m))
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
            yield f"  {key:12s}" + "".join(
                f"{cell_of(e):>22s}" for e in one[key]["errors"].values()
            )
            for pair in one[key]["not_independent"]:
                yield f"    {pair}: share errors, so that the split is not theirs"
        three = one["translation"]["by_three"] if len(found["paths"]) > 3 else {}
        for peer, each in three.items():
            yield f"  by {peer} alone: truth {cell_of(each['truth'])}, ours {cell_of(each['ours'])}"
        apart = one["translation"]["differences"]
        yield "  apart: " + "; ".join(f"{pair} {cell_of(each)}" for pair, each in apart.items())


if __name__ == "__main__":
    main()
