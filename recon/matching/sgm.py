"""The semi-global matcher: gradients and census in small windows, aggregated along paths."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Final

from pydantic import Field, model_validator
from typing_extensions import Self

from recon.kernels.census import Descriptor
from recon.kernels.minima import empty_minima
from recon.kernels.path_costs import (
    Views,
    Window,
    column_offsets,
    empty_planes,
    scaled_window,
    write_views,
)
from recon.kernels.path_rows import Paths
from recon.kernels.plane_minima import PARTS
from recon.kernels.refine import REFINED_BYTES, refine_minima, refined_in
from recon.kernels.semi_global import band_columns, empty_scratch, scratch_bytes, semi_global_minima
from recon.matching.gradients import texture
from recon.matching.scratch import ResultPool, ScratchPool
from recon.matching.search import MeasuredSettings, OddInt, finish, rules_of
from recon.structures import Disparity, RectifiedCamera, RectifiedPair

_LEVELS: Final = 250
"""Largest path cost before rounding, which needs the rest of a byte."""

_ODDS: Final = 2.4
"""`Rules.odds` of this matcher, fitted on MiddEval3; 2003, 2005 and 2006 were held out."""

_STRIP_ROWS: Final = 192

_SIDE_OVERLAP: Final = 16
"""Columns that neighbouring bands share: horizontal and diagonal paths start there."""


class SgmSettings(MeasuredSettings):
    """Settings of the semi-global matcher."""

    window_px: OddInt = Field(default=5, ge=1, le=31, description="Width of the window; odd.")
    window_height_px: OddInt = Field(
        default=5, ge=1, le=31, description="Height of the window; odd."
    )
    prefilter_cap: int = Field(
        default=127,
        ge=1,
        le=127,
        description="Horizontal gradients (Sobel units) are clipped to plus or minus this.",
    )
    cost_cap: int = Field(
        default=14,
        ge=0,
        le=127,
        description="Largest difference of gradients that counts at one pixel; 0 = census alone.",
    )
    census_px: OddInt = Field(
        default=5,
        ge=1,
        le=9,
        description="Width of the census, whose bits are added to the gradients; odd. 1 by 1 = "
        "gradients alone.",
    )
    census_height_px: OddInt = Field(
        default=5, ge=1, le=9, description="Height of the census; odd."
    )
    small_penalty: float = Field(
        default=16.0,
        gt=0.0,
        le=255.0,
        description="For a step of one disparity along a path, as a mean cost of one pixel.",
    )
    large_penalty: float = Field(
        default=50.0,
        gt=0.0,
        le=1000.0,
        description="For a larger step along a path, as a mean cost of one pixel.",
    )
    edge_grey_levels: int = Field(
        default=12,
        ge=0,
        le=255,
        description="Where the picture changes by more along a path, large steps are cheaper.",
    )
    edge_penalty_share: float = Field(
        default=0.25, ge=0.0, le=1.0, description="Share of large_penalty that is left there."
    )
    overlap_rows: int = Field(
        default=4,
        ge=0,
        le=1024,
        description="Rows that each strip of a picture shares with its neighbours.",
    )
    memory_mb: int = Field(
        default=1536,
        ge=1,
        description="Strips are worked on at once as long as they need less than this together.",
    )

    @model_validator(mode="after")
    def _costs_fit(self) -> Self:
        if self.largest_cost == 0:
            raise ValueError("cost_cap 0 needs a census of more than one pixel")
        if self.small_penalty > self.large_penalty:
            raise ValueError("small_penalty must not exceed large_penalty")
        if self.window_px * self.window_height_px * self.largest_cost > 65535:
            raise ValueError("window_px x window_height_px x (cost_cap + census) exceeds 65535")
        return self

    @property
    def largest_cost(self) -> int:
        """Largest cost of one pixel: of its gradient and of all bits of the census."""
        return self.cost_cap + self.census_px * self.census_height_px - 1


class SgmMatcher:
    """Aggregates costs along paths through the picture, and checks the result; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right picture reaches.

    Args:
        settings: What to search and what to believe.
        threads: Strips of rows worked on at once, all cores by default. The result does not
            depend on it.
    """

    def __init__(self, settings: SgmSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._scratch = ScratchPool(empty_scratch, self._threads)
        self._planes = ScratchPool(empty_planes, 1)
        self._minima = ScratchPool(empty_minima, 1)
        self._results = ResultPool(2)

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: No disparity of the range lies within the picture.
        """
        s = self._settings
        ndisp = s.ndisp_within(pair.camera)
        window, descriptor, size = _window(s), _descriptor(s), pair.left.shape
        paths = _paths(s, ndisp, window.levels)
        # A cost is about so many times the mean cost of a pixel.
        rules = rules_of(s, ndisp, max(1, round(PARTS * window.levels)), _ODDS)
        results = self._results.lend(REFINED_BYTES * pair.left.size)
        refined = refined_in(results, *size)

        def prepare(strip: range) -> None:
            offsets = column_offsets(window, ndisp, s.min_disparity_px)
            write_views(pair.right, descriptor, offsets, strip, views)

        def search(strip: range) -> None:
            with self._scratch.borrow(pair.camera.width_px, paths) as scratch:
                semi_global_minima(views, window, paths, strip, scratch, minima)
            enough = texture(pair, (s.window_px, s.window_height_px), s.min_texture, strip)
            refine_minima(minima, enough, rules, strip.start, strip.stop, refined)

        strips, at_once = self._strips(pair.camera, paths)
        with (
            self._planes.borrow(*size, descriptor.planes, window.radius, ndisp) as planes,
            self._minima.borrow(*size) as minima,
            ThreadPoolExecutor(at_once) as pool,
        ):
            views = Views(pair.left, *planes)
            list(pool.map(prepare, strips))
            list(pool.map(search, strips))
            return finish(refined, s, pool, at_once)

    def _strips(self, camera: RectifiedCamera, paths: Paths) -> tuple[list[range], int]:
        """The strips of a picture, and how many may be worked on at once."""
        height = camera.height_px
        # An even number of strips keeps two cores busy to the end.
        rows = -(-height // (2 * -(-height // (2 * _STRIP_ROWS))))
        bytes_each = scratch_bytes(band_columns(camera.width_px, paths), paths)
        at_once = min(self._threads, (self._settings.memory_mb << 20) // bytes_each)
        strips = [range(y, min(y + rows, height)) for y in range(0, height, rows)]
        return strips, max(1, at_once)


def _descriptor(settings: SgmSettings) -> Descriptor:
    s = settings
    return Descriptor(s.prefilter_cap, s.census_height_px // 2, s.census_px // 2)


def _window(settings: SgmSettings) -> Window:
    s = settings
    return scaled_window(
        radius=s.window_px // 2,
        rows_radius=s.window_height_px // 2,
        gradient_cap=s.cost_cap,
        largest=s.largest_cost,
        levels=_LEVELS / (s.largest_cost + s.small_penalty + s.large_penalty),
    )


def _paths(settings: SgmSettings, ndisp: int, levels: float) -> Paths:
    s = settings
    large = round(s.large_penalty * levels)
    small = max(1, round(s.small_penalty * levels))
    return Paths(
        ndisp=ndisp,
        minimum=s.min_disparity_px,
        small=small,
        large=large,
        large_at_edge=max(small, round(large * s.edge_penalty_share)),
        edge=s.edge_grey_levels,
        overlap=s.overlap_rows,
        side_overlap=_SIDE_OVERLAP,
    )
