"""`recon capture` without its command line: record cameras into a folder of pairs."""

from __future__ import annotations

import json
import queue
import shutil
import threading
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, ReconError
from recon.io.atomic import write_text
from recon.rig.capture import CapturedPair, Recording, capture_pairs, warm_up
from recon.rig.capture_folder import CaptureFolder
from recon.sources.opencv_camera import Camera, OpenCvCamera

# Length of the write queue: a longer one would only hide that the disk is too slow.
_WAITING: Final = 32
# A time step longer than this many periods means that a frame was lost.
_GAP_PERIODS: Final = 1.5


@dataclass(eq=False)
class _Log:
    """Timestamps of the pairs that were written."""

    left_s: list[float] = field(default_factory=list)
    right_s: list[float] = field(default_factory=list)

    def add(self, pair: CapturedPair) -> None:
        self.left_s.append(pair.left_s)
        self.right_s.append(pair.right_s)


def run_capture(
    devices: Iterable[str],
    folder: Path,
    settings: Recording,
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

    Raises:
        SourceError: A camera cannot be opened, or stops; what was recorded before stays.
        OutputError: The folder cannot be written; what was written before stays.
        FormatError: There is no such calibration file.
    """
    if calibration is not None and not calibration.is_file():
        raise FormatError("file does not exist", where=calibration)
    size = (settings.width_px, settings.height_px)
    asked = None if None in size else (int(size[0] or 0), int(size[1] or 0))
    with ExitStack() as stack:
        cameras: list[Camera] = []
        for device in devices:
            cameras.append(OpenCvCamera(device, asked, settings.rate_hz))
            stack.callback(cameras[-1].close)
        return record(tuple(cameras), folder, settings, calibration, stopped)


def record(
    cameras: tuple[Camera, ...],
    folder: Path,
    settings: Recording,
    calibration: Path | None,
    stopped: Callable[[], bool],
) -> dict[str, Any]:
    """Record from opened cameras; see `run_capture`."""
    started = datetime.now(timezone.utc).isoformat(timespec="seconds")
    log = _Log()
    with CaptureFolder(folder, settings.suffix) as target:
        if calibration is not None:
            shutil.copyfile(calibration, folder / f"calibration{calibration.suffix}")
        locked = warm_up(cameras, settings)
        try:
            _write_all(capture_pairs(cameras, settings, stopped), target, settings, log)
        finally:
            summary = {
                "started_utc": started,
                "devices": [camera.name for camera in cameras],
                "exposure_locked": locked,
                **_figures(log),
                "calibration": calibration is not None,
                "out": str(folder),
            }
            # An empty recording has no summary.
            if target.frames:
                _write_summary(folder, summary)
    return summary


def _write_all(
    pairs: Iterable[CapturedPair], target: CaptureFolder, settings: Recording, log: _Log
) -> None:
    """Write in a second thread, so that the disk does not block the cameras."""
    waiting: queue.Queue[CapturedPair | None] = queue.Queue(_WAITING)
    failed: list[Exception] = []

    def work() -> None:
        while (pair := waiting.get()) is not None:
            if failed:
                continue  # keep draining the queue, so that the other thread does not block
            try:
                target.add(pair)
                log.add(pair)
                if settings.preview_every and (target.frames - 1) % settings.preview_every == 0:
                    target.preview(pair)
            except (ReconError, OSError, MemoryError) as error:
                failed.append(error)

    writer = threading.Thread(target=work, name="capture-writer")
    writer.start()
    try:
        for pair in pairs:
            if failed:
                break
            waiting.put(pair)
    finally:
        waiting.put(None)
        writer.join()
    if failed:
        raise failed[0]


def _figures(log: _Log) -> dict[str, Any]:
    left_s, right_s = np.array(log.left_s), np.array(log.right_s)
    frames = len(left_s)
    steps_s, skew_s = np.diff(left_s), np.abs(right_s - left_s)
    period_s = float(np.median(steps_s)) if frames > 1 else None
    return {
        "frames": frames,
        "seconds": float(left_s[-1] - left_s[0]) if frames else 0.0,
        "rate_hz": 1 / period_s if period_s else None,
        "gaps": int((steps_s > _GAP_PERIODS * period_s).sum()) if period_s else 0,
        "skew_mean_ms": 1000 * float(skew_s.mean()) if frames else None,
        "skew_max_ms": 1000 * float(skew_s.max()) if frames else None,
    }


def _write_summary(folder: Path, summary: dict[str, Any]) -> None:
    write_text(folder / "capture.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
