"""The SAD matcher: local windows, compared by the sum of absolute differences."""

from __future__ import annotations

import math
import os
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Literal

import cv2
import numpy as np
from pydantic import Field, model_validator
from typing_extensions import Self

from recon.kernels.half_windows import Search
from recon.kernels.refine import Rules
from recon.kernels.tiles import Tiles, offer_supported
from recon.matching.fill import fill_holes
from recon.matching.gradients import clipped_gradients, texture
from recon.matching.half_size import (
    LEAST_NDISP,
    divided,
    half_rules,
    half_search,
    halve,
    support,
    undivided,
    zero_texture,
)
from recon.matching.search import (
    MeasuredSettings,
    MinTexture,
    OddInt,
    UniquenessPercent,
    finish,
    rules_of,
)
from recon.matching.strips import StripSearch, in_strips
from recon.structures import Disparity, RectifiedCamera, RectifiedPair
from recon.structures.arrays import UInt8


class SadSettings(MeasuredSettings):
    """Settings of the SAD matcher."""

    window_px: OddInt = Field(default=11, ge=1, le=61, description="Width of the window; odd.")
    window_height_px: OddInt = Field(
        default=11, ge=1, le=61, description="Height of the window; odd."
    )
    window_slant: float = Field(
        default=1 / 3,
        ge=-1.0,
        le=1.0,
        description="Disparity per row of a second window, which competes with the upright one "
        "at each pixel; 0 = none. On level ground it is baseline / camera height. Its upper and "
        "its lower half are moved against each other by whole disparities, so it is rounded.",
    )
    prefilter: Literal["sobel", "none"] = Field(
        default="sobel", description="What is compared: horizontal gradients, or grey levels."
    )
    prefilter_cap: int = Field(
        default=31,
        ge=1,
        le=127,
        description="Gradients (Sobel units) are clipped to plus or minus this.",
    )
    cost_cap: int = Field(
        default=20,
        ge=1,
        le=255,
        description="Largest cost of one pixel; limits what an outlier or an edge can do.",
    )
    uniqueness_percent: UniquenessPercent = 2
    min_texture: MinTexture = 0.1
    half_size_first: bool = Field(
        default=True,
        description="Match the pictures at half size first, and search each tile only among the "
        "disparities found there.",
    )
    least_support: float = Field(
        default=0.03,
        ge=0.0,
        le=1.0,
        description="Least share of a tile's matches at half size that eight disparities must "
        "have to be searched there.",
    )
    median_px: Literal[0, 3, 5] = Field(
        default=0,
        description="Each disparity becomes the median of a square of this width around it, holes "
        "filled for that from the row; 0 = as measured.",
    )

    @model_validator(mode="after")
    def _costs_fit(self) -> Self:
        if self.window_px * (self.window_height_px + 1) * self.cost_cap >= 65535:
            raise ValueError("window_px x (window_height_px + 1) x cost_cap must stay below 65535")
        return self


class SadMatcher:
    """Compares windows of gradients and checks what it finds; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right picture reaches.

    Args:
        settings: What to search and what to believe.
        threads: Strips of rows worked on at once, all cores by default. The result does not
            depend on it.
    """

    def __init__(self, settings: SadSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = max(1, threads or os.cpu_count() or 1)
        prefilter = partial(_prefiltered, settings=settings)
        self._full = StripSearch(prefilter, self._threads)
        self._half = StripSearch(prefilter, self._threads)

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: No disparity of the range lies within the picture.
        """
        search, rules = self._plan(pair.camera)
        s = self._settings
        with ThreadPoolExecutor(self._threads) as pool:
            enough = partial(texture, pair, (s.window_px, s.window_height_px), s.min_texture)
            tiles = self._tiles(pool, pair, search)
            refined = self._full.find(pool, (pair.left, pair.right), search, tiles, rules, enough)
            found = finish(refined, s, pool, self._threads)
        return _smoothed(found, s.median_px)

    def _tiles(self, pool: Executor, pair: RectifiedPair, search: Search) -> Tiles:
        """Which candidates are offered where."""
        if not self._settings.half_size_first or search.ndisp < LEAST_NDISP:
            return undivided(search, pair.left.shape)
        halved = half_search(search)
        views = halve(pair.left), halve(pair.right)
        shape = views[0].shape
        asked = partial(zero_texture, shape[1], pair.valid)
        whole, rules = undivided(halved, shape), half_rules(halved)
        found = self._half.find(pool, views, halved, whole, rules, asked)
        tiles = divided(search, pair.left.shape)
        wanted = support(self._settings.least_support)
        values, minimum, ndisp = found.values, search.minimum, search.ndisp

        def offer(rows: range) -> None:
            offer_supported(values, minimum, ndisp, wanted, rows.start, rows.stop, tiles)

        in_strips(pool, self._threads, offer, len(tiles.offered))
        return tiles

    def _plan(self, camera: RectifiedCamera) -> tuple[Search, Rules]:
        s = self._settings
        ndisp = s.ndisp_within(camera)
        radius, rows_radius = s.window_px // 2, s.window_height_px // 2
        # The middles of the two halves lie half a radius above and below the pixel.
        lean = math.floor(s.window_slant * rows_radius / 2 + 0.5)
        search = Search(ndisp, s.min_disparity_px, radius, rows_radius, s.cost_cap, lean)
        return search, rules_of(s, ndisp, s.window_px * s.window_height_px)


def _smoothed(disparity: Disparity, median_px: int) -> Disparity:
    """The disparity with medians for values; what has none gets none."""
    if median_px == 0 or not disparity.valid.any():
        return disparity
    filled = np.nan_to_num(fill_holes(disparity.values))
    medians = cv2.medianBlur(filled, median_px)
    values = np.where(disparity.valid, medians, np.float32(np.nan))
    return replace(disparity, values=values)


def _prefiltered(image: UInt8, rows: range, settings: SadSettings) -> UInt8:
    """What the windows compare in N rows: uint8 (N, W)."""
    if settings.prefilter == "none":
        return image[rows.start : rows.stop]
    return clipped_gradients(image, settings.prefilter_cap, rows)
