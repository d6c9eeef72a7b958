"""What changed as files: a cloud by class, a map from above, pictures of both days."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from recon.core.errors import ReconError
from recon.core.geometry.se3 import apply, invert
from recon.core.progress import tracked
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from recon.core.values.arrays import Float64, UInt8
from recon.core.values.camera import project
from recon.export.product import DriveImages, open_drive
from recon.io.images.image import write_image
from recon.io.models.columns import table_of
from recon.io.models.ply import write_tables
from recon.io.models.rasters import write_nav2_costs
from recon.map.changes.compare import Comparison
from recon.map.changes.objects import CAME, CLASSES, NOT_COMPARED, SAME, WENT, ChangedObject, Day
from recon.map.store.map_file import MapFile

_COLOURS: Final = np.array([[170] * 3, [30, 110, 235], [235, 120, 20], [80, 80, 60]], np.uint8)
_VALUES: Final = {NOT_COMPARED: UNKNOWN, SAME: FREE, WENT: OCCUPIED // 2, CAME: OCCUPIED}
"""Of cells seen from above; a cell is of the last of these classes that it has."""
_PICTURES: Final = 24  # of the largest objects
_LEAST_PX: Final = 100  # of a side of what is cut out
_SIDE_PX: Final = 360  # of what is shown of it
_FAR_PX: Final = 9999  # where lines end that leave an image
_NEAR_M: Final = 0.1  # so near are corners drawn that are behind a camera


def write_changes(found: Comparison, stem: Path) -> None:
    """Write the cloud by class, each point with its ``day`` (0, 1), and the map from above."""
    days, cell_m = (found.before, found.after), found.before.observations.settings.resolution_m
    xyz = np.concatenate([day.cloud.xyz for day in days])
    classes = np.concatenate([day.classes for day in days])
    colours = zip(("red", "green", "blue"), _COLOURS[classes].T, strict=True)
    day = np.repeat(np.arange(2, dtype=np.uint8), [len(day.cloud) for day in days])
    table = table_of(xyz, {"change": classes, "day": day, **dict(colours)})
    write_tables(stem.with_suffix(".ply"), {"vertex": table}, ["frame map"])
    low = np.floor(xyz[:, :2].min(axis=0) / cell_m)
    i, j = (np.floor(xyz[:, :2] / cell_m) - low).astype(int).T
    cells = np.full((j.max() + 1, i.max() + 1), UNKNOWN, np.int8)
    for kind, value in _VALUES.items():
        cells[j[classes == kind], i[classes == kind]] = value
    x_m, y_m = (low * cell_m).tolist()
    write_nav2_costs(stem, OccupancyGrid(cells, cell_m, (x_m, y_m)))


class Pictures:
    """Pictures of what changed, of both days, by the images of the drives of a map.

    ``missing`` says why the images of some drives, by number, cannot be read.
    """

    def __init__(self, map_: MapFile, found: Comparison) -> None:
        self._found, self.missing, self._drives = found, dict[int, str](), dict[int, DriveImages]()
        for session in map_.linked:
            try:
                self._drives[session.number] = open_drive(map_, session)
            except ReconError as error:  # noqa: PERF203 - few drives
                self.missing[session.number] = str(error)

    def write(self, path: Callable[[str], Path]) -> list[ChangedObject]:
        """Write pictures of the largest objects, BEFORE on the left; return all objects."""
        objects = [*self._found.objects]
        for place, changed in enumerate(tracked(objects[:_PICTURES], "pictures", "drawn")):
            came = changed.change == CLASSES[CAME]
            own, other = (self._found.before, self._found.after)[:: -1 if came else 1]
            T = own.observations.T_map_camera
            off_m = np.linalg.norm(T[:, :3, 3] - changed.centre_m, axis=1)
            near = self._best(changed, own, changed.hits / off_m**2)
            if near is None:
                continue
            turned = np.abs(other.observations.T_map_camera - T[near])[:, :3, 2:]
            turned[:, :, 1] /= off_m[near]
            there = self._best(changed, other, 1 / (1e-3 + turned.sum(axis=(1, 2))))
            images = [self._drawn(changed, own, near), self._drawn(changed, other, there)]
            name = f"pictures/{changed.number:03d}.jpg"
            write_image(path(name), np.hstack(images[:: -1 if came else 1]))
            objects[place] = replace(changed, picture=name)
        return objects

    def _best(self, changed: ChangedObject, day: Day, worth: Float64) -> int | None:
        """Return the frame of a day of most worth (F,), where the object is in the image."""
        score = [
            one and self._inside(changed, *name) ** 2 * one
            for one, name in zip(worth.tolist(), day.observations.frames, strict=True)
        ]
        best = int(np.argmax(score))
        return best if score[best] > 0 else None

    def _inside(self, changed: ChangedObject, number: int, frame: int) -> float:
        """Return which fraction of an object is in an image, or is before its drive's camera."""
        if number not in self._drives:
            return 0.0
        drive = self._drives[number]
        camera = drive.session.camera
        u, v, _ = project(apply(invert(drive.T_map_camera[frame]), changed.xyz), camera)
        return float(np.mean((u > 0) & (u < camera.width_px) & (v > 0) & (v < camera.height_px)))

    def _drawn(self, changed: ChangedObject, day: Day, row: int | None) -> UInt8:
        """Return a square of an image around an object, its box drawn; grey without a frame."""
        if row is None:
            return np.full((_SIDE_PX, _SIDE_PX, 3), 60, np.uint8)
        number, frame = day.observations.frames[row]
        drive = self._drives[number]
        image = drive.rectified(next(iter(drive.source.frames(frame))))[0]
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) if image.ndim == 2 else image.copy()
        ahead = apply(invert(drive.T_map_camera[frame]), changed.corners_m)
        ahead[:, 2] = np.maximum(ahead[:, 2], _NEAR_M)
        uv = np.stack(project(ahead, drive.session.camera)[:2], axis=1).clip(-_FAR_PX, _FAR_PX)
        corners = np.rint(uv).astype(np.int32)
        colour = _COLOURS[CLASSES.index(changed.change)].tolist()
        sides = [corners[:4], corners[4:], *(corners[[n, n + 4]] for n in range(4))]
        cv2.polylines(image, sides, isClosed=True, color=colour, lineType=cv2.LINE_AA)
        size = np.array(image.shape[1::-1])
        uv = uv.clip(0, size)
        side = min(max(_LEAST_PX, 2 * int(np.ptp(uv, axis=0).max())), *size)
        x, y = ((uv.min(axis=0) + uv.max(axis=0) - side) / 2).clip(0, size - side).astype(int)
        shown = cv2.resize(image[y : y + side, x : x + side], (_SIDE_PX, _SIDE_PX))
        return np.asarray(shown, np.uint8)
