"""The SAD matcher: local windows, compared by the sum of absolute differences."""

from __future__ import annotations

import math
import os
from concurrent.futures import Executor, ThreadPoolExecutor
from functools import partial
from typing import Final

from pydantic import Field

from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.stereo.kernels.half_windows import Search
from recon.stereo.kernels.refine import Rules
from recon.stereo.kernels.tiles import Tiles, offer_supported
from recon.stereo.match.gradients import clipped_gradients, texture
from recon.stereo.match.half_size import (
    LEAST_NDISP,
    divided,
    half_rules,
    half_search,
    halve,
    support,
    undivided,
    zero_texture,
)
from recon.stereo.match.search import (
    MeasuredSettings,
    OddInt,
    UniquenessPercent,
    finish,
    rules_of,
)
from recon.stereo.match.strips import StripSearch, in_strips

_GRADIENT_CAP: Final = 31
"""Gradients (Sobel units) are clipped to plus or minus this before they are compared."""

_COST_CAP: Final = 20
"""Largest cost of one pixel; limits what an outlier or an edge can do. Times the pixels of both
halves of the widest window it is below 65535, as the kernel wants."""

_LEAST_SUPPORT: Final = 0.03
"""Least share of a tile's matches at half size that eight disparities must have to be searched."""

WINDOW_SLANT: Final = 1 / 3
"""Disparity per row of a second window, which competes with the upright one at each pixel; 0 =
none. On level ground it is baseline / camera height. Its upper and its lower half are moved against
each other by whole disparities, so that any slant near this one is the same."""


class SadSettings(MeasuredSettings):
    """Settings of the SAD matcher."""

    window_px: OddInt = Field(
        default=11,
        ge=1,
        le=55,
        description="Edge of the square window; odd. Smaller keeps thin things and sharp edges, "
        "larger is denser where texture is weak.",
    )
    uniqueness_percent: UniquenessPercent = 2
    min_texture: float = Field(
        default=0.1,
        ge=0.0,
        le=255.0,
        description="Least mean horizontal gradient in the window, grey levels per pixel. Raise it "
        "where noise of a dark or plain surface is matched.",
    )
    half_size_first: bool = Field(
        default=True,
        description="Match the images at half size first, and search each tile only among the "
        "disparities found there. Off takes twice the time and may find thinner things.",
    )


class SadMatcher:
    """Compares windows of gradients and checks what it finds; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right image reaches.

    Args:
        settings: What to search and what to believe.
        threads: Strips of rows worked on at once, all cores by default. The result does not
            depend on it.
        average: Whether disparities are averaged with their neighbours.
    """

    def __init__(
        self, settings: SadSettings, threads: int | None = None, *, average: bool = True
    ) -> None:
        self._settings = settings
        self._average = average
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._full = StripSearch(_prefiltered, self._threads)
        self._half = StripSearch(_prefiltered, self._threads)

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: No disparity of the range lies within the image.
        """
        search, rules = self._plan(pair.camera)
        s = self._settings
        with ThreadPoolExecutor(self._threads) as pool:
            enough = partial(texture, pair, (s.window_px, s.window_px), s.min_texture)
            tiles = self._tiles(pool, pair, search)
            refined = self._full.find(pool, (pair.left, pair.right), search, tiles, rules, enough)
            return finish(refined, s, pool, self._threads, average=self._average)

    def _tiles(self, pool: Executor, pair: RectifiedPair, search: Search) -> Tiles:
        """Return which candidates are offered where."""
        if not self._settings.half_size_first or search.ndisp < LEAST_NDISP:
            return undivided(search, pair.left.shape)
        halved = half_search(search)
        views = halve(pair.left), halve(pair.right)
        shape = views[0].shape
        asked = partial(zero_texture, shape[1], pair.valid)
        whole, rules = undivided(halved, shape), half_rules(halved)
        found = self._half.find(pool, views, halved, whole, rules, asked)
        tiles = divided(search, pair.left.shape)
        wanted = support(_LEAST_SUPPORT)
        values, minimum, ndisp = found.values, search.minimum, search.ndisp

        def offer(rows: range) -> None:
            offer_supported(values, minimum, ndisp, wanted, rows.start, rows.stop, tiles)

        in_strips(pool, self._threads, offer, len(tiles.offered))
        return tiles

    def _plan(self, camera: RectifiedCamera) -> tuple[Search, Rules]:
        s = self._settings
        ndisp = s.ndisp_within(camera)
        radius = s.window_px // 2
        # The middles of the two halves lie half a radius above and below the pixel.
        slant = math.floor(WINDOW_SLANT * radius / 2 + 0.5)
        search = Search(ndisp, s.min_disparity_px, radius, radius, _COST_CAP, slant)
        return search, rules_of(s, ndisp, s.window_px**2, min_texture=s.min_texture)


def _prefiltered(image: UInt8, rows: range) -> UInt8:
    """Return what the windows compare in N rows: uint8 (N, W)."""
    return clipped_gradients(image, _GRADIENT_CAP, rows)
