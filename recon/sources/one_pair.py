"""One pair, of two image files or a Middlebury scene: read, as a source, with its truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import CalibrationError, FormatError, SourceError
from recon.core.values import DisparityTruth, Rig, StereoPair
from recon.core.values.image import join_pair
from recon.io.cameras.calibration import read_calibration
from recon.io.cameras.kitti import kitti_cameras_of
from recon.io.files import StrPath
from recon.io.images.disparity import read_disparity
from recon.io.images.image import (
    MAX_MEGAPIXELS,
    eight_bits,
    find_white,
    read_focal_length,
    read_levels,
)
from recon.io.middlebury import read_middlebury_scene, stand_in_camera
from recon.sources.calibration import CALIBRATE, camera_of_numbers, check_given_once, read_rig
from recon.sources.settings import SourceSettings
from recon.sources.source import StereoSource, pair_frames

UP_TO_SCALE: Final = "no baseline was given: all lengths are in baselines, not in metres"
LEAST_SIDE_PX: Final = 16  # smaller than this, an image does not hold the windows that are compared


@dataclass(frozen=True, eq=False, repr=False)
class OnePair(StereoSource):
    """One pair as a source; what is known of its truth is a disparity, which is no `truth`."""

    pair: StereoPair
    calibration: Rig
    files: tuple[Path, ...] = ()
    description: str = "two images"

    @cached_property
    def name(self) -> str:
        return self.pair.name

    def __len__(self) -> int:
        return 1

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
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
        what = "no calibration is published for this scene, so there is no depth"
        expected = "calib.txt, or dmin.txt for scenes of 2005 and 2006"
        raise CalibrationError(what, where=folder, expected=expected, hint=CALIBRATE)
    files = tuple(sorted(path for path in folder.iterdir() if path.is_file()))
    return OnePair(scene.pair, rig, files, "a Middlebury scene: one rectified pair")


def read_pair(left: StrPath, right: StrPath, max_megapixels: float = MAX_MEGAPIXELS) -> StereoPair:
    """Read two images; of two 16-bit ones both are scaled to 8 bits by the brightest pixel."""
    levels = [read_levels(path, max_megapixels) for path in (left, right)]
    white = find_white(levels)
    images = [eight_bits(each, white) for each in levels]
    sizes = [f"{image.shape[1]}x{image.shape[0]}" for image in images]
    if sizes[0] != sizes[1]:
        what, got = "left and right images differ in size", f"left {sizes[0]}, right {sizes[1]}"
        raise SourceError(what, where=right, got=got, hint="both cameras must record the same size")
    if min(images[0].shape[:2]) < LEAST_SIDE_PX:
        what = "images are too small to be matched"
        expected = f"at least {LEAST_SIDE_PX} pixels a side"
        raise SourceError(what, where=left, got=sizes[0], expected=expected)
    return join_pair(images[0], images[1], name=Path(left).name)


@dataclass(frozen=True, eq=False)
class PairInput:
    """One pair with its calibration and, if known, the true disparity of its rectified left view.

    ``notes`` say what the camera was taken from where there is no calibration file; with
    ``up_to_scale`` the baseline is unknown and counts as 1 m.
    """

    pair: StereoPair
    calibration: Rig
    files: tuple[Path, ...] = ()
    truth: DisparityTruth | None = None
    notes: tuple[str, ...] = ()
    up_to_scale: bool = False


def read_pair_input(
    left: Path,
    right: Path,
    calibration: Path | None,
    *,
    known: SourceSettings | None = None,
    metres_per_unit: float | None = None,
    max_megapixels: float = MAX_MEGAPIXELS,
) -> PairInput:
    """Read two images with their calibration; without one the pair is rectified.

    Of ``known`` numbers of the camera, a missing focal length is that of the EXIF data of the left
    image, and without a baseline the cloud is up to scale: notes say so.
    """
    if known is not None:
        check_given_once(calibration, known)
    pair = read_pair(left, right, max_megapixels)
    height_px, width_px = pair.left.shape[:2]
    if calibration is None:
        given = PairInput(pair, stand_in_camera(width_px, height_px), (left, right))
        return given if known is None else _with_camera(given, known)
    size, cameras = (width_px, height_px), kitti_cameras_of(left)
    rig = read_calibration(calibration, *size, metres_per_unit=metres_per_unit, cameras=cameras)
    return PairInput(pair, rig, (left, right, calibration))


def _with_camera(given: PairInput, known: SourceSettings) -> PairInput:
    height_px, width_px = given.pair.left.shape[:2]
    notes, instead = [], {"baseline_m": 1.0}
    if known.focal_px is None:
        left = given.files[0]
        found = read_focal_length(left, width_px, height_px)
        if found is None:
            what = "focal length is unknown: there is no calibration and no EXIF data"
            raise CalibrationError(what, where=left, hint="--calib FILE, or --focal PX")
        instead["focal_px"] = found.focal_px
        notes.append(f"focal length of {found.focal_px:.0f} px from EXIF ({found.basis})")
    camera = camera_of_numbers(known, (width_px, height_px), **instead)
    up_to_scale = known.baseline_m is None
    if up_to_scale:
        notes.append(f"{UP_TO_SCALE}; --baseline M gives metres")
    return replace(given, calibration=camera, notes=tuple(notes), up_to_scale=up_to_scale)


def with_truth(given: PairInput, path: Path | None) -> PairInput:
    """Return the pair with the true disparity of its rectified left image: PFM or 16-bit PNG."""
    if path is None:
        return given
    values, shape = read_disparity(path), given.pair.left.shape[:2]
    if values.shape != shape:
        what = "size of the ground truth differs from the images"
        got = f"{values.shape[1]}x{values.shape[0]}"
        raise FormatError(what, where=path, got=got, expected=f"{shape[1]}x{shape[0]}")
    truth = DisparityTruth(values, np.isfinite(values))
    return replace(given, truth=truth, files=(*given.files, path))
