"""`recon calibrate` without its command line: from images of a board to a calibration file."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from recon.commands.config import ReconConfig, dump_config
from recon.core.errors import OutputError, SourceError
from recon.core.values.arrays import Float64
from recon.core.values.board import CalibrationBoard
from recon.io.atomic import write_text
from recon.io.cameras.camera_info import write_camera_info
from recon.io.cameras.kalibr import write_kalibr
from recon.io.cameras.opencv_yaml import write_opencv_calibration
from recon.io.cameras.recon_yaml import write_recon_calibration
from recon.rig.calibrate import (
    Spread,
    StereoFit,
    View,
    calibrate_stereo,
    measure_spread,
    shared_pixels,
)
from recon.rig.calibrate.board_video import is_video, pick_views
from recon.rig.calibrate.board_views import BoardViews, find_views
from recon.rig.calibrate.summary import summarise
from recon.rig.calibrate.verdict import judge_calibration, verdict_of_calibration
from recon.run.directory import RunDirectory
from recon.run.machine import serial_algebra, use_threads
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost
from recon.sources.image_pairs import ImagePairs, pair_images
from recon.stereo.rectify import RectifyingTurns, plan_turns

CalibrationForm = Literal["recon", "opencv", "ros", "kalibr"]

# Figures that are also written into the calibration file.
_KEPT: Final = (
    "verdict", "board", "stereo_rms_px", "epipolar_px", "baseline_interval_m", "focal_interval_px",
    "views_used", "views_dropped", "depth_error_cm",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CalibrationRun:
    """The results of a run.

    Attributes:
        board: The board.
        config: The configuration.
        seen: The views of the board.
        fit: The calibrated rig.
        spread: Its bootstrap intervals.
        turns: Its rectifying rotations.
        rows_px: float64 (N,), row errors of all corners after rectification.
        summary: The figures of ``summary.json``.
    """

    board: CalibrationBoard
    config: ReconConfig
    seen: BoardViews
    fit: StereoFit
    spread: Spread
    turns: RectifyingTurns
    rows_px: Float64
    summary: dict[str, Any]


@dataclass(frozen=True)
class CalibrateOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        file: The calibration file; None = only ``calibration.yaml`` in the run's folder.
        form: Its format.
        folder: Folder for report, images and figures; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Does not change results.
        present: Writes the images and the report of the run into its folder.
    """

    file: Path | None = None
    form: CalibrationForm = "recon"
    folder: Path | None = None
    threads: int | None = None
    present: Callable[[CalibrationRun, RunDirectory], None] | None = None


def run_calibration(
    left: str,
    right: str | None,
    board: CalibrationBoard,
    config: ReconConfig,
    options: CalibrateOptions,
) -> CalibrationRun:
    """Calibrate a rig from images of a board.

    Args:
        left: Folder or pattern of the left images, or the left video, or one with both views.
        right: The same of the right camera; None if one video has both views.
        board: The board that they show.
        config: The configuration.
        options: Output files and threads.

    Raises:
        ReconError: The images do not pair up, do not show the board, or fit no rig, or a file
            cannot be written; then no output is left behind.
    """
    start = time.perf_counter()
    threads, watch = use_threads(options.threads), Stopwatch()
    _check_file(options.file)
    videos = _videos(left, right)
    pictures = ImagePairs((), by_order=False) if videos else pair_images(left, right or "")
    with RunDirectory.for_command("calibrate", options.folder) as directory:
        if videos:
            with watch.stage("pick"):
                pictures = pick_views(videos, config.source, directory.path)
        with watch.stage("find"):
            seen = find_views(pictures, board, threads)
        with watch.stage("solve"), serial_algebra():
            fit = calibrate_stereo(seen.views, seen.size_px, config.calibration)
        with watch.stage("bootstrap"), serial_algebra():
            spread = measure_spread(fit, config.calibration)
        run = _run(config, seen, fit, spread)
        findings = judge_calibration(seen.board, pictures, run.summary)
        warnings = [finding.text for finding in findings]
        run.summary["verdict"] = verdict_of_calibration(findings)
        run.summary["findings"] = [asdict(finding) for finding in findings]
        run.summary["frames_left_out"] = len(pictures.lonely)
        run.summary["warnings"] = warnings
        _write(run, options, directory)
        run.summary.update(cost(watch, time.perf_counter() - start))
        if options.present is not None:
            with watch.stage("report"):
                options.present(run, directory)
        run.summary.update(cost(watch, time.perf_counter() - start))
        run.summary["out"] = str(directory.folder)
        directory.write_json("summary.json", run.summary)
        record = {
            "source": " ".join(filter(None, (left, right))),
            "board": str(seen.board),
            "inputs": fingerprint(videos or (path for pair in pictures.pairs for path in pair)),
            "timings": watch.seconds,
            "warnings": warnings,
        }
        write_record(directory, "calibrate", record)
    return run


def _videos(left: str, right: str | None) -> list[Path]:
    """The arguments if they are videos, else nothing."""
    sides = [side for side in (left, right) if side is not None]
    videos = [Path(side) for side in sides if is_video(side)]
    if len(videos) != len(sides) and (videos or right is None):
        raise SourceError(
            "two folders, two patterns, two videos, or one video with both views are needed",
            where=next(side for side in sides if not is_video(side)),
            hint="recon calibrate LEFT RIGHT --board …",
        )
    return videos


def _run(config: ReconConfig, seen: BoardViews, fit: StereoFit, spread: Spread) -> CalibrationRun:
    turns = plan_turns(fit.calibration, config.rectification)
    rows_px = np.concatenate([_rows_apart(turns, fit, view) for view in fit.views])
    summary = summarise(seen, fit, spread, rows_px)
    summary["rectified_focal_px"] = turns.camera.focal_px
    summary["model"] = config.calibration.model
    return CalibrationRun(seen.board, config, seen, fit, spread, turns, rows_px, summary)


def _rows_apart(turns: RectifyingTurns, fit: StereoFit, view: View) -> Float64:
    """float64 (N,), row of each corner in the rectified left image minus that in the right one."""
    left_px, right_px = shared_pixels(view)
    left = turns.place(fit.calibration, left_px)
    right = turns.place(fit.calibration, right_px, right=True)
    return np.asarray(left[:, 1] - right[:, 1])


def _write(run: CalibrationRun, options: CalibrateOptions, directory: RunDirectory) -> None:
    write_calibration(directory.path("calibration.yaml"), run, "recon")
    write_text(directory.path("config.yaml"), dump_config(run.config))
    if options.file is not None:
        files = write_calibration(options.file, run, options.form)
        run.summary["files"] = [str(path) for path in files]


def write_calibration(path: Path, run: CalibrationRun, form: CalibrationForm) -> tuple[Path, ...]:
    """Write the calibrated rig in a given format.

    Returns:
        The files: two for ROS, else one.

    Raises:
        CalibrationError: The format cannot represent the lens model.
        OutputError: A file cannot be written.
    """
    rig = run.fit.calibration
    if form == "ros":
        rotations = (run.turns.R_left, run.turns.R_right)
        return write_camera_info(path, rig, rotations, run.turns.camera)
    if form == "opencv":
        write_opencv_calibration(path, rig)
    elif form == "kalibr":
        write_kalibr(path, rig)
    else:
        write_recon_calibration(path, rig, {key: run.summary[key] for key in _KEPT})
    return (path,)


def _check_file(path: Path | None) -> None:
    if path is not None and path.is_dir():
        raise OutputError(
            "the calibration file is a folder",
            where=path,
            hint=f"--out {path / 'calibration.yaml'}; pictures and report go to --report",
        )
