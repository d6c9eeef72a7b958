"""Whether a long drive costs more by the frame than a short one: time, memory and map file.

A block of a town is driven around, lap after lap, so that all that is seen was seen before. A lap
has small pictures, which are rendered once; the drive is mapped in a process of its own. Processor
time of a frame is that of the whole process between two frames, of the first lap but its beginning
and of the last tenth: in the first tenth nothing has been seen before, and it is stated, too.

Examples:
    python benchmarks/length.py 2000 --json
    python benchmarks/length.py 8000 --folder /tmp/town
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import speed
from memory import repeat
from results import ROOT

from recon.io.atomic import write_text
from recon.map.map import Map
from recon.map.store.map_file import MAP_FILE
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import CORNER_M, StreetScene
from tests.scenery.kitti import write_kitti

STEP_M: Final = 0.7
MIN_FRAMES: Final = 20  # of which a tenth has a time between two
LAP: Final = 400  # frames, unless the drive is shorter
ASPECT: Final = 3 / 8
ROUND: Final = 1.5  # length of the block, over its width


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    kept = options.folder and nullcontext(str(options.folder))
    with kept or tempfile.TemporaryDirectory() as folder:
        lap, drive = (Path(folder).resolve() / name for name in ("lap", "drive"))
        if not lap.is_dir():
            write_kitti(SyntheticSource(town(options.lap, options.width)), lap)
        go_around(lap, drive, options.frames)
        result = measured(drive, Path(folder) / "run", options.lap, options.set)
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("frames", type=int, nargs="?", default=2000)
    parser.add_argument("--width", type=int, default=320, help="of the pictures, pixels")
    parser.add_argument("--lap", type=int, default=LAP, help="frames of a lap, 0.7 m apart")
    parser.add_argument("--folder", type=Path, help="where the lap is, or is to be kept")
    parser.add_argument("--set", action="append", default=[], help="a setting of recon map")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args(arguments)
    if min(options.frames, options.lap) < MIN_FRAMES:
        parser.error(f"a drive, and a lap, have {MIN_FRAMES} frames or more")
    return options


def town(frames: int, width_px: int) -> StreetScene:
    """One lap around a block, at the end of which the car is where it began."""
    lap_m = STEP_M * frames
    # A corner is shorter than its two sides.
    width_m = (lap_m + (8 - 2 * math.pi) * CORNER_M) / 2 / (1 + ROUND)
    height_px = round(ASPECT * width_px)
    picture = {"width_px": width_px, "height_px": height_px, "focal_px": 0.57 * width_px}
    street = {"path": "block", "block_m": (ROUND * width_m, width_m), "sway": 0.0}
    how = {"frames": frames, "speed_m_per_frame": STEP_M, "smooth_edges": False}
    return StreetScene.model_validate({**picture, **street, **how})


def go_around(lap: Path, drive: Path, frames: int) -> None:
    """Make a drive of the pictures and poses of a lap, again and again."""
    repeat(lap, drive, frames)
    poses = (lap / "poses.txt").read_text().splitlines()
    lines = (poses[index % len(poses)] for index in range(frames))
    write_text(drive / "poses.txt", "\n".join(lines) + "\n")


def measured(drive: Path, out: Path, lap: int, settings: Sequence[str]) -> dict[str, Any]:
    """Map a drive; what a frame costs at its beginning and its end, and what the map is."""
    options = [part for text in settings for part in ("--set", text)]
    frames, summary = speed.watched(ROOT, drive, out, "--no-mesh", *options)
    tenth = max(1, len(frames) // 10)
    parts = frames[: tenth + 1], frames[lap : lap + tenth + 1] or frames, frames[-tenth - 1 :]
    first, second, last = map(per_frame, parts)
    with Map.open(out) as map_:
        closed = map_.first.loops.get("closed", ())
        spans = [abs(loop["last"] - loop["first"]) for loop in closed]
    map_mb = (out / MAP_FILE).stat().st_size / 1e6
    return {
        "frames": len(frames),
        "path_m": round(summary["path_length_m"], 1),
        "first_tenth_processor_ms": round(1e3 * first, 1),
        "second_lap_processor_ms": round(1e3 * second, 1),
        "last_tenth_processor_ms": round(1e3 * last, 1),
        "last / first": round(last / first, 3),
        "last / second lap": round(last / second, 3),
        "peak_memory_mb": summary["peak_memory_mb"],
        "map_mb_per_km": round(1e3 * map_mb / summary["path_length_m"], 1),
        "loops_closed": len(closed),
        "farthest_loop_frames": max(spans, default=0),
        "ate_m": round(summary["trajectory"]["ate_m"], 3),
        "t_rel_percent": summary["trajectory"]["t_rel_percent"],
        "seconds": summary["seconds"],
    }


def per_frame(costs: Sequence[speed.Cost]) -> float:
    """Processor seconds from one frame to the next, in the mean."""
    return (costs[-1].processor_s - costs[0].processor_s) / max(len(costs) - 1, 1)


def table(result: dict[str, Any]) -> str:
    return "\n".join(f"{name:28}{value}" for name, value in result.items())


if __name__ == "__main__":
    main()
