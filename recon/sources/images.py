"""Drives stored as image files, one per camera and frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import SourceError
from recon.core.values import ImuRecord, Recorded, RectifiedCamera, check_size
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.image import join_pair
from recon.io.images.image import FULL_WHITE, MAX_MEGAPIXELS, find_white, read_image, read_levels
from recon.sources.image_names import IMAGES, natural_key
from recon.sources.settings import SourceSettings
from recon.sources.source import FrameList, Recording, check_most, pair_frames
from recon.sources.times import pair_stamps

_WHITE_SAMPLE: Final = 8  # frames, over a drive of 16-bit images, that its white is taken from


class ImageFrame(NamedTuple):
    """The two files of one frame, and the exposure time of the left one."""

    left: Path
    right: Path
    timestamp_s: float


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class ImageSource(Recording):
    """A drive in image files; ``images`` are those of each frame, in order."""

    images: Sequence[ImageFrame]
    imu: Callable[[], ImuRecord] | None = None  # reads what the inertial unit measured
    truth_of_raw: bool = False

    @cached_property
    def files(self) -> Sequence[Path]:
        images = (path for frame in self.images for path in (frame.left, frame.right))
        return [*self.texts, *images]

    @cached_property
    def stamps_s(self) -> Float64:
        return stamps_of(self.images)

    def read_imu(self) -> ImuRecord | None:
        return None if self.imu is None else self.imu()

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        for index in range(start, len(self.images)):
            frame = self.images[index]
            left, right = (self._read(path) for path in (frame.left, frame.right))
            yield join_pair(left, right, frame.timestamp_s, index, frame.left.name)

    @cached_property
    def white(self) -> int:
        """The 16-bit value that becomes white in all images; from a sample of both cameras."""
        most = self._most_megapixels
        if not self.images or read_levels(self.images[0].left, most).dtype == np.uint8:
            return FULL_WHITE
        chosen = np.unique(np.linspace(0, len(self.images) - 1, _WHITE_SAMPLE).astype(int))
        frames = [self.images[index] for index in chosen]
        return find_white(
            read_levels(p, most) for frame in frames for p in (frame.left, frame.right)
        )

    @property
    def _most_megapixels(self) -> float:
        # A calibration was accepted for images of its size.
        rig = self.calibration
        camera = rig if isinstance(rig, RectifiedCamera) else rig.left
        return max(MAX_MEGAPIXELS, camera.width_px * camera.height_px / 1e6)

    def _read(self, path: Path) -> UInt8:
        image = read_image(path, self.white, self._most_megapixels)
        check_size(self.calibration, image.shape[1], image.shape[0], path)
        return image


def stamps_of(frames: Sequence[ImageFrame]) -> Float64:
    """Return float64 (N,), the times of some frames."""
    return np.array([frame.timestamp_s for frame in frames])


def pair_listed(
    lists: Sequence[Sequence[tuple[float, Path]]], settings: SourceSettings, where: Path
) -> tuple[list[ImageFrame], FrameList]:
    """Pair lists of time and file, by time; a listed image that is missing has no partner."""
    for one in lists:
        check_most(sum(path.is_file() for _, path in one), len(one), where)
    stamps = [np.array([stamp for stamp, _ in one]) for one in lists]
    found = pair_stamps(stamps[0], stamps[1], settings.tolerance_s, where)

    def entry(side: int, k: int | None) -> tuple[float, Path] | None:
        return None if k is None or not lists[side][k][1].is_file() else lists[side][k]

    names = [(lists[1][j or 0] if i is None else lists[0][i])[1].stem for i, j in found]
    frames = [(entry(0, i), entry(1, j)) for i, j in found]
    used, listing = pair_frames(frames, settings, where, names)
    return [ImageFrame(left, right, stamp_s) for (stamp_s, left), (_, right) in used], listing


def pair_named(
    frames: Sequence[tuple[Path | None, Path | None]], settings: SourceSettings, where: Path
) -> tuple[list[tuple[Path, Path]], FrameList]:
    """Return the pairs that are used; of ``frames`` in order, an image may be missing (None)."""
    whole = sum(None not in frame for frame in frames)
    alone_right = sum(left is None and right is not None for left, right in frames)
    alone = max(len(frames) - whole - alone_right, alone_right)
    check_most(whole, whole + alone, where)
    return pair_frames(
        frames, settings, where, [(left or right or Path()).stem for left, right in frames]
    )


def existing(path: Path) -> Path | None:
    """Return the file, or None if it is missing."""
    return path if path.is_file() else None


def image_size(path: Path, settings: SourceSettings) -> tuple[int, int]:
    """Return width and height of an image file, at most as large as the settings allow."""
    height_px, width_px = read_levels(path, settings.max_megapixels).shape[:2]
    return width_px, height_px


def list_images(folder: Path) -> list[Path]:
    """Return the images of a folder in natural order: 2 before 10."""
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    paths = [path for path in folder.iterdir() if is_image(path)]
    if not paths:
        raise SourceError("folder contains no images", where=folder, expected="PNG, JPEG or PGM")
    return sorted(paths, key=lambda path: natural_key(path.name))


def is_image(path: Path) -> bool:
    """Return whether a file is an image by its suffix; hidden files do not count."""
    return path.suffix.lower() in IMAGES and not path.name.startswith(".")
