"""Accuracy of occupancy: rendered streets, mapped with the defaults, against exact ground truth.

Streets differ only in their seed. ``worst`` has the lowest value of each figure and its target.
With ``--runs FOLDER`` the runs are kept, and ``recon evaluate occupancy`` gives the same figures
from their files.

Example: python benchmarks/occupancy.py --json
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured

from recon.commands.config import load_config
from recon.commands.demo import demo_source
from recon.commands.evaluate import run_evaluate_occupancy
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.summary import to_json

ASKED: Final = {
    "voxels.precision": 0.9,
    "voxels.recall": 0.9,
    "grid.iou_occupied": 0.8,
    "grid_exact.iou_free": 0.95,
}
SHOWN: Final = (
    *ASKED,
    "voxels_exact.precision",
    "voxels_exact.recall",
    "grid_exact.iou_occupied",
    "grid.occupied_called_free",
)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    with tempfile.TemporaryDirectory() as folder:
        runs = options.runs or Path(folder)
        streets = {seed: figures(seed, options, runs) for seed in options.seeds}
    worst = {
        name: {"measured": min(found[name] for found in streets.values()), "asked": least}
        for name, least in ASKED.items()
    }
    result = {"frames": options.frames, "set": options.set, "streets": streets, "worst": worst}
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3], help="streets")
    parser.add_argument("--frames", type=int, default=40, help="frames of each")
    parser.add_argument("--set", action="append", default=[], help="a setting, as recon takes it")
    parser.add_argument("--runs", type=Path, help="keep the runs in this folder")
    return parser.parse_args(arguments)


def figures(seed: int, options: argparse.Namespace, runs: Path) -> dict[str, Any]:
    """The figures of one street, from the files of its run."""
    street = [f"street.seed={seed}", f"street.frames={options.frames}"]
    config = load_config(None, [*street, *options.set])
    out = runs / f"seed_{seed}"
    run_map(
        demo_source(config), config, MapOptions(audit=False, command="demo", out=out, mesh=False)
    )
    found = to_json(run_evaluate_occupancy(out).metrics)
    flat = {
        f"{part}.{name}": value
        for part, values in found.items()
        if isinstance(values, dict)
        for name, value in values.items()
    }
    return {name: flat[name] for name in SHOWN}


def table(result: dict[str, Any]) -> str:
    lines = [f"{'':28s}" + "".join(f"{'seed ' + str(seed):>9s}" for seed in result["streets"])]
    for name in SHOWN:
        values = [found[name] for found in result["streets"].values()]
        asked = f"   asked {ASKED[name]:g}" if name in ASKED else ""
        lines.append(f"{name:28s}" + "".join(f"{value:9.3f}" for value in values) + asked)
    return "\n".join(lines)


if __name__ == "__main__":
    main()
