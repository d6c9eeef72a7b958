"""Rectification, calibrated and uncalibrated, checks of rectified pairs, and grey conversion."""

from recon.rectification.epipolar import epipolar_curves, epipolar_lines
from recon.rectification.features import match_again, match_exactly
from recon.rectification.grey import GreyMode, to_grey
from recon.rectification.inspect import (
    InspectionSettings,
    PairFeatures,
    PairInspection,
    check_inspection,
    inspect_features,
    inspect_pair,
    match_features,
)
from recon.rectification.rectify import (
    RectificationSettings,
    Rectifier,
    RectifyingTurns,
    plan_turns,
)
from recon.rectification.shaping import map_pixels
from recon.rectification.uncalibrated import (
    UncalibratedRectification,
    UncalibratedSettings,
    rectify_pictures,
    rectify_uncalibrated,
)

__all__ = [
    "GreyMode",
    "InspectionSettings",
    "PairFeatures",
    "PairInspection",
    "RectificationSettings",
    "Rectifier",
    "RectifyingTurns",
    "UncalibratedRectification",
    "UncalibratedSettings",
    "check_inspection",
    "epipolar_curves",
    "epipolar_lines",
    "inspect_features",
    "inspect_pair",
    "map_pixels",
    "match_again",
    "match_exactly",
    "match_features",
    "plan_turns",
    "rectify_pictures",
    "rectify_uncalibrated",
    "to_grey",
]
