"""Speed of our matchers against OpenCV's, with the same images, range, window, threads and checks.

Every round runs all matchers in turn, so that other load affects all alike; the figures are
medians over the rounds. All checks are enabled: texture, uniqueness, left-right and speckles. The
peak memory for a large pair is measured in a separate process.

Example: python benchmarks/matching.py --json --threads 1
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from unittest.mock import patch

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np

from recon.core.machine import peak_memory_mb
from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.io.middlebury import stand_in_camera
from recon.stereo.match import sad
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import SadMatcher
from recon.stereo.match.search import SearchSettings
from recon.stereo.match.sgm import SgmMatcher

SIZES = ((480, 640, 64), (375, 1242, 128), (994, 1482, 144))
GROWTH = ((188, 621, 64), (375, 1242, 64), (375, 1242, 128), (375, 1242, 256), (750, 2484, 128))
LARGE = (2000, 3000, 300)
LARGE_RUNS = ("none", "sad", "sgm")
WINDOW_PX = 11
RATIOS = (
    ("sad", "opencv-bm"),
    ("sad-upright", "opencv-bm"),
    ("sgm", "opencv-sgbm-hh"),
    ("sgm", "opencv-sgbm-3way"),
)
Run = Callable[[], object]


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    cv2.setNumThreads(options.threads)
    if options.peak:
        print(peak_mb(options.peak, options.threads))
        return
    sizes = [sizes_in(text) for text in options.size] or SIZES
    result = {
        "opencv": cv2.__version__,
        "threads": options.threads,
        "rounds": options.rounds,
        "sizes": [compare(*size, options.threads, options.rounds) for size in sizes],
        "growth": [] if options.size else growth(options.threads, options.rounds),
        "memory": [] if options.size else [memory(name, options.threads) for name in LARGE_RUNS],
    }
    print(json.dumps(result, indent=2) if options.json else table(result))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    parser.add_argument("--threads", type=int, default=1, help="threads of each matcher")
    parser.add_argument("--rounds", type=int, default=7, help="runs that a median is taken of")
    parser.add_argument(
        "--size", action="append", default=[], metavar="HxWxD", help="only this size; repeatable"
    )
    parser.add_argument("--peak", choices=LARGE_RUNS, help="only print the peak memory, MB")
    return parser.parse_args(arguments)


def compare(height: int, width: int, ndisp: int, threads: int, rounds: int) -> dict[str, Any]:
    """Median milliseconds of every matcher at one size, and the speed ratios in `RATIOS`."""
    pair = make_pair(height, width, ndisp)
    ms = medians_ms({**ours(pair, threads), **opencv(pair, ndisp)}, rounds)
    ratios = {f"{b} / {a}": round(ms[b] / ms[a], 3) for a, b in RATIOS}
    return {"height": height, "width": width, "ndisp": ndisp, "ms": ms, "ratios": ratios}


def growth(threads: int, rounds: int) -> list[dict[str, Any]]:
    """Nanoseconds per pixel and disparity of our matchers, by image size and range."""
    rows = []
    for height, width, ndisp in GROWTH:
        ms = medians_ms(ours(make_pair(height, width, ndisp), threads), max(1, rounds // 2))
        volume = height * width * ndisp
        ns = {name: round(1e6 * value / volume, 3) for name, value in ms.items()}
        rows.append({"height": height, "width": width, "ndisp": ndisp, "ns_per_candidate": ns})
    return rows


def sizes_in(text: str) -> tuple[int, int, int]:
    """Height, width and number of disparities, from such as 480x640x64."""
    height, width, ndisp = map(int, text.split("x"))
    return height, width, ndisp


def memory(name: str, threads: int) -> dict[str, Any]:
    """Peak memory of a process that matches one large pair; "none" only makes the pair."""
    command = [sys.executable, __file__, "--peak", name, "--threads", str(threads)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    height, width, ndisp = LARGE
    size = {"height": height, "width": width, "ndisp": ndisp}
    return {"matcher": name, **size, "peak_mb": float(done.stdout)}


def peak_mb(name: str, threads: int) -> float:
    pair = make_pair(*LARGE)
    if name != "none":
        ours(pair, threads)[name]()
    return round(peak_memory_mb(), 1)


def make_pair(height: int, width: int, ndisp: int) -> RectifiedPair:
    """A textured plane whose disparity grows row by row up to half of the range."""
    rng = np.random.default_rng(0)
    scene = cv2.GaussianBlur(rng.integers(0, 256, (height, width), dtype=np.uint8), (0, 0), 1.5)
    scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    right = cv2.remap(scene, x + y * (0.5 * ndisp / height), y, cv2.INTER_LINEAR)
    left, right = (add_noise(view, rng) for view in (scene, right))
    return RectifiedPair(left, right, stand_in_camera(width, height, ndisp))


def add_noise(image: UInt8, rng: np.random.Generator) -> UInt8:
    return np.clip(image + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)


def ours(pair: RectifiedPair, threads: int) -> dict[str, Run]:
    """`sad`, `sad` without its second, slanted window (StereoBM has none), and `sgm`."""
    matchers: dict[str, Matcher] = {
        "sad": SadMatcher(SearchSettings(window_px=WINDOW_PX), threads),
        "sgm": SgmMatcher(SearchSettings(), threads),
    }
    runs = {name: partial(matcher.match, pair) for name, matcher in matchers.items()}
    return {**runs, "sad-upright": partial(upright, matchers["sad"], pair)}


def upright(matcher: Matcher, pair: RectifiedPair) -> Disparity:
    with patch.object(sad, "WINDOW_SLANT", 0.0):
        return matcher.match(pair)


def opencv(pair: RectifiedPair, ndisp: int) -> dict[str, Run]:
    """OpenCV's matchers themselves, without the adapter's conversions."""
    ndisp = -(-ndisp // 16) * 16
    bm = cv2.StereoBM.create(ndisp, WINDOW_PX)
    bm.setTextureThreshold(10)
    engines: dict[str, cv2.StereoBM | cv2.StereoSGBM] = {"opencv-bm": bm}
    for name, mode in (("hh", cv2.STEREO_SGBM_MODE_HH), ("3way", cv2.STEREO_SGBM_MODE_SGBM_3WAY)):
        sgbm = cv2.StereoSGBM.create(0, ndisp, 3, P1=8 * 9, P2=32 * 9, mode=mode)
        sgbm.setPreFilterCap(63)
        engines[f"opencv-sgbm-{name}"] = sgbm
    for engine in engines.values():
        engine.setUniquenessRatio(5)
        engine.setDisp12MaxDiff(1)
        engine.setSpeckleWindowSize(50)
        engine.setSpeckleRange(1)
    return {name: partial(e.compute, pair.left, pair.right) for name, e in engines.items()}


def medians_ms(runs: dict[str, Run], rounds: int) -> dict[str, float]:
    """Median milliseconds of each; the first round compiles and is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: round(1e3 * statistics.median(s[1:]), 2) for name, s in seconds.items()}


def table(result: dict[str, Any]) -> str:
    lines = [f"OpenCV {result['opencv']}, {result['threads']} thread(s), median ms"]
    for row in result["sizes"]:
        lines.append(f"\n{row['height']}x{row['width']}, {row['ndisp']} disparities")
        lines += [f"  {name:18s}{ms:9.2f}" for name, ms in row["ms"].items()]
        lines += [f"  {name:28s}{ratio:7.2f}x" for name, ratio in row["ratios"].items()]
    if result["growth"]:
        lines.append("\nns per pixel and disparity")
    for row in result["growth"]:
        size = f"{row['height']}x{row['width']}x{row['ndisp']}"
        lines.append(
            f"  {size:15s}" + "".join(f" {k} {v}" for k, v in row["ns_per_candidate"].items())
        )
    if result["memory"]:
        lines.append(f"\npeak memory at {'x'.join(map(str, LARGE))}, MB")
        lines += [f"  {row['matcher']:18s}{row['peak_mb']:9.0f}" for row in result["memory"]]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
