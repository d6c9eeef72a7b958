"""From a rectified pair to a disparity for each pixel."""

from recon.matching.fill import fill_holes
from recon.matching.protocol import Matcher
from recon.matching.registry import (
    MATCHERS,
    MatchingSettings,
    field_of,
    make_matcher,
    rates_matches,
    searched_ndisp,
)
from recon.matching.sad import SadMatcher, SadSettings
from recon.matching.sgm import SgmMatcher, SgmSettings

__all__ = [
    "MATCHERS",
    "Matcher",
    "MatchingSettings",
    "SadMatcher",
    "SadSettings",
    "SgmMatcher",
    "SgmSettings",
    "field_of",
    "fill_holes",
    "make_matcher",
    "rates_matches",
    "searched_ndisp",
]
