"""Surfaces that another one replaced within the reach of *same*: displaced by more than error.

Patches around cells that both days saw are compared along their normal, as M3C2 does. How far such
patches are apart by error alone (matching, drift, leaves, grazing views) the map itself tells: by
the spread of those that are as rough on both days, and whose points are as uncertain. Displaced is
what is off by several times that, in pieces that are larger than chance makes them: sizes of pieces
that error makes fall geometrically, at a rate that the smaller ones show.

Ref: D. Lague, N. Brodu, J. Leroux, "Accurate 3D comparison of complex topography with terrestrial
laser scanner", ISPRS J. 82, 2013, section 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon.core.kernels.voxels import pack_keys
from recon.core.progress import tracked
from recon.core.values import PointCloud
from recon.core.values.arrays import Bool, Float32, Float64, Int64
from recon.map.occupancy.bodies import pieces_of

GAP_CELLS: Final = 2.5  # between cells of a piece; those of a body have gaps of two
PATCH: Final = 9  # cells of a surface that err together
_RADIUS: Final = 1.5  # of a patch, cells
_REACH: Final = 2.25  # how far along the normal the other day is looked at, cells
_MOST_POINTS: Final = 40  # of a patch: half as many again as a plane has, of two points a cell edge
_LEAST_POINTS: Final = 5  # of a patch, of which a plane and its error are known
_CLASSES: Final = 5  # of roughness, and of sigma, with a spread of their own
_DRIFT_CELLS: Final = 20  # edge of a square with one drift, by twice as much around its middle
_TURNS: Final = 8  # until outliers of the drift are known
_NORMAL: Final = 1.4826  # standard deviation of normal errors, in medians of their sizes
_SIGMAS: Final = 8.0  # of a displaced patch: the tails of errors are longer than normal ones
_LEAST_SPREAD: Final = 0.005  # cells: rounding and light, which no spread shows
_BY_CHANCE: Final = 0.01  # pieces in a map
_AT_ONCE: Final = 1 << 14  # cells, so that their neighbours fit into memory


def cells_of(xyz: Float32, cell_m: float) -> Int64:
    """Return the packed cells (N,) of points (N, 3)."""
    return pack_keys(np.floor(xyz / cell_m).astype(np.int64))


def find_displaced(before: PointCloud, after: PointCloud, cell_m: float) -> tuple[Bool, Bool]:
    """Return bool (N,) of either day: points of surfaces that were displaced on the other day."""
    if not (len(before) and len(after)):
        return np.zeros(len(before), np.bool_), np.zeros(len(after), np.bool_)
    pair = _Patches.of(before, after, cell_m), _Patches.of(after, before, cell_m)
    days = [replace(day, off_m=day.off_m - day.drift_m()) for day in pair]
    rough_m = np.concatenate([days[n].rough_beside(days[1 - n]) for n in (0, 1)])
    known, off_m, sigma_m = (
        np.concatenate([getattr(day, name) for day in days])
        for name in ("known", "off_m", "sigma_m")
    )
    rows, spread_m = np.flatnonzero(known), np.full(len(known), np.inf)
    for alike in np.array_split(rows[np.argsort(rough_m[rows], kind="stable")], _CLASSES):
        order = np.argsort(sigma_m[alike], kind="stable")
        for some in filter(len, np.array_split(alike[order], _CLASSES)):
            spread_m[some] = _NORMAL * np.median(np.abs(off_m[some]))
    far = np.abs(off_m) > _SIGMAS * np.maximum(spread_m, _LEAST_SPREAD * cell_m)
    parts = np.split(far, [len(days[0].known)])
    one, other = (day.in_pieces(part) for day, part in zip(days, parts, strict=True))
    return one, other


def least_displaced(sizes: Int64) -> int:
    """Return how many cells a piece has that is no chance, by the sizes of all pieces (P,)."""
    least = PATCH + 1
    while len(small := sizes[sizes < least]) > 1:
        mean = small.mean() + 2 * small.std() / math.sqrt(len(small))  # at 95 %
        if mean == 1:
            break
        rarer = math.log(_BY_CHANCE / (len(small) + 3)) / math.log(1 - 1 / mean)
        if 1 + rarer <= least:
            break
        least = math.ceil(1 + rarer)
    return least


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches of a day around its cells (C), and how far the other day is off them."""

    cell_m: float
    middles: Float64  # (C, 3), cells
    home: Int64  # (N,), cell of each point
    normals: Float64  # (C, 3)
    off_m: Float64  # (C,), along the normal
    rough_m: Float64  # (C,), inf = too few points
    sigma_m: Float64  # (C,), the larger one of both days
    known: Bool  # (C,), both days have enough points

    @classmethod
    def of(cls, own: PointCloud, other: PointCloud, cell_m: float) -> _Patches:
        _, home = np.unique(cells_of(own.xyz, cell_m), return_inverse=True)
        count = np.bincount(home)[:, None]
        middles = np.stack([np.bincount(home, axis) for axis in own.xyz.T], axis=1) / count
        trees = cKDTree(own.xyz), cKDTree(other.xyz)
        parts = [
            _compared(middles[first : first + _AT_ONCE], (own, other), trees, cell_m)
            for first in tracked(range(0, len(middles), _AT_ONCE), "parts", "compare surfaces")
        ]
        return cls(cell_m, middles / cell_m, home, *map(np.concatenate, zip(*parts, strict=True)))

    def rough_beside(self, other: _Patches) -> Float64:
        """Return how rough patches are on the day on which they are rougher."""
        there = self.middles + self.normals * (self.off_m / self.cell_m)[:, None]
        beside = other.rough_m[cKDTree(other.middles).query(there)[1]]
        return np.asarray(np.maximum(self.rough_m, beside))

    def drift_m(self) -> Float64:
        """Return (C,), along the normals, by how much all that is around is off, to most of it."""
        rows = np.flatnonzero(self.known & np.isfinite(self.rough_m))
        plan, drift_m = self.middles[:, :2], np.zeros((len(self.middles), 3))
        tree, at = cKDTree(plan[rows]), np.floor(plan / _DRIFT_CELLS).astype(np.int64)
        for square in np.unique(at[rows], axis=0):
            middle = (square + 0.5) * _DRIFT_CELLS
            near = rows[tree.query_ball_point(middle, 2 * _DRIFT_CELLS)]
            normals, off_m = self.normals[near], self.off_m[near]
            sure = weight = 1 / np.hypot(self.rough_m[near], 0.1 / _RADIUS * self.cell_m) ** 2
            for _ in range(_TURNS):
                weighted = normals * weight[:, None]
                least = 1e-3 * weight.sum() * np.eye(3)  # where no surface shows it
                shift_m = np.linalg.solve(weighted.T @ normals + least, weighted.T @ off_m)
                left = np.abs(off_m - normals @ shift_m)
                weight = sure * (left <= 3 * _NORMAL * np.median(left) + 1e-9)
            drift_m[(at == square).all(axis=1)] = shift_m
        return np.asarray((drift_m * self.normals).sum(axis=1))

    def in_pieces(self, far: Bool) -> Bool:
        """Return bool (N,), points in cells that are far off in pieces that are no chance."""
        found, rows = np.zeros(len(far), np.bool_), np.flatnonzero(far)
        pairs = cKDTree(self.middles[rows]).query_pairs(GAP_CELLS, output_type="ndarray")
        piece = pieces_of(len(rows), pairs.astype(np.int64))
        sizes = np.bincount(piece)
        found[rows] = (sizes >= least_displaced(sizes))[piece]
        return found[self.home]


def _compared(
    middles: Float64,
    clouds: tuple[PointCloud, PointCloud],
    trees: tuple[cKDTree, cKDTree],
    cell_m: float,
) -> tuple[Float64, Float64, Float64, Float64, Bool]:
    """Return the fields of `_Patches` from normals to known, of patches around some middles."""
    radius_m, reach_m = _RADIUS * cell_m, _REACH * cell_m
    off, row = trees[0].query(middles, _MOST_POINTS, distance_upper_bound=radius_m)
    own = np.isfinite(off)
    row[~own] = 0
    count = own.sum(axis=1)
    points = clouds[0].xyz[row].astype(np.float64)
    centre = (points * own[:, :, None]).sum(axis=1) / count[:, None]
    points = (points - centre[:, None]) * own[:, :, None]
    squares = np.einsum("nki,nkj->nij", points, points) / np.maximum(count - 1, 1)[:, None, None]
    variance, axes = np.linalg.eigh(squares)
    normals, rough_m = axes[:, :, 0], np.sqrt(variance[:, 0].clip(0.0))
    rough_m[count < _LEAST_POINTS] = np.inf
    height = np.einsum("nki,ni->nk", points, normals)
    within_m = math.hypot(radius_m, reach_m)
    off, at = trees[1].query(middles, 2 * _MOST_POINTS, distance_upper_bound=within_m)
    near = np.isfinite(off)
    at[~near] = 0
    ahead = clouds[1].xyz[at] - centre[:, None]
    along = np.einsum("nki,ni->nk", ahead, normals)
    beside = np.linalg.norm(ahead - along[:, :, None] * normals[:, None], axis=2)
    near &= (beside < radius_m) & (np.abs(along) < reach_m)
    known = np.minimum(count, near.sum(axis=1)) >= _LEAST_POINTS
    sigma_m = np.maximum(*map(_mean_sigma_m, clouds, (row, at), (own, near)))
    off_m = np.where(known, _median(along, near) - _median(height, own), 0.0)
    return normals, off_m, rough_m, sigma_m, known


def _mean_sigma_m(cloud: PointCloud, row: NDArray[np.intp], there: Bool) -> Float64:
    sigma_m = np.zeros(len(cloud)) if cloud.sigma_m is None else cloud.sigma_m
    total = (sigma_m[row] * there).sum(axis=1)
    return np.asarray(total / np.maximum(there.sum(axis=1), 1))


def _median(values: Float64, there: Bool) -> Float64:
    """Return the median of the values of each row that are there, 0 where none is."""
    ordered, count = np.sort(np.where(there, values, np.inf), axis=1), there.sum(axis=1)
    ends = np.stack([(count - 1).clip(0) // 2, count // 2], axis=1)
    ends = np.minimum(ends, values.shape[1] - 1)
    middle = np.take_along_axis(ordered, ends, axis=1).mean(axis=1)
    return np.asarray(np.where(count > 0, middle, 0.0))
