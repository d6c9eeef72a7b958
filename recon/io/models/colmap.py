"""A model of COLMAP, as text and as binary files, written frame by frame.

Ref: https://colmap.github.io/format.html (rigs and frames since COLMAP 3.12); the binary files are
those of COLMAP's ``scene/reconstruction_io_binary.cc``, with the number of records first.
"""

from __future__ import annotations

import struct
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

_PINHOLE: Final = 1  # numbers of the binary format
_CAMERA: Final = 0
_FILES: Final = ("rigs", "cameras", "frames", "images", "points3D")
PIXEL_CENTRE: Final = 0.5  # of the first pixel; in ours it is 0
Seen = tuple[Float64, NDArray[np.intp]]
"""Columns and rows (K, 2) in an image, pixel centres at integers, and the points' numbers (K,)."""


class ColmapModel:
    """An open model. Rigs, frames, images and points are numbered from 1."""

    def __init__(self, text: dict[str, IO[str]], binary: dict[str, IO[bytes]]) -> None:
        self._text, self._binary, self._frames = text, binary, 0
        self._records = dict.fromkeys(binary, 0)
        self._rigs: list[RectifiedCamera] = []

    def add_rig(self, camera: RectifiedCamera) -> int:
        """Add two rectified cameras, of which the left one is the reference; their number."""
        self._rigs.append(camera)
        number, f, cy = len(self._rigs), camera.focal_px, camera.cy_px + PIXEL_CENTRE
        left, right = sensors = _pair(number)
        for sensor, cx in zip(sensors, (camera.cx_px, camera.cx_right_px), strict=True):
            size = camera.width_px, camera.height_px
            lens = f, f, cx + PIXEL_CENTRE, cy
            self._line("cameras", sensor, "PINHOLE", *size, *lens)
            self._record("cameras", "Ii2Q4d", sensor, _PINHOLE, *size, *lens)
        pose = _pose(_right_left(camera))
        self._line("rigs", number, 2, "CAMERA", left, "CAMERA", right, 1, *pose)
        self._record("rigs", "2IiIiIB7d", number, 2, _CAMERA, left, _CAMERA, right, 1, *pose)
        return number

    def add_frame(
        self, rig: int, T_camera_world: Float64, names: Sequence[str], seen: Sequence[Seen]
    ) -> tuple[int, int]:
        """Add a pair of images with what each sees; the numbers of the two images."""
        self._frames += 1
        sensors, images = _pair(rig), _pair(self._frames)
        poses = T_camera_world, _right_left(self._rigs[rig - 1]) @ T_camera_world
        for k, (uv, points) in enumerate(seen):
            view, name, count = (images[k], *_pose(poses[k]), sensors[k]), names[k], len(points)
            found = zip((uv + PIXEL_CENTRE).tolist(), points.tolist(), strict=True)
            words = [word for place, point in found for word in (*place, point)]
            self._line("images", *view, name)
            self._line("images", *words)
            named = f"I7dI{len(name) + 1}sQ" + "2dQ" * count
            self._record("images", named, *view, name.encode(), count, *words)
        frame = self._frames, rig, *_pose(T_camera_world), 2
        each = [(sensor, image) for sensor, image in zip(sensors, images, strict=True)]
        self._line("frames", *frame, *(word for one in each for word in ("CAMERA", *one)))
        data = (word for one in each for word in (_CAMERA, *one))
        self._record("frames", "2I7dI" + "iIQ" * 2, *frame, *data)
        return images

    def add_point(
        self,
        number: int,
        xyz: Float64,
        rgb: Sequence[int],
        error_px: float,
        track: Sequence[tuple[int, int]],
    ) -> None:
        """Add a point; ``track`` has image and place in what it sees, of all that see it."""
        words = [word for sighting in track for word in sighting]
        point = number, *xyz.tolist(), *rgb, error_px
        self._line("points3D", *point, *words)
        self._record("points3D", "Q3d3BdQ" + "2I" * len(track), *point, len(track), *words)

    def _line(self, file: str, *words: float | str) -> None:
        self._text[file].write(" ".join(map(str, words)) + "\n")

    def _record(self, file: str, layout: str, *words: float | bytes) -> None:
        self._records[file] += 1
        self._binary[file].write(struct.pack("<" + layout, *words))

    def count(self) -> None:
        """Write in front of the binary files how many records they have."""
        for name, file in self._binary.items():
            file.seek(0)
            file.write(struct.pack("<Q", self._records[name]))


@contextmanager
def write_colmap(folder: Path) -> Iterator[ColmapModel]:
    """Open a model to be written into a folder; its files appear when all is done."""
    with ExitStack() as stack:
        text: dict[str, IO[str]] = {}
        binary: dict[str, IO[bytes]] = {}
        for name in _FILES:
            path = stack.enter_context(atomic_path(folder / f"{name}.txt"))
            text[name] = stack.enter_context(path.open("w", encoding="utf-8"))
            path = stack.enter_context(atomic_path(folder / f"{name}.bin"))
            binary[name] = stack.enter_context(path.open("wb"))
            binary[name].write(bytes(8))
        model = ColmapModel(text, binary)
        yield model
        model.count()


def _pair(number: int) -> tuple[int, int]:
    """Return the numbers of the left and the right sensor of a rig, or image of a frame."""
    return 2 * number - 1, 2 * number


def _right_left(camera: RectifiedCamera) -> Float64:
    return make_transform(np.eye(3), np.array([-camera.baseline_m, 0.0, 0.0]))


def _pose(T: Float64) -> list[float]:
    x, y, z, w = quaternion_from_rotation(T[:3, :3]).tolist()
    return [w, x, y, z, *T[:3, 3].tolist()]
