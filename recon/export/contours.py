"""Lines of equal height of the ground, for programs of surveying and GIS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.errors import MappingError, require
from recon.core.values.arrays import Float64
from recon.export.product import ExportContext, ExportResult, ProductFigures
from recon.export.rasters import ground_blocks, ground_heights, place_of
from recon.io.models.lines import write_lines
from recon.map.ground.surface import CELL_M

_SIGMAS: Final = 3.0  # of the ground between two lines
_MOST_LEVELS: Final = 50
_INDEX: Final = 5  # every so many levels, a line is drawn bolder


@dataclass(frozen=True)
class ContourFigures(ProductFigures):
    """The lines."""

    lines: int
    interval_m: float  # between two heights

    @property
    def text(self) -> str:
        return f"{self.lines:,} lines, every {self.interval_m:g} m"


def contours_product(context: ExportContext, path: Path) -> ExportResult:
    """Write lines of equal height where points show the ground, perhaps where a survey says.

    The interval is three times the noise of the ground, and at least a fiftieth of its range,
    rounded up to 1, 2 or 5 of a power of ten.

    Ref: ASPRS, "Accuracy standards for large-scale maps", 1990 (RMSE of heights: a third of it).
    """
    contourpy = require("contourpy", extra="survey")
    place = place_of(context, CELL_M)
    heights = np.full((place.rows, place.columns), np.nan)
    for row, column, (ground_m, shown) in ground_blocks(context, place, ground_heights):
        at = heights[row : row + len(shown), column : column + shown.shape[1]]
        at[shown > 0] = ground_m[shown > 0]
    if np.isnan(heights).all():
        raise MappingError("no ground was found below the path, so it has no contours")
    low, high = float(np.nanmin(heights)), float(np.nanmax(heights))
    # Beside the mean of its neighbours, a height has 1.5 times the variance of its noise.
    off_m = heights[1:-1] - (heights[2:] + heights[:-2]) / 2
    noise_m = 1.4826 * float(np.nanmedian(np.abs(np.append(off_m, 0.0)))) / math.sqrt(1.5)
    interval_m = _rounded(max(_SIGMAS * noise_m, (high - low) / _MOST_LEVELS))
    x, y = place.centres(0, 0, heights.shape).transpose(2, 0, 1)
    drawn = contourpy.contour_generator(x, y, np.ma.masked_invalid(heights))
    lines, numbers = list[Float64](), list[int]()
    for number in range(math.ceil(low / interval_m), math.floor(high / interval_m) + 1):
        found = drawn.lines(number * interval_m)
        lines, numbers = lines + found, numbers + [number] * len(found)
    levels = np.array(numbers, int)
    columns = {"height": np.round(levels * interval_m, 9), "index": levels % _INDEX == 0}
    write_lines(path, lines, columns, context.crs)
    return ExportResult(ContourFigures(len(lines), interval_m))


def _rounded(length_m: float) -> float:
    """Return the next of 1, 2 and 5 of powers of ten; a centimetre at least."""
    power = 10.0 ** math.floor(math.log10(max(length_m, 0.01)))
    steps = (step * power for step in (1, 2, 5, 10))
    return next(float(f"{step:.1g}") for step in steps if step >= length_m * (1 - 1e-9))
