"""How many disparities to search where neither settings nor calibration say it."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import UInt8
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import SadMatcher, SadSettings
from recon.stereo.match.search import usual_ndisp

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
    gives the same result. It is never narrower than `usual_ndisp`, so from frame to frame it
    changes only where something is nearer than that allows.

    Args:
        matcher: The matcher; it must take its range from the camera.
        minimum_px: The first disparity that it searches.
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
    """Return the number of disparities that a pair needs, from matching it at a small size.

    The small pair is searched up to half its width. Its trusted disparities show how near the scene
    is; a tenth and one pixel of the small pair are added, because small objects may be nearer.

    Returns:
        A multiple of 16: at least `usual_ndisp`, which it is where too little can be trusted, and
        at most the image's width (rounded up).
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
    """Return the pair, ``factor`` times smaller, with a range of half its width; without rims."""
    width, height = pair.left.shape[1] // factor, pair.left.shape[0] // factor
    camera = replace(pair.camera.resized(width, height), ndisp=width // 2)
    left, right = (_shrunk(image, factor, (width, height)) for image in (pair.left, pair.right))
    return RectifiedPair(left, right, camera)


def _shrunk(image: UInt8, factor: int, size: tuple[int, int]) -> UInt8:
    whole = np.ascontiguousarray(image[: size[1] * factor, : size[0] * factor])
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _trusted_disparities(small: RectifiedPair) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Return float32 (N,), disparities in pixels of the small pair."""
    settings = SadSettings(window_px=7, uniqueness_percent=10)
    found = SadMatcher(settings, threads=1, average=False).match(small)
    return found.values[found.valid & (found.confidence >= _CONFIDENCE)]
