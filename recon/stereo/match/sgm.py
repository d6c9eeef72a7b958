"""The semi-global matcher: gradients and census in small windows, aggregated along paths."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final

from pydantic import Field, model_validator
from typing_extensions import Self

from recon.core.values import Disparity, RectifiedCamera, RectifiedPair
from recon.stereo.kernels.minima import empty_minima
from recon.stereo.kernels.path_costs import (
    CENSUS_RADIUS,
    Views,
    Window,
    empty_planes,
    scaled_window,
    write_views,
)
from recon.stereo.kernels.paths import Paths
from recon.stereo.kernels.plane_minima import PARTS
from recon.stereo.kernels.refine import REFINED_BYTES, refine_minima, refined_in
from recon.stereo.kernels.semi_global import (
    band_columns,
    empty_scratch,
    scratch_bytes,
    semi_global_minima,
)
from recon.stereo.match import search as common

_LEVELS: Final = 250  # largest path cost before rounding, which needs the rest of a byte
_ODDS: Final = 2.4  # `Rules.odds`, fitted on MiddEval3; 2003, 2005 and 2006 were held out
_STRIP_ROWS: Final = 192
_SIDE_OVERLAP: Final = 16  # columns shared by bands: horizontal and diagonal paths start there
_COST_CAP: Final = 14  # largest difference of gradients that counts at one pixel
# Of one pixel: of its gradient and of all bits of the census.
_LARGEST_COST: Final = _COST_CAP + (2 * CENSUS_RADIUS + 1) ** 2 - 1
# Where the image changes by more along a path, large steps are cheaper: surfaces end there.
_EDGE_GREY_LEVELS: Final = 12
_EDGE_P2_SHARE: Final = 0.25  # share of P2 that is left there
_OVERLAP_ROWS: Final = 4  # rows that strips share, for vertical paths to start in
_MEMORY_BYTES: Final = 1536 << 20  # what strips that are worked on at once need together, at most


class SgmSettings(common.MeasuredSettings):
    """Settings of the semi-global matcher."""

    window_px: common.OddInt = Field(5, ge=1, le=31)
    """Edge of the square window; odd. Larger suppresses noise and widens edges."""
    p1: float = Field(16.0, gt=0.0, le=255.0)
    """Penalty of a step of one disparity along a path, as a mean cost of one pixel. Smaller where
    most surfaces are slanted."""
    p2: float = Field(50.0, gt=0.0, le=1000.0)
    """Penalty of a larger step along a path, as a mean cost of one pixel. Larger is smoother, and
    fills more of what is plain; smaller keeps thin things."""

    @model_validator(mode="before")
    @classmethod
    def _has_new_names(cls, values: Any) -> Any:
        for old, new in (("small_penalty", "p1"), ("large_penalty", "p2")):
            if isinstance(values, Mapping) and old in values:
                raise ValueError(f"{old} is now called {new}")
        return values

    @model_validator(mode="after")
    def _penalties_fit(self) -> Self:
        if self.p1 > self.p2:
            raise ValueError("p1 must not exceed p2")
        return self


class SgmMatcher:
    """Aggregates costs along paths through the image, and checks the result; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right image reaches.
    ``threads`` (None = all cores) has no effect on the result.
    """

    def __init__(self, settings: SgmSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._scratch = common.ScratchPool(empty_scratch, self._threads)
        self._planes = common.ScratchPool(empty_planes, 1)
        self._minima = common.ScratchPool(empty_minima, 1)
        self._results = common.ResultPool(2)

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair."""
        s = self._settings
        ndisp = s.ndisp_within(pair.camera)
        window, size = _window(s), pair.left.shape
        paths = _paths(s, ndisp, window.levels)
        # A cost is about so many times the mean cost of a pixel.
        rules = common.rules_of(s, ndisp, max(1, round(PARTS * window.levels)), odds=_ODDS)
        results = self._results.lend(REFINED_BYTES * pair.left.size)
        refined = refined_in(results, *size)

        def prepare(strip: range) -> None:
            write_views(pair.right, window.radius, s.min_disparity_px, strip, views)

        def search(strip: range) -> None:
            with self._scratch.borrow(pair.camera.width_px, paths) as scratch:
                semi_global_minima(views, window, paths, strip, scratch, minima)
            enough = common.no_texture(pair.camera.width_px, pair.valid, strip)
            refine_minima(minima, enough, rules, strip.start, strip.stop, refined)

        strips, at_once = self._strips(pair.camera, paths)
        with (
            self._planes.borrow(*size, window.radius, ndisp) as planes,
            self._minima.borrow(*size) as minima,
            ThreadPoolExecutor(at_once) as pool,
        ):
            views = Views(pair.left, *planes)
            list(pool.map(prepare, strips))
            list(pool.map(search, strips))
            return common.finish(refined, pool, at_once)

    def _strips(self, camera: RectifiedCamera, paths: Paths) -> tuple[list[range], int]:
        height = camera.height_px
        # An even number of strips keeps two cores busy to the end.
        rows = -(-height // (2 * -(-height // (2 * _STRIP_ROWS))))
        bytes_each = scratch_bytes(band_columns(camera.width_px, paths), paths)
        at_once = min(self._threads, _MEMORY_BYTES // bytes_each)
        strips = [range(y, min(y + rows, height)) for y in range(0, height, rows)]
        return strips, max(1, at_once)


def _window(settings: SgmSettings) -> Window:
    s = settings
    return scaled_window(
        radius=s.window_px // 2,
        rows_radius=s.window_px // 2,
        gradient_cap=_COST_CAP,
        largest=_LARGEST_COST,
        levels=_LEVELS / (_LARGEST_COST + s.p1 + s.p2),
    )


def _paths(settings: SgmSettings, ndisp: int, levels: float) -> Paths:
    s = settings
    p2 = round(s.p2 * levels)
    p1 = max(1, round(s.p1 * levels))
    return Paths(
        ndisp=ndisp,
        minimum=s.min_disparity_px,
        p1=p1,
        p2=p2,
        p2_at_edge=max(p1, round(p2 * _EDGE_P2_SHARE)),
        edge=_EDGE_GREY_LEVELS,
        overlap=_OVERLAP_ROWS,
        side_overlap=_SIDE_OVERLAP,
    )
