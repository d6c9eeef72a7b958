"""Calibrated rectification, checks of rectified pairs, and grey conversion."""

from recon.stereo.rectify.epipolar import epipolar_curves, epipolar_lines
from recon.stereo.rectify.features import match_again, match_exactly
from recon.stereo.rectify.grey import GreyMode, to_grey
from recon.stereo.rectify.inspect import (
    PairFeatures,
    PairInspection,
    check_inspection,
    inspect_features,
    inspect_pair,
    match_features,
)
from recon.stereo.rectify.rectifier import (
    RectificationSettings,
    Rectifier,
    RectifyingTurns,
    plan_turns,
)

__all__ = [
    "GreyMode",
    "PairFeatures",
    "PairInspection",
    "RectificationSettings",
    "Rectifier",
    "RectifyingTurns",
    "check_inspection",
    "epipolar_curves",
    "epipolar_lines",
    "inspect_features",
    "inspect_pair",
    "match_again",
    "match_exactly",
    "match_features",
    "plan_turns",
    "to_grey",
]
