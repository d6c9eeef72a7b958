"""`recon rectify`: images in, row-aligned images out."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig
from recon.io.images.image import write_image
from recon.report.calibration_page import write_epipolar_images
from recon.rig.rectification import (
    RectifyRun,
    measure_rows,
    plan_by_calibration,
    plan_by_features,
    read_pairs,
)
from recon.run.run import Run
from recon.run.threads import serial_algebra
from recon.sources.image_names import ImagePairs, pair_images
from recon.sources.one_pair import read_pair

_WARN_ROW_PX: Final = 0.5
_KEPT_TYPES: Final = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})


def run_rectify(
    left: str,
    right: str,
    config: ReconConfig,
    *,
    calibration: Path | None = None,
    metres_per_unit: float = 1.0,
    out: Path | None = None,
    threads: int | None = None,
) -> RectifyRun:
    """Rectify a pair, or all pairs of two folders: what `recon rectify` does.

    A calibration file says how, or else the features of some of the pairs. All images are warped;
    then the row errors of the first pair are measured, and drawn with its epipolar lines.

    Args:
        left: Image, folder or pattern of the left camera.
        right: The same for the right camera.
        config: The configuration.
        calibration: Calibration file; None = homographies from features.
        metres_per_unit: Unit of the translation in an OpenCV file.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.
    """
    images = pair_images(left, right)
    with Run("rectify", out, config, threads=threads) as run, serial_algebra():
        with run.stage("plan"):
            if calibration is None:
                plan = plan_by_features(images)
            else:
                plan = plan_by_calibration(
                    calibration, images, config.rectification, metres_per_unit=metres_per_unit
                )
        with run.stage("rectify"):
            for pair, (left_file, right_file) in read_pairs(images):
                left_image, right_image = plan.warp(pair)
                write_image(run.path(f"left/{_rectified_name(left_file)}"), left_image)
                write_image(run.path(f"right/{_rectified_name(right_file)}"), right_image)
        plan.write(run)
        first = read_pair(*images.pairs[0])
        result = measure_rows(plan, first)
        summary = result.summary
        summary["pairs"] = len(images.pairs)
        summary["frames_left_out"] = len(images.lonely)
        summary["warnings"] = _warnings(summary, images)
        with run.report(summary):
            write_epipolar_images(result, run)
        inputs = [file for files in images.pairs for file in files]
        inputs += [] if calibration is None else [calibration]
        run.finish(summary, source=f"{left} {right}", inputs=inputs)
    return result


def _rectified_name(path: Path) -> str:
    """Return the name of an image in its own file type; PNG for the types that are not written."""
    return path.name if path.suffix.lower() in _KEPT_TYPES else f"{path.stem}.png"


def _warnings(summary: dict[str, Any], images: ImagePairs) -> list[str]:
    lines = []
    if summary["up_to_scale"]:
        lines.append("without a calibration: rows correspond, but depth is up to scale, no metres")
    if summary.get("model") == "raw":
        lines.append("rows correspond as recorded: the images are written unchanged")
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
