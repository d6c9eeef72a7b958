"""What matchers measure and infer on pairs beside those of MiddEval3, and where there is nothing.

The scenes are rendered (sky, plain walls, wires, glass, a cave, shelves, a floor, some with the
right image in other light; a street; rooms), and, where RECON_DATA has them, a yard and a pair of
SceneFlow. A disparity is measured, or inferred from planes around it; figures are fractions of
pixels, in per cent. Of those whose truth is known: `measured` and `inferred`, whose errors are
`off by 2` and `off by 3` (in pixels, of those given), and whose confidence is compared with the
fraction within a pixel (`ece`). `in none` are the pixels of sky and of what is dark that have a
disparity all the same. `other side`: of all pixels within 5 px of a step of depth, those with the
disparity of the other side. `off by 2` alone is of all that is given.

Examples:
    python benchmarks/pairs.py --json
    python benchmarks/pairs.py --scenes yard 'cave 0' --matchers sad fine --middlebury trainingQ
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import checkout  # noqa: F401 - what is measured
import cv2
import numpy as np
from numpy.typing import NDArray
from tuned_on import LEGEND, TUNED_ON, mark

from recon.core.values import (
    Disparity,
    DisparityTruth,
    Reason,
    RectifiedCamera,
    RectifiedPair,
    StereoPair,
)
from recon.core.values.arrays import Bool, Float32, Float64
from recon.evaluation.disparity import measure_reliability, measure_sparsification
from recon.evaluation.middlebury.bench import find_scenes, read_scored_scene
from recon.io.images.disparity import read_disparity
from recon.io.images.image import read_image
from recon.io.middlebury import stand_in_camera
from recon.stereo.match.registry import MatchingSettings, make_matcher, settings_taken
from recon.stereo.rectify.rectifier import Rectifier
from recon.street.render import StreetCamera
from recon.street.settings import StreetScene
from recon.street.street import build_street
from tests.scenery.hard_scenes import HARD_SCENES
from tests.scenery.pairs import Kind, hard_pair, relit

MATCHERS: Final = ("sad", "sgm", "fine", "opencv-bm", "opencv-sgbm")
SEEDS: Final = (0, 1)
RELIT: Final = (("corner", "gradient"), ("shelves", "gamma"), ("floor", "spot"))
"""Scenes that are also matched with the right image in another light."""
NEAR_PX: Final = 5
"""Of a step: pixels at most so far from it are near it."""
STEP_PX: Final = 2.0
"""Between neighbours of which the true disparity differs by more there is a step."""
RIGHT_PX: Final = 1.0
LEAST_NONE: Final = 0.01
"""Of an image: a smaller sky is rather the rim of something else."""
WARM_UP_ROWS: Final = 64
Figures = dict[str, float | None]


@dataclass(frozen=True, eq=False)
class Scene:
    """A pair whose truth is known, or known to be none."""

    pair: RectifiedPair
    truth: DisparityTruth
    none: Bool  # (H, W), where nothing can be seen: sky, and what is dark
    sky: Bool  # (H, W), the former


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    found = {}
    for name, load in chosen(options):
        scene = load()
        found[name] = dict(results(scene, options.matchers))
        if not options.json:
            print("\n".join(lines(name, found[name])), flush=True)
    tuned = {name: TUNED_ON[name] for name in found if name in TUNED_ON}
    print(json.dumps({"scenes": found, "tuned_on": tuned}) if options.json else LEGEND)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", action="store_true", help="JSON of all scenes at the end")
    parser.add_argument("--matchers", nargs="+", choices=MATCHERS, default=MATCHERS)
    parser.add_argument("--scenes", nargs="+", help="only those whose names begin so")
    parser.add_argument("--middlebury", type=Path, help="a folder of scenes, which are added")
    return parser.parse_args(arguments)


def chosen(options: argparse.Namespace) -> Iterator[tuple[str, Callable[[], Scene]]]:
    """Yield the scenes by name, each with what makes it."""
    every = dict(real_scenes())
    if options.middlebury is not None:
        for name, folder in find_scenes(options.middlebury).items():
            every[name] = partial(middlebury_scene, name, folder)
    for seed in SEEDS:
        every |= {f"{name} {seed}": partial(hard_scene, name, seed) for name in HARD_SCENES}
        every |= {
            f"{name}, {light} {seed}": partial(hard_scene, name, seed, light)
            for name, light in RELIT
        }
        every[f"street {seed}"] = partial(street_scene, {"seed": seed, "frames": 12}, 11)
        every[f"room {seed}"] = partial(
            street_scene, {"seed": seed, "path": "room", "frames": 60, "shutter": 0.0}, 59
        )
    for name, load in every.items():
        if options.scenes is None or any(name.startswith(each) for each in options.scenes):
            yield name, load


def real_scenes() -> Iterator[tuple[str, Callable[[], Scene]]]:
    """Yield the scenes of the folder of data, if there is one."""
    data = os.environ.get("RECON_DATA")
    for name, part, load in (
        ("TartanAir yard", "rendered/yard", tartan_air_scene),
        ("SceneFlow 4", "pairs/sceneflow_dmb4", sceneflow_scene),
    ):
        if data and (Path(data) / part).is_dir():
            yield name, partial(load, Path(data) / part)


def tartan_air_scene(folder: Path) -> Scene:
    """The first pair of a drive of TartanAir, whose sky is at the least disparity of its file."""
    image = np.asarray(cv2.imread(str(folder / "truth" / "000000.png"), cv2.IMREAD_UNCHANGED))
    sky = np.asarray(image <= image.min())
    truth = np.where(sky, np.nan, image / 256.0).astype(np.float32)
    height, width = image.shape
    left, right = (read_image(folder / side / "000000.png") for side in ("left", "right"))
    camera = RectifiedCamera(320.0, 320.0, 320.0, 320.0, 0.25, width, height)
    return scene_of(left, right, camera, DisparityTruth.from_values(truth), sky)


def sceneflow_scene(folder: Path) -> Scene:
    left, right = (read_image(folder / f"{side}.png") for side in ("left", "right"))
    truth = DisparityTruth.from_values(np.abs(read_disparity(folder / "disp.pfm")))
    height, width = truth.values.shape
    none = np.zeros((height, width), np.bool_)
    return scene_of(left, right, stand_in_camera(width, height), truth, none)


def middlebury_scene(name: str, folder: Path) -> Scene:
    scored = read_scored_scene(name, folder, None)
    if scored is None or scored.truth.values.shape != scored.pair.left.shape[:2]:
        raise SystemExit(f"{name}: no truth of the size of the images")
    none = np.zeros(scored.truth.values.shape, np.bool_)
    return scene_of(scored.pair.left, scored.pair.right, scored.camera, scored.truth, none)


def hard_scene(name: str, seed: int, light: str | None = None) -> Scene:
    """A rendered scene, of which the right image may be in another light."""
    one = hard_pair(name, seed)
    if light is not None:
        one = replace(one, right=relit(one.right, light, np.random.default_rng(seed)))
    sky, dark = one.kind == Kind.SKY, one.kind == Kind.DARK
    return Scene(one.pair, one.truth, sky | dark, sky)


def street_scene(settings: dict[str, Any], frame: int) -> Scene:
    """A frame of a rendered drive; what is in a mirror is not judged."""
    street = StreetCamera(build_street(StreetScene.parse(settings)))
    depth, pair = street.depth(frame, in_mirrors=False), street.pair(frame)
    truth = street.disparity_truth(frame)
    behind = street.depth(frame) != depth
    known = np.where(behind, np.float32(np.nan), truth.values)
    sky = np.isnan(depth)
    truth = DisparityTruth(known, truth.nonocc & ~behind)
    return scene_of(pair.left, pair.right, street.world.camera, truth, sky)


def scene_of(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    camera: RectifiedCamera,
    truth: DisparityTruth,
    sky: Bool,
) -> Scene:
    return Scene(Rectifier(camera).rectify(StereoPair(left, right)), truth, sky, sky)


def results(scene: Scene, matchers: Sequence[str]) -> Iterator[tuple[str, Figures]]:
    """Yield the figures of each matcher, with and without filling where it has that setting."""
    for matcher in matchers:
        for filled in fillings(matcher):
            asked = MatchingSettings.parse({"fill": filled or False, "opencv": {"pad": True}})
            made = make_matcher(matcher, asked)
            made.match(first_rows(scene.pair))
            start = time.perf_counter()
            found = made.match(scene.pair)
            seconds = time.perf_counter() - start
            label = f"`{matcher}`" + (", filled" if filled else "")
            yield label, {**figures(found, scene), "seconds": seconds}


def fillings(matcher: str) -> tuple[bool | None, ...]:
    return (False, True) if "fill" in settings_taken(matcher) else (None,)


def first_rows(pair: RectifiedPair) -> RectifiedPair:
    """The top of a pair, on which kernels are compiled and networks loaded before it is timed."""
    n = min(WARM_UP_ROWS, pair.camera.height_px)
    return RectifiedPair(pair.left[:n], pair.right[:n], replace(pair.camera, height_px=n))


def figures(found: Disparity, scene: Scene) -> Figures:
    """All figures of a result but the time it took."""
    known = np.isfinite(scene.truth.values)
    error = np.abs(found.values - scene.truth.values)
    figured: Figures = {"off by 2": percent(error > 2.0, found.valid & known)}
    judged = scene.none.mean() > LEAST_NONE
    for kind, limit, other in (("measured", 2.0, "inferred"), ("inferred", 3.0, "measured")):
        given = masks(found)[kind]
        ours = found.reject(masks(found)[other], Reason.AMBIGUOUS)
        figured |= {
            f"{kind}": percent(given, known),
            f"{kind}, off by {limit:g}": percent(error > limit, given & known),
            f"{kind}, in none": percent(given, scene.none) if judged else None,
            f"{kind}, confidence": mean(found.confidence[given & known]),
            f"{kind}, ece": ece(ours, scene.truth),
            **{f"{kind}, {name}": each for name, each in at_steps(ours, scene).items()},
        }
    return figured


def masks(found: Disparity) -> dict[str, Bool]:
    return {"measured": found.measured, "inferred": found.valid & ~found.measured}


def ece(found: Disparity, truth: DisparityTruth) -> float | None:
    if not (found.valid & np.isfinite(truth.values)).any():
        return None
    return measure_reliability(found, truth, RIGHT_PX).calibration_error


def at_steps(found: Disparity, scene: Scene) -> Figures:
    """Figures of the pixels near a step of depth; that of the sky is behind all."""
    truth = np.where(scene.sky, np.float32(0), scene.truth.values)
    near = near_steps(truth) & np.isfinite(truth)
    judged = near & found.valid
    own, given = truth[judged].astype(np.float64), found.values[judged].astype(np.float64)
    off = np.abs(given - own)
    other = np.zeros(len(own), np.bool_)
    for across in neighbours(truth, judged):
        other |= (np.abs(across - own) > STEP_PX) & (np.abs(across - given) < np.minimum(off, 1.0))
    there = DisparityTruth(truth, np.isfinite(truth))
    left = found.reject(~judged, Reason.AMBIGUOUS)
    if not judged.any():
        return {"other side": None, "ause at steps": None}
    return {
        "other side": 100.0 * float(np.sum(other & (off > RIGHT_PX)) / near.sum()),
        "ause at steps": measure_sparsification(left, there, RIGHT_PX).ause,
    }


def near_steps(truth: Float32) -> Bool:
    """Return bool (H, W), the pixels near a step between neighbours."""
    step = np.zeros(truth.shape, np.uint8)
    with np.errstate(invalid="ignore"):
        across, below = (np.abs(np.diff(truth, axis=axis)) > STEP_PX for axis in (1, 0))
    step[:, :-1] |= across
    step[:, 1:] |= across
    step[:-1] |= below
    step[1:] |= below
    side = 2 * NEAR_PX - 1  # a pixel at a step is one pixel from the other side
    return np.asarray(cv2.dilate(step, np.ones((side, side), np.uint8)) > 0)


def neighbours(truth: Float32, judged: Bool) -> Iterator[Float64]:
    """Yield the truths (N,) around the judged pixels, one place after the other; NaN = none."""
    padded = np.pad(truth, NEAR_PX, constant_values=np.nan)
    height, width = truth.shape
    for dy, dx in np.ndindex(2 * NEAR_PX + 1, 2 * NEAR_PX + 1):
        yield padded[dy : dy + height, dx : dx + width][judged].astype(np.float64)


def percent(mask: Bool, among: Bool) -> float | None:
    return mean(100.0 * mask[among])


def mean(values: NDArray[Any]) -> float | None:
    return float(np.mean(values)) if values.size else None


def lines(name: str, found: dict[str, Figures]) -> Iterator[str]:
    """The figures of a scene, a line a matcher."""
    for number, (label, one) in enumerate(found.items()):
        if not number:
            yield f"{name}\n{'':24}" + " ".join(f"{SHORT.get(k, k):>8}" for k in one)
        cells = ("" if value is None else f"{value:.3g}" for value in one.values())
        yield f"{label + mark(label, name):24}" + " ".join(f"{cell:>8}" for cell in cells)


SHORT: Final = {"off by 2": ">2"} | {
    f"{kind}{name}": f"{letter}{short}"
    for kind, letter in (("measured", "M"), ("inferred", "I"))
    for name, short in {
        "": "", ", off by 2": ">2", ", off by 3": ">3", ", in none": " none",
        ", confidence": " conf", ", ece": " ece", ", other side": " other",
        ", ause at steps": " ause",
    }.items()
}  # fmt: skip


if __name__ == "__main__":
    main()
