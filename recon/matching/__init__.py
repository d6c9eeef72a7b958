"""From a rectified pair to a disparity for each pixel."""

from recon.matching.fill import fill_holes
from recon.matching.foreign import name_of
from recon.matching.protocol import Matcher
from recon.matching.registry import (
    MATCHERS,
    MatchingSettings,
    check_matcher,
    field_of,
    make_matcher,
    searched_ndisp,
    settings_of,
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
    "check_matcher",
    "field_of",
    "fill_holes",
    "make_matcher",
    "name_of",
    "searched_ndisp",
    "settings_of",
]
