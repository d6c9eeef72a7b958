"""The turn of the right camera that makes disparities fit the motion, and rows meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.rig.audit.rig_fit import CorrectedPlaces, StereoTracks, fit_correction

MIN_WINDOWS: Final = 6
"""Fewer windows do not show how much their answers scatter."""

_PARAMETERS: Final = 5
"""Pitch, yaw, roll, focal length, lenses."""

_TELLING_SIGMAS: Final = 2.0
"""What is nearer to zero than this is left as it is calibrated."""


@dataclass(frozen=True, eq=False)
class RightTurn:
    """What corrects the right camera: it is turned in place, and its image is enlarged.

    Attributes:
        values: float64 (5,): pitch, yaw and roll, radians, by which rays are turned about x, y
            and z; the share by which the image is enlarged about the principal point; and what
            lenses bend: the shift of columns at 45° from the axis, in focal lengths.
        covariance: float64 (5, 5), of the values.
        windows: Number of windows they are from.
    """

    values: Float64
    covariance: Float64
    windows: int

    @property
    def sigmas(self) -> Float64:
        """float64 (5,), standard deviations of the values.

        Lenses that are known to bend columns may bend them by as much in other ways, which yaw and
        focal length then stand for.
        """
        sigmas = np.sqrt(np.diag(self.covariance))
        sigmas[[1, 3]] = np.hypot(sigmas[[1, 3]], self.values[4])
        return np.asarray(sigmas)

    @property
    def telling(self) -> Float64:
        """float64 (4,): pitch, yaw, roll and enlargement, 0 where the drive does not show them."""
        shown = np.abs(self.values) > _TELLING_SIGMAS * self.sigmas
        return np.where(shown, self.values, 0.0)[:4]


def estimate_turn(tracks: Sequence[StereoTracks], camera: RectifiedCamera) -> RightTurn | None:
    """Estimate the turn of the right camera that makes disparities fit the motion, and rows meet.

    The covariance is that of the windows' answers: what one window gets wrong as a whole, such as
    what drives beside it, counts once and not once a feature.

    Returns:
        None if there are too few windows.

    Ref:
        Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986 (the
        covariance of clustered data).
    """
    if len(tracks) < MIN_WINDOWS:
        return None
    found = fit_correction(tracks, camera, Turning(camera))
    inverse = np.linalg.inv(found.H.sum(axis=0))
    scatter = found.g.T @ found.g * len(tracks) / (len(tracks) - _PARAMETERS)
    return RightTurn(found.values, inverse @ scatter @ inverse, len(tracks))


@dataclass(frozen=True, eq=False)
class Turning:
    """The turn of the right camera as a correction of a rig."""

    camera: RectifiedCamera

    def place(self, tracks: StereoTracks, values: Float64) -> CorrectedPlaces:
        """Return where the features of a window are after a turn."""
        uv, by_right = tracks.window.uvd[:, :, :2], self.by_turn(tracks.right_uv, self.camera)
        right = turned_places(tracks.right_uv, values, self.camera)
        return CorrectedPlaces(uv, right, np.zeros_like(by_right), by_right)

    def prior(self) -> Float64:
        """Return what is known beforehand: nothing."""
        return np.zeros(_PARAMETERS)

    @staticmethod
    def by_turn(right_uv: Float64, camera: RectifiedCamera) -> Float64:
        """Return how places (…, 2) in the right image follow a turn: float64 (…, 2, 5)."""
        return np.asarray(camera.focal_px * _basis(right_uv, camera))


def turned_places(right_uv: Float64, turn: Float64, camera: RectifiedCamera) -> Float64:
    """Return where features (…, 2) of the right image are after a turn (5,), to first order."""
    return right_uv + camera.focal_px * (_basis(right_uv, camera) @ turn)


def _basis(uv: Float64, camera: RectifiedCamera) -> Float64:
    """Return what a turn does to places (…, 2) in the right image: float64 (…, 2, 5).

    A small rotation w moves a ray p by w × p.
    """
    x, y = np.moveaxis((uv - [camera.cx_right_px, camera.cy_px]) / camera.focal_px, -1, 0)
    columns = np.stack([-x * y, 1 + x * x, -y, x, x * x], axis=-1)
    rows = np.stack([-(1 + y * y), x * y, x, y, np.zeros_like(x)], axis=-1)
    return np.stack([columns, rows], axis=-2)
