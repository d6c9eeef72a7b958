"""Block matching as the seed paper prints it: whole disparities, no check, plain numpy.

It exists for comparison by ``recon paper`` alone, so it is no entry of ``MATCHERS``.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from recon.core.errors import MatchingError
from recon.core.settings import Settings
from recon.core.values import Disparity, Reason, RectifiedCamera, RectifiedPair
from recon.core.values.arrays import Float32, Int32
from recon.stereo.match.search import OddInt, usual_ndisp

# A value rounded to whole pixels is off by up to half a pixel, each amount as likely.
_SIGMA_PX: Final = 1 / math.sqrt(12)


class PrintedSettings(Settings):
    """Settings of the printed matcher."""

    patch_px: OddInt = Field(default=11, ge=1, le=61, description="Edge of the square patch; odd.")
    signed: bool = Field(
        default=True,
        description="Sum the differences with their signs, as Eq. 9-10 are printed; false = sum "
        "their absolute values, which is what SAD means.",
    )
    ndisp: int | None = Field(
        default=None,
        ge=1,
        le=4096,
        description="Number of disparities searched, from 0. None: what the calibration says, or "
        "else a tenth of the image width, rounded up to a multiple of 16.",
    )


class PrintedMatcher:
    """Takes the disparity with the smallest sum over a square patch; a `Matcher`.

    A pixel has no value only where no patch lies within both images. Every other pixel keeps
    its minimum, however doubtful: confidence 1 says that nothing was asked, not that it is right.

    Args:
        settings: Patch, range, and whether signs count.
    """

    def __init__(self, settings: PrintedSettings) -> None:
        self._settings = settings

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: The patch is larger than the image.

        Ref: Eq. 9-10 of the seed paper, see docs/paper.md.
        """
        patch_px = self._settings.patch_px
        if patch_px > min(pair.left.shape):
            raise MatchingError(
                "patch is larger than the image",
                got=f"{patch_px} px",
                expected=f"at most {min(pair.left.shape)} px",
            )
        inside = self._smallest_sums(pair)
        values = np.full(pair.left.shape, np.nan, dtype=np.float32)
        radius = patch_px // 2
        height, width = inside.shape
        values[radius : radius + height, radius : radius + width] = inside
        return _undoubted(values)

    def _smallest_sums(self, pair: RectifiedPair) -> Float32:
        """Return float32, the disparity of each pixel whose patch lies within the left image."""
        left, right = pair.left.astype(np.int32), pair.right.astype(np.int32)
        outside = self._settings.patch_px - 1
        size = (left.shape[0] - outside, left.shape[1] - outside)
        least = np.full(size, np.iinfo(np.int64).max)
        best = np.zeros(size, dtype=np.float32)
        for d in range(min(self._ndisp(pair.camera), size[1])):
            sums = self._patch_sums(left[:, d:] - right[:, : right.shape[1] - d])
            # Strictly less: of equal sums the smallest disparity wins.
            better = sums < least[:, d:]
            least[:, d:][better] = sums[better]
            best[:, d:][better] = d
        return best

    def _patch_sums(self, difference: Int32) -> NDArray[Any]:
        """int64 (H - patch + 1, W - patch + 1), sums over all patches by an integral image."""
        compared = difference if self._settings.signed else np.abs(difference)
        n = self._settings.patch_px
        table = np.pad(compared.astype(np.int64), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        return np.asarray(table[n:, n:] - table[:-n, n:] - table[n:, :-n] + table[:-n, :-n])

    def _ndisp(self, camera: RectifiedCamera) -> int:
        return self._settings.ndisp or camera.ndisp or usual_ndisp(camera.width_px)


def _undoubted(values: Float32) -> Disparity:
    """Return a disparity without any check: where there is a value, it is believed."""
    known = np.isfinite(values)
    return Disparity(
        values=values,
        confidence=known.astype(np.float32),
        sigma_px=np.where(known, np.float32(_SIGMA_PX), np.float32(np.nan)),
        reason=np.where(known, np.uint8(Reason.VALID), np.uint8(Reason.BORDER)),
    )
