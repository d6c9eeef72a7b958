"""How soon a map is seen in the browser, and what a drive loses by being seen while it is mapped.

The drive is mapped with and without ``--view``, by turns; nobody looks, as a browser here would
draw without a graphics card. ``mapping`` is the median of the ratios of frames a second. Then
`recon view` shows the last run: ``first picture`` is the time from its start until headless
Chromium, open before, has received the first points.

Example: python benchmarks/view.py DRIVE --json
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import checkout  # noqa: F401 - what is measured

from recon.io.models.ply import read_ply
from recon.view.server import FIRST_POINTS
from tests.scenery import chromium

ROUNDS: Final = 3
POINT_BYTES: Final = 15  # three float32, three uint8
RECON: Final = (sys.executable, "-m", "recon")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("drive", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ratios = [lost(given.drive, Path(folder), number) for number in range(ROUNDS)]
        run = Path(folder) / "seen"
        pictures = [first_picture_s(run, Path(folder) / f"{number}") for number in range(ROUNDS)]
        points = len(read_ply(run / "map/cloud.ply"))
    found = {
        "mapping": statistics.median(ratios),
        "first picture": statistics.median(pictures),
        "points": points,
    }
    print(json.dumps(found) if given.json else f"{found} of {ratios}, {pictures}")


def lost(drive: Path, folder: Path, number: int) -> float:
    """Frames a second with a viewer over those without."""
    ways = {"seen": ["--view"], "unseen": []}
    fps = {}
    for way in sorted(ways, reverse=bool(number % 2)):
        out = folder / way
        words = [*RECON, "map", str(drive), "--no-mesh", "--out", str(out), "--json", *ways[way]]
        summary = subprocess.run([*words, "--quiet"], check=True, capture_output=True).stdout
        fps[way] = float(json.loads(summary)["fps"])
    return fps["seen"] / fps["unseen"]


def first_picture_s(run: Path, profile: Path) -> float:
    found = map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))
    program = next(filter(None, found), None)
    if program is None:
        raise LookupError("Chromium is not installed")
    least = POINT_BYTES * min(FIRST_POINTS // 2, len(read_ply(run / "map/cloud.ply")))
    with chromium.opened(program, profile) as page:
        start = time.monotonic()
        words = [*RECON, "view", str(run), "--port", "0"]
        with subprocess.Popen(words, stderr=subprocess.PIPE, text=True) as viewer:
            try:
                page.open(str(viewer.stderr and viewer.stderr.readline()).split()[0])
                page.wait(60.0, least)
                return time.monotonic() - start
            finally:
                viewer.kill()


if __name__ == "__main__":
    main()
