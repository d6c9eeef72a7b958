"""Drives stored as image files, one per camera and frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.errors import SourceError
from recon.formats.image import read_image
from recon.sources.files import join_pair
from recon.sources.pairing import natural_key
from recon.structures import (
    RectifiedCamera,
    SequenceTruth,
    StereoCalibration,
    StereoPair,
    check_size,
)
from recon.structures.arrays import Float64, UInt8

PICTURES: Final = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp"})


@dataclass(frozen=True)
class PictureFrame:
    """The two files of one frame.

    Attributes:
        left: Left image.
        right: Right image.
        timestamp_s: Exposure time stamp of the left image.
    """

    left: Path
    right: Path
    timestamp_s: float


@dataclass(frozen=True, eq=False)
class PictureSource:
    """A drive in image files, read one pair at a time.

    Attributes:
        name: Name of the folder.
        description: Recognised kind and layout, in one line.
        calibration: The rectified camera, or the two raw ones.
        pictures: The files of each frame, in order.
        truth: Ground truth trajectory, if known.
        texts: Files other than images that were read.
    """

    name: str
    description: str
    calibration: RectifiedCamera | StereoCalibration
    pictures: Sequence[PictureFrame]
    truth: SequenceTruth | None = None
    texts: tuple[Path, ...] = ()

    @property
    def files(self) -> Sequence[Path]:
        """Calibration and other text files, then the images."""
        pictures = (path for frame in self.pictures for path in (frame.left, frame.right))
        return [*self.texts, *pictures]

    @property
    def stamps_s(self) -> Float64:
        """float64 (N,), times of the left images."""
        return np.array([frame.timestamp_s for frame in self.pictures])

    def __len__(self) -> int:
        return len(self.pictures)

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Read the pairs from number ``start`` on.

        Raises:
            FormatError: An image is missing or damaged.
            CalibrationError: An image has another size than the calibration.
        """
        for index in range(start, len(self.pictures)):
            frame = self.pictures[index]
            left, right = (self._read(path) for path in (frame.left, frame.right))
            yield join_pair(left, right, frame.timestamp_s, index, frame.left.name)

    def _read(self, path: Path) -> UInt8:
        image = read_image(path)
        check_size(self.calibration, image.shape[1], image.shape[0], path)
        return image


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file.

    Raises:
        FormatError: The file is missing or damaged.
    """
    height_px, width_px = read_image(path).shape[:2]
    return width_px, height_px


def list_pictures(folder: Path) -> list[Path]:
    """The images of a folder in natural order: 2 before 10.

    Raises:
        SourceError: The folder does not exist or contains no images.
    """
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    paths = [path for path in folder.iterdir() if is_picture(path)]
    if not paths:
        raise SourceError("folder contains no images", where=folder, expected="PNG, JPEG or PGM")
    return sorted(paths, key=lambda path: natural_key(path.name))


def is_picture(path: Path) -> bool:
    """Whether a file is an image by its suffix; hidden files do not count."""
    return path.suffix.lower() in PICTURES and not path.name.startswith(".")
