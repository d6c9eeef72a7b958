"""From recorded pictures to rows that correspond, and from colour to grey."""

from recon.rectification.grey import GreyMode, to_grey
from recon.rectification.rectify import RectificationSettings, Rectifier

__all__ = [
    "GreyMode",
    "RectificationSettings",
    "Rectifier",
    "to_grey",
]
