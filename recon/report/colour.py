"""Colours for values: one scale per kind of value, and one colour for unknown."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from recon.core.errors import ShapeError
from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, OccupancyTruth, Reason
from recon.core.values.arrays import UInt8
from recon.evaluation.occupancy import grid_on_truth

Rgb = tuple[int, int, int]

DISPARITY_SCALE: Final = "turbo"
CONFIDENCE_SCALE: Final = "viridis"
ERROR_SCALE: Final = "RdYlBu_r"
MISSING: Final[Rgb] = (20, 22, 26)

# Valid pixels recede and each failure stands out, also in lightness.
REASON_COLOURS: Final[Mapping[Reason, Rgb]] = MappingProxyType(
    {
        Reason.VALID: (226, 232, 236),
        Reason.LOW_TEXTURE: (86, 180, 233),
        Reason.AMBIGUOUS: (230, 159, 0),
        Reason.LEFT_RIGHT: (213, 94, 0),
        Reason.OCCLUDED: (140, 30, 80),
        Reason.OUT_OF_RANGE: (0, 114, 178),
        Reason.BORDER: (70, 76, 84),
        Reason.SPECKLE: (240, 100, 180),
        Reason.EDGE: (0, 158, 115),
    }
)
REASON_LABELS: Final[Mapping[Reason, str]] = MappingProxyType(
    {reason: reason.name.lower().replace("_", " ") for reason in Reason}
    | {Reason.LEFT_RIGHT: "left-right check", Reason.EDGE: "flying edge"}
)
_GRID_IMAGE_PX: Final = 1500
GRID_FREE: Final[Rgb] = (247, 249, 250)
GRID_OCCUPIED: Final[Rgb] = (24, 28, 34)
GRID_UNKNOWN: Final[Rgb] = (190, 197, 204)
# Correct cells keep the colours of a grid; cells that do not count are darker.
GRID_ERRORS: Final[Mapping[tuple[int, int], Rgb]] = MappingProxyType(
    {
        (FREE, FREE): GRID_FREE,
        (FREE, OCCUPIED): (230, 159, 0),
        (FREE, UNKNOWN): (160, 220, 190),
        (OCCUPIED, FREE): (213, 40, 40),
        (OCCUPIED, OCCUPIED): GRID_OCCUPIED,
        (OCCUPIED, UNKNOWN): (0, 114, 178),
    }
)
GRID_NOT_COUNTED: Final[Rgb] = (120, 128, 136)


def colour_disparity(
    values: NDArray[Any], low: float | None = None, high: float | None = None
) -> UInt8:
    """Colour a disparity map: far is blue, near is red, invalid is almost black.

    Args:
        values: (H, W), pixels; NaN = no match.
        low: Value of the first colour; None = 1st percentile of the finite values.
        high: Value of the last colour; None = 99th percentile.

    Returns:
        uint8 (H, W, 3) RGB.
    """
    return colour_values(values, DISPARITY_SCALE, value_range(values, low, high))


def colour_confidence(confidence: NDArray[Any]) -> UInt8:
    """Colour a confidence map (H, W) in [0, 1]; 0 (no match) is almost black."""
    known = np.where(confidence > 0, confidence, np.nan)
    return colour_values(known, CONFIDENCE_SCALE, (0.0, 1.0))


def colour_error(error: NDArray[Any], limit: float) -> UInt8:
    """Colour absolute errors: 0 is blue, ``limit`` and above is red, NaN is almost black.

    Args:
        error: (H, W), of either sign.
        limit: Error of the last colour, in the same unit.
    """
    return colour_values(np.abs(error), ERROR_SCALE, (0.0, limit))


def colour_reasons(reason: UInt8) -> UInt8:
    """Colour a map of `Reason` codes (H, W) by `REASON_COLOURS`."""
    table = np.zeros((len(Reason), 3), dtype=np.uint8)
    for code, colour in REASON_COLOURS.items():
        table[code] = colour
    highest = int(reason.max(initial=0))
    if highest >= len(table):
        raise ShapeError("reason code is unknown", got=highest, expected=f"0 to {len(table) - 1}")
    return table[reason]


def colour_grid(grid: OccupancyGrid) -> UInt8:
    """Colour a grid as a map with y up: row 0 of the image is the largest y.

    Returns:
        uint8 (rows, columns, 3) RGB: free is almost white, occupied almost black.
    """
    image = np.full((*grid.cells.shape, 3), GRID_UNKNOWN, dtype=np.uint8)
    image[grid.cells == FREE] = GRID_FREE
    image[grid.cells == OCCUPIED] = GRID_OCCUPIED
    return image[::-1]


def colour_grid_errors(grid: OccupancyGrid, truth: OccupancyTruth) -> UInt8:
    """Colour a grid by comparison with ground truth.

    Returns:
        uint8 (rows, columns, 3) RGB, row 0 = the largest y. Correct cells are almost white (free)
        or almost black (occupied); an obstacle marked free is red, one marked unknown blue, a
        false obstacle orange, free ground marked unknown green; unseen cells are grey. Each cell
        is a square of whole pixels, so that small grids are enlarged.
    """
    cells = grid_on_truth(grid, truth)
    image = np.full((*cells.shape, 3), GRID_NOT_COUNTED, dtype=np.uint8)
    for (true, found), colour in GRID_ERRORS.items():
        image[truth.seen & (truth.grid.cells == true) & (cells == found)] = colour
    side = max(1, _GRID_IMAGE_PX // max(image.shape[:2]))
    return np.asarray(image[::-1].repeat(side, axis=0).repeat(side, axis=1))


def colour_values(values: NDArray[Any], scale: str, limits: tuple[float, float]) -> UInt8:
    """Colour values of any shape by a matplotlib colormap; NaN gets `MISSING`."""
    colormap = colormaps[scale].with_extremes(bad=unit_colour(MISSING))
    shown = Normalize(*limits, clip=True)(np.ma.masked_invalid(values))
    return np.asarray(colormap(shown, bytes=True)[..., :3])


def value_range(
    values: NDArray[Any], low: float | None = None, high: float | None = None
) -> tuple[float, float]:
    """Return limits of a colour scale: as given, else the 1st and 99th percentile; never empty."""
    finite = np.asarray(values)[np.isfinite(values)]
    if finite.size:
        found_low, found_high = np.percentile(finite, (1.0, 99.0))
    else:
        found_low, found_high = 0.0, 1.0
    first = float(found_low if low is None else low)
    last = float(found_high if high is None else high)
    return (first, last) if last > first else (first, first + 1.0)


def unit_colour(colour: Rgb) -> tuple[float, float, float]:
    """Return a colour for matplotlib, with components in [0, 1]."""
    red, green, blue = colour
    return red / 255, green / 255, blue / 255
