"""Rectification from the images alone, where no calibration is known."""

from recon.rig.uncalibrated.rectify import (
    UncalibratedRectification,
    rectify_images,
    rectify_uncalibrated,
)

__all__ = [
    "UncalibratedRectification",
    "rectify_images",
    "rectify_uncalibrated",
]
