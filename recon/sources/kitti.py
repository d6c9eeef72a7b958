"""Drives in the layout of the KITTI odometry benchmark.

::

    folder/
      image_0/ image_1/     left and right picture of each frame, same names (or image_2, image_3)
      calib.txt             P0 P1 (or P2 P3)
      times.txt             seconds, one line per frame
      poses.txt             optional: T_world_camera0, 12 numbers per frame

In KITTI's own download the poses lie apart, in ``poses/06.txt`` for ``sequences/06``; they are
found there too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.errors import SourceError
from recon.formats.files import StrPath
from recon.formats.kitti import COLOUR_CAMERAS, GREY_CAMERAS, read_kitti_calib, read_kitti_offset
from recon.formats.trajectory import read_kitti_poses
from recon.geometry.se3 import invert
from recon.sources.pictures import (
    PictureFrame,
    PictureSource,
    is_picture,
    list_pictures,
    picture_size,
)
from recon.sources.rig import Rig, read_rig
from recon.sources.settings import SourceSettings
from recon.sources.times import read_times
from recon.structures import SequenceTruth, Trajectory
from recon.structures.arrays import Float64


def open_kitti(
    folder: StrPath,
    settings: SourceSettings | None = None,
    cameras: tuple[int, int] | None = None,
) -> PictureSource:
    """Open a drive in KITTI's odometry layout.

    All but the pictures is read and checked at once: names and number of the pictures on both
    sides, calibration, times, poses. The pictures are read while iterating. Lines of times.txt
    and poses.txt beyond the last picture are ignored, so a drive may be cut short.

    Args:
        folder: The folder of the drive.
        settings: Perhaps name another calibration, or a rate in place of times.
        cameras: (0, 1) for the grey, (2, 3) for the colour pair; None = grey where there is one.

    Raises:
        SourceError: A folder or picture is missing, or there are fewer times or poses than
            pictures.
        FormatError: A file is damaged.
        CalibrationError: The calibration cannot give depth.
    """
    path = Path(folder)
    if not path.is_dir():
        raise SourceError("folder does not exist", where=path)
    pair = cameras or choose_cameras(path, "image_{}")
    pictures = list_pairs(*(path / f"image_{camera}" for camera in pair))
    settings = settings or SourceSettings()
    times, time_files = _read_times(path, len(pictures), settings)
    rig, calibration_files = _read_rig(path, settings, pair, pictures[0][0])
    texts = (*calibration_files, *time_files, _find_poses(path))
    return PictureSource(
        name=path.resolve().name,
        description=f"KITTI odometry drive, image_{pair[0]} and image_{pair[1]}",
        calibration=rig,
        pictures=[
            PictureFrame(left, right, float(time_s))
            for (left, right), time_s in zip(pictures, times, strict=True)
        ],
        truth=_read_truth(path, times, pair[0]),
        texts=tuple(text for text in texts if text is not None),
    )


def choose_cameras(folder: Path, pattern: str) -> tuple[int, int]:
    """The grey pair of cameras, unless only the colour pair is whole.

    Raises:
        SourceError: There is none.
    """
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
                    expected=f"{pattern.format(missing)} beside it",
                )
    names = [pattern.format(camera) for camera in range(4)]
    raise SourceError(
        "folder has no pictures in KITTI's layout",
        where=folder,
        expected=f"{names[0]} and {names[1]}, or {names[2]} and {names[3]}",
    )


def list_pairs(left: Path, right: Path) -> list[tuple[Path, Path]]:
    """Left and right picture of each frame, by name; a name on one side alone is an error.

    Raises:
        SourceError: A picture has no partner, or there are none.
    """
    folders = (left, right)
    names = [_names(folder) for folder in folders]
    for here, there in ((0, 1), (1, 0)):
        missing = sorted(names[here] - names[there])
        if missing:
            raise SourceError(
                "picture is missing",
                where=folders[there] / missing[0],
                got=f"{len(names[0])} left and {len(names[1])} right pictures",
                hint="each frame needs a left and a right picture of the same name",
            )
    return [(left / path.name, right / path.name) for path in list_pictures(left)]


def _names(folder: Path) -> set[str]:
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    return {path.name for path in folder.iterdir() if is_picture(path)}


def _read_times(
    folder: Path, frames: int, settings: SourceSettings
) -> tuple[Float64, tuple[Path, ...]]:
    """Seconds of each frame, and the file that tells them; none where a rate is given."""
    if settings.rate_hz is not None:
        return np.arange(frames) / settings.rate_hz, ()
    path = folder / "times.txt"
    if not path.exists():
        raise SourceError(
            "times are missing",
            where=path,
            hint="write the time of each frame in seconds, one per line, or give the frames per "
            "second with --set source.rate_hz=",
        )
    return read_times(path, frames), (path,)


def _read_rig(
    folder: Path, settings: SourceSettings, cameras: tuple[int, int], picture: Path
) -> tuple[Rig, tuple[Path, ...]]:
    """The file does not tell the size of the pictures."""
    path, size = folder / "calib.txt", picture_size(picture)
    if settings.calibration is not None:
        return read_rig(settings, folder, size)
    if not path.exists():
        raise SourceError(
            "calibration is missing", where=path, hint="name a file with --calib FILE"
        )
    return read_kitti_calib(path, *size, cameras), (path,)


def _read_truth(folder: Path, times: Float64, camera: int) -> SequenceTruth | None:
    path = _find_poses(folder)
    if path is None:
        return None
    poses = read_kitti_poses(path).T_world_camera
    if len(poses) < len(times):
        raise SourceError(
            "fewer poses than pictures",
            where=path,
            got=f"{len(poses)} poses",
            expected=f"{len(times)}",
        )
    calibration = folder / "calib.txt"
    # KITTI's poses are those of camera 0, which may not be the left one of this pair.
    offset = read_kitti_offset(calibration, camera) if calibration.exists() else np.eye(4)
    left = poses[: len(times)] @ invert(offset)
    return SequenceTruth(Trajectory(invert(left[0]) @ left, times))


def _find_poses(folder: Path) -> Path | None:
    path = folder.resolve()
    candidates = (path / "poses.txt", path.parent.parent / "poses" / f"{path.name}.txt")
    return next((candidate for candidate in candidates if candidate.is_file()), None)
