"""What may be wrong with a rig, as parameters that are 0 where nothing is.

The right camera is turned in place and its image enlarged, and both lenses bend otherwise than
calibrated. On all drives of KITTI that were tried the lenses are most of it; without their prisms
(s1 to s4), a path becomes up to 2 % too short.

What no motion shows is the baseline, and with it the scale of the map: see `length.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from recon.core.values import CameraIntrinsics, RectifiedCamera, Rig, StereoCalibration
from recon.core.values.arrays import Bool, Float64
from recon.stereo.rectify.epipolar import as_raw, correct_rig
from recon.stereo.rectify.lens import rays_of
from recon.stereo.rectify.rectifier import RectifyingTurns

LENS: Final = ("k1", "k2", "k3", "p1", "p2", "s1", "s2", "s3", "s4")
_IN_OPENCV: Final = [0, 1, 4, 2, 3, 8, 9, 10, 11]  # k1 k2 p1 p2 k3 … k6 s1 … s4
_COEFFICIENTS: Final = 12
TURN: Final = ("pitch", "yaw", "roll", "zoom")
NAMES: Final = (*TURN, *(f"left_{name}" for name in LENS), *(f"right_{name}" for name in LENS))

_TURN_SIGMAS: Final = np.array([0.0175, 0.0175, 0.0175, 0.02])
"""Standard deviations beforehand: a degree, and 2 % of the focal length. Wider than any rig that
was ever calibrated: they only matter where a drive shows nothing."""

LENS_SIGMA_PX: Final = 1.0  # of what each term of a lens moves at the corners, beforehand
_UNBENDING: Final = 5  # rounds; each adds at least a digit where lenses are usable
_WEIGHINGS: Final = 10  # rounds in which the spread of faults is found, to a few per cent
_ROUNDING: Final = 1e-9  # parameters shown below which none is
_GRID: Final = (24, 16)  # places in the image, across and down, at which lenses are fitted


@dataclass(frozen=True, eq=False)
class Places:
    """Where features (…, 2) are without the fault, and how that follows its parameters (P)."""

    left_uv: Float64
    right_uv: Float64
    by_left: Float64  # (…, 2, P)
    by_right: Float64

    def chosen(self, at: NDArray[np.int64]) -> Places:
        """Return those of some of the features (frames, features, 2) of a window."""
        parts = (self.left_uv, self.right_uv, self.by_left, self.by_right)
        return Places(*(part[:, at] for part in parts))


@dataclass(frozen=True, eq=False)
class RigFault:
    """The parameters of a fault in the rectified views of a camera.

    In this order: pitch, yaw and roll of rays of the right camera, radians; the share by which its
    image is enlarged; k1 k2 k3 p1 p2 s1 s2 s3 s4 of the left and of the right lens, OpenCV's.
    """

    camera: RectifiedCamera

    @property
    def sigmas(self) -> Float64:
        """float64 (P,), standard deviations that are expected beforehand."""
        camera = self.camera
        corner = np.array([camera.width_px, camera.height_px]) / (2.0 * camera.focal_px)
        lens = LENS_SIGMA_PX / (camera.focal_px * np.linalg.norm(_bent_by(corner), axis=0))
        return np.concatenate([_TURN_SIGMAS, lens, lens])

    def correct(self, left_uv: Float64, right_uv: Float64, values: Float64) -> Places:
        """Return where features would be seen by a rig without the fault."""
        camera = self.camera
        turn, left, right = split(values)
        left_uv, by_lens = self._unbent(left_uv, camera.cx_px, left)
        centre = np.array([camera.cx_right_px, camera.cy_px])
        zoomed = centre + (1.0 + turn[3]) * (right_uv - centre)
        right_uv, by_right_lens = self._unbent(zoomed, camera.cx_right_px, right)
        by_turn = camera.focal_px * _turned_by(right_uv, camera)
        none, no_turn = np.zeros_like(by_lens), np.zeros_like(by_turn)
        return Places(
            left_uv,
            right_uv + by_turn[..., :3] @ turn[:3],
            np.concatenate([no_turn, by_lens, none], axis=-1),
            np.concatenate([by_turn, none, by_right_lens], axis=-1),
        )

    def _unbent(self, uv: Float64, cx_px: float, terms: Float64) -> tuple[Float64, Float64]:
        """Return places (…, 2) without a lens, and how they follow its terms: (…, 2, T)."""
        f, centre = self.camera.focal_px, np.array([cx_px, self.camera.cy_px])
        xy = unbent((uv - centre) / f, terms)
        return f * xy + centre, -f * _bent_by(xy)


def split(values: Float64) -> tuple[Float64, Float64, Float64]:
    """Return the turn (4,) of parameters, and the terms (9,) of the left and of the right lens."""
    turn, left, right = np.split(values, [len(TURN), len(TURN) + len(LENS)])
    return turn, left, right


def unbent(xy: Float64, terms: Float64) -> Float64:
    """Return where rays (…, 2) that a lens (9,) bends are seen without it.

    Ref: OpenCV, "Camera calibration and 3D reconstruction": thin prism model.
    """
    straight = xy
    for _ in range(_UNBENDING if terms.any() else 0):
        straight = xy - _bent(straight, terms)
    return straight


def _bent(xy: Float64, terms: Float64) -> Float64:
    """Return ``_bent_by(xy) @ terms`` (…, 2), in a fifth of the time."""
    k1, k2, k3, p1, p2, s1, s2, s3, s4 = terms
    x, y = np.moveaxis(xy, -1, 0)
    r2, two_xy = x * x + y * y, 2.0 * x * y
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    across = x * radial + p1 * two_xy + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2)
    down = y * radial + p1 * (r2 + 2.0 * y * y) + p2 * two_xy + r2 * (s3 + r2 * s4)
    return np.stack([across, down], axis=-1)


def _bent_by(xy: Float64) -> Float64:
    """Return what the terms of a lens add to straight rays (…, 2): float64 (…, 2, 9)."""
    x, y = np.moveaxis(xy, -1, 0)
    r2, zero = x * x + y * y, np.zeros_like(x)
    r4 = r2 * r2
    radial = np.stack([r2, r4, r2 * r4], axis=-1)
    columns = np.stack([2 * x * y, r2 + 2 * x * x, r2, r4, zero, zero], axis=-1)
    rows = np.stack([r2 + 2 * y * y, 2 * x * y, zero, zero, r2, r4], axis=-1)
    return np.stack(
        [
            np.concatenate([x[..., None] * radial, columns], axis=-1),
            np.concatenate([y[..., None] * radial, rows], axis=-1),
        ],
        axis=-2,
    )


def _turned_by(uv: Float64, camera: RectifiedCamera) -> Float64:
    """Return what a turn does to places (…, 2) in the right image, in focal lengths: (…, 2, 4)."""
    x, y = np.moveaxis((uv - [camera.cx_right_px, camera.cy_px]) / camera.focal_px, -1, 0)
    columns = np.stack([-x * y, 1 + x * x, -y, x], axis=-1)
    rows = np.stack([-(1 + y * y), x * y, x, y], axis=-1)
    return np.stack([columns, rows], axis=-2)


def may_bend(rig: Rig) -> bool:
    """Return whether lenses can be corrected: those of OpenCV's plain model, or rectified images.

    A rational or a fisheye lens has no prisms that could be added.
    """
    if isinstance(rig, RectifiedCamera):
        return True
    return all(
        lens.model == "pinhole" and not (lens.distortion[5:8].any() or lens.distortion[12:].any())
        for lens in (rig.left, rig.right)
    )


def without_fault(rig: Rig, turns: RectifyingTurns, values: Float64) -> StereoCalibration:
    """Return a calibration without a fault that was seen in its rectified views."""
    turn, *lenses = split(values)
    raw, turned = as_raw(rig), correct_rig(rig, turn, turns.R_left)
    left, right = (
        _relensed(before, after, R, terms)
        for before, after, R, terms in zip(
            (raw.left, raw.right),
            (turned.left, turned.right),
            (turns.R_left, turns.R_right),
            lenses,
            strict=True,
        )
    )
    return replace(turned, left=left, right=right)


def spread_pixels(camera: CameraIntrinsics | RectifiedCamera, counts: tuple[int, int]) -> Float64:
    """Return places all over an image, so many across and down: float64 (down, across, 2)."""
    sizes = (camera.width_px, camera.height_px)
    places = (np.linspace(0, size - 1, count) for size, count in zip(sizes, counts, strict=True))
    return np.stack(np.meshgrid(*places), axis=-1)


def _relensed(
    before: CameraIntrinsics, after: CameraIntrinsics, R: Float64, terms: Float64
) -> CameraIntrinsics:
    """Return a camera with the lens that takes straightened rays to the pixels they came from.

    ``R`` turns its rays into the axes of the rectified view, in which ``terms`` bend.
    """
    if not terms.any():
        return after
    pixels = spread_pixels(before, _GRID).reshape(-1, 2)
    zoom = before.matrix[0, 0] / after.matrix[0, 0]
    level = rays_of(before, pixels) @ R.T
    known = level[:, 2] > 0
    xy = unbent(zoom * level[known, :2] / level[known, 2:], terms)
    straight = np.column_stack([xy, np.ones(len(xy))]) @ R
    straight = straight[:, :2] / straight[:, 2:]
    seen = np.column_stack([pixels[known], np.ones(len(xy))]) @ np.linalg.inv(after.matrix).T
    distortion = np.zeros(_COEFFICIENTS)
    distortion[_IN_OPENCV] = np.linalg.lstsq(
        _bent_by(straight).reshape(-1, len(LENS)), (seen[:, :2] - straight).ravel(), rcond=None
    )[0]
    return replace(after, distortion=distortion)


def shrink(
    values: Float64, H: Float64, sigmas: Float64, moved: Float64 | None = None
) -> tuple[Float64, Float64, float]:
    """Return parameters (P,) moved to 0 in directions that the drive does not show.

    Beside them the mean squares (P, P) of their errors, of which what is moved is part, and the
    variance of faults, in that expected, by those that are shown: these, and what was ``moved``
    (P,) before.

    Each direction, whitened by the prior, is shrunk by its own certainty: not at all where the
    drive fixes it well, to 0 where it is within its standard deviation. ``H`` (P, P) is the
    information of the drive, ``sigmas`` (P,) those of the prior.

    Ref: Breiman, "Better subset regression using the nonnegative garrote", 1995.
    """
    D, V = np.linalg.eigh(sigmas[:, None] * H * sigmas)
    D = np.maximum(D, 0.0)
    z = V.T @ (values / sigmas)
    # What the drive alone says is z (1 + D) / D, with a variance of 1 / D: its share by chance.
    shown = (D > 0.0) & (z != 0.0)
    chance = np.divide(D, (z * (1.0 + D)) ** 2, where=shown, out=np.ones_like(D))
    kept = sigmas * (V @ (np.maximum(0.0, 1.0 - chance) * z))
    moved = np.zeros_like(values) if moved is None else moved
    told = (H + np.diag(1.0 / sigmas**2)) @ values + H @ moved
    spread = _spread(told, H, sigmas)
    likely, covariance = _widened(told, H, sigmas, spread)
    left = likely - moved - kept
    return kept, covariance + np.outer(left, left), spread


def _widened(told: Float64, H: Float64, sigmas: Float64, spread: float) -> tuple[Float64, Float64]:
    """Return parameters (P,) and their covariance where lenses may bend more than expected."""
    variance = sigmas**2
    variance[len(TURN) :] *= spread
    covariance = np.linalg.inv(H + np.diag(1.0 / variance))
    return covariance @ told, np.asarray(covariance)


def _spread(told: Float64, H: Float64, sigmas: Float64) -> float:
    """Return the variance of what lenses bend, in that expected, that makes ``told`` likeliest.

    Where they are worse than expected in directions that the drive shows, they are in others, too.

    Ref: MacKay, "Bayesian interpolation", 1992.
    """
    spread, lens = 1.0, slice(len(TURN), None)
    for _ in range(_WEIGHINGS if len(sigmas) > len(TURN) else 0):
        values, covariance = _widened(told, H, sigmas, spread)
        shown = 1.0 - np.diag(covariance)[lens] / (spread * sigmas[lens] ** 2)
        bent = np.sum((values[lens] / sigmas[lens]) ** 2)
        spread = max(1.0, float(bent / max(shown.sum(), _ROUNDING)))
    return spread


def active(rig: Rig) -> Bool:
    """Return which parameters (P,) can be corrected."""
    lens = np.full(len(LENS), may_bend(rig))
    return np.concatenate([np.ones(len(TURN), np.bool_), lens, lens])
