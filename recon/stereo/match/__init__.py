"""From a rectified pair to a disparity for each pixel."""

from recon.stereo.match.fill import fill_holes
from recon.stereo.match.foreign import name_of
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import (
    MATCHERS,
    MatchingSettings,
    check_matcher,
    field_of,
    make_matcher,
    searched_ndisp,
    settings_of,
)
from recon.stereo.match.sad import SadMatcher, SadSettings
from recon.stereo.match.sgm import SgmMatcher, SgmSettings

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
