"""Rough disparities, found at half size in a fifth of the time: for poses of live drives."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values import Disparity, RectifiedPair
from recon.stereo.match.registry import MatchingSettings, make_matcher, settings_of
from recon.stereo.match.sad import SadSettings, halve
from recon.stereo.match.search import SearchSettings

Number = TypeVar("Number", np.float32, np.uint8)

_WINDOW_PX: Final = 7
"""Edge of the window at half size: nearly that of `sad` at full size."""


class HalfSizeMatcher:
    """Matches with `sad` at half size; a `Matcher` whose disparities are those of the full size.

    They are as dense as those of the full size and cost about a fifth of the time, but are off by
    a quarter of a pixel or more.

    Args:
        settings: The range of the matcher that is chosen there is searched.
        threads: Strips of rows worked on at once. The result does not depend on it.
    """

    def __init__(self, settings: MatchingSettings, threads: int | None = None) -> None:
        chosen = settings_of(settings.matcher, settings)
        ranged = chosen if isinstance(chosen, SearchSettings) else settings.sad
        half = SadSettings(
            window_px=_WINDOW_PX,
            min_disparity_px=ranged.min_disparity_px // 2,
            ndisp=None if ranged.ndisp is None else max(3, -(-ranged.ndisp // 2)),
        )
        self._matcher = make_matcher("sad", MatchingSettings(sad=half), threads)

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair."""
        return _enlarged(self._matcher.match(_half(pair)), pair.left.shape)


def _half(pair: RectifiedPair) -> RectifiedPair:
    left, right = halve(pair.left), halve(pair.right)
    height, width = left.shape
    camera = pair.camera.resized(width, height)
    valid = None if pair.valid is None else pair.valid[::2, ::2]
    return RectifiedPair(left, right, camera, valid=valid)


def _enlarged(found: Disparity, shape: tuple[int, ...]) -> Disparity:
    """Return a disparity of half size at full size: four pixels have the value of one."""
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
