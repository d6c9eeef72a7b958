"""From recorded pictures to rows that correspond, and from colour to grey."""

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
from recon.rectification.rectify import RectificationSettings, Rectifier

__all__ = [
    "GreyMode",
    "InspectionSettings",
    "PairFeatures",
    "PairInspection",
    "RectificationSettings",
    "Rectifier",
    "check_inspection",
    "inspect_features",
    "inspect_pair",
    "match_features",
    "to_grey",
]
