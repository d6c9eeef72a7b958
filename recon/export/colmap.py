"""The drives of a map as a model of COLMAP, with the rectified images that it is of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.core.geometry.se3 import apply, invert
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.camera import project
from recon.export.product import DriveImages, ExportContext, ExportResult, ProductFigures
from recon.io.images.image import write_image
from recon.io.models.colmap import ColmapModel, Seen, write_colmap
from recon.places.adjustment import shared_points
from recon.places.closure import Closure, DrivePath
from recon.sources.source import check_source


@dataclass(frozen=True)
class ColmapFigures(ProductFigures):
    """A COLMAP model."""

    colmap_images: int
    colmap_points: int


def colmap_product(context: ExportContext, folder: Path) -> ExportResult:
    """Write a folder with ``images`` and ``sparse/0``, in map axes.

    Cameras are those of the rectified images: pinholes without distortion, the right one a baseline
    beside the left one, which is the reference of the rig. The points are features of keyframes.
    """
    images = points = 0
    with write_colmap(folder / "sparse" / "0") as model:
        for drive in context.drives:
            check_source(drive.source, stereo=True)
            written = _Written(drive, model, first=points + 1)
            for names, pair in written.frames():
                for name, image in zip(names, pair, strict=True):
                    write_image(folder / "images" / name, image)
                    images += 1
            points += written.add_points()
    warnings = [] if points else ["no points in the COLMAP model: no keyframes share any"]
    return ExportResult(ColmapFigures(images, points), warnings)


class _Written:
    """A drive on its way into a model: its frames, then the points that they see."""

    def __init__(self, drive: DriveImages, model: ColmapModel, first: int) -> None:
        self._drive, self._model, self._first = drive, model, first
        session = drive.session
        path = DrivePath.of(session.odometry, session.health, session.scale)
        closure, keyframes = Closure(session.trajectory, session.closed, ()), session.keyframes
        among = [frame for frame in keyframes.frames if drive.placed[frame]]
        self._camera = session.camera
        self._points = shared_points(path, closure, keyframes, self._camera, among)
        self._xyz = apply(drive.session.T_map_world, self._points.xyz)
        self._rgb = np.zeros((len(self._xyz), 3), np.uint8)
        self._off_px = np.zeros(len(self._xyz))  # summed over the images of a point
        self._tracks: list[list[tuple[int, int]]] = [[] for _ in self._rgb]

    def frames(self) -> Iterator[tuple[list[str], tuple[UInt8, ...]]]:
        """Add all frames, one after the other; yield the names of their images, and these."""
        drive, rig = self._drive, self._model.add_rig(self._camera)
        for frame, images in drive.views():
            names = [drive.file(side, frame) for side in ("left", "right")]
            T_camera_map = invert(drive.T_map_camera[frame])
            seen = self._seen(frame, images[0], T_camera_map)
            numbers = self._model.add_frame(rig, T_camera_map, names, seen)
            for number, (_, points) in zip(numbers, seen, strict=True):
                for place, point in enumerate((points - self._first).tolist()):
                    self._tracks[point].append((number, place))
            yield names, images

    def _seen(self, frame: int, left: UInt8, T_camera_map: Float64) -> list[Seen]:
        """Return what the left and the right image see; note its colours, and how far it is off."""
        seen, node = self._points.seen, np.flatnonzero(self._points.frames == frame)
        rows = np.isin(seen.node, node)
        (u, v, d), points = seen.uvd[rows].T, seen.point[rows]
        height_px, width_px = left.shape[:2]
        column, row = (np.rint(x).astype(np.intp) for x in (u, v))
        column, row = np.clip(column, 0, width_px - 1), np.clip(row, 0, height_px - 1)
        self._rgb[points] = left.reshape(height_px, width_px, -1)[row, column]
        inside = (u - d >= 0) & (u - d <= width_px - 1)
        at_u, at_v, at_d = project(apply(T_camera_map, self._xyz[points]), self._camera)
        views = (u, at_u, np.full(len(u), True)), (u - d, at_u - at_d, inside)
        for x, at_x, k in views:
            self._off_px[points[k]] += np.hypot(at_x - x, at_v - v)[k]
        return [(np.column_stack([x, v])[k], points[k] + self._first) for x, _, k in views]

    def add_points(self) -> int:
        off_px = self._off_px / np.maximum(1, [*map(len, self._tracks)])
        each = zip(self._xyz, self._rgb.tolist(), off_px.tolist(), self._tracks, strict=True)
        for number, point in enumerate(each, start=self._first):
            self._model.add_point(number, *point)
        return len(self._xyz)
