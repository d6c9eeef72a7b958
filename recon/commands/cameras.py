"""Rigs and their recordings: `recon calibrate`, `rectify`, `capture` and `audit`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Final

from recon.commands.config import ReconConfig
from recon.core.errors import FormatError, OutputError, SourceError
from recon.core.progress import tracked
from recon.core.values.board import CalibrationBoard
from recon.core.work import serial_algebra
from recon.io.atomic import check_targets, write_text
from recon.io.files import StrPath
from recon.io.images.image import write_image
from recon.report.audit_page import write_audit_page
from recon.report.calibration_page import write_calibration_page, write_epipolar_images
from recon.rig.audit import Audit, audit_source, correct_calibration
from recon.rig.calibrate.board_views import find_views, is_video, pick_views
from recon.rig.calibrate.guide import BoardGuide, guided
from recon.rig.calibrate.lenses import compare_lenses
from recon.rig.calibrate.stereo import calibrate_stereo, measure_spread
from recon.rig.calibrate.verdict import (
    CalibrationResult,
    describe_calibration,
    write_calibration,
)
from recon.rig.capture import (
    CaptureFolder,
    CaptureSummary,
    RecordingSettings,
    capture_pairs,
    open_cameras,
    warm_up,
    write_pairs,
)
from recon.rig.rectification import (
    RectifyResult,
    measure_epipolar,
    plan_by_calibration,
    plan_by_features,
    read_pairs,
)
from recon.rig.written import CalibrationForm, targets_of
from recon.run.run import Run
from recon.sources.images import ImagePairs, pair_images
from recon.sources.live import Camera
from recon.sources.one_pair import read_pair
from recon.sources.source import StereoSource
from recon.stereo.match.registry import make_matcher


def run_calibrate(
    left: str,
    right: str | None,
    board: CalibrationBoard,
    config: ReconConfig,
    *,
    file: Path | None = None,
    form: CalibrationForm | None = None,
    out: Path | None = None,
    threads: int | None = None,
) -> CalibrationResult:
    """Calibrate a rig from images of a board: what `recon calibrate` does.

    Still views are picked from videos, and the board is found in all images. Cameras and rig are
    fitted to its corners, without the views that do not fit; drawing views at random says how
    sure the fit is. What it will do to depth gives the verdict.

    ``left`` and ``right`` are folders, patterns or videos; ``right`` None: ``left`` is one video
    with both views. The calibration is also written to ``file``, in its ``form`` (None = that of
    its name); ``out`` gets report, images and figures.
    """
    if file is not None and file.is_dir():
        hint = f"--out {file / 'calibration.yaml'}; pictures and report go to --report"
        raise OutputError("the calibration file is a folder", where=file, hint=hint)
    videos = _videos(left, right)
    images = ImagePairs((), by_order=False) if videos else pair_images(left, right or "")
    inputs = videos or [path for pair in images.pairs for path in pair]
    if file is not None:
        check_targets(targets_of(file, form), inputs)
    with Run("calibrate", out, config, threads=threads) as run:
        if videos:
            with run.stage("pick"):
                images = pick_views(videos, config.source, run.path)
        with run.stage("find"):
            seen = find_views(images, board, run.threads)
        with run.stage("solve"), serial_algebra():
            circle_m = board.marker_m if board.kind in ("circles", "acircles") else 0.0
            fit = calibrate_stereo(seen.views, seen.size_px, config.calibration, circle_m)
        with run.stage("bootstrap"), serial_algebra():
            spread = measure_spread(fit, config.calibration)
        with run.stage("compare"), serial_algebra():
            lenses = compare_lenses(fit, seen.size_px, config.calibration)
        result = describe_calibration(seen, fit, spread, config, images, lenses)
        write_calibration(run.path("calibration.yaml"), result, "recon")
        summary = result.summary
        if file is not None:
            summary = replace(summary, files=[str(path) for path in targets_of(file, form)])
        with run.report(summary) as summary:
            write_calibration_page(replace(result, summary=summary), run)
        source, record = " ".join(filter(None, (left, right))), {"board": str(seen.board)}
        summary = run.finish(summary, source=source, inputs=inputs, record=record)
        if file is not None:  # last: an interrupted run leaves nothing
            write_calibration(file, result, form)
    return replace(result, summary=summary)


def _videos(left: str, right: str | None) -> list[Path]:
    sides = [side for side in (left, right) if side is not None]
    videos = [Path(side) for side in sides if is_video(side)]
    if len(videos) != len(sides) and (videos or right is None):
        raise SourceError(
            "two folders, two patterns, two videos, or one video with both views are needed",
            where=next(side for side in sides if not is_video(side)),
            hint="recon calibrate LEFT RIGHT --board …",
        )
    return videos


_KEPT_TYPES: Final = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})


def run_rectify(
    left: str,
    right: str,
    config: ReconConfig,
    *,
    calibration: Path | None = None,
    metres_per_unit: float | None = None,
    out: Path | None = None,
    threads: int | None = None,
) -> RectifyResult:
    """Rectify a pair, or all pairs of two folders: what `recon rectify` does.

    A calibration file says how, or else the features of some of the pairs. All images are warped;
    then the epipolar errors of the first pair are measured, and drawn with its epipolar lines.

    ``left`` and ``right`` are images, folders or patterns; ``metres_per_unit`` is the unit of the
    translation in an OpenCV file.
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
            pairs = tracked(read_pairs(images), "pairs", total=len(images.pairs))
            for pair, (left_file, right_file) in pairs:
                left_image, right_image = plan.warp(pair)
                write_image(run.path(f"left/{_rectified_name(left_file)}"), left_image)
                write_image(run.path(f"right/{_rectified_name(right_file)}"), right_image)
        plan.write(run.content)
        first = read_pair(*images.pairs[0])
        result = measure_epipolar(plan, first, images)
        with run.report(result.summary) as summary:
            write_epipolar_images(result, run)
        inputs = [file for files in images.pairs for file in files]
        inputs += [] if calibration is None else [calibration]
        summary = run.finish(summary, source=f"{left} {right}", inputs=inputs)
    return replace(result, summary=summary)


def _rectified_name(path: Path) -> str:
    """Return the name of an image in its own file type; PNG for the types that are not written."""
    return path.name if path.suffix.lower() in _KEPT_TYPES else f"{path.stem}.png"


def run_capture(
    devices: Iterable[str],
    folder: Path,
    settings: RecordingSettings,
    *,
    calibration: Path | None = None,
    board: CalibrationBoard | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> CaptureSummary:
    """Record until stopped; with a calibration, the folder can be mapped as it is.

    ``devices`` are left and right camera, or one with both views: numbers, paths or video files.
    The folder must be new or empty; its ``capture.json`` gets the figures that are returned.
    ``stopped`` is called before each pair. With a ``board``, it says while recording which views
    are missing.
    """
    if calibration is not None and not calibration.is_file():
        raise FormatError("file does not exist", where=calibration)
    with open_cameras(devices, settings) as cameras:
        return record(cameras, folder, settings, calibration, stopped, board)


def record(
    cameras: tuple[Camera, ...],
    folder: Path,
    settings: RecordingSettings,
    calibration: Path | None,
    stopped: Callable[[], bool],
    board: CalibrationBoard | None = None,
) -> CaptureSummary:
    """Record from opened cameras; see `run_capture`."""
    guide = None if board is None else BoardGuide(board)
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    with CaptureFolder(folder, settings.suffix) as target:
        if calibration is not None:
            shutil.copyfile(calibration, folder / f"calibration{calibration.suffix}")
        locked = warm_up(cameras, settings)
        try:
            pairs = capture_pairs(cameras, settings, stopped)
            shown = tracked(pairs, "pairs", "record", total=settings.frames)
            shown = shown if guide is None else guided(shown, guide)
            write_pairs(shown, target, settings.preview_every)
        finally:
            summary = CaptureSummary(
                started_utc=started,
                devices=[camera.name for camera in cameras],
                exposure_locked=locked,
                figures=target.figures,
                calibration=calibration is not None,
                board=None if guide is None else guide.advice(),
                out=str(folder),
            )
            if target.frames:  # else it has no summary
                text = json.dumps(summary.to_json(), indent=2, allow_nan=False) + "\n"
                write_text(folder / "capture.json", text)
    return summary


def run_audit(
    source: StereoSource,
    config: ReconConfig,
    *,
    quick: bool = False,
    repair: StrPath | None = None,
    out: StrPath | None = None,
) -> Audit:
    """Check a recording before a long run: what `recon audit` does.

    Some segments of the recording are read, and features are matched in some of their pairs. What
    they say of rows, time, exposure, focus and calibration gives findings and a verdict.

    Args:
        source: The recording.
        config: The configuration; its ``audit``, ``rectification`` and ``matching`` are used.
        quick: A short check of a second or two, as `recon map` makes it.
        repair: File for the rig that features and motion show, in the format that its name asks for
            (`recon.rig.written`); None = none is written.
        out: Folder for a report with images; None = none is written.

    Raises:
        CalibrationError: The calibration cannot rectify anything, or there are too few features to
            correct it.
        ReconError: The calibration or the report cannot be written, or would replace a file of the
            recording.
    """
    if repair is not None:
        check_targets(targets_of(Path(repair)), source.files)
    audit = audit_source(source, config, quick=quick)
    if repair is not None:
        audit = replace(audit, corrected=correct_calibration(source, config, audit, Path(repair)))
    if out is not None:
        matcher = make_matcher(config.matching.matcher, config.matching, None)
        with Run("audit", out, config) as run:
            with run.report(audit.summary) as summary:
                write_audit_page(audit, source, matcher, run)
            record = {"warnings": [finding.text for finding in audit.findings]}
            run.finish(summary, source=source.name, inputs=source.files, record=record)
    return audit
