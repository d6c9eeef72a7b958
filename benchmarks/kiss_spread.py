"""How much the drift of kiss-icp depends on what should not matter: its range, by half a metre.

The rig is refined first, as `recon map` does it. A frame is matched once, and its points go to
several odometries that differ in nothing but their range. A last bit of a point or the
order of the points changes the path as much: a single figure of kiss-icp is one draw, so the
median and the range are given.

Example: python benchmarks/kiss_spread.py DRIVE --json
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import checkout  # noqa: F401 - what is measured
from altered_drives import alterations, run

from recon.commands.config import load_config
from recon.look.look import refine_rig
from recon.odometry.checked import CheckedOdometry
from recon.odometry.kiss import KissOdometry
from recon.odometry.visual import VisualOdometry
from recon.sources.registry import open_source

RANGES_M = tuple(29.5 + 0.1 * step for step in range(11))
"""Around `recon.odometry.kiss.RANGE_M`."""


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    odometries = {
        f"{range_m:g}": CheckedOdometry(KissOdometry(range_m, VisualOdometry(None)), 1.0)
        for range_m in options.ranges
    }
    drive, config = alterations(open_source(options.drive))["as it is"], load_config(None, [])
    rig = refine_rig(drive, config, config.rig)
    found = run(drive, odometries, rig)
    result = {"spread": spread(list(found.values())), "ranges_m": found}
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path, help="rectified drive with true poses")
    parser.add_argument("--ranges", type=float, nargs="+", default=RANGES_M, help="metres")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


def spread(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Median, least and largest of each figure."""
    columns = {name: [float(row[name]) for row in rows] for name in rows[0]}
    return {
        name: {"median": statistics.median(values), "least": min(values), "most": max(values)}
        for name, values in columns.items()
    }


def table(result: dict[str, Any]) -> str:
    lines = [
        f"{key:>8s} m: {row['t_rel_percent']:.3f} %" for key, row in result["ranges_m"].items()
    ]
    lines += [f"{key}: {values}" for key, values in result["spread"].items()]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
