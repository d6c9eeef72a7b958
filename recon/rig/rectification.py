"""Rectification of recorded images, by a calibration or by their features, and how good it is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import CalibrationError
from recon.core.summary import Figures, Rows, RunSummary, inline, optional, shown_path
from recon.core.text import counted, metres
from recon.core.values import StereoCalibration, StereoPair
from recon.core.values.arrays import Float64, UInt8, size_text
from recon.io.cameras.calibration import read_calibration, write_recon_calibration
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.fields import write_yaml
from recon.io.files import naming
from recon.rig.uncalibrated import UncalibratedRectification, rectify_images
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
_WARN_EPIPOLAR_PX: Final = 0.5
_NEVER_WRONG_PX: Final = 0.5
Lines = tuple[list[Float64], list[Float64]]


@dataclass(frozen=True)
class ByCalibration(Figures):
    """The camera that a calibration rectifies to."""

    focal_px: float
    field_of_view_deg: float
    baseline_m: float
    method: str = "calibration"
    up_to_scale: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class ByFeatures(Figures):
    """The homographies that feature matches show."""

    fundamental: Float64  # (3, 3)
    found: UncalibratedRectification = inline()
    method: str = "features"
    up_to_scale: bool = True


@dataclass(frozen=True, kw_only=True)
class RectifySummary(RunSummary):
    """What `recon rectify` did, and the epipolar error that its features leave."""

    pair: str  # the first one, in which rows are measured
    plan: ByCalibration | ByFeatures = inline()
    features: int
    pairs: int
    frames_left_out: int  # images without a partner
    epipolar_error_px: float | None = optional()  # mean; None = there are no features
    epipolar_error_median_px: float | None = optional()
    epipolar_error_95_px: float | None = optional()

    def rows(self) -> Rows:
        out, plan = self.out or "", self.plan
        error = "not known: no features"
        if self.epipolar_error_px is not None:
            error = f"error of {self.epipolar_error_px:.2f} px"
            error += f", 95 % below {self.epipolar_error_95_px:.2f} px"
        if isinstance(plan, ByCalibration):
            scale, use = f"baseline {metres(plan.baseline_m)}", f"recon map {shown_path(out)}"
        else:
            scale, use = "up to scale: no calibration", "recon disparity LEFT RIGHT"
        return [
            (f"{counted(self.pairs, 'pair')} rectified by {plan.method}",),
            *self.folder_row(),
            ("images", "left/ and right/", scale),
            ("epipolar", error),
            *self.cost_row(),
            ("next", use),
        ]


@dataclass(frozen=True, eq=False)
class RectifyPlan:
    """One way to rectify."""

    warp: Callable[[StereoPair], tuple[UInt8, UInt8]]  # rectifies the images of a pair
    # maps (N, 2) pixels of the left and right image to the rectified ones
    place: Callable[[Float64, Float64], tuple[Float64, Float64]]
    lines: Callable[[Float64, Float64], Lines]  # their epipolar lines in the images as recorded
    write: Callable[[Path], None]  # writes the calibration, or the homographies, into a folder
    figures: ByCalibration | ByFeatures


@dataclass(frozen=True, eq=False)
class RectifyResult:
    """Results of a run; pixels are float64 (N, 2) of the left and the right image."""

    pair: StereoPair  # the first pair, as recorded
    rectified: tuple[UInt8, UInt8]  # its rectified images
    raw_px: tuple[Float64, Float64]  # its feature matches without false ones
    raw_lines: Lines  # their epipolar lines
    rectified_px: tuple[Float64, Float64]  # the same matches, rectified
    summary: RectifySummary


def plan_by_calibration(
    path: Path,
    images: ImagePairs,
    settings: RectificationSettings,
    *,
    metres_per_unit: float | None,
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
        figures=ByCalibration(camera.focal_px, camera.field_of_view_deg, camera.baseline_m),
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
                "H_left": result.H_left.tolist(),
                "H_right": result.H_right.tolist(),
                "fundamental": result.fundamental.tolist(),
            },
        ),
        figures=ByFeatures(found=result, fundamental=result.fundamental),
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


def measure_epipolar(plan: RectifyPlan, pair: StereoPair, images: ImagePairs) -> RectifyResult:
    """Rectify the first pair, and measure the epipolar errors that its feature matches leave."""
    found = match_exactly(to_grey(pair.left), to_grey(pair.right))
    raw = (found.left_uv.astype(np.float64), found.right_uv.astype(np.float64))
    left, right = plan.place(*raw)
    rows = np.abs(left[:, 1] - right[:, 1])
    limit = _WRONG * float(np.median(rows)) if len(rows) else 0.0
    good = rows <= max(limit, _NEVER_WRONG_PX)
    summary = RectifySummary(
        pair=pair.name,
        plan=plan.figures,
        features=int(good.sum()),
        pairs=len(images.pairs),
        frames_left_out=len(images.lonely),
    )
    if good.any():
        summary = replace(
            summary,
            epipolar_error_px=float(rows[good].mean()),
            epipolar_error_median_px=float(np.median(rows[good])),
            epipolar_error_95_px=float(np.quantile(rows[good], 0.95)),
        )
    summary = replace(summary, warnings=_warnings(summary, images))
    kept = (raw[0][good], raw[1][good])
    return RectifyResult(
        pair, plan.warp(pair), kept, plan.lines(*kept), (left[good], right[good]), summary
    )


def _warnings(found: RectifySummary, images: ImagePairs) -> list[str]:
    lines = []
    if found.plan.up_to_scale:
        lines.append("without a calibration: rows correspond, but depth is up to scale, no metres")
    if isinstance(found.plan, ByFeatures) and found.plan.found.model == "raw":
        lines.append("rows correspond as recorded: the images are written unchanged")
    if found.epipolar_error_px is None:
        lines.append("no features to measure rows by")
    elif found.epipolar_error_px > _WARN_EPIPOLAR_PX:
        lines.append(f"rows are {found.epipolar_error_px:.2f} px apart: a matcher needs 0.5")
    if images.lonely:
        names = ", ".join(path.name for path in images.lonely[:6])
        lines.append(f"images without a partner, left out: {len(images.lonely)} ({names})")
    if images.by_order:
        lines.append("names do not tell which images belong together: paired by their order")
    return lines
