"""The folder a capture is written to, pair by pair and in a thread; valid at any moment."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from typing_extensions import Self

from recon.core.errors import OutputError, ReconError
from recon.io.frames_csv import FRAMES, HEADER, CapturedFrame
from recon.io.images.image import write_image
from recon.rig.capture import CapturedPair, RecordingSettings

# Length of the write queue: a longer one would only hide that the disk is too slow.
_WAITING: Final = 32
# A time step longer than this many periods means that a frame was lost.
_GAP_PERIODS: Final = 1.5


class CaptureFolder:
    """Appends pairs; a pair that cannot be written completely is removed again."""

    def __init__(self, folder: Path, suffix: str) -> None:
        self.folder, self._suffix = folder, suffix
        self.frames = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.iterdir()):
                raise OutputError(
                    "folder is not empty", where=folder, hint="give a new one with --out"
                )
            self._list = os.open(folder / FRAMES, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
            self._length = os.write(self._list, HEADER.encode())
        except OSError as error:
            raise OutputError(
                "folder cannot be written", where=folder, got=error.strerror
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        os.fsync(self._list)
        os.close(self._list)
        if kind is not None and self.frames == 0:
            (self.folder / FRAMES).unlink()
            with suppress(OSError):  # it holds a preview
                self.folder.rmdir()

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
        self.frames += 1

    def preview(self, pair: CapturedPair) -> None:
        """Replace ``preview.jpg`` by both images side by side."""
        write_image(self.folder / "preview.jpg", np.hstack([pair.left, pair.right]))

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


@dataclass(eq=False)
class CaptureLog:
    """Timestamps of the pairs that were written."""

    left_s: list[float] = field(default_factory=list)
    right_s: list[float] = field(default_factory=list)

    def add(self, pair: CapturedPair) -> None:
        """Note a pair that was written."""
        self.left_s.append(pair.left_s)
        self.right_s.append(pair.right_s)

    @property
    def figures(self) -> dict[str, Any]:
        """Number of pairs, rate, gaps and difference in time between the cameras."""
        left_s, right_s = np.array(self.left_s), np.array(self.right_s)
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


def write_pairs(
    pairs: Iterable[CapturedPair],
    target: CaptureFolder,
    settings: RecordingSettings,
    log: CaptureLog,
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
