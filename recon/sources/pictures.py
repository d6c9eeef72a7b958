"""Drives whose pictures lie in folders: one file per camera and frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.errors import FormatError, SourceError
from recon.formats.image import read_image
from recon.sources.files import join_pair
from recon.sources.pairing import natural_key
from recon.structures import RectifiedCamera, SequenceTruth, StereoCalibration, StereoPair
from recon.structures.arrays import Float64, UInt8

PICTURES: Final = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm", ".tif", ".tiff", ".bmp"})


@dataclass(frozen=True)
class PictureFrame:
    """The two files of one frame.

    Attributes:
        left: Left picture.
        right: Right picture.
        timestamp_s: Time of exposure of the left one.
    """

    left: Path
    right: Path
    timestamp_s: float


@dataclass(frozen=True, eq=False)
class PictureSource:
    """A drive in picture files, read one pair at a time.

    Attributes:
        name: Name of the folder.
        description: What it was taken for, in one line.
        calibration: The rectified camera, or the two raw ones.
        pictures: The files of each frame, in order.
        truth: What is known of the true path.
        texts: Files other than pictures that were read.
    """

    name: str
    description: str
    calibration: RectifiedCamera | StereoCalibration
    pictures: Sequence[PictureFrame]
    truth: SequenceTruth | None = None
    texts: tuple[Path, ...] = ()

    @property
    def files(self) -> Sequence[Path]:
        """Calibration and the like, then the pictures."""
        pictures = (path for frame in self.pictures for path in (frame.left, frame.right))
        return [*self.texts, *pictures]

    @property
    def stamps_s(self) -> Float64:
        """float64 (N,), times of the left pictures."""
        return np.array([frame.timestamp_s for frame in self.pictures])

    def __len__(self) -> int:
        return len(self.pictures)

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Read the pairs from number ``start`` on.

        Raises:
            FormatError: A picture is missing, damaged or of another size than the calibration.
        """
        for index in range(start, len(self.pictures)):
            frame = self.pictures[index]
            left, right = (self._read(path) for path in (frame.left, frame.right))
            yield join_pair(left, right, frame.timestamp_s, index, frame.left.name)

    def _read(self, path: Path) -> UInt8:
        image = read_image(path)
        check_size(image, self.calibration, path)
        return image


def size_of(calibration: RectifiedCamera | StereoCalibration) -> tuple[int, int]:
    """Width and height of the pictures that a calibration belongs to."""
    camera = calibration if isinstance(calibration, RectifiedCamera) else calibration.left
    return camera.width_px, camera.height_px


def check_size(
    image: UInt8, calibration: RectifiedCamera | StereoCalibration, where: Path | str
) -> None:
    """Refuse a picture of another size than the calibration.

    Raises:
        FormatError: It is.
    """
    size = (image.shape[1], image.shape[0])
    expected = size_of(calibration)
    if size != expected:
        raise FormatError(
            "picture has another size than the calibration, or than the first of the drive",
            where=where,
            got=f"{size[0]}x{size[1]}",
            expected=f"{expected[0]}x{expected[1]}",
        )


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture file.

    Raises:
        FormatError: It is missing or damaged.
    """
    height_px, width_px = read_image(path).shape[:2]
    return width_px, height_px


def list_pictures(folder: Path) -> list[Path]:
    """The pictures of a folder in natural order: 2 before 10.

    Raises:
        SourceError: The folder does not exist or holds no pictures.
    """
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    paths = [path for path in folder.iterdir() if is_picture(path)]
    if not paths:
        raise SourceError("folder holds no pictures", where=folder, expected="PNG, JPEG or PGM")
    return sorted(paths, key=lambda path: natural_key(path.name))


def is_picture(path: Path) -> bool:
    """Tell a picture by its suffix; hidden files are none."""
    return path.suffix.lower() in PICTURES and not path.name.startswith(".")
