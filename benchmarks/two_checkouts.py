"""This checkout beside another: a mapped drive, the start of the program, the size of the code.

Both map the drive in turn, each in a process of its own, so that other load affects both alike;
figures are medians over the rounds. Ratios are this checkout's over the other's.

Example: python benchmarks/two_checkouts.py --other ../earlier --drive DRIVE --rounds 3
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parents[1]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    checkouts = {"this": HERE, "other": options.other.resolve()}
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in checkouts}
    for number in range(options.rounds):
        # The one that goes first changes, as whatever it warms up serves the second.
        for name in sorted(checkouts, reverse=bool(number % 2)):
            rounds[name].append(run(checkouts[name], options.drive))
    figures = {
        name: {key: statistics.median(r[key] for r in found) for key in found[0]}
        | house(checkouts[name])
        for name, found in rounds.items()
    }
    if options.json:
        print(json.dumps(figures, indent=2))
        return
    print(f"{'':24}{'this':>12}{'other':>12}{'ratio':>8}")
    for key, value in figures["this"].items():
        other = figures["other"][key]
        print(f"{key:24}{value:12.4g}{other:12.4g}{value / other if other else float('nan'):8.3f}")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--other", type=Path, required=True, help="the other checkout")
    parser.add_argument("--drive", type=Path, required=True, help="what `recon map` maps")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    return parser.parse_args(arguments)


def run(checkout: Path, drive: Path) -> dict[str, float]:
    """Map the drive once with the code of a checkout."""
    program = [sys.executable, "-m", "recon"]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        start = time.perf_counter()
        map_drive = [*program, "map", str(drive.resolve()), "--out", str(out), "--quiet"]
        processor_s = call(map_drive, checkout)
        seconds = time.perf_counter() - start
        summary = json.loads((out / "summary.json").read_text())
        size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
        config_lines = len((out / "config.yaml").read_text().splitlines())
    return {
        "fps": float(summary["fps"]),
        "seconds": seconds,
        "processor_s": processor_s,
        "peak_memory_mb": float(summary["peak_memory_mb"]),
        "run_folder_mb": size / 1e6,
        "config_lines": config_lines,
        "help_processor_s": call([*program, "--help"], checkout),
        **first_frame(drive, checkout),
    }


def first_frame(drive: Path, checkout: Path) -> dict[str, float]:
    """Seconds, and those of a processor, until a drive has its first frame mapped."""
    with tempfile.TemporaryDirectory() as folder:
        map_drive = [sys.executable, "-m", "recon", "map", str(drive.resolve())]
        environment = {**os.environ, "PYTHONPATH": str(checkout)}
        start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        with subprocess.Popen(
            [*map_drive, "--out", str(Path(folder) / "run"), "--json", "--verbose"],
            cwd=checkout,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ) as process:
            for line in process.stdout or ():
                if line.startswith(b'{"event": "frame"'):
                    break
            seconds = time.perf_counter() - start
            process.kill()
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"first_frame_s": seconds, "first_frame_processor_s": used_s}


def call(command: Sequence[str], checkout: Path) -> float:
    """Run a command with the code of a checkout; the processor time that it took."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, cwd=checkout, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def house(checkout: Path) -> dict[str, Any]:
    """The size of the code of a checkout."""
    files = sorted((checkout / "recon").rglob("*.py"))
    trees = [ast.parse(path.read_text()) for path in files]
    classes = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    folders = [path.parent for path in files]
    listed = subprocess.run(
        [sys.executable, "-m", "recon", "settings", "--json"],
        cwd=checkout,
        env={**os.environ, "PYTHONPATH": str(checkout)},
        check=True,
        capture_output=True,
        text=True,
    )
    return {
        "lines": sum(len(path.read_text().splitlines()) for path in files),
        "files": len(files),
        "rooms": len(list((checkout / "recon").glob("*/__init__.py"))),
        "largest_folder_files": max(folders.count(folder) for folder in set(folders)),
        "classes": len(classes),
        "dataclasses": sum(
            "dataclass" in ast.unparse(decorator) for c in classes for decorator in c.decorator_list
        ),
        "settings": sum(len(group["settings"]) for group in json.loads(listed.stdout)["groups"]),
    }


if __name__ == "__main__":
    main()
