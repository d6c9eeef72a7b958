"""How much was dug and heaped up between two maps, or above a plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import MappingError
from recon.core.summary import Figures
from recon.core.values import PointCloud
from recon.core.values.arrays import Float64
from recon.export.rasters import columns_of
from recon.io.models.rasters import RasterPlace
from recon.map.cut import Rectangle

_BLOCK: Final = 25  # edge, in cells, of blocks whose errors are taken for independent
_SURE: Final = 1.96  # standard deviations; 95 %
_STABLE: Final = 3.0  # standard deviations, robust, within which nothing has changed


@dataclass(frozen=True, kw_only=True)
class VolumeFigures(Figures):
    """What was dug and heaped up, in cells that both have."""

    cut_m3: float
    fill_m3: float
    net_m3: float  # fill - cut; also of cells whose change is less than their noise
    sigma_m3: float  # standard deviation of it
    common_sigma_m: float  # by which all heights may be off together
    compared_m2: float
    not_compared_m2: float  # of cells that one has and the other lacks


def volume_between(
    before: PointCloud | float, after: PointCloud, cell_m: float, within: Rectangle | None = None
) -> VolumeFigures:
    """Return what was dug and heaped up from a cloud, or a level plane, to a later cloud.

    Heights are those of the uppermost points of cells whose middles lie ``within``; None = of all.
    Errors of points are independent. By how much one map lies too high as a whole is what blocks
    that did not change differ by, anywhere; a plane counts as exact. Cells whose heights differ by
    less than 1.96 standard deviations are neither dug nor heaped up: noise would be both.

    Raises:
        MappingError: There is no cell that both have.

    Ref: J. Wheaton et al., "Accounting for uncertainty in DEMs from repeat topographic surveys",
    Earth Surface Processes and Landforms 35, 2010 (changes that are sure).
    """
    clouds = [one for one in (before, after) if isinstance(one, PointCloud) and len(one)]
    if not clouds:
        raise MappingError("there are no points to compare")
    cells = np.concatenate([np.floor(one.xyz[:, :2] / cell_m) for one in clouds])
    (west, south), (east, north) = cells.min(axis=0).astype(int), cells.max(axis=0).astype(int) + 1
    place = RasterPlace(cell_m, int(west), int(north), int(east - west), int(north - south))
    (old_m, old_variance), (new_m, new_variance) = (_heights(place, one) for one in (before, after))
    rise_m, variance = new_m - old_m, old_variance + new_variance
    common_m = _common_m(rise_m) if isinstance(before, PointCloud) else 0.0
    inside = np.ones(rise_m.shape, np.bool_)
    if within is not None:
        middles = place.centres(0, 0, rise_m.shape)
        inside = within.contains(middles.reshape(-1, 2)).reshape(rise_m.shape)
    known, area_m2 = inside & ~np.isnan(rise_m), cell_m**2
    if not known.any():
        raise MappingError("there is no cell in which both have points")
    sure_m = np.where(rise_m**2 > _SURE**2 * (variance + common_m**2), rise_m, 0)[known]
    return VolumeFigures(
        cut_m3=-area_m2 * float(sure_m[sure_m < 0].sum()),
        fill_m3=area_m2 * float(sure_m[sure_m > 0].sum()),
        net_m3=area_m2 * float(rise_m[known].sum()),
        sigma_m3=area_m2 * float(np.sqrt(variance[known].sum() + (common_m * known.sum()) ** 2)),
        common_sigma_m=common_m,
        compared_m2=area_m2 * float(known.sum()),
        not_compared_m2=area_m2 * float((inside & (np.isnan(old_m) ^ np.isnan(new_m))).sum()),
    )


def _heights(place: RasterPlace, surface: PointCloud | float) -> tuple[Float64, Float64]:
    """Return heights of cells (rows, columns) and their variances; NaN = there is no point."""
    shape = place.rows, place.columns
    if not isinstance(surface, PointCloud):
        return np.full(shape, float(surface)), np.zeros(shape)
    height_m, variance = np.full((2, *shape), np.nan)
    if len(surface):
        sigma_m = 0.0 if surface.sigma_m is None else surface.sigma_m.astype(np.float64)
        weight = np.broadcast_to(1 / np.maximum(sigma_m, 1e-6) ** 2, len(surface))
        at, total = columns_of(place, surface.xyz.astype(np.float64), weight)
        with np.errstate(invalid="ignore", divide="ignore"):
            variance[at] = np.where(total(1.0) > 0, 1 / total(1.0), np.nan)
            height_m[at] = total(surface.xyz[:, 2]) / total(1.0)
    return height_m, variance


def _common_m(rise_m: Float64) -> float:
    """Return by how much blocks of cells that did not change are off beyond their noise (RMS)."""
    if np.isnan(rise_m).all():
        return 0.0
    off_m = np.abs(rise_m - np.nanmedian(rise_m))
    spread_m = 1.4826 * float(np.nanmedian(off_m))  # of a normal distribution
    stable, squares, sizes = off_m <= _STABLE * spread_m, list[float](), list[int]()
    for row in range(0, len(rise_m), _BLOCK):
        for column in range(0, rise_m.shape[1], _BLOCK):
            at = np.s_[row : row + _BLOCK, column : column + _BLOCK]
            found = rise_m[at][stable[at]]
            if len(found):  # a median has 1.57 times the variance of a mean
                squares.append(float(np.median(found)) ** 2 - 1.57 * spread_m**2 / len(found))
                sizes.append(len(found))
    return math.sqrt(max(float(np.average(squares, weights=sizes)), 0.0))
