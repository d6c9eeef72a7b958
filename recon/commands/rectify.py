"""The pipeline behind `recon rectify`: images in, row-aligned images out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from recon.commands.config import ReconConfig, dump_config
from recon.core.errors import CalibrationError
from recon.core.geometry.projection import map_pixels
from recon.core.values import StereoCalibration, StereoPair
from recon.core.values.arrays import Float64, UInt8
from recon.io.atomic import write_text
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.io.images.image import write_image
from recon.io.yaml_file import write_yaml
from recon.rig.uncalibrated import UncalibratedRectification, rectify_images
from recon.run.directory import RunDirectory
from recon.run.machine import serial_algebra, use_threads
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost, plain
from recon.sources.files import read_pair
from recon.sources.image_pairs import ImagePairs, pair_images
from recon.stereo.rectify import (
    Rectifier,
    epipolar_curves,
    epipolar_lines,
    match_exactly,
    plan_turns,
    to_grey,
)

_UNCALIBRATED_PAIRS: Final = 8
"""Pairs of a folder whose features are matched where there is no calibration."""

_WARN_ROW_PX: Final = 0.5
# A row error above this multiple of the median is a false match, not a calibration error.
_WRONG: Final = 5.0
_NEVER_WRONG_PX: Final = 0.5
_KEPT_TYPES: Final = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})

Lines = tuple[list[Float64], list[Float64]]


@dataclass(frozen=True, eq=False)
class RectifyRun:
    """Results of a run.

    Attributes:
        pair: The first pair, as recorded.
        rectified: Its rectified images.
        raw_px: float64 (N, 2) twice: feature matches of the first pair without false ones, in the
            left and right image as recorded.
        raw_lines: Their epipolar lines in the left and right image.
        rectified_px: The same matches, rectified.
        summary: The figures of ``summary.json``.
    """

    pair: StereoPair
    rectified: tuple[UInt8, UInt8]
    raw_px: tuple[Float64, Float64]
    raw_lines: Lines
    rectified_px: tuple[Float64, Float64]
    summary: dict[str, Any]


@dataclass(frozen=True)
class RectifyOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        calibration: Calibration file; None = homographies from features.
        metres_per_unit: Unit of the translation in an OpenCV file.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.
        present: Draws the figures of the run into its folder.
    """

    calibration: Path | None = None
    metres_per_unit: float = 1.0
    out: Path | None = None
    threads: int | None = None
    present: Callable[[RectifyRun, RunDirectory], None] | None = None


def run_rectify(left: str, right: str, config: ReconConfig, options: RectifyOptions) -> RectifyRun:
    """Rectify a pair, or all pairs of two folders.

    Args:
        left: Image, folder or pattern of the left camera.
        right: The same for the right camera.
        config: The configuration.
        options: Calibration, result folder and figures.

    Raises:
        ReconError: The images do not pair up or cannot be rectified, or the folder cannot be
            written; nothing is left behind.
    """
    start = time.perf_counter()
    use_threads(options.threads)
    watch, images = Stopwatch(), pair_images(left, right)
    with RunDirectory.for_command("rectify", options.out) as directory, serial_algebra():
        with watch.stage("plan"):
            first = read_pair(*images.pairs[0])
            cameras = kitti_cameras_of(images.pairs[0][0])
            plan = _by_file(options, config, first, cameras) if options.calibration else None
            plan = plan or _by_features(images, first)
        with watch.stage("rectify"):
            for pair, (left_path, right_path) in _pairs(images):
                warped = plan.warp(pair)
                write_image(directory.path(f"left/{_rectified_name(left_path)}"), warped[0])
                write_image(directory.path(f"right/{_rectified_name(right_path)}"), warped[1])
        run = _measure(plan, first)
        run.summary["pairs"] = len(images.pairs)
        run.summary["frames_left_out"] = len(images.lonely)
        run.summary["warnings"] = _warnings(run.summary, images)
        plan.write(directory)
        write_text(directory.path("config.yaml"), dump_config(config))
        if options.present is not None:
            with watch.stage("report"):
                options.present(run, directory)
        run.summary.update(cost(watch, time.perf_counter() - start))
        run.summary["out"] = str(directory.folder)
        directory.write_json("summary.json", run.summary)
        write_record(
            directory,
            "rectify",
            {
                "source": f"{left} {right}",
                "inputs": fingerprint(path for pair in images.pairs for path in pair),
                "timings": watch.seconds,
                "warnings": run.summary["warnings"],
            },
        )
    return run


@dataclass(frozen=True, eq=False)
class _Plan:
    """One way to rectify: how to warp images, map pixels, draw lines and write the result."""

    warp: Callable[[StereoPair], tuple[UInt8, UInt8]]
    place: Callable[[Float64, Float64], tuple[Float64, Float64]]
    lines: Callable[[Float64, Float64], Lines]
    write: Callable[[RunDirectory], None]
    figures: dict[str, Any]


def _by_file(
    options: RectifyOptions,
    config: ReconConfig,
    first: StereoPair,
    cameras: tuple[int, int] | None,
) -> _Plan:
    """Rectification by a calibration file; depth is metric."""
    path = options.calibration
    height, width = first.left.shape[:2]
    rig = read_calibration(
        path or "",
        width,
        height,
        metres_per_unit=options.metres_per_unit,
        cameras=cameras,
    )
    if not isinstance(rig, StereoCalibration):
        raise CalibrationError(
            "the calibration is of images that are already rectified",
            where=path,
            hint="use them directly with recon pair or recon map",
        )
    rectifier = Rectifier(rig, config.rectification)
    turns, camera = plan_turns(rig, config.rectification), rectifier.camera
    return _Plan(
        warp=rectifier.warp,
        place=lambda a, b: (turns.place(rig, a), turns.place(rig, b, right=True)),
        lines=lambda a, b: epipolar_curves(rig, a, b),
        write=lambda run: write_recon_calibration(run.path("calibration.yaml"), camera),
        figures={
            "method": "calibration",
            "up_to_scale": False,
            "focal_px": camera.focal_px,
            "field_of_view_deg": camera.field_of_view_deg,
            "baseline_m": camera.baseline_m,
        },
    )


def _by_features(images: ImagePairs, first: StereoPair) -> _Plan:
    """Rectification by homographies from feature matches; depth has no scale."""
    height, width = first.left.shape[:2]
    size = (width, height)
    step = max(1, len(images.pairs) // _UNCALIBRATED_PAIRS)
    some = replace(images, pairs=images.pairs[::step][:_UNCALIBRATED_PAIRS])
    greys = [(to_grey(pair.left), to_grey(pair.right)) for pair, _ in _pairs(some)]
    try:
        result = rectify_images(greys)
    except CalibrationError as error:
        if len(images.pairs) > 1:
            raise
        raise CalibrationError(
            error.what,
            where=images.pairs[0][0],
            got=error.got,
            expected=error.expected,
            hint=f"{error.hint}; or it has too few good matches, and several pairs are needed: "
            "give two folders of one rig, or a calibration with --calib",
        ) from error

    def warp(pair: StereoPair) -> tuple[UInt8, UInt8]:
        left, right = (
            np.asarray(cv2.warpPerspective(image, H, size))
            for image, H in ((pair.left, result.H_left), (pair.right, result.H_right))
        )
        return left, right

    figures = _uncalibrated_figures(result)
    return _Plan(
        warp=warp,
        place=lambda a, b: (map_pixels(result.H_left, a), map_pixels(result.H_right, b)),
        lines=lambda a, b: epipolar_lines(result.fundamental, a, b, size),
        write=lambda run: write_yaml(
            run.path("homographies.yaml"),
            {
                "note": "rectified = H * raw, up to scale; depth has no unit",
                "width_px": width,
                "height_px": height,
                **{name: figures[name] for name in ("H_left", "H_right", "fundamental")},
            },
        ),
        figures=figures,
    )


def _rectified_name(path: Path) -> str:
    """The name of an image in its own file type; PNG for the types that are not written."""
    return path.name if path.suffix.lower() in _KEPT_TYPES else f"{path.stem}.png"


def _uncalibrated_figures(result: UncalibratedRectification) -> dict[str, Any]:
    return {
        "method": "features",
        "up_to_scale": True,
        "matches": result.matches,
        "inliers": len(result.features),
        "row_error_held_out_px": plain(result.held_out_px),
        "disparity_range_px": list(result.disparity_px),
        "H_left": result.H_left.tolist(),
        "H_right": result.H_right.tolist(),
        "fundamental": result.fundamental.tolist(),
    }


def _pairs(images: ImagePairs) -> Iterator[tuple[StereoPair, tuple[Path, Path]]]:
    """Yield the pairs with their files, one in memory at a time; all must have the same size."""
    shape: tuple[int, ...] | None = None
    for files in images.pairs:
        pair = read_pair(*files)
        shape = shape or pair.left.shape[:2]
        if pair.left.shape[:2] != shape:
            raise CalibrationError(
                "images differ in size",
                where=files[0],
                got=f"{pair.left.shape[1]}x{pair.left.shape[0]}",
                expected=f"{shape[1]}x{shape[0]}",
            )
        yield pair, files


def _measure(plan: _Plan, first: StereoPair) -> RectifyRun:
    """Measure the row alignment of the first pair by feature matches."""
    found = match_exactly(to_grey(first.left), to_grey(first.right))
    raw = (found.left_uv.astype(np.float64), found.right_uv.astype(np.float64))
    left, right = plan.place(*raw)
    rows = np.abs(left[:, 1] - right[:, 1])
    limit = _WRONG * float(np.median(rows)) if len(rows) else 0.0
    good = rows <= max(limit, _NEVER_WRONG_PX)
    summary = {"pair": first.name, **plan.figures, "features": int(good.sum())}
    if good.any():
        summary |= {
            "row_error_px": float(rows[good].mean()),
            "row_error_median_px": float(np.median(rows[good])),
            "row_error_95_px": float(np.quantile(rows[good], 0.95)),
        }
    kept = (raw[0][good], raw[1][good])
    return RectifyRun(
        first, plan.warp(first), kept, plan.lines(*kept), (left[good], right[good]), summary
    )


def _warnings(summary: dict[str, Any], images: ImagePairs) -> list[str]:
    lines = []
    if summary["up_to_scale"]:
        lines.append("without a calibration: rows correspond, but depth is up to scale, no metres")
    if summary.get("row_error_px", 0.0) > _WARN_ROW_PX:
        lines.append(f"rows are {summary['row_error_px']:.2f} px apart: a matcher needs 0.5")
    if "row_error_px" not in summary:
        lines.append("no features to measure rows by")
    if images.lonely:
        names = ", ".join(path.name for path in images.lonely[:6])
        lines.append(f"images without a partner, left out: {len(images.lonely)} ({names})")
    if images.by_order:
        lines.append("names do not tell which images belong together: paired by their order")
    return lines
