"""The semi-global matcher: gradients and census in small windows, aggregated along paths."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Final

from recon.core.values import Disparity, RectifiedPair
from recon.stereo.kernels.minima import empty_minima
from recon.stereo.kernels.path_costs import (
    CENSUS_RADIUS,
    Views,
    Window,
    WriteCosts,
    empty_planes,
    scaled_window,
    window_costs,
    write_views,
)
from recon.stereo.kernels.paths import Paths
from recon.stereo.kernels.plane_minima import PARTS
from recon.stereo.kernels.refine import REFINED_BYTES, Rules, refine_minima, refined_in
from recon.stereo.kernels.semi_global import (
    band_columns,
    empty_scratch,
    scratch_bytes,
    semi_global_minima,
)
from recon.stereo.match import search as common

LEVELS: Final = 250  # largest path cost before rounding, which needs the rest of a byte
ODDS: Final = 2.4  # `Rules.odds`, fitted on MiddEval3; 2003, 2005 and 2006 were held out
_STRIP_ROWS: Final = 192
_SIDE_OVERLAP: Final = 16  # columns shared by bands: horizontal and diagonal paths start there
COST_CAP: Final = 14  # largest difference of gradients that counts at one pixel
# Of one pixel: of its gradient and of all bits of the census.
LARGEST_COST: Final = COST_CAP + (2 * CENSUS_RADIUS + 1) ** 2 - 1
# Where the image changes by more along a path, large steps are cheaper: surfaces end there.
EDGE_GREY_LEVELS: Final = 12
EDGE_P2_SHARE: Final = 0.25  # fraction of P2 that is left there
# Penalties of a step of one disparity along a path, and of a larger one, as mean costs of a pixel.
# A smaller P1 is for slanted surfaces, a larger P2 fills more of what is plain, a smaller one keeps
# thin things: all tables of docs/results.md are of these two, and no rig has asked for others.
_P1, _P2 = 16.0, 50.0
_WINDOW_PX, _MOST_WINDOW_PX = 5, 31  # usual and widest edge of the window
_OVERLAP_ROWS: Final = 4  # rows that strips share, for vertical paths to start in
_MEMORY_BYTES: Final = 1536 << 20  # what strips that are worked on at once need together, at most


class SgmMatcher:
    """Aggregates costs along paths through the image, and checks the result; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right image reaches.
    ``threads`` (None = all cores) has no effect on the result.
    """

    def __init__(self, settings: common.SearchSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._window = _window(settings.window_within(_WINDOW_PX, _MOST_WINDOW_PX) // 2)
        self.reach_px = self._window.radius + 1  # paths carry on what windows say
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._planes = common.ScratchPool(empty_planes, 1)
        self._search = PathSearch(self._threads)

    def match(self, pair: RectifiedPair) -> Disparity:
        s = self._settings
        ndisp = s.ndisp_within(pair.camera)
        window = self._window
        paths = paths_of(ndisp, s.min_disparity_px, _P1, _P2, window.levels)
        # A cost is about so many times the mean cost of a pixel.
        rules = common.rules_of(s, ndisp, max(1, round(PARTS * window.levels)), odds=ODDS)
        with self._planes.borrow(*pair.left.shape, window.radius, ndisp) as planes:
            views = Views(pair.left, *planes)

            def prepare(strip: range) -> None:
                write_views(pair.right, window.radius, s.min_disparity_px, strip, views)

            costs = partial(window_costs, views, window)
            return self._search.run(pair, costs, window.radius, paths, rules, prepare)


class PathSearch:
    """Finds the best candidates along paths, whatever writes the costs of the pixels."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._scratch = common.ScratchPool(empty_scratch, threads)
        self._minima = common.ScratchPool(empty_minima, 1)
        self._results = common.ResultPool(2)

    def run(
        self,
        pair: RectifiedPair,
        costs: Callable[[int], WriteCosts],
        radius: int,
        paths: Paths,
        rules: Rules,
        prepare: Callable[[range], None] | None = None,
    ) -> Disparity:
        """Return the disparity, checked and refined.

        ``costs`` makes, for bands of so many columns, what writes costs of a reach of ``radius``;
        ``prepare`` is done before for each strip of rows.
        """
        size = pair.left.shape
        refined = refined_in(self._results.lend(REFINED_BYTES * pair.left.size), *size)

        def search(strip: range) -> None:
            with self._scratch.borrow(size[1], paths) as scratch:
                write = costs(scratch.columns)
                semi_global_minima(pair.left, write, radius, paths, strip, scratch, minima)
            enough = common.no_texture(size[1], pair.valid, strip)
            refine_minima(minima, enough, rules, strip.start, strip.stop, refined)

        # An even number of strips keeps two cores busy to the end.
        rows = -(-size[0] // (2 * -(-size[0] // (2 * _STRIP_ROWS))))
        strips = [range(y, min(y + rows, size[0])) for y in range(0, size[0], rows)]
        bytes_each = scratch_bytes(band_columns(size[1], paths), paths)
        at_once = max(1, min(self._threads, _MEMORY_BYTES // bytes_each))
        with self._minima.borrow(*size) as minima, ThreadPoolExecutor(at_once) as pool:
            if prepare is not None:
                list(pool.map(prepare, strips))
            list(pool.map(search, strips))
            return common.finish(refined, pool, at_once)


def _window(radius: int) -> Window:
    return scaled_window(
        radius=radius,
        rows_radius=radius,
        gradient_cap=COST_CAP,
        largest=LARGEST_COST,
        levels=LEVELS / (LARGEST_COST + _P1 + _P2),
    )


def paths_of(ndisp: int, minimum: int, p1: float, p2: float, levels: float) -> Paths:
    """Return candidates and penalties, ``levels`` steps of a path cost for one of a pixel's."""
    large = round(p2 * levels)
    small = max(1, round(p1 * levels))
    return Paths(
        ndisp=ndisp,
        minimum=minimum,
        p1=small,
        p2=large,
        p2_at_edge=max(small, round(large * EDGE_P2_SHARE)),
        edge=EDGE_GREY_LEVELS,
        overlap=_OVERLAP_ROWS,
        side_overlap=_SIDE_OVERLAP,
    )
