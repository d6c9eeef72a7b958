"""The fine matcher: learned features, paths, then a search among planes; for pairs that deserve it.

A network of some 100,000 weights describes each pixel by what is around it, in the image and at
half and a quarter of its size. How unlike two descriptions are is added to the costs of `sgm`, and
paths are followed as there. What they find is where a search among planes starts
(`kernels/planes.py`): where windows see nothing, planes go on from where they do, or
are those of whole segments.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, Int32, UInt8
from recon.stereo.kernels import planes as kernels
from recon.stereo.kernels.path_costs import (
    Views,
    WriteCosts,
    empty_planes,
    padded,
    scaled_window,
    window_costs,
    write_views,
)
from recon.stereo.kernels.plane_minima import PARTS
from recon.stereo.kernels.semi_global import divided
from recon.stereo.kernels.similarity import Blend, add_dissimilarity
from recon.stereo.match import search as common
from recon.stereo.match import sgm
from recon.stereo.match.features import Describer, fine_grey, load_network, rows_at_once
from recon.stereo.match.fill import outside
from recon.stereo.match.plane_search import search_planes
from recon.stereo.match.segments import SAME_SURFACE_PX

# Costs of one pixel, in units of those of `sgm`.
_LEARNED: Final = 14.0  # of features that are orthogonal; added to the costs of `sgm`
_LARGEST_LEARNED: Final = 17.0
_LARGEST: Final = _LARGEST_LEARNED + sgm.LARGEST_COST
_P1, _P2 = 16.0, 58.0  # penalties of paths from disparity to disparity
_PER_PX, _MOST = 50.0, 140.0  # and from plane to plane
_EDGE_RATIO: Final = 0.15  # of the latter that is left where the image has an edge
_RADIUS: Final = 1  # of windows; planes do what larger ones do
_LEVELS: Final = sgm.LEVELS / (_LARGEST + _P2)  # steps of a cost in a byte
_WINDOW: Final = scaled_window(
    radius=_RADIUS,
    rows_radius=_RADIUS,
    gradient_cap=sgm.COST_CAP,
    largest=sgm.LARGEST_COST,
    levels=_LEVELS,
)
_BLEND: Final = Blend(
    learned=_LEARNED * _LEVELS,
    largest=_LARGEST_LEARNED * _LEVELS,
    top=float(int(_LARGEST * _LEVELS)),
)
# Fitted on MiddEval3 at quarter and half size: of what planes and paths agree on, at least and by
# the square of the confidence of the paths.
_AGREED_CONFIDENCE: Final = (0.53, 0.46)
_VOLUME_BYTES: Final = 448 << 20  # at most; larger images are matched in strips of rows
_OVERLAP_ROWS: Final = 64  # of strips


class FineMatcher:
    """Matches for quality, in seconds per megapixel; a `Matcher`.

    A pixel is matched where paths and planes agree on it. ``threads`` (None = all cores) has no
    effect on the result.
    """

    def __init__(self, settings: common.SearchSettings, threads: int | None = None) -> None:
        self._settings = settings
        self._threads = max(1, threads or os.cpu_count() or 1)
        self._paths = sgm.PathSearch(self._threads)
        self._network: Any = None

    def match(self, pair: RectifiedPair) -> Disparity:
        height, width = pair.left.shape
        ndisp = self._settings.ndisp_within(pair.camera)
        rows = max(_VOLUME_BYTES // (padded(width) * ndisp), 4 * _OVERLAP_ROWS)
        if height <= rows:
            return self._match(pair, ndisp)
        parts = []
        for strip in divided(height, rows, _OVERLAP_ROWS):
            part = self._match(_rows(pair, strip.start, strip.end), ndisp)
            kept = slice(strip.first - strip.start, strip.last - strip.start)
            parts.append(
                (part.values[kept], part.confidence[kept], part.sigma_px[kept], part.reason[kept])
            )
        return Disparity(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _match(self, pair: RectifiedPair, ndisp: int) -> Disparity:
        s = self._settings
        paths = sgm.paths_of(ndisp, s.min_disparity_px, _P1, _P2, _LEVELS)
        rules = common.rules_of(s, ndisp, max(1, round(PARTS * _LEVELS)), odds=sgm.ODDS)
        volume = self._volume(pair, ndisp)
        seen = self._paths.run(pair, partial(_copy_costs, volume), 0, paths, rules)
        if not seen.valid.any():
            return seen
        values = search_planes(pair, seen, volume, _changes(s.min_disparity_px), self._threads)
        return _judged(pair, seen, values, (s.min_disparity_px, s.min_disparity_px + ndisp - 1))

    def _volume(self, pair: RectifiedPair, ndisp: int) -> UInt8:
        """Return the costs of all pixels, uint8 (H, P, at least W)."""
        minimum, (height, width) = self._settings.min_disparity_px, pair.left.shape
        views = Views(pair.left, *empty_planes(height, width, _RADIUS, ndisp))
        volume = np.empty((height, ndisp, padded(width)), np.uint8)
        if self._network is None:
            self._network = load_network()
        left, right = fine_grey(pair.left, pair.left_rgb), fine_grey(pair.right, pair.right_rgb)
        level = float(left.mean())
        describers = [Describer(self._network, image, level) for image in (left, right)]
        at_once = rows_at_once(width)

        def prepare(rows: range) -> None:
            write_views(pair.right, _RADIUS, minimum, rows, views)

        def compare(rows: range) -> None:
            write = window_costs(views, _WINDOW, volume.shape[2])
            write((0, width), rows.start, rows.stop, volume)

        with ThreadPoolExecutor(self._threads) as pool:
            for work in (prepare, compare):
                common.in_strips(pool, self._threads, work, height)
            for first in range(0, height, at_once):
                end = min(first + at_once, height)
                ours, others = (
                    each.describe(first, end, pool, self._threads) for each in describers
                )
                add = partial(_add_learned, ours, others, width, minimum, volume[first:end])
                common.in_strips(pool, self._threads, add, end - first)
        return volume


def _add_learned(
    left: Int32, right: Int32, width: int, minimum: int, costs: UInt8, rows: range
) -> None:
    add_dissimilarity(left, right, width, minimum, _BLEND, rows.start, rows.stop, costs)


def _changes(minimum: int) -> kernels.Changes:
    return kernels.Changes(
        per_px=_PER_PX * _LEVELS,
        most=_MOST * _LEVELS,
        most_at_edge=_EDGE_RATIO * _MOST * _LEVELS,
        edge=sgm.EDGE_GREY_LEVELS,
        outside=float(sgm.LEVELS),
        minimum=minimum,
    )


def _copy_costs(volume: UInt8, _columns: int) -> WriteCosts:
    """Return what copies the costs of a volume (H, P, at least W)."""

    def write(band: tuple[int, int], top: int, bottom: int, costs: UInt8) -> None:
        start, end = band
        for y in range(top, bottom):
            costs[y % len(costs), :, : end - start] = volume[y, :, start:end]

    return write


def _rows(pair: RectifiedPair, start: int, end: int) -> RectifiedPair:
    names = ("left", "right", "left_rgb", "right_rgb", "valid")
    images = {name: getattr(pair, name) for name in names}
    rows: dict[str, Any] = {
        name: None if image is None else image[start:end] for name, image in images.items()
    }
    return replace(pair, camera=replace(pair.camera, height_px=end - start), **rows)


def _judged(
    pair: RectifiedPair, seen: Disparity, values: Float32, ends: tuple[int, int]
) -> Disparity:
    """Return the disparity with reasons, confidence and uncertainty.

    That a plane and what was seen agree makes both more probable than either. What planes alone
    lead to is not measured: it keeps the reason why nothing was found, or is AMBIGUOUS where a
    plane contradicts what was, BORDER or OUT_OF_RANGE where it leads there.
    """
    with np.errstate(invalid="ignore"):
        agree = seen.valid & (np.abs(values - seen.values) <= SAME_SURFACE_PX)
    beyond, border = (values < ends[0]) | (values > ends[1]), outside(values)
    if pair.valid is not None:
        border |= ~pair.valid
    agree &= ~(beyond | border)
    reason = np.where(seen.valid & ~agree, np.uint8(Reason.AMBIGUOUS), seen.reason)
    reason[beyond], reason[border] = np.uint8(Reason.OUT_OF_RANGE), np.uint8(Reason.BORDER)
    least, more = _AGREED_CONFIDENCE
    sure, nan = np.float32(least) + np.float32(more) * seen.confidence**2, np.float32(np.nan)
    return Disparity(
        values=np.where(agree, values, nan),
        confidence=np.where(agree, sure, np.float32(0)),
        sigma_px=np.where(agree, seen.sigma_px, nan),
        reason=reason,
    )
