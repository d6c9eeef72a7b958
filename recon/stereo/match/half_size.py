"""Search at half size, which decides where to search at full size.

It takes an eighth of the time. Its reliable matches give the disparities of each tile; a match at
another disparity would more often than not be wrong, so a search among fewer candidates is not only
faster, but also more accurate.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.values.arrays import UInt8
from recon.stereo.kernels.half_windows import Search, widest_block
from recon.stereo.kernels.refine import NO_FIT, Rules
from recon.stereo.kernels.tiles import Support, Tiles, make_tiles

RADIUS_PX: Final = 3
"""Half the window at half size: smaller than at full size, or thin things are lost."""

UNIQUENESS_PERCENT: Final = 5
LEFT_RIGHT_PX: Final = 1

LEAST_NDISP: Final = 32
"""With fewer candidates a search at half size takes longer than it saves."""

TILE_HEIGHT_PX: Final = 16
_TILE_COLUMNS: Final = 160
"""Columns of a tile together with those that its windows reach over."""

SUPPORT: Final = Support(margin_x=8, margin_y=8, margin=3, matched=0.15, share=0.03, least=4)
"""How much support at half size offers candidates to a tile."""


def halve(image: UInt8) -> UInt8:
    """Return means of two by two pixels; a last row or column that is left over counts twice."""
    rows, columns = image.shape
    even = image
    if rows % 2 or columns % 2:
        even = np.pad(image, ((0, rows % 2), (0, columns % 2)), mode="edge")
    size = (even.shape[1] // 2, even.shape[0] // 2)
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def half_search(search: Search) -> Search:
    """Return what to search at half size."""
    minimum = search.minimum // 2
    ndisp = -(-(search.minimum + search.ndisp) // 2) - minimum
    return Search(ndisp, minimum, RADIUS_PX, RADIUS_PX, search.cost_cap, slant=0)


def half_rules(search: Search) -> Rules:
    """Return what makes a match of a search at half size reliable."""
    return Rules(
        ndisp=search.ndisp,
        minimum=search.minimum,
        fit=NO_FIT,
        texture=0.0,
        uniqueness=UNIQUENESS_PERCENT,
        left_right=LEFT_RIGHT_PX,
        window_pixels=(2 * RADIUS_PX + 1) ** 2,
        sigma_floor_px=0.1,
    )


def undivided(search: Search, shape: tuple[int, int]) -> Tiles:
    """Return one tile from top to bottom, offered everything, as wide as is fast."""
    return make_tiles(shape, (shape[0], widest_block(search, shape[1])), search.ndisp)


def divided(search: Search, shape: tuple[int, int]) -> Tiles:
    """Return the tiles that are offered what half size supports."""
    height = max(TILE_HEIGHT_PX, search.rows_radius)
    width = min(_TILE_COLUMNS - 2 * search.radius, shape[1])
    return make_tiles(shape, (height, width), search.ndisp)
