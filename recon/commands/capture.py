"""`recon capture`: record cameras into a folder of pairs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from recon.core.errors import FormatError
from recon.io.atomic import write_text
from recon.rig.capture import (
    CaptureFolder,
    CaptureLog,
    RecordingSettings,
    capture_pairs,
    open_cameras,
    warm_up,
    write_pairs,
)
from recon.sources.opencv_camera import Camera


def run_capture(
    devices: Iterable[str],
    folder: Path,
    settings: RecordingSettings,
    *,
    calibration: Path | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Record until told to stop; with a calibration, the folder can be mapped as it is.

    Args:
        devices: Left and right camera, or one with both views: numbers, paths or video files.
        folder: Output folder; must be new or empty.
        settings: Image size, frame rate, duration.
        calibration: File to copy into the folder.
        stopped: Called before each pair; True ends the recording.

    Returns:
        The figures, as written to ``capture.json`` in the folder.
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
    log = CaptureLog()
    with CaptureFolder(folder, settings.suffix) as target:
        if calibration is not None:
            shutil.copyfile(calibration, folder / f"calibration{calibration.suffix}")
        locked = warm_up(cameras, settings)
        try:
            write_pairs(capture_pairs(cameras, settings, stopped), target, settings, log)
        finally:
            summary = {
                "started_utc": started,
                "devices": [camera.name for camera in cameras],
                "exposure_locked": locked,
                **log.figures,
                "calibration": calibration is not None,
                "out": str(folder),
            }
            # An empty recording has no summary.
            if target.frames:
                _write_summary(folder, summary)
    return summary


def _write_summary(folder: Path, summary: dict[str, Any]) -> None:
    write_text(folder / "capture.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
