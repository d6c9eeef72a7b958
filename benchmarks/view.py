"""How soon a map is seen in the browser, and what a drive loses by being seen while it is mapped.

The drive is mapped without ``--view``, with it while nobody looks, and while somebody does, by
turns: ``unseen`` and ``seen`` are medians of the ratios of frames a second to those without. Who
looks takes all that the page would and draws nothing, as a browser here would draw without a
graphics card. Then `recon view` shows the last run: ``first picture`` is the time from its start
until headless Chromium, open before, has received the first points.

Example: python benchmarks/view.py DRIVE --json
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

import checkout  # noqa: F401 - what is measured
import msgspec
import viser
from viser._messages import ViewerCameraMessage
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

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
        ratios = [kept(given.drive, Path(folder), number) for number in range(ROUNDS)]
        run = Path(folder) / "seen"
        pictures = [first_picture_s(run, Path(folder) / f"{number}") for number in range(ROUNDS)]
        points = len(read_ply(run / "map/cloud.ply"))
    found = {
        **{way: statistics.median(one[way] for one in ratios) for way in ratios[0]},
        "first picture": statistics.median(pictures),
        "points": points,
    }
    print(json.dumps(found) if given.json else f"{found} of {ratios}, {pictures}")


def kept(drive: Path, folder: Path, number: int) -> dict[str, float]:
    """Frames a second with ``--view``, over those without."""
    ways = {"alone": [], "unseen": ["--view"], "seen": ["--view"]}
    fps = {}
    for way in sorted(ways, reverse=bool(number % 2)):
        out = folder / way
        words = [*RECON, "map", str(drive), "--no-mesh", "--out", str(out), "--json", *ways[way]]
        pipe = subprocess.PIPE
        with subprocess.Popen([*words, "--quiet"], stdout=pipe, stderr=pipe, text=True) as mapping:
            if way == "seen":
                look(str(mapping.stderr and mapping.stderr.readline()).split()[0])
            fps[way] = float(json.loads(mapping.communicate()[0])["fps"])
    return {way: fps[way] / fps["alone"] for way in ("unseen", "seen")}


def look(url: str) -> None:
    """Take what a page shows until it ends; it begins when a camera looks at the scene."""
    turn, eye_m, ahead_m, up = (1.0, 0.0, 0.0, 0.0), (-9.0, 0.0, 9.0), (0.0,) * 3, (0.0, 0.0, 1.0)
    camera = ViewerCameraMessage(turn, eye_m, 1.0, 0.1, 1e3, 900, 1600, ahead_m, up)
    protocols = [Subprotocol(f"viser-v{viser.__version__}")]
    address, origin = url.replace("http", "ws", 1), Origin(url.rpartition("/")[0])
    with (
        connect(address, origin=origin, subprotocols=protocols, max_size=None) as page,
        suppress(ConnectionClosed),
    ):
        page.send(msgspec.msgpack.encode(camera.as_serializable_dict()))
        while True:
            page.recv()


def first_picture_s(run: Path, profile: Path) -> float:
    least = POINT_BYTES * min(FIRST_POINTS // 2, len(read_ply(run / "map/cloud.ply")))
    with chromium.opened(profile) as page:
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
