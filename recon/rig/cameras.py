"""Two cameras, or one with both views, as a source of pairs that arrive while a drive goes on."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from recon.core.errors import SettingsError, SourceError
from recon.core.text import is_count
from recon.core.values import Rig, StereoPair
from recon.rig.capture import (
    CaptureSettings,
    RecordingSettings,
    capture_pairs,
    open_cameras,
    warm_up,
)
from recon.sources.calibration import CALIBRATE, read_rig
from recon.sources.opencv_camera import Camera
from recon.sources.settings import SourceSettings
from recon.sources.source import StereoSource


class CameraSource(StereoSource):
    """The pairs that cameras take from now on; live if none of them is a video file.

    ``files`` are what the calibration was read from; ``stopped`` is asked before each pair.
    """

    name: str
    calibration: Rig
    files: Sequence[Path]
    description = "pairs from cameras"

    def __init__(
        self,
        cameras: tuple[Camera, ...],
        settings: RecordingSettings,
        calibration: Rig,
        files: Sequence[Path] = (),
        stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        self._cameras, self._settings, self._stopped = cameras, settings, stopped
        self.calibration, self.files = calibration, files
        self.name = " and ".join(camera.name for camera in cameras)
        self.live = all(camera.live for camera in cameras)

    def __len__(self) -> int:
        """Return the largest number of pairs; 0 = not known."""
        return self._settings.frames or 0

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pairs from now on, numbered from 0; the first ``start`` are left out."""
        taken = capture_pairs(self._cameras, self._settings, self._stopped)
        for index, pair in islice(enumerate(taken), start, None):
            yield StereoPair(pair.left, pair.right, pair.left_s, index, f"frame {index}")


def is_camera(name: str) -> bool:
    """Return whether a name is that of a camera, not of a recording: a number, a device, a URL."""
    number = is_count(name) and not Path(name).exists()
    return number or "://" in name or name.startswith("/dev/")


@contextmanager
def open_camera_source(
    devices: Iterable[str],
    settings: CaptureSettings,
    source: SourceSettings,
    stopped: Callable[[], bool] = lambda: False,
) -> Iterator[CameraSource]:
    """Open cameras as a source, for the body of a ``with`` statement.

    ``source`` names the calibration; its ``end`` is the number of pairs. See `CameraSource`.
    """
    if source.shift_frames:
        raise SettingsError(
            "images of cameras are paired as they are taken",
            where="source.shift_frames",
            got=source.shift_frames,
            expected=0,
            hint="record them with recon capture, and map the recording with it",
        )
    recording = RecordingSettings.parse(
        {**dict(settings), "side_by_side": source.side_by_side, "frames": source.end}
    )
    with open_cameras(devices, settings) as cameras:
        where = " and ".join(camera.name for camera in cameras)
        if not source.has_camera:
            raise SourceError("cameras need a calibration", where=where, hint=CALIBRATE)
        warm_up(cameras, recording)
        first = next(capture_pairs(cameras, recording, stopped), None)
        if first is None:
            raise SourceError("the cameras give no pair", where=where)
        height_px, width_px = first.left.shape[:2]
        rig, files = read_rig(source, Path(), (width_px, height_px))
        yield CameraSource(cameras, recording, rig, files, stopped)
