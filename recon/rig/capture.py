"""Pairs from two cameras, or from one that gives both views side by side: recorded, or mapped live.

Both cameras are grabbed before either frame is decoded, to keep the exposures close. Recordings
have the layout of plain folders (see `folders`); the line of a pair in ``frames.csv`` is written
last and marks it as complete.
"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field
from typing_extensions import Self

from recon.core.errors import OutputError, ReconError, SettingsError, SourceError
from recon.core.settings import Settings
from recon.core.summary import Figures, Rows, Summary, inline, optional, shown_path
from recon.core.text import counted, is_count
from recon.core.values import Rig, StereoPair
from recon.core.values.arrays import UInt8, size_text
from recon.io.images.image import write_image
from recon.io.trajectory import FRAMES, HEADER, CapturedFrame
from recon.sources.calibration import CALIBRATE, read_rig
from recon.sources.live import Camera
from recon.sources.settings import SideBySide, SourceSettings
from recon.sources.source import StereoSource
from recon.sources.video import split_views

_USUAL_RATE_HZ: Final = 30.0  # assumed if a driver does not report its rate
_WARM_UP_FRAMES: Final = 15  # frames dropped at the start, while the exposure adapts
_WAITING: Final = 32  # pairs to be written; more would only hide that the disk is too slow
_GAP_PERIODS: Final = 1.5  # a longer time step means that a frame was lost


_Length = Annotated[int, Field(ge=16, le=100000)]


class CaptureSettings(Settings):
    """Settings of a recording."""

    size_px: tuple[_Length, _Length] | None = None
    """Requested width and height of frames. none = the driver's default."""
    rate_hz: float | None = Field(None, ge=0.001, le=1000000.0)
    """Requested frame rate. none = the driver's default."""
    lock_exposure: bool = True
    """Lock exposure and white balance if the driver supports it. Turn it off where the light
    changes during the drive."""
    suffix: Literal["png", "jpg"] = "png"
    """File format: png = lossless, jpg = for a slow disk."""


class RecordingSettings(CaptureSettings):
    """The settings of one recording, how the views of one device lie, and when it ends."""

    side_by_side: SideBySide = "left-right"
    """Arrangement of the views in the frames of one device."""

    frames: int | None = Field(None, ge=1, le=1_000_000_000)
    """Stop after this many pairs."""
    seconds: float | None = Field(None, ge=0.001, le=1_000_000_000.0)
    """Stop after this many seconds."""
    preview_every: int | None = Field(None, ge=1, le=1_000_000_000)
    """Update preview.jpg every N pairs. None = no preview."""


@dataclass(frozen=True, eq=False)
class CapturedPair:
    """One pair of frames from the cameras: uint8 (H, W, 3) RGB, and their times."""

    left: UInt8
    right: UInt8
    left_s: float
    right_s: float


@contextmanager
def open_cameras(devices: Iterable[str], settings: CaptureSettings) -> Iterator[tuple[Camera, ...]]:
    """Open a left and a right camera, or one with both views, by number, path or address."""
    with ExitStack() as stack:
        cameras: list[Camera] = []
        for device in devices:
            cameras.append(Camera(device, settings.size_px, settings.rate_hz))
            stack.callback(cameras[-1].close)
        yield tuple(cameras)


def capture_pairs(
    cameras: tuple[Camera, ...], settings: RecordingSettings, stopped: Callable[[], bool]
) -> Iterator[CapturedPair]:
    """Yield pairs until the limit is reached, a file ends, or ``stopped`` returns True.

    Where one camera loses a frame, the other drops its own, so that pairs are nearest in time.
    """
    known_hz = [camera.rate_hz for camera in cameras if np.isfinite(camera.rate_hz)]
    period_s = 1 / (settings.rate_hz or min(known_hz, default=_USUAL_RATE_HZ))
    first_s: float | None = None
    count = 0
    while not stopped() and count != settings.frames:
        stamps = _grab(cameras, period_s)
        if stamps is None:
            return
        first_s = stamps[0] if first_s is None else first_s
        if settings.seconds is not None and stamps[0] - first_s > settings.seconds:
            return
        yield CapturedPair(*_retrieve(cameras, settings), stamps[0], stamps[-1])
        count += 1


def warm_up(cameras: tuple[Camera, ...], settings: CaptureSettings) -> bool:
    """Drop the first frames of live cameras; return whether the exposure of all is locked."""
    if not all(camera.live for camera in cameras):
        return False
    for _ in range(_WARM_UP_FRAMES):
        for camera in cameras:
            camera.grab()
    if not settings.lock_exposure:
        return False
    exposure = cameras[0].lock(None)
    return exposure is not None and all(camera.lock(exposure) is not None for camera in cameras[1:])


def _grab(cameras: tuple[Camera, ...], period_s: float) -> list[float] | None:
    """Grab frames taken together and return their timestamps; None at the end of a file."""
    stamps = [camera.grab() for camera in cameras]
    while all(stamp is not None for stamp in stamps):
        times = [stamp for stamp in stamps if stamp is not None]
        if max(times) - min(times) <= period_s / 2:
            return times
        earlier = int(np.argmin(times))
        stamps[earlier] = cameras[earlier].grab()
    silent = cameras[stamps.index(None)]
    if silent.live:
        hint = "check its cable and power"
        raise SourceError("camera gives no more frames", where=silent.name, hint=hint)
    return None


def _retrieve(cameras: tuple[Camera, ...], settings: RecordingSettings) -> tuple[UInt8, UInt8]:
    images = [camera.retrieve() for camera in cameras]
    if len(images) == 1:
        stacked = settings.side_by_side in {"top-bottom", "bottom-top"}
        if images[0].shape[0 if stacked else 1] % 2:
            got = size_text(images[0])
            raise SourceError("frames cannot be halved", where=cameras[0].name, got=got)
        return split_views(images[0], SourceSettings(side_by_side=settings.side_by_side))
    if images[0].shape != images[1].shape:
        raise SourceError(
            "cameras differ in frame size",
            where=cameras[1].name,
            got=f"left {size_text(images[0])}, right {size_text(images[1])}",
            hint="request the same size from both with --size",
        )
    return images[0], images[1]


@dataclass(frozen=True, kw_only=True)
class CaptureFigures(Figures):
    """How many pairs were recorded, and how regularly."""

    frames: int
    seconds: float  # from the first pair to the last
    rate_hz: float | None
    gaps: int
    skew_mean_ms: float | None  # difference in time between the cameras
    skew_max_ms: float | None


@dataclass(frozen=True, kw_only=True)
class CaptureSummary(Summary):
    """What `recon capture` recorded: the content of ``capture.json``."""

    started_utc: str
    devices: Sequence[str]
    exposure_locked: bool
    figures: CaptureFigures = inline()
    calibration: bool  # whether it lies in the folder
    board: str | None = optional()  # what the views of a board lack
    out: str

    def rows(self) -> Rows:
        seen = self.figures
        rate = (
            ""
            if seen.rate_hz is None
            else f" at {seen.rate_hz:.3g} Hz, {counted(seen.gaps, 'gap')}"
        )
        skew = seen.skew_max_ms
        apart = "" if skew is None else f"left and right at most {skew:.1f} ms apart"
        calibrated = "" if self.calibration else " --calib CALIBRATION"
        return [
            (f"{counted(seen.frames, 'pair')} in {seen.seconds:.1f} s{rate}",),
            ("folder", self.out),
            *([("time", apart)] if apart else []),
            *([("board", self.board)] if self.board else []),
            ("next", f"recon audit {shown_path(self.out)}{calibrated}"),
        ]


class CaptureFolder:
    """The folder a capture is written to, pair by pair, each wholly or not at all."""

    def __init__(self, folder: Path, suffix: str) -> None:
        self.folder, self._suffix = folder, suffix
        self._left_s: list[float] = []
        self._right_s: list[float] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                hint = "give a new one with --out"
                raise OutputError("folder is not empty", where=folder, hint=hint)
            self._list = os.open(folder / FRAMES, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            self._length = os.write(self._list, HEADER.encode())
        except OSError as error:
            what = "folder cannot be written"
            raise OutputError(what, where=folder, got=error.strerror) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        os.fsync(self._list)
        os.close(self._list)
        if kind is not None and self.frames == 0:
            (self.folder / FRAMES).unlink()
            with suppress(OSError):  # it holds a preview
                self.folder.rmdir()

    @property
    def frames(self) -> int:
        """Number of pairs that were written."""
        return len(self._left_s)

    def add(self, pair: CapturedPair) -> None:
        """Write both images, then their line in the list."""
        name = f"{self.frames:06d}.{self._suffix}"
        frame = CapturedFrame(f"left/{name}", f"right/{name}", pair.left_s, pair.right_s)
        try:
            write_image(self.folder / frame.left, pair.left)
            write_image(self.folder / frame.right, pair.right)
            self._append(frame.line().encode())
        except OutputError:
            for written in (frame.left, frame.right):
                (self.folder / written).unlink(missing_ok=True)
            raise
        self._left_s.append(pair.left_s)
        self._right_s.append(pair.right_s)

    def preview(self, pair: CapturedPair) -> None:
        """Replace ``preview.jpg`` by both images side by side."""
        write_image(self.folder / "preview.jpg", np.hstack([pair.left, pair.right]))

    @property
    def figures(self) -> CaptureFigures:
        left_s, frames = np.array(self._left_s), self.frames
        steps_s, skew_s = np.diff(left_s), np.abs(np.array(self._right_s) - left_s)
        period_s = float(np.median(steps_s)) if frames > 1 else None
        return CaptureFigures(
            frames=frames,
            seconds=float(left_s[-1] - left_s[0]) if frames else 0.0,
            rate_hz=1 / period_s if period_s else None,
            gaps=int((steps_s > _GAP_PERIODS * period_s).sum()) if period_s else 0,
            skew_mean_ms=1000 * float(skew_s.mean()) if frames else None,
            skew_max_ms=1000 * float(skew_s.max()) if frames else None,
        )

    def _append(self, line: bytes) -> None:
        try:
            written = os.write(self._list, line)
            if written < len(line):  # a short write: the disk became full
                written += os.write(self._list, line[written:])
        except OSError as error:
            os.ftruncate(self._list, self._length)
            os.lseek(self._list, self._length, os.SEEK_SET)
            raise OutputError(
                "list of frames cannot be written",
                where=self.folder / FRAMES,
                got=error.strerror or str(error),
                hint="check that the disk is not full",
            ) from error
        self._length += written


def write_pairs(
    pairs: Iterable[CapturedPair], target: CaptureFolder, preview_every: int | None
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
                if preview_every and (target.frames - 1) % preview_every == 0:
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


class CameraSource(StereoSource):
    """The pairs that cameras take from now on; live if none of them is a video file."""

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
