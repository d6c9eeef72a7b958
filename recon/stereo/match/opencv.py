"""OpenCV's block matcher and its semi-global matcher, to compare with.

What changes at this border: OpenCV gives 16ths of a pixel, and ``(minimum - 1) · 16`` where it
found nothing; it skips the columns that the whole range does not fit, unless it is to `pad` the
images.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np

from recon.core.errors import MatchingError
from recon.core.settings import Settings
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.stereo.match.protocol import unrated_disparity
from recon.stereo.match.search import LEFT_RIGHT_PX, SearchSettings

_STEPS: Final = 16  # OpenCV counts in 16ths of a pixel, and searches multiples of 16 disparities
_LIMIT_PX: Final = 2**15 // _STEPS - 1  # 16ths of a pixel are counted in 16 bits
_SGBM_MODE: Final = cv2.STEREO_SGBM_MODE_HH  # eight paths over the whole image, its most accurate
_BM_PREFILTER_CAP: Final = 31  # OpenCV's default, as the threshold
_BM_TEXTURE_THRESHOLD: Final = 10  # least sum of prefiltered values in the window
_SGBM_PREFILTER_CAP: Final = 63
_P1, _P2 = 8, 32  # P1 and P2 per pixel of the block, as OpenCV's documentation suggests
_UNIQUENESS_PERCENT: Final = 5  # of the second best cost over the best; OpenCV suggests 5 to 15
_SPECKLE_PX: Final = 50  # regions of at most so many pixels are removed, as of our matchers
_SPECKLE_STEP_PX: Final = 1
_BM_BLOCK_PX: Final = 9  # where the settings name none, as below
_SGBM_BLOCK_PX: Final = 3  # a single window of SGBM smooths by its paths instead


class OpencvSettings(Settings):
    """Settings of `opencv-bm` (``cv2.StereoBM``) and `opencv-sgbm` (``cv2.StereoSGBM``)."""

    pad: bool = False
    """Widen the images by repeating their edges, so that every pixel is searched as far as the
    right image reaches. false = OpenCV as it comes, without a strip at the left as wide as the
    range, which scoring then fills by a guess."""


class OpencvMatcher:
    """A matcher of OpenCV, ``cv2.StereoBM`` or ``cv2.StereoSGBM``; the process sets its threads."""

    def __init__(
        self, settings: SearchSettings, opencv: OpencvSettings, *, semi_global: bool
    ) -> None:
        self._settings, self._pad = settings, opencv.pad
        self._semi_global = semi_global

    def match(self, pair: RectifiedPair) -> Disparity:
        s, ndisp = self._settings, _range(self._settings, pair.camera)
        block_px = s.window_px or (_SGBM_BLOCK_PX if self._semi_global else _BM_BLOCK_PX)
        make = _semi_global_engine if self._semi_global else _block_engine
        above, before, after = 0, 0, 0
        if self._pad:  # what OpenCV leaves out
            above, high = block_px // 2 + 1, s.min_disparity_px + ndisp - 1
            before, after = above + max(0, high), above + max(0, -s.min_disparity_px)
        return _match(pair, make(s, ndisp, block_px), s, (above, above, before, after))


def _block_engine(s: SearchSettings, ndisp: int, block_px: int) -> cv2.StereoBM:
    engine = cv2.StereoBM.create(ndisp, block_px)
    engine.setMinDisparity(s.min_disparity_px)
    engine.setPreFilterType(cv2.STEREO_BM_PREFILTER_XSOBEL)
    engine.setPreFilterCap(_BM_PREFILTER_CAP)
    engine.setTextureThreshold(_BM_TEXTURE_THRESHOLD)
    engine.setUniquenessRatio(_UNIQUENESS_PERCENT)
    engine.setDisp12MaxDiff(LEFT_RIGHT_PX)
    return engine


def _semi_global_engine(s: SearchSettings, ndisp: int, block_px: int) -> cv2.StereoSGBM:
    return cv2.StereoSGBM.create(
        minDisparity=s.min_disparity_px,
        numDisparities=ndisp,
        blockSize=block_px,
        P1=_P1 * block_px**2,
        P2=_P2 * block_px**2,
        disp12MaxDiff=LEFT_RIGHT_PX,
        preFilterCap=_SGBM_PREFILTER_CAP,
        uniquenessRatio=_UNIQUENESS_PERCENT,
        mode=_SGBM_MODE,
    )


def _match(
    pair: RectifiedPair, engine: Any, s: SearchSettings, sides: tuple[int, int, int, int]
) -> Disparity:
    """Let OpenCV match images widened above, below, left and right by so many pixels.

    It does not report which check rejects a pixel: those are AMBIGUOUS.
    """
    try:
        views = (pair.left, pair.right)
        raw = engine.compute(*(cv2.copyMakeBorder(v, *sides, cv2.BORDER_REPLICATE) for v in views))
    except cv2.error as error:
        got = f"{pair.camera.width_px}x{pair.camera.height_px}: {error.err[:200]}"
        what = "OpenCV cannot match this pair with these settings"
        raise MatchingError(what, got=got) from error
    (top, _, left, _), (height, width) = sides, pair.left.shape
    fixed = np.ascontiguousarray(raw[top : top + height, left : left + width])
    unknown = (s.min_disparity_px - 1) * _STEPS
    values = fixed / np.float32(_STEPS)
    reason = np.where(fixed > unknown, Reason.VALID, Reason.AMBIGUOUS).astype(np.uint8)
    found = unrated_disparity(values, reason, pair)
    kept = np.where(found.valid, fixed, np.int16(unknown))
    cv2.filterSpeckles(kept, unknown, _SPECKLE_PX, _SPECKLE_STEP_PX * _STEPS)
    return found.reject(kept == unknown, Reason.SPECKLE)


def _range(settings: SearchSettings, camera: RectifiedCamera) -> int:
    ndisp = _STEPS * -(-settings.ndisp_for(camera) // _STEPS)
    first, last = settings.min_disparity_px, settings.min_disparity_px + ndisp - 1
    if first <= -_LIMIT_PX or last >= _LIMIT_PX:
        what, got = "disparities exceed the range of OpenCV", f"from {first} to {last} px"
        expected = f"between {-_LIMIT_PX} and {_LIMIT_PX} px"
        hint = "check min_disparity_px and ndisp, or match smaller images"
        raise MatchingError(what, got=got, expected=expected, hint=hint)
    return ndisp
