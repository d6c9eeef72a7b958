"""The turn of the right camera that makes disparities fit the motion, and rows meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.values import CameraIntrinsics, RectifiedCamera, StereoCalibration
from recon.core.values.arrays import Float64
from recon.rig.audit.rig_fit import CorrectedPlaces, StereoTracks, fit_correction, remaining_cost
from recon.rig.audit.row_alignment import correct_rig

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


_TERMS: Final = 6
"""Of each lens: k1 k2 p1 p2 s1 s3 of OpenCV."""

_TURN: Final = 4
"""Of the right camera: pitch, yaw, roll, enlargement."""

_PRIOR_PX: Final = 2.0
"""Standard deviation of what each term moves at the corners, before anything is seen."""

_ROUNDS: Final = 10
"""Times that bent places are straightened; each adds at least a digit where lenses are usable."""

_LEAST_GAIN: Final = 0.1
"""Share of the cost of other windows that lenses must take away, or they are not believed."""


@dataclass(frozen=True, eq=False)
class BentLenses:
    """What both lenses bend, and how the right camera is turned if they do.

    Attributes:
        camera: The rectified camera that is believed to see without them.
        turn: float64 (4,), as `RightTurn.values` has it.
        left: float64 (6,), k1 k2 p1 p2 s1 s3 of OpenCV.
        right: float64 (6,), of the right camera.
    """

    camera: RectifiedCamera
    turn: Float64
    left: Float64
    right: Float64

    @property
    def calibration(self) -> StereoCalibration:
        """The cameras with these lenses, the right one turned in place."""
        rig = correct_rig(self.camera, self.turn, np.eye(3))
        left, right = _with_lens(rig.left, self.left), _with_lens(rig.right, self.right)
        return replace(rig, left=left, right=right)

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

    They are believed if, fitted to every second window, they explain the others better than a turn
    alone does.

    Returns:
        None if there are too few windows, or the lenses are as they are calibrated.
    """
    if len(tracks) < MIN_WINDOWS:
        return None
    turning, bending = Turning(camera), _Bending(camera)
    seen, others = tracks[::2], tracks[1::2]
    turned, straight = (
        remaining_cost(others, camera, each, fit_correction(seen, camera, each).values)
        for each in (turning, bending)
    )
    if straight > (1.0 - _LEAST_GAIN) * turned:
        return None
    values = fit_correction(tracks, camera, bending).values
    return BentLenses(camera, *_split(values))


def _with_lens(camera: CameraIntrinsics, terms: Float64) -> CameraIntrinsics:
    """Return a camera with a lens, in OpenCV's order: k1 k2 p1 p2 k3 … k6 s1 … s4."""
    distortion = np.zeros(12)
    distortion[[0, 1, 2, 3, 8, 10]] = terms
    return replace(camera, distortion=distortion)


def straightened(xy: Float64, terms: Float64) -> Float64:
    """Return where rays (…, 2) are seen that a lens (6,) bends, without it.

    Ref:
        OpenCV, "Camera calibration and 3D reconstruction": thin prism model.
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


@dataclass(frozen=True, eq=False)
class _Bending:
    """Lenses, and the turn of the right camera, as a correction of a rig."""

    camera: RectifiedCamera

    def place(self, tracks: StereoTracks, values: Float64) -> CorrectedPlaces:
        """Return where the features of a window are, straightened and turned."""
        camera, (turn, left, right) = self.camera, _split(values)
        left_uv, by_left = self._straight(tracks.window.uvd[..., :2], camera.cx_px, 1.0, left)
        enlarged = float(1.0 + turn[3])
        right_uv, by_right = self._straight(tracks.right_uv, camera.cx_right_px, enlarged, right)
        by_turn = Turning.by_turn(right_uv, camera)[..., :_TURN]
        none = np.zeros_like(by_left)
        return CorrectedPlaces(
            left_uv,
            turned_places(right_uv, np.array([*turn[:3], 0.0, 0.0]), camera),
            np.concatenate([np.zeros_like(by_turn), by_left, none], axis=-1),
            np.concatenate([by_turn, none, by_right], axis=-1),
        )

    def prior(self) -> Float64:
        """Return what is known beforehand: lenses that are calibrated to a few pixels."""
        camera = self.camera
        corner = np.array([camera.width_px, camera.height_px]) / (2.0 * camera.focal_px)
        moved_px = camera.focal_px * np.linalg.norm(_bent_by(corner), axis=0)
        return np.concatenate([np.zeros(_TURN), *2 * [(moved_px / _PRIOR_PX) ** 2]])

    def _straight(
        self, uv: Float64, cx_px: float, enlarged: float, terms: Float64
    ) -> tuple[Float64, Float64]:
        """Return places (…, 2) after a lens, and how they follow its terms (…, 2, 6)."""
        f, centre = self.camera.focal_px, np.array([cx_px, self.camera.cy_px])
        straight = straightened(enlarged * (uv - centre) / f, terms)
        return f * straight + centre, -f * _bent_by(straight)


def _split(values: Float64) -> tuple[Float64, Float64, Float64]:
    """Return the turn (4,), and the terms (6,) of the left and of the right lens."""
    turn, left, right = np.split(values, [_TURN, _TURN + _TERMS])
    return turn, left, right
