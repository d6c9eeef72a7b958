"""Block matching as the seed paper prints it: whole disparities, no check, plain numpy.

It exists for comparison by ``recon paper`` alone, so it is no entry of ``MATCHERS``.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import MatchingError
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, Int32
from recon.stereo.match.search import usual_ndisp

# A value rounded to whole pixels is off by up to half a pixel, each amount as likely.
_SIGMA_PX: Final = 1 / math.sqrt(12)


def match_as_printed(pair: RectifiedPair, patch_px: int, *, signed: bool) -> Disparity:
    """Return the disparity with the smallest sum over a square patch.

    A pixel has no value only where no patch lies within both images. Every other pixel keeps
    its minimum, however doubtful: confidence 1 says that nothing was asked, not that it is right.

    Args:
        pair: The images; searched as far as the camera says, or else a tenth of the width.
        patch_px: Edge of the patch; odd.
        signed: Whether to sum the differences with their signs, as Eq. 9-10 are printed; else
            their absolute values, which is what SAD means.

    Raises:
        MatchingError: The patch is larger than the image.

    Ref: Eq. 9-10 of the seed paper, see docs/paper.md.
    """
    if patch_px > min(pair.left.shape):
        raise MatchingError(
            "patch is larger than the image",
            got=f"{patch_px} px",
            expected=f"at most {min(pair.left.shape)} px",
        )
    values = np.full(pair.left.shape, np.nan, dtype=np.float32)
    inside = _smallest_sums(pair, patch_px, signed)
    radius, (height, width) = patch_px // 2, inside.shape
    values[radius : radius + height, radius : radius + width] = inside
    known = np.isfinite(values)
    return Disparity(
        values=values,
        confidence=known.astype(np.float32),
        sigma_px=np.where(known, np.float32(_SIGMA_PX), np.float32(np.nan)),
        reason=np.where(known, np.uint8(Reason.VALID), np.uint8(Reason.BORDER)),
    )


def _smallest_sums(pair: RectifiedPair, patch_px: int, signed: bool) -> Float32:
    """Return float32, the disparity of each pixel whose patch lies within the left image."""
    left, right = pair.left.astype(np.int32), pair.right.astype(np.int32)
    size = (left.shape[0] - patch_px + 1, left.shape[1] - patch_px + 1)
    least = np.full(size, np.iinfo(np.int64).max)
    best = np.zeros(size, dtype=np.float32)
    for d in range(min(pair.camera.ndisp or usual_ndisp(pair.camera.width_px), size[1])):
        difference = left[:, d:] - right[:, : right.shape[1] - d]
        sums = _patch_sums(difference if signed else np.abs(difference), patch_px)
        # Strictly less: of equal sums the smallest disparity wins.
        better = sums < least[:, d:]
        least[:, d:][better] = sums[better]
        best[:, d:][better] = d
    return best


def _patch_sums(compared: Int32, n: int) -> NDArray[Any]:
    """Return int64 (H - n + 1, W - n + 1), sums over all patches by an integral image."""
    table = np.pad(compared.astype(np.int64), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    return np.asarray(table[n:, n:] - table[:-n, n:] - table[n:, :-n] + table[:-n, :-n])
