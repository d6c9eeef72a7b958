"""What every matcher promises."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from recon.core.values import Disparity, RectifiedPair


@runtime_checkable
class Matcher(Protocol):
    """Finds the disparity of each pixel of the left view."""

    def match(self, pair: RectifiedPair) -> Disparity:
        """Match one rectified pair.

        Raises:
            MatchingError: The settings do not fit the pair.
        """
        ...
