"""Corrections of a rig from the motion of a drive: the right camera turned, both lenses bent.

Where a lens bends otherwise than calibrated, features do not move as their depth and the motion of
the camera say, and their rows differ. On kitti_raw_0013 and sequence 06 of KITTI, calibrated on
different days, that shows the same lenses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.values import RectifiedCamera, StereoCalibration
from recon.core.values.arrays import Float64
from recon.rig.audit.rig_fit import (
    CorrectedPlaces,
    RigCorrection,
    StereoTracks,
    fit_correction,
    remaining_cost,
)
from recon.rig.audit.row_alignment import correct_rig

MIN_WINDOWS: Final = 6  # fewer windows do not show how much their answers scatter
_PARAMETERS: Final = 5  # pitch, yaw, roll, focal length, lenses
_TERMS: Final = 6  # of each lens: k1 k2 p1 p2 s1 s3 of OpenCV
_TURN: Final = 4  # of the right camera: pitch, yaw, roll, enlargement
_PRIOR_PX: Final = 2.0  # standard deviation of what each term moves at the corners, beforehand
_ROUNDS: Final = 10  # of straightening; each adds at least a digit where lenses are usable
_LEAST_GAIN: Final = 0.1  # share of the cost of other windows that believable lenses take away
_TELLING_SIGMAS: Final = 2.0  # what is nearer to zero than this is left as it is calibrated


@dataclass(frozen=True, eq=False)
class RightTurn:
    """What corrects the right camera: it is turned in place, and its image is enlarged."""

    # (5,): pitch, yaw and roll of rays, radians; the share by which the image is enlarged; and what
    # lenses bend: the shift of columns at 45° from the axis, in focal lengths
    values: Float64
    covariance: Float64  # (5, 5), of the values
    windows: int  # number of windows they are from

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

    The covariance is that of the windows' answers, whose features err together. None if there are
    too few windows.

    Ref: Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986 (the
    covariance of clustered data).
    """
    if len(tracks) < MIN_WINDOWS:
        return None
    found = fit_correction(tracks, camera, turning(camera))
    inverse = np.linalg.inv(found.H.sum(axis=0))
    scatter = found.g.T @ found.g * len(tracks) / (len(tracks) - _PARAMETERS)
    return RightTurn(found.values, inverse @ scatter @ inverse, len(tracks))


def turning(camera: RectifiedCamera) -> RigCorrection:
    """Return the turn of the right camera as a correction of a rig."""

    def place(tracks: StereoTracks, values: Float64) -> CorrectedPlaces:
        by_right = camera.focal_px * _basis(tracks.right_uv, camera)
        right_uv = turned_places(tracks.right_uv, values, camera)
        left_uv = tracks.window.uvd[:, :, :2]
        return CorrectedPlaces(left_uv, right_uv, np.zeros_like(by_right), by_right)

    return RigCorrection(place, np.zeros(_PARAMETERS))


def turned_places(right_uv: Float64, turn: Float64, camera: RectifiedCamera) -> Float64:
    """Return where features (…, 2) of the right image are after a turn (5,), to first order."""
    return right_uv + camera.focal_px * (_basis(right_uv, camera) @ turn)


def _basis(uv: Float64, camera: RectifiedCamera) -> Float64:
    """Return what a turn does to places (…, 2) in the right image: float64 (…, 2, 5)."""
    x, y = np.moveaxis((uv - [camera.cx_right_px, camera.cy_px]) / camera.focal_px, -1, 0)
    columns = np.stack([-x * y, 1 + x * x, -y, x, x * x], axis=-1)
    rows = np.stack([-(1 + y * y), x * y, x, y, np.zeros_like(x)], axis=-1)
    return np.stack([columns, rows], axis=-2)


@dataclass(frozen=True, eq=False)
class BentLenses:
    """What both lenses bend, and how the right camera is turned if they do."""

    camera: RectifiedCamera  # the rectified camera that is believed to see without them
    turn: Float64  # (4,), as `RightTurn.values` has it
    left: Float64  # (6,), k1 k2 p1 p2 s1 s3 of OpenCV
    right: Float64  # (6,), of the right camera

    @property
    def calibration(self) -> StereoCalibration:
        """The cameras with these lenses, the right one turned in place."""
        rig, distortion = correct_rig(self.camera, self.turn, np.eye(3)), np.zeros((2, 12))
        # OpenCV's order: k1 k2 p1 p2 k3 … k6 s1 … s4.
        distortion[:, [0, 1, 2, 3, 8, 10]] = self.left, self.right
        left = replace(rig.left, distortion=distortion[0])
        return replace(rig, left=left, right=replace(rig.right, distortion=distortion[1]))

    @property
    def moved_px(self) -> tuple[float, float]:
        """By how many pixels each lens moves what it sees, root mean square."""
        camera, lengths = self.camera, []
        column, row = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
        for cx_px, terms in ((camera.cx_px, self.left), (camera.cx_right_px, self.right)):
            xy = np.stack([column - cx_px, row - camera.cy_px], axis=-1) / camera.focal_px
            moved = camera.focal_px * (straightened(xy, terms) - xy)
            lengths.append(float(np.sqrt(np.square(moved).sum(axis=-1).mean())))
        return lengths[0], lengths[1]


def estimate_lenses(tracks: Sequence[StereoTracks], camera: RectifiedCamera) -> BentLenses | None:
    """Estimate what both lenses bend, with the turn of the right camera.

    None if, fitted to every second window, they explain the others no better than a turn alone, or
    if there are too few windows.
    """
    if len(tracks) < MIN_WINDOWS:
        return None
    corrections = turning(camera), bending(camera)
    seen, others = tracks[::2], tracks[1::2]
    turned, straight = (
        remaining_cost(others, camera, each, fit_correction(seen, camera, each).values)
        for each in corrections
    )
    if straight > (1.0 - _LEAST_GAIN) * turned:
        return None
    return BentLenses(camera, *_split(fit_correction(tracks, camera, corrections[1]).values))


def straightened(xy: Float64, terms: Float64) -> Float64:
    """Return where rays (…, 2) are seen that a lens (6,) bends, without it.

    Ref: OpenCV, "Camera calibration and 3D reconstruction": thin prism model.
    """
    straight = xy
    for _ in range(_ROUNDS):
        straight = xy - _bent_by(straight) @ terms
    return straight


def _bent_by(xy: Float64) -> Float64:
    """Return what the terms of a lens add to straight rays (…, 2): float64 (…, 2, 6)."""
    x, y = np.moveaxis(xy, -1, 0)
    r2, zero = x * x + y * y, np.zeros_like(x)
    columns = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, r2, zero], axis=-1)
    rows = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, zero, r2], axis=-1)
    return np.stack([columns, rows], axis=-2)


def bending(camera: RectifiedCamera) -> RigCorrection:
    """Return lenses, and the turn of the right camera, as a correction of a rig."""
    f = camera.focal_px

    def straight(uv: Float64, cx_px: float, zoom: float, terms: Float64) -> tuple[Float64, Float64]:
        """Return places (…, 2) after a lens, and how they follow its terms (…, 2, 6)."""
        centre = np.array([cx_px, camera.cy_px])
        xy = straightened(zoom * (uv - centre) / f, terms)
        return f * xy + centre, -f * _bent_by(xy)

    def place(tracks: StereoTracks, values: Float64) -> CorrectedPlaces:
        turn, left, right = _split(values)
        left_uv, by_left = straight(tracks.window.uvd[..., :2], camera.cx_px, 1.0, left)
        zoom = float(1.0 + turn[3])
        right_uv, by_right = straight(tracks.right_uv, camera.cx_right_px, zoom, right)
        by_turn = (f * _basis(right_uv, camera))[..., :_TURN]
        none = np.zeros_like(by_left)
        by_left = np.concatenate([np.zeros_like(by_turn), by_left, none], axis=-1)
        by_right = np.concatenate([by_turn, none, by_right], axis=-1)
        turned_uv = turned_places(right_uv, np.array([*turn[:3], 0.0, 0.0]), camera)
        return CorrectedPlaces(left_uv, turned_uv, by_left, by_right)

    # Lenses are calibrated to a few pixels.
    corner = np.array([camera.width_px, camera.height_px]) / (2.0 * f)
    moved_px = f * np.linalg.norm(_bent_by(corner), axis=0)
    known = (moved_px / _PRIOR_PX) ** 2
    return RigCorrection(place, np.concatenate([np.zeros(_TURN), known, known]))


def _split(values: Float64) -> tuple[Float64, Float64, Float64]:
    """Return the turn (4,), and the terms (6,) of the left and of the right lens."""
    turn, left, right = np.split(values, [_TURN, _TURN + _TERMS])
    return turn, left, right
