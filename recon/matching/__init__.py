"""From a rectified pair to a disparity for each pixel."""

from recon.matching.fill import fill_holes
from recon.matching.protocol import Matcher
from recon.matching.registry import MATCHERS, MatchingSettings, field_of, make_matcher
from recon.matching.sad import SadMatcher, SadSettings

__all__ = [
    "MATCHERS",
    "Matcher",
    "MatchingSettings",
    "SadMatcher",
    "SadSettings",
    "field_of",
    "fill_holes",
    "make_matcher",
]
