"""`fine` of this checkout beside that of another: seconds by turns, and how much is right.

Each checkout has a process of its own, and they match the same pair in turn, so that other load
affects both alike; figures are medians over the rounds, ratios this checkout's over the other's.
With a truth (PFM), bad 2 is the percentage of its pixels whose disparity is off by more than 2 px,
or that have none.

Example: python benchmarks/fine.py ../earlier left.png right.png --ndisp 128 --rounds 5
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

HERE = Path(__file__).resolve().parents[1]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    if options.serve:
        serve(options)
        return
    checkouts = {"this": HERE, "other": options.other.resolve()}
    workers = {name: start(checkout, options) for name, checkout in checkouts.items()}
    rounds: dict[str, list[dict[str, float]]] = {name: [] for name in workers}
    # The first round compiles and is not counted.
    for number in range(options.rounds + 1):
        for name in sorted(workers, reverse=bool(number % 2)):
            rounds[name].append(ask(workers[name]))
    for worker in workers.values():
        worker.communicate()
    print(f"{'':16}{'this':>12}{'other':>12}{'ratio':>8}")
    for key in rounds["this"][0]:
        this, other = (statistics.median(r[key] for r in rounds[name][1:]) for name in checkouts)
        print(f"{key:16}{this:12.4g}{other:12.4g}{this / other if other else float('nan'):8.3f}")


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("other", type=Path, help="the other checkout")
    parser.add_argument("left", type=Path)
    parser.add_argument("right", type=Path)
    parser.add_argument("--ndisp", type=int, required=True, help="disparities that are searched")
    parser.add_argument("--truth", type=Path, help="disparity of the left image (PFM)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def start(checkout: Path, options: argparse.Namespace) -> subprocess.Popen[str]:
    """Start what matches the pair with the code of a checkout, once for each line that it reads."""
    files = [str(path.resolve()) for path in (checkout, options.left, options.right)]
    command = [sys.executable, __file__, *files, f"--ndisp={options.ndisp}", "--serve"]
    command += [f"--truth={options.truth.resolve()}"] if options.truth else []
    environment, pipe = {**os.environ, "PYTHONPATH": str(checkout)}, subprocess.PIPE
    return subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, text=True)


def ask(worker: subprocess.Popen[str]) -> dict[str, float]:
    if worker.stdin is None or worker.stdout is None:
        raise RuntimeError("the worker has no pipes")
    worker.stdin.write("again\n")
    worker.stdin.flush()
    found: dict[str, float] = json.loads(worker.stdout.readline())
    return found


def serve(options: argparse.Namespace) -> None:
    """Match the pair for each line of the input, and print figures of it as a line of JSON."""
    import recon  # noqa: PLC0415 - of the checkout, as are the others
    from recon.core.values import Reason, RectifiedPair  # noqa: PLC0415
    from recon.io.images.disparity import read_pfm  # noqa: PLC0415
    from recon.io.middlebury import stand_in_camera  # noqa: PLC0415
    from recon.stereo.match.fine import FineMatcher  # noqa: PLC0415
    from recon.stereo.match.search import SearchSettings  # noqa: PLC0415

    if options.other.resolve() not in Path(recon.__file__).parents:
        raise RuntimeError(f"{recon.__file__} is not of {options.other}")
    left, right = read(options.left), read(options.right)
    one, other = (cv2.cvtColor(view, cv2.COLOR_RGB2GRAY) for view in (left, right))
    camera = stand_in_camera(one.shape[1], one.shape[0], options.ndisp)
    pair = RectifiedPair(one, other, camera, left_rgb=left, right_rgb=right)
    truth = read_pfm(options.truth) if options.truth else None
    matcher = FineMatcher(SearchSettings())
    for _ in sys.stdin:
        before, processor = time.perf_counter(), time.process_time()
        found = matcher.match(pair)
        after, used = time.perf_counter(), time.process_time()
        figures = {"seconds": after - before, "processor_s": used - processor}
        if truth is not None:
            known = np.isfinite(truth)
            right = np.abs(found.values - truth)[known] <= 2
            figures["bad_2"] = 100 * float(1 - right.mean())
        figures["measured"] = 100 * float((found.reason == Reason.VALID).mean())
        print(json.dumps(figures), flush=True)


def read(path: Path) -> Any:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(path)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


if __name__ == "__main__":
    main()
