"""Sources of one pair: two image files, or a Middlebury scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from recon.core.errors import CalibrationError, SourceError
from recon.core.values import Rig, SequenceTruth, StereoPair
from recon.core.values.arrays import UInt8
from recon.io.files import StrPath
from recon.io.images.image import MAX_MEGAPIXELS, eight_bits, find_white, read_levels
from recon.io.middlebury.scene import read_middlebury_scene
from recon.sources.calibration import CALIBRATE, read_rig
from recon.sources.frame_list import pair_frames
from recon.sources.protocol import source_text
from recon.sources.settings import SourceSettings

LEAST_SIDE_PX: Final = 16
"""Smaller than this, an image does not hold the windows that are compared."""


@dataclass(frozen=True, eq=False, repr=False)
class OnePair:
    """One pair as a source.

    Attributes:
        pair: The images.
        calibration: A `RectifiedCamera` if they are already rectified.
        files: The files that both were read from.
        description: What it is, in one line.
        truth: None: what is known of the truth of a pair is a disparity.
    """

    pair: StereoPair
    calibration: Rig
    files: tuple[Path, ...] = ()
    description: str = "two images"
    truth: SequenceTruth | None = None

    @property
    def name(self) -> str:
        """Name of the pair."""
        return self.pair.name

    def __repr__(self) -> str:
        return source_text(self)

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        """Yield the pair, or nothing from any later start."""
        yield from (self.pair,)[start:]


def open_middlebury(folder: Path, settings: SourceSettings) -> OnePair:
    """Open a Middlebury scene of 2005 or 2006 (with ``dmin.txt``), 2014 or MiddEval3."""
    pair_frames([(0, 0)], settings, folder)
    scene = read_middlebury_scene(folder)
    rig: Rig | None = scene.camera
    if settings.has_camera:
        height_px, width_px = scene.pair.left.shape[:2]
        rig, _ = read_rig(settings, folder, (width_px, height_px))
    if rig is None:
        raise CalibrationError(
            "no calibration is published for this scene, so there is no depth",
            where=folder,
            expected="calib.txt, or dmin.txt for scenes of 2005 and 2006",
            hint=CALIBRATE,
        )
    files = tuple(sorted(path for path in folder.iterdir() if path.is_file()))
    return OnePair(scene.pair, rig, files, "a Middlebury scene: one rectified pair")


def read_pair(left: StrPath, right: StrPath, max_megapixels: float = MAX_MEGAPIXELS) -> StereoPair:
    """Read the two images of a pair; if only one is in colour, the other is converted.

    16-bit images are scaled to 8 bits, both alike, by the brightest pixel.
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
    """Join two images of equal size; if only one is in colour, the other is converted."""
    if left.ndim != right.ndim:
        left, right = (p if p.ndim == 3 else p[:, :, None].repeat(3, axis=2) for p in (left, right))
    return StereoPair(left, right, timestamp_s, index, name)
