"""What came or went in pieces: where, how large, how much, and which frames saw it.

Error alone changes patches of cells anywhere: evidence is averaged over cells that touch, so those
within 3 × 3 of a surface err together. Pieces that are no larger say how frequent that is: with a
frequency ``p``, chance makes ``n·(c·p)^(k-1)`` pieces of ``k`` patches from ``n``, if a patch can
be joined in ``c`` ways (a bound of the number of lattice animals). Pieces are objects from the size
of which less than one in ten maps has one by chance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from recon.core.dates import date_of_stamp
from recon.core.progress import tracked
from recon.core.summary import Figures, hidden
from recon.core.values import PointCloud
from recon.core.values.arrays import Bool, Float64, Int64, UInt8
from recon.map.changes.displaced import GAP_CELLS, PATCH, cells_of
from recon.map.occupancy.bodies import FrameObservations, pieces_of
from recon.map.store.session import Session

CLASSES: Final = ("same", "came", "went", "not compared")
SAME, CAME, WENT, NOT_COMPARED = range(4)
_WAYS: Final = math.e * 8  # to join a patch: so many touch it
_BY_CHANCE: Final = 0.1  # pieces in a map


@dataclass(frozen=True, eq=False)
class Day:
    """Drives, what they saw, and their cloud, map axes, with the class of each point (N,).

    ``displaced`` (N,) are those of surfaces that another one replaced (`find_displaced`).
    """

    sessions: Sequence[Session]
    observations: FrameObservations
    cloud: PointCloud
    classes: UInt8
    displaced: Bool

    @property
    def not_compared_ratio(self) -> float:
        """Fraction of the points, which are as dense as voxels, that could not be compared."""
        return float(np.mean(self.classes == NOT_COMPARED)) if len(self.cloud) else 0.0


@dataclass(frozen=True)
class Sighting(Figures):
    """A frame that saw an object; ``date`` is that of its drive where its stamp is none."""

    session: int
    drive: str
    frame: int
    time_s: float
    date: str  # UTC; "" = not known


@dataclass(frozen=True, eq=False)
class ChangedObject(Figures):
    """Something that came or went; its box is in map axes, turned from x to y by its heading."""

    number: int
    change: str  # came or went
    centre_m: Float64  # (3,)
    length_m: float
    width_m: float
    height_m: float
    heading_deg: float
    volume_m3: float | None  # of what was seen, over the other day's ground; None = not seen then
    volume_sigma_m3: float | None
    points: int
    first_seen: Sighting
    last_seen: Sighting
    corners_m: Float64 = hidden()  # (8, 3), those of its box, the lower four first
    xyz: Float64 = hidden()  # (N, 3), its points
    hits: Int64 = hidden()  # (F,), cells of it that each frame of its day hit
    picture: str | None = None  # None = no image of either day could be read


def objects_of(own: Day, other: Day, kind: int) -> list[ChangedObject]:
    """Return the objects of a day among its points of the class ``CAME`` or ``WENT``."""
    seen, chosen = own.observations, own.classes == kind
    cloud = own.cloud.select(chosen)
    cell_m = seen.settings.resolution_m
    keys, home = np.unique(cells_of(cloud.xyz, cell_m), return_inverse=True)
    if not len(keys):
        return []
    middles = np.stack([np.bincount(home, axis) for axis in cloud.xyz.T], axis=1)
    tree = cKDTree(middles / (np.bincount(home)[:, None] * cell_m))
    pairs = tree.query_pairs(GAP_CELLS, output_type="ndarray").astype(np.int64)
    piece = pieces_of(len(keys), pairs)
    sizes = np.bincount(piece)
    compared = len(np.unique(cells_of(own.cloud.xyz[own.classes != NOT_COMPARED], cell_m)))
    displaced = np.bincount(piece[home], own.displaced[chosen]) > 0  # no chance, however small
    small = int((sizes[~displaced] <= PATCH).sum())
    enough = displaced | (sizes >= least_cells(small, compared))
    hits = np.zeros((len(seen.frames), len(sizes)), np.int64)
    for frame, look in tracked(seen.by_frame(keys), "frames", f"see what {CLASSES[kind]}"):
        hits[frame] = np.bincount(piece[look > 0], minlength=len(sizes))
    return [
        _object(own, other, cloud.select(piece[home] == one), hits[:, one], kind)
        for one in np.flatnonzero(enough & hits.any(axis=0)).tolist()
    ]


def least_cells(small: int, compared: int) -> int:
    """Return how many cells a piece has that is no chance, where so many are small."""
    small += 3  # so many may be expected where none was seen, at 95 %
    joined = _WAYS * small * PATCH / max(compared, 1)
    if joined >= 1:
        return compared + 1
    return 1 + PATCH * max(1, math.ceil(math.log(_BY_CHANCE / small) / math.log(joined)))


def _object(own: Day, other: Day, cloud: PointCloud, hits: Int64, kind: int) -> ChangedObject:
    """Return an object by its points."""
    xyz, seen = cloud.xyz.astype(np.float64), np.flatnonzero(hits).tolist()
    rectangle = cv2.minAreaRect(np.ascontiguousarray(cloud.xyz[:, :2]))
    (x, y), (length, width), turn = rectangle
    if width > length:
        length, width, turn = width, length, turn + 90.0
    low, high = float(xyz[:, 2].min()), float(xyz[:, 2].max())
    plan = np.tile(cv2.boxPoints(rectangle), (2, 1))
    return ChangedObject(
        0, CLASSES[kind], np.array([x, y, (low + high) / 2]), length, width, high - low,
        (turn + 90.0) % 180.0 - 90.0, *_volume(cloud, other.cloud, own.observations),
        len(cloud), _sighting(own, seen[0]), _sighting(own, seen[-1]),
        np.column_stack([plan, np.repeat([low, high], 4)]), xyz, hits,
    )  # fmt: skip


def _sighting(day: Day, row: int) -> Sighting:
    number, frame = day.observations.frames[row]
    session = next(one for one in day.sessions if one.number == number)
    time_s = float(session.trajectory.timestamps_s[frame])
    date = date_of_stamp(time_s).text or session.date.text
    return Sighting(number, session.info.source, frame, time_s, date)


def _volume(
    cloud: PointCloud, other: PointCloud, seen: FrameObservations
) -> tuple[float | None, float | None]:
    """Return the volume between points and the lowest ones of another day, and its sigma, m³.

    Summed are columns that both days saw. Those at the border are covered by half, give or take
    1/√12; the errors of heights are those of the points.
    """
    cell_m = seen.settings.resolution_m
    low = np.floor(cloud.xyz[:, :2].min(axis=0) / cell_m)
    shape = tuple((np.floor(cloud.xyz[:, :2].max(axis=0) / cell_m) - low + 1).astype(int))
    top, ground = np.full(shape, -np.inf), np.full(shape, np.inf)
    for heights, add, of in ((top, np.maximum, cloud), (ground, np.minimum, other)):
        columns = (np.floor(of.xyz[:, :2] / cell_m) - low).astype(int)
        inside = ((columns >= 0) & (columns < shape)).all(axis=1)
        add.at(heights, (*columns[inside].T,), of.xyz[inside, 2])
    both = np.isfinite(top) & np.isfinite(ground)
    if not both.any():
        return None, None
    height_m = (top[both] - ground[both]).clip(0.0)
    whole = binary_erosion(np.pad(np.isfinite(top), 1))[1:-1, 1:-1][both]
    covered = np.where(whole, 1.0, 0.5)
    sigmas = [np.zeros(1) if of.sigma_m is None else of.sigma_m for of in (cloud, other)]
    error_m = math.hypot(*(float(np.median(one)) for one in sigmas))
    variance = (covered * error_m) ** 2 + np.where(whole, 0.0, height_m**2 / 12)
    return float(height_m @ covered) * cell_m**2, float(np.sqrt(variance.sum())) * cell_m**2
