"""Drives in the layout of the KITTI odometry benchmark.

::

    folder/
      image_0/ image_1/     left and right image of each frame, same names (or image_2, image_3)
      calib.txt             P0 P1 (or P2 P3)
      times.txt             seconds, one line per frame
      poses.txt             optional: T_world_camera0, 12 numbers per frame

KITTI's own download has the poses in a separate folder, ``poses/06.txt`` for ``sequences/06``;
they are found there too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.core.errors import SourceError
from recon.core.geometry.se3 import invert
from recon.core.values import Rig, SequenceTruth, Trajectory
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.io.cameras.kitti import COLOUR_CAMERAS, GREY_CAMERAS, read_kitti_offset, read_kitti_rig
from recon.io.files import StrPath, resolved
from recon.io.trajectory import read_kitti_poses
from recon.sources.calibration import CALIBRATE, as_rectified, read_rig
from recon.sources.frame_list import FrameList
from recon.sources.image_names import natural_key
from recon.sources.images import (
    ImageFrame,
    ImageSource,
    image_size,
    is_image,
    pair_named,
)
from recon.sources.settings import SourceSettings
from recon.sources.times import read_times_of_pairs


def open_kitti(
    folder: StrPath,
    settings: SourceSettings | None = None,
    cameras: tuple[int, int] | None = None,
) -> ImageSource:
    """Open a drive in KITTI's odometry layout.

    File names, calibration, times and poses are read and checked at once; the images are read
    while iterating. Images may be deleted: those without a partner are left out, and the lines of
    times.txt and poses.txt are found by the numbers in the names.

    Args:
        folder: The folder of the drive.
        settings: May name another calibration, or a frame rate in place of times.
        cameras: (0, 1) for the grey pair, (2, 3) for the colour pair; None = grey if present.
    """
    path = Path(folder)
    if not path.is_dir():
        raise SourceError("folder does not exist", where=path)
    pair = cameras or choose_cameras(path, "image_{}")
    settings = settings or SourceSettings()
    images, listing = _list_pairs(*(path / f"image_{camera}" for camera in pair), settings=settings)
    times, time_files = _read_times(path, listing, settings)
    rig, calibration_files = _read_rig(path, settings, pair, images[0][0])
    texts = (*calibration_files, *time_files, _find_poses(path))
    return ImageSource(
        name=resolved(path).name,
        description=f"KITTI odometry drive, image_{pair[0]} and image_{pair[1]}{listing}",
        calibration=rig,
        images=[
            ImageFrame(left, right, float(time_s))
            for (left, right), time_s in zip(images, times, strict=True)
        ],
        listing=listing,
        truth=_read_truth(path, times, listing, pair[0]),
        texts=tuple(text for text in texts if text is not None),
    )


def choose_cameras(folder: Path, pattern: str) -> tuple[int, int]:
    """Return the grey pair of cameras, or the colour pair if only that is complete."""
    pairs = (GREY_CAMERAS, COLOUR_CAMERAS)
    for pair in pairs:
        if all((folder / pattern.format(camera)).is_dir() for camera in pair):
            return pair
    for left, right in pairs:
        for here, missing in ((left, right), (right, left)):
            if (folder / pattern.format(here)).is_dir():
                raise SourceError(
                    "folder of the other camera is missing",
                    where=folder,
                    got=pattern.format(here),
                    expected=f"{pattern.format(missing)} as well",
                )
    names = [pattern.format(camera) for camera in range(4)]
    raise SourceError(
        "folder has no images in KITTI's layout",
        where=folder,
        expected=f"{names[0]} and {names[1]}, or {names[2]} and {names[3]}",
    )


def _list_pairs(
    left: Path, right: Path, *, settings: SourceSettings
) -> tuple[list[tuple[Path, Path]], FrameList]:
    """Return the left and right image of each frame, paired by equal names."""
    names = [_names(folder) for folder in (left, right)]
    for folder, found in zip((left, right), names, strict=True):
        if not found:
            raise SourceError("folder contains no images", where=folder)
    frames = [
        (left / name if name in names[0] else None, right / name if name in names[1] else None)
        for name in sorted(names[0] | names[1], key=natural_key)
    ]
    return pair_named(frames, settings, left.parent)


def _names(folder: Path) -> set[str]:
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    return {path.name for path in folder.iterdir() if is_image(path)}


def _read_times(
    folder: Path, listing: FrameList, settings: SourceSettings
) -> tuple[Float64, tuple[Path, ...]]:
    """Return times of the frames in seconds, and their file; no file if a rate is given."""
    if settings.rate_hz is not None:
        return np.array(listing.kept) / settings.rate_hz, ()
    path = folder / "times.txt"
    if not path.exists():
        raise SourceError(
            "times are missing",
            where=path,
            hint="write the time of each frame in seconds, one per line, or give the frames per "
            "second with --set source.rate_hz=",
        )
    return read_times_of_pairs(path, listing), (path,)


def _read_rig(
    folder: Path, settings: SourceSettings, cameras: tuple[int, int], image: Path
) -> tuple[Rig, tuple[Path, ...]]:
    """Read the calibration; its file need not contain the image size."""
    path, size = folder / "calib.txt", image_size(image, settings)
    if settings.has_camera:
        return read_rig(settings, folder, size, cameras)
    if not path.exists():
        raise SourceError("calibration is missing", where=path, hint=CALIBRATE)
    return as_rectified(read_kitti_rig(path, *size, cameras)), (path,)


def _read_truth(
    folder: Path, times: Float64, listing: FrameList, camera: int
) -> SequenceTruth | None:
    path = _find_poses(folder)
    if path is None:
        return None
    poses = read_kitti_poses(path).T_world_camera
    lines = listing.lines(len(poses))
    if lines is None:
        raise SourceError(
            "fewer poses than images",
            where=path,
            got=counted(len(poses), "pose"),
            expected=f"{len(listing.names)}",
        )
    calibration = folder / "calib.txt"
    # KITTI's poses are those of camera 0, which need not be the left camera of this pair.
    offset = read_kitti_offset(calibration, camera) if calibration.exists() else np.eye(4)
    left = poses[lines] @ invert(offset)
    return SequenceTruth(Trajectory(invert(left[0]) @ left, times))


def _find_poses(folder: Path) -> Path | None:
    path = resolved(folder)
    candidates = (path / "poses.txt", path.parent.parent / "poses" / f"{path.name}.txt")
    return next((candidate for candidate in candidates if candidate.is_file()), None)
