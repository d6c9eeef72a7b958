"""Drives of KITTI: of the odometry benchmark, and raw, rectified (``_sync``) or not (``_extract``).

::

    folder/                    odometry
      image_0/ image_1/        left and right image of each frame, same names (or image_2, image_3)
      calib.txt                P0 P1 (or P2 P3)
      times.txt                seconds, one line per frame
      poses.txt                optional: T_world_camera0, 12 numbers per frame
                               (or poses/06.txt beside sequences/06, as in KITTI's own download)

    2011_09_26/                raw
      calib_cam_to_cam.txt     (or in the drive's folder)
      2011_09_26_drive_0013_sync/
        image_00/ image_01/    (or image_02, image_03)
          data/0000000000.png
          timestamps.txt       date and time, one line per image
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import SourceError
from recon.core.geometry.se3 import invert
from recon.core.text import counted, is_count
from recon.core.values import RectifiedCamera, Rig, SequenceTruth, Trajectory
from recon.core.values.arrays import Float64
from recon.io.cameras.kitti import COLOUR_CAMERAS, GREY_CAMERAS, read_kitti_offset, read_kitti_rig
from recon.io.files import resolved
from recon.io.trajectory import read_kitti_poses
from recon.sources.calibration import CALIBRATE, as_rectified, read_rig
from recon.sources.images import (
    ImageFrame,
    ImageSource,
    image_size,
    list_images,
    natural_key,
    pair_listed,
    pair_named,
)
from recon.sources.settings import SourceSettings
from recon.sources.source import FrameList
from recon.sources.times import check_increasing, read_dates, read_times_of_pairs

_RAW_CALIBRATION: Final = "calib_cam_to_cam.txt"


def open_kitti(folder: Path, settings: SourceSettings | None = None) -> ImageSource:
    """Open a drive of the odometry benchmark, the grey images if it has both kinds."""
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    pair = _choose_cameras(folder, "image_{}")
    settings = settings or SourceSettings()
    views = [folder / f"image_{camera}" for camera in pair]
    left, right = ({path.name: path for path in list_images(view)} for view in views)
    names = sorted(left.keys() | right.keys(), key=natural_key)
    frames = [(left.get(name), right.get(name)) for name in names]
    # Where images were deleted, lines of times.txt and poses.txt are found by numbers in the names.
    images, listing = pair_named(frames, settings, folder)
    times, time_files = _read_times(folder, listing, settings)
    rig, calibration_files = _read_rig([folder / "calib.txt"], settings, pair, images[0][0])
    truth, pose_files = _read_truth(folder, times, listing, pair[0])
    return ImageSource(
        name=resolved(folder).name,
        description=f"KITTI odometry drive, image_{pair[0]} and image_{pair[1]}{listing}",
        calibration=rig,
        images=[ImageFrame(*both, float(t)) for both, t in zip(images, times, strict=True)],
        listing=listing,
        truth=truth,
        texts=(*calibration_files, *time_files, *pose_files),
    )


def _choose_cameras(folder: Path, pattern: str) -> tuple[int, int]:
    """Return the grey pair of cameras, or the colour pair if only that is complete."""
    names = [pattern.format(camera) for camera in range(4)]
    there = [camera for camera, name in enumerate(names) if (folder / name).is_dir()]
    for pair in (GREY_CAMERAS, COLOUR_CAMERAS):
        if set(pair) <= set(there):
            return pair
    if there:
        what, expected = "folder of the other camera is missing", f"{names[there[0] ^ 1]} as well"
        raise SourceError(what, where=folder, got=names[there[0]], expected=expected)
    expected = f"{names[0]} and {names[1]}, or {names[2]} and {names[3]}"
    raise SourceError("folder has no images in KITTI's layout", where=folder, expected=expected)


def _read_times(
    folder: Path, listing: FrameList, settings: SourceSettings
) -> tuple[Float64, tuple[Path, ...]]:
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
    paths: Sequence[Path], settings: SourceSettings, cameras: tuple[int, int], image: Path
) -> tuple[Rig, tuple[Path, ...]]:
    """Return the rig by the settings, else by the first of some files that is there."""
    size = image_size(image, settings)
    if settings.has_camera:
        return read_rig(settings, paths[0].parent, size, cameras)
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        expected = " or ".join(map(str, paths))
        raise SourceError(
            "calibration is missing", where=paths[0], expected=expected, hint=CALIBRATE
        )
    return as_rectified(read_kitti_rig(path, *size, cameras)), (path,)


def _read_truth(
    folder: Path, times: Float64, listing: FrameList, camera: int
) -> tuple[SequenceTruth | None, tuple[Path, ...]]:
    drive = resolved(folder)
    places = (drive / "poses.txt", drive.parent.parent / "poses" / f"{drive.name}.txt")
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        return None, ()
    poses = read_kitti_poses(path).T_world_camera
    lines = listing.lines(len(poses))
    if lines is None:
        what, got = "fewer poses than images", counted(len(poses), "pose")
        raise SourceError(what, where=path, got=got, expected=f"{len(listing.names)}")
    calibration = folder / "calib.txt"
    # KITTI's poses are those of camera 0, which need not be the left camera of this pair.
    offset = read_kitti_offset(calibration, camera) if calibration.exists() else np.eye(4)
    left = poses[lines] @ invert(offset)
    return SequenceTruth(Trajectory(invert(left[0]) @ left, times)), (path,)


def open_kitti_raw(folder: Path, settings: SourceSettings) -> ImageSource:
    """Open a raw drive; its images are paired by timestamp."""
    cameras = _choose_cameras(folder, "image_{:02d}")
    views = [folder / f"image_{camera:02d}" for camera in cameras]
    frames, listing = pair_listed([_read_dated(v) for v in views], settings, folder)
    # Of the drive, or of its day.
    calibrations = [place / _RAW_CALIBRATION for place in (folder, resolved(folder).parent)]
    rig, calibration_files = _read_rig(calibrations, settings, cameras, frames[0].left)
    rectified = "rectified" if isinstance(rig, RectifiedCamera) else "not rectified"
    return ImageSource(
        name=resolved(folder).name,
        description=f"KITTI raw drive, {views[0].name} and {views[1].name}, {rectified}, "
        f"paired by stamps{listing}",
        calibration=rig,
        images=frames,
        listing=listing,
        texts=(*calibration_files, *(view / "timestamps.txt" for view in views)),
    )


def _read_dated(view: Path) -> list[tuple[float, Path]]:
    """Return time and image of each frame; where images are missing, names give the frame."""
    path, images = view / "timestamps.txt", list_images(view / "data")
    if not path.exists():
        raise SourceError("times are missing", where=path)
    stamps = read_dates(path)
    check_increasing(stamps, str(path))
    if len(stamps) == len(images):
        return list(zip(stamps.tolist(), images, strict=True))
    if len(stamps) < len(images) or not all(is_count(image.stem) for image in images):
        what, got = "numbers of times and images differ", counted(len(stamps), "time")
        raise SourceError(what, where=path, got=got, expected=f"{len(images)}")
    named = {int(image.stem): image for image in images}
    missing = [view / "data" / f"{number:010d}.png" for number in range(len(stamps))]
    return [(stamp, named.get(k, missing[k])) for k, stamp in enumerate(stamps.tolist())]
