"""How the right camera is turned against its calibration, as the motion of a drive shows it.

Pitch and roll move rows. Yaw and another focal length move columns, which one pair cannot tell from
depth; but a tracked point has a depth by the motion alone, up to the length of the baseline.

Lenses that are calibrated badly bend disparities by the square of the distance from the middle of
the image (kitti_raw_0013: 1.3 px at its sides). That is estimated with the turn, which would take
it for yaw otherwise, but no turn can correct it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any, Final

import numpy as np

from recon.core.geometry.projection import map_pixels
from recon.core.values import RectifiedCamera, Rig, StereoCalibration
from recon.core.values.arrays import Float64
from recon.odometry.features import find_in_right, surface_slopes
from recon.odometry.protocol import OdometryFrame
from recon.odometry.visual import VisualOdometry
from recon.odometry.window import TrackWindow
from recon.rig.audit.corrections import (
    MIN_WINDOWS,
    BentLenses,
    RightTurn,
    estimate_lenses,
    estimate_turn,
)
from recon.rig.audit.rig_fit import StereoTracks
from recon.rig.audit.sample import plan_stretches
from recon.run.threads import serial_algebra
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor, StereoSettings
from recon.stereo.rectify.rectifier import RectifyingTurns, plan_turns

_MIN_FRAMES: Final = 4  # windows of fewer frames, after a loss, are left out
DEPTHS_M: Final = (10.0, 30.0)  # distances for which the depth error is stated
_FRAMES: Final = 6  # frames in a window
_READ: Final = 72  # frames to read in all, in several runs


@dataclass(frozen=True, eq=False)
class SeenMotion:
    """What the motion of a drive shows of its rig."""

    turn: RightTurn | None  # how the right camera is turned; None if there are too few windows
    tracks: tuple[StereoTracks, ...]  # the windows of tracks
    views: RectifyingTurns | None  # of their images; None if they were rectified before

    def tracks_as_recorded(self, camera: RectifiedCamera) -> tuple[StereoTracks, ...]:
        """Return the windows as they are in the images of a camera that were rectified before."""
        if self.views is None:
            return self.tracks
        rotations = (self.views.R_left, self.views.R_right)
        recorded = (camera.matrix, camera.right_matrix)
        left, right = (
            K @ R.T @ np.linalg.inv(seen)
            for K, R, seen in zip(recorded, rotations, self.views.matrices, strict=True)
        )
        return tuple(_mapped(part, left, right) for part in self.tracks)

    def bent_lenses(self, rig: Rig) -> BentLenses | None:
        """Return what the lenses bend; None if they do not, or if images are rectified here."""
        if not isinstance(rig, RectifiedCamera):
            return None
        return estimate_lenses(self.tracks_as_recorded(rig), rig)


def measure_turn(source: StereoSource, rig: Rig, config: StereoSettings) -> SeenMotion | None:
    """Measure how the right camera of a drive is turned against a calibration.

    With that calibration, rows have to meet to a pixel or so. None if the drive is too short.
    """
    if len(source) < MIN_WINDOWS * _FRAMES:
        return None
    reconstructor = FrameReconstructor(rig, config)
    tracks: list[StereoTracks] = []
    with serial_algebra():
        for start, stop in plan_stretches(len(source), _READ, quick=False):
            pairs = islice(source.frames(start), stop - start)
            tracks += stereo_tracks(OdometryFrame(*reconstructor.match(pair)) for pair in pairs)
        turn = estimate_turn(tracks, reconstructor.camera)
    views = plan_turns(rig, config.rectification) if isinstance(rig, StereoCalibration) else None
    return SeenMotion(turn, tuple(tracks), views)


def turn_figures(turn: RightTurn, camera: RectifiedCamera) -> dict[str, Any]:
    """Return what a turn means, with standard deviations, ready for JSON."""
    degrees, sigmas = np.degrees(turn.values[:3]), np.degrees(turn.sigmas[:3])
    named = zip(("pitch_deg", "yaw_deg", "roll_deg"), degrees, sigmas, strict=True)
    # Disparities grow where the right image moves to the left.
    offset_px, sigma_px = camera.focal_px * np.array([-turn.values[1], turn.sigmas[1]])
    side = (camera.width_px / 2 / camera.focal_px) ** 2
    lens_px = camera.focal_px * side
    return {
        "windows": turn.windows,
        **{name: _both(x, s) for name, x, s in named},
        "focal_percent": _both(-100.0 * turn.values[3], 100.0 * turn.sigmas[3]),
        "disparity_px": _both(offset_px, sigma_px),
        "lens_px": _both(-lens_px * turn.values[4], lens_px * turn.sigmas[4]),
        "depth_percent": {
            f"{z:g}": 100.0 * float(offset_px) * z / (camera.focal_px * camera.baseline_m)
            for z in DEPTHS_M
        },
        "not_visible": "baseline",
    }


def _both(value: float, sigma: float) -> dict[str, float]:
    return {"value": float(value), "sigma": float(sigma)}


def stereo_tracks(frames: Iterable[OdometryFrame]) -> Iterator[StereoTracks]:
    """Track features through consecutive frames, in windows without common frames."""
    odometry, recent = VisualOdometry(), list[OdometryFrame]()
    for frame in frames:
        result = odometry.register(frame)
        recent = [*recent, frame] if result.health.ok else []
        if len(recent) == _FRAMES:
            window = odometry.window
            if len(window.T_world_camera) >= _MIN_FRAMES:
                yield StereoTracks(window, _in_right(window, recent))
            recent = []


def _mapped(tracks: StereoTracks, H_left: Float64, H_right: Float64) -> StereoTracks:
    """Return tracks in images to which homographies (3, 3) take them."""
    uvd, shape = tracks.window.uvd.copy(), tracks.right_uv.shape
    uvd[..., :2] = map_pixels(H_left, uvd[..., :2].reshape(-1, 2)).reshape(shape)
    right_uv = map_pixels(H_right, tracks.right_uv.reshape(-1, 2)).reshape(shape)
    uvd[..., 2] = uvd[..., 0] - right_uv[..., 0]
    return StereoTracks(replace(tracks.window, uvd=uvd), right_uv)


def _in_right(window: TrackWindow, frames: Sequence[OdometryFrame]) -> Float64:
    """Return where the features of a window are in the right images: float64 (W, N, 2)."""
    right_uv = np.full((*window.uvd.shape[:2], 2), np.nan)
    for k, frame in enumerate(frames[-len(window.uvd) :]):
        seen = np.isfinite(window.uvd[k, :, 2])
        uv, d = window.uvd[k, seen, :2], window.uvd[k, seen, 2]
        right_uv[k, seen] = find_in_right(frame.pair, uv, d, surface_slopes(frame.disparity, uv))
    return right_uv
