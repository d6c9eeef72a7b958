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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.errors import FormatError, SourceError
from recon.formats.files import StrPath, read_table
from recon.formats.image import read_image
from recon.formats.kitti import COLOUR_CAMERAS, GREY_CAMERAS, read_kitti_calib, read_kitti_offset
from recon.formats.trajectory import read_kitti_poses
from recon.geometry.se3 import invert
from recon.structures import RectifiedCamera, SequenceTruth, StereoPair, Trajectory
from recon.structures.arrays import Float64, UInt8

_PICTURES: Final = frozenset({".png", ".jpg", ".jpeg", ".pgm", ".ppm"})


@dataclass(frozen=True)
class _Frame:
    index: int
    left: Path
    right: Path
    timestamp_s: float


class KittiSource:
    """A drive in KITTI's layout.

    All but the pictures is read and checked at once: names and number of the pictures on both
    sides, calibration, times, poses. The pictures are read while iterating. Lines of times.txt
    and poses.txt beyond the last picture are ignored, so a drive may be cut short.

    Args:
        folder: The folder of the drive.
        cameras: (0, 1) for the grey, (2, 3) for the colour pair; None = grey where there is one.

    Raises:
        SourceError: A folder or picture is missing, or there are fewer times or poses than
            pictures.
        FormatError: A file is damaged.
        CalibrationError: The calibration cannot give depth.
    """

    def __init__(self, folder: StrPath, cameras: tuple[int, int] | None = None) -> None:
        path = Path(folder)
        if not path.is_dir():
            raise SourceError("folder does not exist", where=path)
        self._path = path
        self._cameras = cameras or _choose_cameras(path)
        pictures = _list_pairs(*(path / f"image_{camera}" for camera in self._cameras))
        times = _read_times(path / "times.txt", len(pictures))
        self._frames = [
            _Frame(index, left, right, float(time_s))
            for index, ((left, right), time_s) in enumerate(zip(pictures, times, strict=True))
        ]
        self._calibration = self._read_calibration()
        self._truth = self._read_truth(times)

    @property
    def name(self) -> str:
        """Name of the folder."""
        return self._path.resolve().name

    @property
    def calibration(self) -> RectifiedCamera:
        """The rectified camera."""
        return self._calibration

    @property
    def truth(self) -> SequenceTruth | None:
        """The poses of the left camera, the first one the identity, where there are any."""
        return self._truth

    @property
    def files(self) -> Sequence[Path]:
        """Calibration, times, poses and pictures."""
        pictures = [path for frame in self._frames for path in (frame.left, frame.right)]
        texts = [self._path / "calib.txt", self._path / "times.txt", _find_poses(self._path)]
        return [path for path in texts if path is not None and path.exists()] + pictures

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[StereoPair]:
        for frame in self._frames:
            yield StereoPair(
                left=self._read_picture(frame.left),
                right=self._read_picture(frame.right),
                timestamp_s=frame.timestamp_s,
                index=frame.index,
                name=frame.left.name,
            )

    def _read_picture(self, path: Path) -> UInt8:
        image = read_image(path)
        camera = self._calibration
        if image.shape[:2] != (camera.height_px, camera.width_px):
            raise FormatError(
                "picture has another size than the first of the drive",
                where=path,
                got=f"{image.shape[1]}x{image.shape[0]}",
                expected=f"{camera.width_px}x{camera.height_px}",
            )
        return image

    def _read_calibration(self) -> RectifiedCamera:
        path = self._path / "calib.txt"
        if not path.exists():
            raise SourceError("calibration is missing", where=path)
        # The file does not tell the size of the pictures.
        height_px, width_px = read_image(self._frames[0].left).shape[:2]
        return read_kitti_calib(path, width_px, height_px, self._cameras)

    def _read_truth(self, times: Float64) -> SequenceTruth | None:
        path = _find_poses(self._path)
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
        offset = read_kitti_offset(self._path / "calib.txt", self._cameras[0])
        left = poses[: len(times)] @ invert(offset)
        return SequenceTruth(Trajectory(invert(left[0]) @ left, times))


def _choose_cameras(folder: Path) -> tuple[int, int]:
    """The grey pair, unless only the colour pair is whole."""
    pairs = (GREY_CAMERAS, COLOUR_CAMERAS)
    for pair in pairs:
        if all((folder / f"image_{camera}").is_dir() for camera in pair):
            return pair
    for left, right in pairs:
        for here, missing in ((left, right), (right, left)):
            if (folder / f"image_{here}").is_dir():
                raise SourceError(
                    "folder of the other camera is missing",
                    where=folder,
                    got=f"image_{here}",
                    expected=f"image_{missing} beside it",
                )
    raise SourceError(
        "folder has no pictures in KITTI's layout",
        where=folder,
        expected="image_0 and image_1, or image_2 and image_3",
    )


def _list_pairs(left: Path, right: Path) -> list[tuple[Path, Path]]:
    """Left and right picture of each frame, by name; a name on one side alone is an error."""
    names = [_list_pictures(folder) for folder in (left, right)]
    for here, there, folder in ((0, 1, right), (1, 0, left)):
        missing = sorted(names[here] - names[there])
        if missing:
            raise SourceError(
                "picture is missing",
                where=folder / missing[0],
                got=f"{len(names[0])} left and {len(names[1])} right pictures",
                hint="each frame needs a left and a right picture of the same name",
            )
    if not names[0]:
        raise SourceError("folder holds no pictures", where=left, expected="PNG, JPEG or PGM files")
    return [(left / name, right / name) for name in sorted(names[0])]


def _list_pictures(folder: Path) -> set[str]:
    if not folder.is_dir():
        raise SourceError("folder does not exist", where=folder)
    return {
        path.name
        for path in folder.iterdir()
        if path.suffix.lower() in _PICTURES and not path.name.startswith(".")
    }


def _read_times(path: Path, frames: int) -> Float64:
    """float64 (frames,), seconds, not decreasing."""
    if not path.exists():
        raise SourceError(
            "times are missing", where=path, hint="write one line per frame: its time in seconds"
        )
    table, lines = read_table(path, (1,))
    times: Float64 = table[:frames, 0].copy()
    if len(times) < frames:
        raise SourceError(
            "fewer times than pictures",
            where=path,
            got=f"{len(times)} times",
            expected=f"{frames}",
        )
    backwards = np.diff(times) < 0
    if backwards.any():
        raise FormatError(
            "time runs backwards", where=f"{path}:{lines[int(np.argmax(backwards)) + 1]}"
        )
    return times


def _find_poses(folder: Path) -> Path | None:
    path = folder.resolve()
    candidates = (path / "poses.txt", path.parent.parent / "poses" / f"{path.name}.txt")
    return next((candidate for candidate in candidates if candidate.is_file()), None)
