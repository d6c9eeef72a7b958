"""What a pair at a small size shows: how many disparities to search, and rough disparities."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import SadMatcher, SadSettings, halve
from recon.stereo.match.search import SearchSettings, usual_ndisp

_COARSE_WIDTH_PX: Final = 200
"""Approximate width of the small pair; images are reduced by whole factors."""

_STEP: Final = 16
_SHARE: Final = 99.5
"""Percentile of the trusted disparities that the range must include before its margin."""

_LEAST_MATCHES: Final = 100
_CONFIDENCE: Final = 0.8


class AutoRangeMatcher:
    """Chooses the range of another matcher for each pair; a `Matcher`.

    The range is a function of the pair alone, never of the frames before it, so that a resumed run
    gives the same result.
    """

    def __init__(self, matcher: Matcher, minimum_px: int = 0) -> None:
        self._matcher = matcher
        self._minimum_px = minimum_px

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair."""
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
    factor = max(1, width // _COARSE_WIDTH_PX)
    usual = usual_ndisp(width)
    if width // factor < 6 or height < factor:
        return usual
    trusted = _trusted_disparities(_smaller(pair, factor))
    if trusted.size < _LEAST_MATCHES:
        return usual
    nearest_px = factor * (1.1 * float(np.percentile(trusted, _SHARE)) + 1.0)
    needed = min(nearest_px, width) - minimum_px + 1
    return max(usual, _STEP * int(np.ceil(needed / _STEP)))


def _smaller(pair: RectifiedPair, factor: int) -> RectifiedPair:
    width, height = pair.left.shape[1] // factor, pair.left.shape[0] // factor
    camera = replace(pair.camera.resized(width, height), ndisp=width // 2)
    left, right = (_shrunk(image, factor, (width, height)) for image in (pair.left, pair.right))
    return RectifiedPair(left, right, camera)


def _shrunk(image: UInt8, factor: int, size: tuple[int, int]) -> UInt8:
    whole = np.ascontiguousarray(image[: size[1] * factor, : size[0] * factor])
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _trusted_disparities(small: RectifiedPair) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    settings = SadSettings(window_px=7, uniqueness_percent=10)
    found = SadMatcher(settings, threads=1, average=False).match(small)
    return found.values[found.valid & (found.confidence >= _CONFIDENCE)]


Number = TypeVar("Number", np.float32, np.uint8)

_WINDOW_PX: Final = 7  # edge of the window at half size: nearly that of `sad` at full size


class HalfSizeMatcher:
    """Matches with `sad` at half size; a `Matcher` whose disparities are those of the full size.

    They are as dense as those of the full size and cost about a fifth of the time, but are off by
    a quarter of a pixel or more. ``searched`` is the range at full size.
    """

    def __init__(self, searched: SearchSettings, threads: int | None = None) -> None:
        half = SadSettings(
            window_px=_WINDOW_PX,
            min_disparity_px=searched.min_disparity_px // 2,
            ndisp=None if searched.ndisp is None else max(3, -(-searched.ndisp // 2)),
        )
        sad = SadMatcher(half, threads)
        self._matcher: Matcher = sad if half.ndisp else AutoRangeMatcher(sad, half.min_disparity_px)

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
