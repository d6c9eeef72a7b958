"""Rectification of recorded images, by a calibration or by their features, and how good it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.text import to_json
from recon.core.values import StereoCalibration, StereoPair
from recon.core.values.arrays import Float64, UInt8, size_text
from recon.io.cameras.calibration import read_calibration, write_recon_calibration
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.fields import write_yaml
from recon.io.files import naming
from recon.rig.uncalibrated import rectify_images
from recon.sources.images import ImagePairs
from recon.sources.one_pair import read_pair
from recon.stereo.rectify.features import map_pixels, match_exactly
from recon.stereo.rectify.lens import epipolar_curves, epipolar_lines
from recon.stereo.rectify.rectifier import RectificationSettings, Rectifier, plan_turns, to_grey

# Pairs of a folder whose features are matched where there is no calibration: in other pairs of a
# flown room rows are 0.44 to 0.52 px apart by 8 of them, 0.41 to 0.43 by 16, and 0.41 by 74.
_UNCALIBRATED_PAIRS: Final = 16
# A epipolar error above this multiple of the median is a false match, not a calibration error.
_WRONG: Final = 5.0
_NEVER_WRONG_PX: Final = 0.5
Lines = tuple[list[Float64], list[Float64]]


@dataclass(frozen=True, eq=False)
class RectifyPlan:
    """One way to rectify."""

    warp: Callable[[StereoPair], tuple[UInt8, UInt8]]  # rectifies the images of a pair
    # maps (N, 2) pixels of the left and right image to the rectified ones
    place: Callable[[Float64, Float64], tuple[Float64, Float64]]
    lines: Callable[[Float64, Float64], Lines]  # their epipolar lines in the images as recorded
    write: Callable[[Path], None]  # writes the calibration, or the homographies, into a folder
    figures: dict[str, Any]  # figures of the plan for ``summary.json``


@dataclass(frozen=True, eq=False)
class RectifyResult:
    """Results of a run; pixels are float64 (N, 2) of the left and the right image."""

    pair: StereoPair  # the first pair, as recorded
    rectified: tuple[UInt8, UInt8]  # its rectified images
    raw_px: tuple[Float64, Float64]  # its feature matches without false ones
    raw_lines: Lines  # their epipolar lines
    rectified_px: tuple[Float64, Float64]  # the same matches, rectified
    summary: dict[str, Any]  # the figures of ``summary.json``


def plan_by_calibration(
    path: Path, images: ImagePairs, settings: RectificationSettings, *, metres_per_unit: float
) -> RectifyPlan:
    """Return the rectification by a calibration file; depth is metric."""
    files = images.pairs[0]
    height, width = read_pair(*files).left.shape[:2]
    cameras = kitti_cameras_of(files[0])
    rig = read_calibration(path, width, height, metres_per_unit=metres_per_unit, cameras=cameras)
    if not isinstance(rig, StereoCalibration):
        raise CalibrationError(
            "the calibration is of images that are already rectified",
            where=path,
            hint="use them directly with recon pair or recon map",
        )
    with naming(path):
        rectifier = Rectifier(rig, settings)
    turns, camera = plan_turns(rig, settings), rectifier.camera
    return RectifyPlan(
        warp=rectifier.warp,
        place=lambda a, b: (turns.place(rig, a), turns.place(rig, b, right=True)),
        lines=lambda a, b: epipolar_curves(rig, a, b),
        write=lambda folder: write_recon_calibration(folder / "calibration.yaml", camera),
        figures={
            "method": "calibration",
            "up_to_scale": False,
            "focal_px": camera.focal_px,
            "field_of_view_deg": camera.field_of_view_deg,
            "baseline_m": camera.baseline_m,
        },
    )


def plan_by_features(images: ImagePairs) -> RectifyPlan:
    """Return the rectification by homographies from feature matches; depth has no scale."""
    even = np.linspace(0, len(images.pairs) - 1, min(len(images.pairs), _UNCALIBRATED_PAIRS))
    some = replace(images, pairs=tuple(images.pairs[int(at)] for at in even))
    greys = [(to_grey(pair.left), to_grey(pair.right)) for pair, _ in read_pairs(some)]
    height, width = greys[0][0].shape
    size = (width, height)
    try:
        result = rectify_images(greys)
    except CalibrationError as error:
        if len(images.pairs) > 1:
            raise
        hint = f"{error.hint}; or it has too few good matches, and several pairs are needed: "
        hint += "give two folders of one rig, or a calibration with --calib"
        raise error.copy_with(where=images.pairs[0][0], hint=hint) from error

    def warp(pair: StereoPair) -> tuple[UInt8, UInt8]:
        if result.model == "raw":
            return pair.left, pair.right
        left, right = (
            np.asarray(cv2.warpPerspective(image, H, size))
            for image, H in ((pair.left, result.H_left), (pair.right, result.H_right))
        )
        return left, right

    figures: dict[str, Any] = {
        "method": "features",
        "model": result.model,
        "up_to_scale": True,
        **to_json(result),
        "H_left": result.H_left.tolist(),
        "H_right": result.H_right.tolist(),
        "fundamental": result.fundamental.tolist(),
    }
    return RectifyPlan(
        warp=warp,
        place=lambda a, b: (map_pixels(result.H_left, a), map_pixels(result.H_right, b)),
        lines=lambda a, b: epipolar_lines(result.fundamental, a, b, size),
        write=lambda folder: write_yaml(
            folder / "homographies.yaml",
            {
                "note": "rectified = H * raw, up to scale; depth has no unit",
                "width_px": width,
                "height_px": height,
                **{name: figures[name] for name in ("H_left", "H_right", "fundamental")},
            },
        ),
        figures=figures,
    )


def read_pairs(images: ImagePairs) -> Iterator[tuple[StereoPair, tuple[Path, Path]]]:
    """Yield the pairs with their files, one in memory at a time."""
    first: str | None = None
    for files in images.pairs:
        pair = read_pair(*files)
        size = size_text(pair.left)
        first = first or size
        if size != first:
            what = "images differ in size"
            raise CalibrationError(what, where=files[0], got=size, expected=first)
        yield pair, files


def measure_epipolar(plan: RectifyPlan, pair: StereoPair) -> RectifyResult:
    """Rectify a pair, and measure the epipolar errors that are left by its feature matches."""
    found = match_exactly(to_grey(pair.left), to_grey(pair.right))
    raw = (found.left_uv.astype(np.float64), found.right_uv.astype(np.float64))
    left, right = plan.place(*raw)
    rows = np.abs(left[:, 1] - right[:, 1])
    limit = _WRONG * float(np.median(rows)) if len(rows) else 0.0
    good = rows <= max(limit, _NEVER_WRONG_PX)
    summary = {"pair": pair.name, **plan.figures, "features": int(good.sum())}
    if good.any():
        summary |= {
            "epipolar_error_px": float(rows[good].mean()),
            "epipolar_error_median_px": float(np.median(rows[good])),
            "epipolar_error_95_px": float(np.quantile(rows[good], 0.95)),
        }
    kept = (raw[0][good], raw[1][good])
    return RectifyResult(
        pair, plan.warp(pair), kept, plan.lines(*kept), (left[good], right[good]), summary
    )
