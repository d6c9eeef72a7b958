"""`recon calibrate`: images of a board in, a calibration file and its verdict out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig
from recon.core.errors import OutputError, SourceError
from recon.core.values.board import CalibrationBoard
from recon.io.atomic import check_targets
from recon.io.cameras.ros import camera_info_paths
from recon.io.images.image import write_image
from recon.report.calibration_page import write_calibration_page, write_epipolar_images
from recon.rig.calibrate.board_views import find_views, is_video, pick_views
from recon.rig.calibrate.bootstrap import measure_spread
from recon.rig.calibrate.result import (
    CalibrationForm,
    CalibrationRun,
    describe_calibration,
    write_calibration,
)
from recon.rig.calibrate.stereo import calibrate_stereo
from recon.rig.calibrate.verdict import judge_calibration, verdict_of_calibration
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


def run_calibrate(
    left: str,
    right: str | None,
    board: CalibrationBoard,
    config: ReconConfig,
    *,
    file: Path | None = None,
    form: CalibrationForm = "recon",
    out: Path | None = None,
    threads: int | None = None,
) -> CalibrationRun:
    """Calibrate a rig from images of a board: what `recon calibrate` does.

    Still views are picked from videos, and the board is found in all images. Cameras and rig are
    fitted to its corners, without the views that do not fit; drawing views at random says how
    sure the fit is. What it will do to depth gives the verdict.

    Args:
        left: Folder or pattern of the left images, or the left video, or one with both views.
        right: The same of the right camera; None if one video has both views.
        board: The board that they show.
        config: The configuration.
        file: The calibration file; None = only ``calibration.yaml`` in the result folder.
        form: Its format.
        out: Folder for report, images and figures; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Does not change results.
    """
    _check_file(file)
    videos = _videos(left, right)
    images = ImagePairs((), by_order=False) if videos else pair_images(left, right or "")
    inputs = videos or [path for pair in images.pairs for path in pair]
    if file is not None:
        check_targets(camera_info_paths(file) if form == "ros" else [file], inputs)
    with Run("calibrate", out, config, threads=threads) as run:
        if videos:
            with run.stage("pick"):
                images = pick_views(videos, config.source, run.path)
        with run.stage("find"):
            seen = find_views(images, board, run.threads)
        with run.stage("solve"), serial_algebra():
            fit = calibrate_stereo(seen.views, seen.size_px, config.calibration)
        with run.stage("bootstrap"), serial_algebra():
            spread = measure_spread(fit, config.calibration)
        result = describe_calibration(seen, fit, spread, config)
        summary = result.summary
        summary["model"] = config.calibration.model
        findings = judge_calibration(seen.board, images, summary)
        summary["verdict"] = verdict_of_calibration(findings)
        summary["findings"] = [asdict(finding) for finding in findings]
        summary["frames_left_out"] = len(images.lonely)
        summary["warnings"] = [finding.text for finding in findings]
        write_calibration(run.path("calibration.yaml"), result, "recon")
        if file is not None:
            summary["files"] = [str(path) for path in write_calibration(file, result, form)]
        with run.report(summary):
            write_calibration_page(result, run)
        run.finish(
            summary,
            source=" ".join(filter(None, (left, right))),
            inputs=inputs,
            record={"board": str(seen.board)},
        )
    return result


def _videos(left: str, right: str | None) -> list[Path]:
    """Return the arguments if they are videos, else nothing."""
    sides = [side for side in (left, right) if side is not None]
    videos = [Path(side) for side in sides if is_video(side)]
    if len(videos) != len(sides) and (videos or right is None):
        raise SourceError(
            "two folders, two patterns, two videos, or one video with both views are needed",
            where=next(side for side in sides if not is_video(side)),
            hint="recon calibrate LEFT RIGHT --board …",
        )
    return videos


def _check_file(path: Path | None) -> None:
    if path is not None and path.is_dir():
        raise OutputError(
            "the calibration file is a folder",
            where=path,
            hint=f"--out {path / 'calibration.yaml'}; pictures and report go to --report",
        )


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
