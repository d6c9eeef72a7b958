"""The SAD matcher: local windows, compared by the sum of absolute differences."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.stereo.kernels.half_windows import (
    Search,
    Support,
    Tiles,
    empty_scratch,
    empty_views,
    lay_out,
    make_tiles,
    offer_supported,
    widest_block,
)
from recon.stereo.kernels.minima import empty_minima
from recon.stereo.kernels.refine import REFINED_BYTES, Refined, Rules, refine_minima, refined_in
from recon.stereo.kernels.sad import sad_minima
from recon.stereo.match import search as common
from recon.stereo.match.protocol import Matcher

_MIN_TEXTURE: Final = 0.1  # least mean horizontal gradient in the window, grey levels per pixel
# Largest cost of one pixel; limits what an outlier or an edge can do. Times the pixels of both
# halves of the widest window it is below 65535, as the kernel wants.
_COST_CAP: Final = 20
# Disparity per row of a second window, which competes with the upright one at each pixel; 0 = none.
# On level ground it is baseline / camera height. Its upper and its lower half are moved against
# each other by whole disparities, so that any slant near this one is the same.
WINDOW_SLANT: Final = 1 / 3
RADIUS_PX: Final = 3  # half the window at half size: with that of full size thin things are lost
UNIQUENESS_PERCENT: Final = 5
_WINDOW_PX, _MOST_WINDOW_PX = 11, 55  # usual and widest edge of the window: its costs fit 16 bits
_UNIQUENESS_PERCENT: Final = 2  # of a search at full size; at half size more is asked
LEAST_NDISP: Final = 32  # with fewer candidates a search at half size takes longer than it saves
TILE_HEIGHT_PX: Final = 16
_TILE_COLUMNS: Final = 160  # columns of a tile together with those that its windows reach over
# How much support at half size offers candidates to a tile.
SUPPORT: Final = Support(margin_x=8, margin_y=8, margin=3, matched=0.15, ratio=0.03, least=4)


class SadMatcher:
    """Compares windows of gradients and checks what it finds; a `Matcher`.

    Every pixel is searched, those at the left border as far as the right image reaches.
    ``threads`` (None = all cores) has no effect on the result; ``average`` = disparities are
    averaged with their neighbours.
    """

    def __init__(
        self, settings: common.SearchSettings, threads: int | None = None, *, average: bool = True
    ) -> None:
        self._settings = settings
        self._window_px = settings.window_within(_WINDOW_PX, _MOST_WINDOW_PX)
        self.reach_px = self._window_px // 2
        self._average = average
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._full = _StripSearch(self._threads)
        self._half = _StripSearch(self._threads)

    def match(self, pair: RectifiedPair) -> Disparity:
        s, radius = self._settings, self.reach_px
        ndisp = s.ndisp_within(pair.camera)
        # The middles of the two halves lie half a radius above and below the pixel.
        slant = math.floor(WINDOW_SLANT * radius / 2 + 0.5)
        search = Search(ndisp, s.min_disparity_px, radius, radius, _COST_CAP, slant)
        rules = common.rules_of(
            s, ndisp, self._window_px**2, min_texture=_MIN_TEXTURE, uniqueness=_UNIQUENESS_PERCENT
        )
        with ThreadPoolExecutor(self._threads) as pool:
            enough = partial(common.texture, pair, self._window_px)
            tiles = self._tiles(pool, pair, search)
            refined = self._full.find(pool, (pair.left, pair.right), search, tiles, rules, enough)
            return common.finish(refined, pool, self._threads, average=self._average)

    def _tiles(self, pool: Executor, pair: RectifiedPair, search: Search) -> Tiles:
        if search.ndisp < LEAST_NDISP:
            return undivided(search, pair.left.shape)
        minimum = search.minimum // 2
        ndisp = -(-(search.minimum + search.ndisp) // 2) - minimum
        halved = Search(ndisp, minimum, RADIUS_PX, RADIUS_PX, search.cost_cap, slant=0)
        views = halve(pair.left), halve(pair.right)
        shape = views[0].shape
        valid = None if pair.valid is None else pair.valid[::2, ::2]
        asked = partial(common.no_texture, shape[1], valid)
        # What makes a match at half size reliable.
        own = common.SearchSettings(min_disparity_px=minimum, uniqueness_percent=UNIQUENESS_PERCENT)
        rules = common.rules_of(own, ndisp, (2 * RADIUS_PX + 1) ** 2)._replace(fit=False)
        whole = undivided(halved, shape)
        found = self._half.find(pool, views, halved, whole, rules, asked)
        tiles = divided(search, pair.left.shape)
        given, rows = (found.values, search.minimum, search.ndisp, SUPPORT), len(tiles.offered)
        common.run_kernel(pool, self._threads, rows, offer_supported, given, tiles)
        return tiles


class _StripSearch:
    """Searches images, one strip of rows per thread, and keeps its memory between pairs."""

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._scratch = common.ScratchPool(empty_scratch, threads)
        self._views = common.ScratchPool(empty_views, 1)
        self._minima = common.ScratchPool(empty_minima, 1)
        self._results = common.ResultPool(2)

    def find(
        self,
        pool: Executor,
        images: tuple[UInt8, UInt8],
        search: Search,
        tiles: Tiles,
        rules: Rules,
        texture: Callable[[range], Float32],
    ) -> Refined:
        """Search, check and refine; ``texture`` gives that of some rows of the left image."""
        height, width = images[0].shape
        results = self._results.lend(REFINED_BYTES * height * width)
        refined = refined_in(results, height, width)

        def prepare(strip: range) -> None:
            left, right = (common.clipped_gradients(image, strip) for image in images)
            lay_out(left, right, search, strip.start, views)

        def search_strip(strip: range) -> None:
            with self._scratch.borrow(search, tiles.width) as scratch:
                sad_minima(views, search, tiles, strip.start, strip.stop, scratch, minima)
            refine_minima(minima, texture(strip), rules, strip.start, strip.stop, refined)

        with (
            self._views.borrow(search, tiles.width, height, width) as views,
            self._minima.borrow(height, width) as minima,
        ):
            common.in_strips(pool, self._threads, prepare, height)
            common.in_strips(pool, self._threads, search_strip, height)
        return refined


def halve(image: UInt8) -> UInt8:
    """Return means of two by two pixels; a last row or column that is left over counts twice."""
    rows, columns = image.shape
    even = image
    if rows % 2 or columns % 2:
        even = np.pad(image, ((0, rows % 2), (0, columns % 2)), mode="edge")
    size = (even.shape[1] // 2, even.shape[0] // 2)
    return np.asarray(cv2.resize(even, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def undivided(search: Search, shape: tuple[int, int]) -> Tiles:
    """Return one tile from top to bottom, offered everything, as wide as is fast."""
    return make_tiles(shape, (shape[0], widest_block(search, shape[1])), search.ndisp)


def divided(search: Search, shape: tuple[int, int]) -> Tiles:
    """Return the tiles that are offered what half size supports."""
    height = max(TILE_HEIGHT_PX, search.rows_radius)
    width = min(_TILE_COLUMNS - 2 * search.radius, shape[1])
    return make_tiles(shape, (height, width), search.ndisp)


_COARSE_WIDTH_PX: Final = 200  # of the small pair, about; images are reduced by whole factors
_STEP: Final = 16
_SHARE: Final = 99.5  # percentile of the trusted disparities in the range, before its margin
_LEAST_MATCHES: Final = 100
_CONFIDENCE: Final = 0.8


class AutoRangeMatcher:
    """Chooses the range of another matcher by the pair alone: resumed runs give the same result."""

    def __init__(self, matcher: Matcher, minimum_px: int = 0) -> None:
        self._matcher = matcher
        self._minimum_px = minimum_px

    def match(self, pair: RectifiedPair) -> Disparity:
        if pair.camera.ndisp is None:
            ndisp = estimate_ndisp(pair, self._minimum_px)
            pair = replace(pair, camera=replace(pair.camera, ndisp=ndisp))
        return self._matcher.match(pair)


def estimate_ndisp(pair: RectifiedPair, minimum_px: int = 0) -> int:
    """Return the number of disparities that a pair needs, a multiple of 16.

    The pair is matched at a small size. Its trusted disparities show how near the scene is; a tenth
    and one small pixel are added, because small objects may be nearer. It is at least
    `usual_ndisp`, also where too little can be trusted, and at most the image's width (rounded up).
    """
    height, width = pair.left.shape
    usual = common.usual_ndisp(width)
    if width < 6 or height < width // _COARSE_WIDTH_PX:
        return usual
    values = match_small(pair)[1]
    factor, trusted = width // values.shape[1], values[np.isfinite(values)]
    if trusted.size < _LEAST_MATCHES:
        return usual
    nearest_px = factor * (1.1 * float(np.percentile(trusted, _SHARE)) + 1.0)
    needed = min(nearest_px, width) - minimum_px + 1
    return max(usual, _STEP * int(np.ceil(needed / _STEP)))


def match_small(pair: RectifiedPair) -> tuple[RectifiedPair, Float32]:
    """Match a pair at a small size; return it at that size, and what can be trusted, or NaN."""
    height, width = pair.left.shape
    factor = max(1, width // _COARSE_WIDTH_PX)
    size = width // factor, height // factor
    camera = replace(pair.camera.resized(*size), ndisp=size[0] // 2)
    wholes = (im[: size[1] * factor, : size[0] * factor] for im in (pair.left, pair.right))
    left, right = (cv2.resize(whole, size, interpolation=cv2.INTER_AREA) for whole in wholes)
    small = RectifiedPair(np.asarray(left, np.uint8), np.asarray(right, np.uint8), camera)
    settings = common.SearchSettings(window_px=7, uniqueness_percent=10)
    found = SadMatcher(settings, threads=1, average=False).match(small)
    sure = found.valid & (found.confidence >= _CONFIDENCE)
    return small, np.where(sure, found.values, np.float32(np.nan))


Number = TypeVar("Number", np.float32, np.uint8)

_HALF_WINDOW_PX: Final = 7  # edge of the window at half size: nearly that at full size


class HalfSizeMatcher:
    """Matches with `sad` at half size; a `Matcher` whose disparities are those of the full size.

    They are as dense as those of the full size and cost about a fifth of the time, but are off by
    a quarter of a pixel or more. ``searched`` is the range at full size.
    """

    def __init__(self, searched: common.SearchSettings, threads: int | None = None) -> None:
        half = common.SearchSettings(
            window_px=_HALF_WINDOW_PX,
            min_disparity_px=searched.min_disparity_px // 2,
            ndisp=None if searched.ndisp is None else max(3, -(-searched.ndisp // 2)),
        )
        sad = SadMatcher(half, threads)
        self._matcher: Matcher = sad if half.ndisp else AutoRangeMatcher(sad, half.min_disparity_px)

    def match(self, pair: RectifiedPair) -> Disparity:
        left, right = halve(pair.left), halve(pair.right)
        camera = pair.camera.resized(left.shape[1], left.shape[0])
        valid = None if pair.valid is None else pair.valid[::2, ::2]
        found = self._matcher.match(RectifiedPair(left, right, camera, valid=valid))
        shape = pair.left.shape
        return replace(
            found,
            values=_repeated(2 * found.values, shape),
            confidence=_repeated(found.confidence, shape),
            sigma_px=_repeated(2 * found.sigma_px, shape),
            reason=_repeated(found.reason, shape),
        )


def _repeated(values: NDArray[Number], shape: tuple[int, ...]) -> NDArray[Number]:
    rows, columns = values.shape
    size = (2 * columns, 2 * rows)
    large = cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)
    cut = np.ascontiguousarray(large[: shape[0], : shape[1]])
    return cut.astype(values.dtype, copy=False)
