"""Features tracked through a few windows of frames of a drive, in both images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.core.values import Recorded, Rectified
from recon.core.values.arrays import Float64
from recon.look.fault import RigFault
from recon.odometry.features import find_in_right, surface_slopes
from recon.odometry.pose import TrackWindow
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.stereo.frame import FrameReconstructor

FRAMES: Final = 6  # frames in a window
_MIN_FRAMES: Final = 4  # windows of fewer frames, after a loss, are left out
_LEAST_MOTION: Final = 0.1  # in baselines; a window that moves less shows no depth by its motion
_LEAST_SEEN: Final = 3  # frames that a point is seen in; what is seen less checks hardly anything
TRACKED: Final = 72  # frames to track features through in all
REACH: Final = 600  # frames from the start that they are among: a video is decoded up to each
_ODDS: Final = 20.0  # of each window, on average, that a fault turns with what is seen
_PARTS: Final = 6  # of the drive that they are from, two windows in each


@dataclass(frozen=True, eq=False)
class StereoTracks:
    """Tracks in the left images of a window, and the same features in the right ones."""

    window: TrackWindow
    right_uv: Float64  # (W, N, 2), columns and rows; NaN = not found

    def thinned(self, every: int) -> StereoTracks:
        """Return every so many-th of the tracks."""
        window, chosen = self.window, np.arange(0, len(self.window.xyz_world), every)
        fewer = replace(window, uvd=window.uvd[:, chosen], xyz_world=window.xyz_world[chosen])
        return StereoTracks(fewer, self.right_uv[:, chosen])


def tracked_parts(frames: int) -> list[tuple[int, int]]:
    """Return first frame and end of each tracked part, in the middle of equal parts of a drive."""
    frames = min(frames, REACH)
    if frames <= TRACKED:
        whole = frames - frames % FRAMES
        half = whole // 2 - whole // 2 % FRAMES
        return [(0, half), (half, whole)] if half >= 2 * FRAMES else [(0, whole)]
    length = TRACKED // _PARTS
    starts = [int((k + 0.5) * frames / _PARTS - length / 2) for k in range(_PARTS)]
    return [(start, start + length) for start in starts]


class StereoTracker:
    """Windows of tracks without common frames, of frames that an odometry registers in turn."""

    def __init__(self, odometry: VisualOdometry) -> None:
        self._odometry = odometry
        self._recent = list[OdometryFrame]()

    def add(self, frame: OdometryFrame, found: OdometryResult) -> StereoTracks | None:
        """Add the frame that was registered last; returns the window that it completes, if any."""
        self._recent = [*self._recent, frame] if found.health.ok else []
        if len(self._recent) < FRAMES:
            return None
        frames, self._recent = self._recent, []
        window = self._odometry.window
        often = window.seen.sum(axis=0) >= _LEAST_SEEN
        window = TrackWindow(window.T_world_camera, window.uvd[:, often], window.xyz_world[often])
        first, last = window.T_world_camera[[0, -1], :3, 3]
        still = np.linalg.norm(last - first) < _LEAST_MOTION * frame.pair.camera.baseline_m
        if len(window.T_world_camera) < _MIN_FRAMES or still:
            return None
        return StereoTracks(window, _in_right(window, frames))


class Tracking:
    """Windows of tracks of consecutive frames, which are matched roughly and registered."""

    def __init__(self, reconstructor: FrameReconstructor) -> None:
        self.found = list[StereoTracks]()
        self._reconstructor, self._odometry = reconstructor, VisualOdometry()
        self._tracker = StereoTracker(self._odometry)

    def add(self, recorded: Recorded) -> Rectified:
        """Add the next pair; returns it rectified."""
        frame = OdometryFrame(*self._reconstructor.match_roughly(recorded))
        window = self._tracker.add(frame, self._odometry.register(frame))
        if window is not None:
            self.found.append(window)
        return frame.pair


class LiveTracks:
    """Windows of tracks from all over a drive while it arrives.

    Where it ends is not known: of parts of the drive every second is looked at, and where these are
    too many, every second of them is forgotten.
    """

    def __init__(self, odometry: VisualOdometry) -> None:
        self._odometry = odometry
        self._tracker = StereoTracker(odometry)
        self._segments = list[list[StereoTracks]]()
        self._every = 2

    @property
    def windows(self) -> list[StereoTracks]:
        return [window for segment in self._segments for window in segment]

    def add(self, index: int, frame: OdometryFrame, found: OdometryResult) -> None:
        """Add the frame that was registered last."""
        part, place = divmod(index, TRACKED // _PARTS)
        if part % self._every:
            return
        if place == 0:
            self._tracker = StereoTracker(self._odometry)
            self._segments.append([])
        if len(self._segments) > _PARTS:
            self._segments, self._every = self._segments[::2], 2 * self._every
        window = self._tracker.add(frame, found)
        if window is not None:
            self._segments[-1].append(window)


def _in_right(window: TrackWindow, frames: Sequence[OdometryFrame]) -> Float64:
    """Return where the features of a window are in the right images: float64 (W, N, 2)."""
    right_uv = np.full((*window.uvd.shape[:2], 2), np.nan)
    for k, frame in enumerate(frames[-len(window.uvd) :]):
        seen = np.isfinite(window.uvd[k, :, 2])
        uv, d = window.uvd[k, seen, :2], window.uvd[k, seen, 2]
        right_uv[k, seen] = find_in_right(frame.pair, uv, d, surface_slopes(frame.disparity, uv))
    return right_uv


def turns(tracks: Sequence[StereoTracks], fault: RigFault, values: Float64) -> bool:
    """Return whether rows along tracks are as if a fault (P,) turned with what is seen.

    Of a rig it stays where it is in its images: a feature that moves there has another part of it.
    Where the camera hardly turns both are alike, and nothing is said.
    """
    told = sum(_turns(part, fault, values) for part in tracks)
    return told > len(tracks) * math.log(_ODDS)


def _turns(part: StereoTracks, fault: RigFault, values: Float64) -> float:
    """Return the logarithm of the odds of one window, of errors of rows as Laplace's."""
    camera, poses = fault.camera, part.window.T_world_camera
    seen = (part.window.uvd[..., :2], part.right_uv)
    turned = (poses[0, :3, :3].T @ poses[:, :3, :3]).transpose(0, 2, 1)

    def at_first(uv: Float64, cx_px: float) -> Float64:
        xy = (uv - [cx_px, camera.cy_px]) / camera.focal_px
        rays = xy @ turned[:, :2] + turned[:, 2:]
        return np.asarray(camera.focal_px * rays[..., :2] / rays[..., 2:] + [cx_px, camera.cy_px])

    def varied_px(left_uv: Float64, right_uv: Float64) -> float:
        places = fault.correct(left_uv, right_uv, values)
        moved = places.right_uv - right_uv - places.left_uv + left_uv
        rows = (seen[1] - seen[0] + moved)[..., 1]
        rows = rows[:, np.isfinite(rows).any(axis=0)]
        return float(np.nansum(np.abs(rows - np.nanmedian(rows, axis=0))))

    turning = at_first(seen[0], camera.cx_px), at_first(seen[1], camera.cx_right_px)
    found = np.isfinite(part.right_uv[..., 1])
    told = max(1, int(found.sum() - found.any(axis=0).sum()))  # each track has its own median
    varied = varied_px(*turning), varied_px(*seen)
    return told * math.log(varied[1] / varied[0]) if min(varied) > 0.0 else 0.0
