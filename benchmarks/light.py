"""How matchers fare where left and right differ in light: gain, gamma, vignette, a spot, noise.

The right image of Middlebury pairs is altered; bad 2 of every pixel that both views see (dense, as
`recon evaluate middlebury` scores it), weighted as there. "brought back" is what a perfect inverse
leaves after 8 bits.

Example: python benchmarks/light.py $RECON_DATA/middlebury/MiddEval3/trainingQ --matcher sad,sgm
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.commands.config import PAIR_DEFAULTS, load_config
from recon.core.values.arrays import Float64, UInt8
from recon.evaluation.middlebury.bench import Bench, find_scenes, read_scored_scene
from recon.evaluation.middlebury.score import scene_weight

Light = Callable[[Float64], Float64]
"""What becomes of an image (H, W) or (H, W, 3) of grey levels from 0 to 255."""


def across(image: Float64) -> tuple[Float64, Float64]:
    """Columns and rows from the middle: the corners are at a distance of 1."""
    height, width = image.shape[:2]
    v, u = np.mgrid[:height, :width]
    half = np.hypot(width, height) / 2
    x, y = (u - (width - 1) / 2) / half, (v - (height - 1) / 2) / half
    extra = (1,) * (image.ndim - 2)
    return x.reshape(*x.shape, *extra), y.reshape(*y.shape, *extra)


def vignette(image: Float64) -> Float64:
    """Corners have a third of the light."""
    x, y = across(image)
    return np.asarray(image * (1 - 0.67 * (x**2 + y**2)))


def slope(image: Float64) -> Float64:
    """From 0.6 at the left end to 1.4 at the right one."""
    x, _ = across(image)
    return np.asarray(image * (1 + 0.4 * x / float(np.abs(x).max())))


def spot(image: Float64) -> Float64:
    """Stray light in an upper corner: much of it is saturated."""
    x, y = across(image)
    return np.asarray(image + 200 * np.exp(-((x + 0.4) ** 2 + (y + 0.3) ** 2) / (2 * 0.2**2)))


def dim(image: Float64) -> Float64:
    """A tenth of the light, shot and read noise, brought back to the old level by gain."""
    random, photons = np.random.default_rng(0), 0.1 * image
    return 10 * (random.poisson(2 * photons) / 2 + random.normal(0, 0.5, image.shape))


LIGHTS: Final[dict[str, Light]] = {
    "as it is": lambda image: image,
    "gain 0.6": lambda image: 0.6 * image,
    "gain 0.6, brought back": lambda image: np.rint(0.6 * image) / 0.6,
    "gain 1.5": lambda image: 1.5 * image,
    "offset 40": lambda image: image + 40,
    "gamma 0.6": lambda image: 255 * (image / 255) ** 0.6,
    "gamma 1.6": lambda image: 255 * (image / 255) ** 1.6,
    "vignette": vignette,
    "slope": slope,
    "spot": spot,
    "noise": dim,
    "gain 0.6, vignette": lambda image: 0.6 * vignette(image),
}


def lit(image: UInt8, light: Light) -> UInt8:
    return np.asarray(np.clip(np.rint(light(image.astype(np.float64))), 0, 255), np.uint8)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    found: dict[str, dict[str, float]] = {}
    names = options.matcher.split(",")
    bench = Bench(names, load_config(None, options.set, defaults=PAIR_DEFAULTS), options.threads)
    scenes = find_scenes(options.folder)
    for light in options.only or LIGHTS:
        sums: dict[str, list[tuple[float, float]]] = {}
        for name, path in scenes.items():
            scene = read_scored_scene(name, path, None)
            if scene is None:
                continue
            left, right = scene.pair.left, lit(scene.pair.right, LIGHTS[light])
            pair = replace(scene.pair, left=left, right=right)
            for one in bench.results(replace(scene, pair=pair)):
                bad = one.figures["nonocc"]["dense"]["bad"]["2"]
                sums.setdefault(one.matcher, []).append((scene_weight(name), bad))
        found[light] = {
            key: sum(w * bad for w, bad in each) / sum(w for w, _ in each)
            for key, each in sums.items()
        }
        if not options.json:
            cells = "".join(f"{value:10.2f}" for value in found[light].values())
            print(f"{light:22s}{cells}", flush=True)
    if options.json:
        print(json.dumps(found, indent=2))


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="Middlebury scenes with truth")
    parser.add_argument("--matcher", default="sad,sgm,opencv-sgbm", help="names, with commas")
    parser.add_argument("--only", nargs="+", choices=LIGHTS, help="some kinds of light")
    parser.add_argument("--set", action="append", default=[], help="a setting")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
