"""Stereo calibration from images of a board."""

from recon.rig.calibrate.board_size import check_charuco, check_chessboard, grown_size
from recon.rig.calibrate.bootstrap import DepthError, Spread, measure_depth, measure_spread
from recon.rig.calibrate.bundle import Sighting, View
from recon.rig.calibrate.detect import find_board, orient_like
from recon.rig.calibrate.quality import coverage, distances_m, shared_pixels, tilt_deg
from recon.rig.calibrate.settings import CalibrationSettings, LensKind
from recon.rig.calibrate.stereo import StereoFit, calibrate_stereo

__all__ = [
    "CalibrationSettings",
    "DepthError",
    "LensKind",
    "Sighting",
    "Spread",
    "StereoFit",
    "View",
    "calibrate_stereo",
    "check_charuco",
    "check_chessboard",
    "coverage",
    "distances_m",
    "find_board",
    "grown_size",
    "measure_depth",
    "measure_spread",
    "orient_like",
    "shared_pixels",
    "tilt_deg",
]
