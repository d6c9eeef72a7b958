"""From a rectified pair to a disparity for each pixel."""

from recon.matching.protocol import Matcher
from recon.matching.registry import MATCHERS, MatchingSettings, make_matcher
from recon.matching.sad import SadMatcher, SadSettings

__all__ = [
    "MATCHERS",
    "Matcher",
    "MatchingSettings",
    "SadMatcher",
    "SadSettings",
    "make_matcher",
]
