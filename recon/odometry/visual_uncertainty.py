"""How uncertain the pose of a frame is, by the tracks that gave it."""

from __future__ import annotations

from typing import Final

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.odometry.covariance import covariance_of
from recon.odometry.protocol import OdometryHealth
from recon.odometry.window import SIGMA_UV_PX, TrackWindow, pose_information, reprojection

_INDEPENDENCE: Final = 0.25
"""Share of the tracks whose errors count as independent."""

_BEST_PX: Final = 0.05
"""However well features fit, they count as no better: on planes with exact truth they are off by
0.03 px to 0.12 px."""

_MEDIAN: Final = 1.18
"""Median length of an error in the image, in standard deviations along either axis."""


def newest_information(
    window: TrackWindow, camera: RectifiedCamera, sigma_uv_px: float = SIGMA_UV_PX
) -> Float64:
    """Return information (6, 6) of the newest pose, scaled because errors of tracks correlate."""
    return _INDEPENDENCE * pose_information(window, camera, sigma_uv_px)


def newest_health(
    window: TrackWindow, camera: RectifiedCamera, tracks: int, note: str = ""
) -> OdometryHealth:
    """Return the health of the newest pose of a window.

    Args:
        window: The frames, the newest one registered.
        camera: The rectified camera.
        tracks: Number of features that were followed to it, those that do not agree included.
        note: How it was registered, if that is worth telling.
    """
    newest = window.seen[-1]
    error = reprojection(window, camera)[-1, newest, :2]
    reprojection_px = float(np.median(np.linalg.norm(error, axis=1)))
    # What stays with a feature, its disparity, is as uncertain as assumed however well it fits.
    fits_px = max(reprojection_px, _BEST_PX) / _MEDIAN
    sigma = np.sqrt(np.diag(covariance_of(newest_information(window, camera, fits_px))))
    return OdometryHealth(
        tracks=tracks,
        inliers=int(newest.sum()),
        reprojection_px=reprojection_px,
        sigma_m=float(np.linalg.norm(sigma[:3])),
        sigma_deg=float(np.rad2deg(np.linalg.norm(sigma[3:]))),
        scale_px=_scale_px(window.uvd[-1, :, 2], camera),
        notes=(note,) if note else (),
    )


def _scale_px(disparity: Float64, camera: RectifiedCamera) -> float:
    """Return the disparity that fixes the length of a motion, from those (N,) of the features.

    A disparity gives a share of the depth, so a feature tells as much as the square of its own.
    """
    d = disparity[np.isfinite(disparity)] + camera.doffs_px
    return float(d @ d / d.sum()) if len(d) else float("nan")
