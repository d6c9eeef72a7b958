"""The folder a capture is written to, pair by pair; valid at any moment."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from types import TracebackType

import numpy as np
from typing_extensions import Self

from recon.core.errors import OutputError
from recon.io.frames_csv import FRAMES, HEADER, CapturedFrame
from recon.io.images.image import write_image
from recon.rig.capture import CapturedPair


class CaptureFolder:
    """Appends pairs; a pair that cannot be written completely is removed again.

    Args:
        folder: Output folder, created if missing.
        suffix: Suffix of the image files, without the dot.

    Raises:
        OutputError: The folder is not empty, or cannot be written.
    """

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        os.fsync(self._list)
        os.close(self._list)
        if kind is not None and self.frames == 0:
            (self.folder / FRAMES).unlink()
            with suppress(OSError):  # it holds a preview
                self.folder.rmdir()

    def add(self, pair: CapturedPair) -> None:
        """Write both images, then their line in the list.

        Raises:
            OutputError: A file cannot be written, for instance because the disk is full.
        """
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
        """Replace ``preview.jpg`` by both images side by side.

        Raises:
            OutputError: The file cannot be written.
        """
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
