"""What every matcher promises, and matchers that are not ours, whose results are checked."""

from __future__ import annotations

from typing import Any, Final, Protocol, runtime_checkable

import numpy as np

from recon.core.errors import MatchingError
from recon.core.plugins import Plugins, calling, kind_of
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32, UInt8
from recon.core.values.image import ASSUMED_CONFIDENCE, ASSUMED_SIGMA_PX


@runtime_checkable
class Matcher(Protocol):
    """Finds the disparity of each pixel of the left view."""

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair; settings that do not fit it are a `MatchingError`."""
        ...


def unrated_disparity(values: Float32, reason: UInt8, pair: RectifiedPair) -> Disparity:
    """Return a disparity map whose matches all have the assumed confidence and uncertainty.

    Values are read where the reason is VALID. A match where there is no image, or that lies outside
    the right image, becomes BORDER.
    """
    width = values.shape[1]
    with np.errstate(invalid="ignore"):
        there = np.arange(width, dtype=np.float32) - values
        beside = (reason == np.uint8(Reason.VALID)) & ((there < -0.5) | (there > width - 0.5))
    border = beside if pair.valid is None else beside | ~pair.valid
    checked = np.where(border, np.uint8(Reason.BORDER), reason)
    valid, nan = checked == np.uint8(Reason.VALID), np.float32(np.nan)
    return Disparity(
        values=np.where(valid, values, nan).astype(np.float32),
        confidence=np.where(valid, np.float32(ASSUMED_CONFIDENCE), np.float32(0)),
        sigma_px=np.where(valid, np.float32(ASSUMED_SIGMA_PX), nan),
        reason=checked,
    )


PLUGINS: Final = Plugins("matcher", "recon.matchers", ("match(pair)",))


class CheckedMatcher:
    """Checks what a matcher that is not ours returns, without matches where there is no image."""

    def __init__(self, matcher: Matcher, name: str) -> None:
        self._matcher = matcher
        self._name = name

    def match(self, pair: RectifiedPair) -> Disparity:
        where = f"matcher {self._name!r}"
        with calling(MatchingError, "the matcher fails", where=where):
            found: Any = self._matcher.match(pair)
        if not isinstance(found, Disparity):
            what, hint = (
                "the matcher returns no Disparity",
                "return recon.Disparity.from_values(array)",
            )
            raise MatchingError(what, where=where, got=kind_of(found), hint=hint)
        problem = _problem(found, pair)
        if problem is not None:
            what, got, expected = problem
            raise MatchingError(what, where=where, got=got, expected=expected)
        return found if pair.valid is None else found.reject(~pair.valid, Reason.BORDER)


def _problem(found: Disparity, pair: RectifiedPair) -> tuple[str, str, str] | None:
    """Return what is wrong with a disparity, what was found, and what is expected."""
    if found.values.shape != pair.left.shape:
        got, expected = str(found.values.shape), str(pair.left.shape)
        return "the disparity does not have the size of the images", got, expected
    if np.isinf(found.values).any():
        return "disparities are infinite", "inf", "NaN where there is no match"
    sure, sigma = found.confidence[found.valid], found.sigma_px[found.valid]
    if not ((sure >= 0) & (sure <= 1)).all():
        return "a confidence is out of range", _worst(sure), "0 to 1 at each match"
    if not ((sigma > 0) & np.isfinite(sigma)).all():
        return "a standard deviation is out of range", _worst(sigma), "above 0 at each match"
    return None


def _worst(numbers: Any) -> str:
    return "NaN" if np.isnan(numbers).any() else f"{numbers.min():g} to {numbers.max():g}"
