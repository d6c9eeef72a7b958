"""One pair, given as two image files and a calibration file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

from recon.core.errors import SourceError
from recon.core.values import RectifiedCamera, SequenceTruth, StereoCalibration, StereoPair
from recon.core.values.arrays import UInt8
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.files import StrPath
from recon.io.images.image import MAX_MEGAPIXELS, eight_bits, find_white, read_levels
from recon.io.middlebury.scene import stand_in_camera

LEAST_SIDE_PX: Final = 16
"""Smaller than this, an image does not hold the windows that are compared."""


class FilesSource:
    """One pair of images.

    Args:
        left: Left image.
        right: Right image.
        calibration: Any calibration file that `read_calibration` supports; None = the images are
            rectified, and a placeholder camera is used, valid only for matching.
        metres_per_unit: Unit of the translation in an OpenCV file.
        max_megapixels: Refuse larger images, in 10⁶ pixels.

    Raises:
        SourceError: The images differ in size.
        FormatError: A file is missing, damaged or of another format.
        CalibrationError: The calibration cannot give depth, or is of another image size.
    """

    def __init__(
        self,
        left: StrPath,
        right: StrPath,
        calibration: StrPath | None,
        *,
        metres_per_unit: float = 1.0,
        max_megapixels: float = MAX_MEGAPIXELS,
    ) -> None:
        given = (left, right, calibration)
        self._files = tuple(Path(path) for path in given if path is not None)
        self._pair = read_pair(left, right, max_megapixels)
        height_px, width_px = self._pair.left.shape[:2]
        self._calibration = (
            stand_in_camera(width_px, height_px)
            if calibration is None
            else read_calibration(
                calibration,
                width_px,
                height_px,
                metres_per_unit=metres_per_unit,
                cameras=kitti_cameras_of(self._files[0]),
            )
        )

    @property
    def name(self) -> str:
        """Name of the left image."""
        return self._pair.name

    @property
    def description(self) -> str:
        """One line."""
        return "two images"

    @property
    def calibration(self) -> RectifiedCamera | StereoCalibration:
        """A `RectifiedCamera` if the images are already rectified."""
        return self._calibration

    @property
    def truth(self) -> SequenceTruth | None:
        """None."""
        return None

    @property
    def files(self) -> tuple[Path, ...]:
        """Left image, right image, calibration."""
        return self._files

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pair, or nothing from any later start."""
        yield from (self._pair,)[start:]


def read_pair(left: StrPath, right: StrPath, max_megapixels: float = MAX_MEGAPIXELS) -> StereoPair:
    """Read the two images of a pair; if only one is in colour, the other is converted.

    16-bit images are scaled to 8 bits, both alike, by the brightest pixel.

    Raises:
        SourceError: The images differ in size.
        FormatError: An image is missing or damaged.
    """
    levels = [read_levels(path, max_megapixels) for path in (left, right)]
    white = find_white(levels)
    images = [eight_bits(each, white) for each in levels]
    sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in images]
    if sizes[0] != sizes[1]:
        raise SourceError(
            "left and right images differ in size",
            where=right,
            got=f"left {sizes[0]}, right {sizes[1]}",
            hint="both cameras must record the same size",
        )
    if min(images[0].shape[:2]) < LEAST_SIDE_PX:
        raise SourceError(
            "images are too small to be matched",
            where=left,
            got=sizes[0],
            expected=f"at least {LEAST_SIDE_PX} pixels a side",
        )
    return join_pair(images[0], images[1], name=Path(left).name)


def join_pair(
    left: UInt8, right: UInt8, timestamp_s: float = 0.0, index: int = 0, name: str = ""
) -> StereoPair:
    """Join two images of equal size; if only one is in colour, the other is converted.

    Raises:
        ShapeError: The images differ in size.
    """
    if left.ndim != right.ndim:
        left, right = (p if p.ndim == 3 else p[:, :, None].repeat(3, axis=2) for p in (left, right))
    return StereoPair(left, right, timestamp_s, index, name)
