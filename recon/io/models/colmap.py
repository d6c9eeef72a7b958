"""A model of COLMAP as text files, written frame by frame: rigs, cameras, images, points.

Ref: https://colmap.github.io/format.html (rigs and frames since COLMAP 3.12).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.geometry.se3 import make_transform, quaternion_from_rotation
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.io.atomic import atomic_path

_FILES: Final = ("rigs", "cameras", "frames", "images", "points3D")
PIXEL_CENTRE: Final = 0.5  # of the first pixel; in ours it is 0
Seen = tuple[Float64, NDArray[np.intp]]
"""Columns and rows (K, 2) in an image, pixel centres at integers, and the points' numbers (K,)."""


class ColmapModel:
    """An open model. Rigs, frames, images and points are numbered from 1."""

    def __init__(self, files: dict[str, IO[str]]) -> None:
        self._files, self._frames = files, 0
        self._rigs: list[RectifiedCamera] = []

    def add_rig(self, camera: RectifiedCamera) -> int:
        """Add two rectified cameras, of which the left one is the reference; their number."""
        self._rigs.append(camera)
        number, f, cy = len(self._rigs), camera.focal_px, camera.cy_px + PIXEL_CENTRE
        left, right = sensors = _pair(number)
        for sensor, cx in zip(sensors, (camera.cx_px, camera.cx_right_px), strict=True):
            size = camera.width_px, camera.height_px
            self._line("cameras", sensor, "PINHOLE", *size, f, f, cx + PIXEL_CENTRE, cy)
        pose = _pose(_right_left(camera))
        self._line("rigs", number, 2, "CAMERA", left, "CAMERA", right, 1, *pose)
        return number

    def add_frame(
        self, rig: int, T_camera_world: Float64, names: Sequence[str], seen: Sequence[Seen]
    ) -> tuple[int, int]:
        """Add a pair of images with what each sees; the numbers of the two images."""
        self._frames += 1
        sensors, images = _pair(rig), _pair(self._frames)
        poses = T_camera_world, _right_left(self._rigs[rig - 1]) @ T_camera_world
        for k, (uv, points) in enumerate(seen):
            self._line("images", images[k], *_pose(poses[k]), sensors[k], names[k])
            found = zip((uv + PIXEL_CENTRE).tolist(), points.tolist(), strict=True)
            self._line("images", *(word for place, point in found for word in (*place, point)))
        data = (f"CAMERA {sensor} {image}" for sensor, image in zip(sensors, images, strict=True))
        self._line("frames", self._frames, rig, *_pose(T_camera_world), 2, *data)
        return images

    def add_point(
        self, number: int, xyz: Float64, rgb: Sequence[int], track: Sequence[tuple[int, int]]
    ) -> None:
        """Add a point; ``track`` has image and place in what it sees, of all that see it."""
        error_px, words = -1, (word for sighting in track for word in sighting)  # not computed
        self._line("points3D", number, *xyz.tolist(), *rgb, error_px, *words)

    def _line(self, file: str, *words: float | str) -> None:
        self._files[file].write(" ".join(map(str, words)) + "\n")


@contextmanager
def write_colmap(folder: Path) -> Iterator[ColmapModel]:
    """Open a model to be written into a folder; its files appear when all is done."""
    with ExitStack() as stack:
        paths = {name: stack.enter_context(atomic_path(folder / f"{name}.txt")) for name in _FILES}
        files = {name: path.open("w", encoding="utf-8") for name, path in paths.items()}
        yield ColmapModel({name: stack.enter_context(file) for name, file in files.items()})


def _pair(number: int) -> tuple[int, int]:
    """Return the numbers of the left and the right sensor of a rig, or image of a frame."""
    return 2 * number - 1, 2 * number


def _right_left(camera: RectifiedCamera) -> Float64:
    return make_transform(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0]))


def _pose(T: Float64) -> list[float]:
    x, y, z, w = quaternion_from_rotation(T[:3, :3]).tolist()
    return [w, x, y, z, *T[:3, 3].tolist()]
