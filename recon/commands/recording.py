"""`recon capture` and `recon audit`: record pairs; is a recording good enough for a long run?"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from recon.commands.config import ReconConfig
from recon.core.errors import FormatError
from recon.io.atomic import check_targets, write_text
from recon.io.files import StrPath
from recon.report.audit_page import write_audit_page
from recon.rig.audit.audit import Audit, audit_source, correct_calibration
from recon.rig.capture import (
    CaptureFolder,
    RecordingSettings,
    capture_pairs,
    open_cameras,
    warm_up,
    write_pairs,
)
from recon.run.run import Run
from recon.sources.opencv_camera import Camera
from recon.sources.source import StereoSource
from recon.stereo.match.registry import make_matcher


def run_capture(
    devices: Iterable[str],
    folder: Path,
    settings: RecordingSettings,
    *,
    calibration: Path | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Record until stopped; with a calibration, the folder can be mapped as it is.

    ``devices`` are left and right camera, or one with both views: numbers, paths or video files.
    The folder must be new or empty; its ``capture.json`` gets the figures that are returned.
    ``stopped`` is called before each pair.
    """
    if calibration is not None and not calibration.is_file():
        raise FormatError("file does not exist", where=calibration)
    with open_cameras(devices, settings) as cameras:
        return record(cameras, folder, settings, calibration, stopped)


def record(
    cameras: tuple[Camera, ...],
    folder: Path,
    settings: RecordingSettings,
    calibration: Path | None,
    stopped: Callable[[], bool],
) -> dict[str, Any]:
    """Record from opened cameras; see `run_capture`."""
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    with CaptureFolder(folder, settings.suffix) as target:
        if calibration is not None:
            shutil.copyfile(calibration, folder / f"calibration{calibration.suffix}")
        locked = warm_up(cameras, settings)
        try:
            write_pairs(capture_pairs(cameras, settings, stopped), target, settings.preview_every)
        finally:
            summary = {
                "started_utc": started,
                "devices": [camera.name for camera in cameras],
                "exposure_locked": locked,
                **target.figures,
                "calibration": calibration is not None,
                "out": str(folder),
            }
            # An empty recording has no summary.
            if target.frames:
                _write_summary(folder, summary)
    return summary


def _write_summary(folder: Path, summary: dict[str, Any]) -> None:
    write_text(folder / "capture.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")


def run_audit(
    source: StereoSource,
    config: ReconConfig,
    *,
    quick: bool = False,
    mend: StrPath | None = None,
    out: StrPath | None = None,
) -> Audit:
    """Check a recording before a long run: what `recon audit` does.

    Some stretches of the recording are read, and features are matched in some of their pairs. What
    they say of rows, time, exposure, focus and calibration gives findings and a verdict.

    Args:
        source: The recording.
        config: The configuration; its ``audit``, ``rectification`` and ``matching`` are used.
        quick: A short check of a second or two, as `recon map` makes it.
        mend: File for a calibration that fits rows and motion; None = none is written.
        out: Folder for a report with images; None = none is written.

    Raises:
        CalibrationError: The calibration cannot rectify anything, or there are too few features to
            correct it.
        ReconError: The calibration or the report cannot be written, or would replace a file of the
            recording.
    """
    if mend is not None:
        check_targets([Path(mend)], source.files)
    audit = audit_source(source, config, quick=quick)
    if mend is not None:
        audit = replace(audit, corrected=correct_calibration(source, config, audit, Path(mend)))
    if out is not None:
        matcher = make_matcher(config.matching.matcher, config.matching, None)
        with Run("audit", out, config) as run:
            summary = audit.summary
            with run.report(summary):
                write_audit_page(audit, source, matcher, run)
            warnings = [finding.text for finding in audit.findings]
            record = {"warnings": warnings}
            run.finish(summary, source=source.name, inputs=source.files, record=record)
    return audit
