"""Features tracked through a few windows of frames of a drive, in both images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np

from recon.core.progress import tracked
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.core.work import available_cores, serial_algebra, side_by_side
from recon.odometry.features import find_in_right, surface_slopes
from recon.odometry.pose import TrackWindow
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

THREADS: Final = min(2, available_cores())  # that windows are worked on in; results are the same
FRAMES: Final = 6  # frames in a window
_MIN_FRAMES: Final = 4  # windows of fewer frames, after a loss, are left out
_LEAST_MOTION: Final = 0.1  # in baselines; a window that moves less shows no depth by its motion
_LEAST_SEEN: Final = 3  # frames that a point is seen in; what is seen less checks hardly anything
_READ: Final = 72  # frames to read in all
_REACH: Final = 600  # frames from the start that they are among: a video is decoded up to each
_STRETCHES: Final = 6  # parts of the drive that they are from, two windows in each


@dataclass(frozen=True, eq=False)
class StereoTracks:
    """Tracks in the left images of a window, and the same features in the right ones."""

    window: TrackWindow
    right_uv: Float64  # (W, N, 2), columns and rows; NaN = not found


def plan_stretches(frames: int) -> list[tuple[int, int]]:
    """Return first frame and end of each stretch, in the middle of equal parts of a drive."""
    frames = min(frames, _REACH)
    if frames <= _READ:
        whole = frames - frames % FRAMES
        half = whole // 2 - whole // 2 % FRAMES
        return [(0, half), (half, whole)]
    length = _READ // _STRETCHES
    starts = [int((k + 0.5) * frames / _STRETCHES - length / 2) for k in range(_STRETCHES)]
    return [(start, start + length) for start in starts]


def track_stretches(
    source: StereoSource, reconstructor: FrameReconstructor
) -> tuple[StereoTracks, ...]:
    """Return windows of tracks from all over a drive, stretches side by side in threads."""

    def tracks(stretch: tuple[int, int]) -> list[StereoTracks]:
        start, stop = stretch
        pairs = islice(source.frames(start), stop - start)
        odometry = VisualOdometry()
        tracker = StereoTracker(odometry)
        frames = (OdometryFrame(*reconstructor.match_roughly(pair)) for pair in pairs)
        found = (tracker.add(frame, odometry.register(frame)) for frame in frames)
        return [window for window in found if window is not None]

    with serial_algebra():
        stretches = plan_stretches(len(source))
        found = side_by_side(tracks, stretches, threads=THREADS)
        counted = tracked(found, "windows", "track features", total=len(stretches))
        return tuple(window for stretch in counted for window in stretch)


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
        window = _often_seen(self._odometry.window)
        if len(window.T_world_camera) < _MIN_FRAMES or not _moves(window, frame.pair.camera):
            return None
        return StereoTracks(window, _in_right(window, frames))


class LiveTracks:
    """Windows of tracks from all over a drive while it arrives.

    Where it ends is not known: of parts of the drive every second is looked at, and where these are
    too many, every second of them is forgotten.
    """

    def __init__(self, odometry: VisualOdometry) -> None:
        self._odometry = odometry
        self._tracker = StereoTracker(odometry)
        self._stretches = list[list[StereoTracks]]()
        self._every = 2

    @property
    def windows(self) -> list[StereoTracks]:
        return [window for stretch in self._stretches for window in stretch]

    def add(self, index: int, frame: OdometryFrame, found: OdometryResult) -> None:
        """Add the frame that was registered last."""
        part, place = divmod(index, _READ // _STRETCHES)
        if part % self._every:
            return
        if place == 0:
            self._tracker = StereoTracker(self._odometry)
            self._stretches.append([])
        if len(self._stretches) > _STRETCHES:
            self._stretches, self._every = self._stretches[::2], 2 * self._every
        window = self._tracker.add(frame, found)
        if window is not None:
            self._stretches[-1].append(window)


def _moves(window: TrackWindow, camera: RectifiedCamera) -> bool:
    first, last = window.T_world_camera[[0, -1], :3, 3]
    return bool(np.linalg.norm(last - first) >= _LEAST_MOTION * camera.baseline_m)


def _often_seen(window: TrackWindow) -> TrackWindow:
    often = window.seen.sum(axis=0) >= _LEAST_SEEN
    return TrackWindow(window.T_world_camera, window.uvd[:, often], window.xyz_world[often])


def _in_right(window: TrackWindow, frames: Sequence[OdometryFrame]) -> Float64:
    """Return where the features of a window are in the right images: float64 (W, N, 2)."""
    right_uv = np.full((*window.uvd.shape[:2], 2), np.nan)
    for k, frame in enumerate(frames[-len(window.uvd) :]):
        seen = np.isfinite(window.uvd[k, :, 2])
        uv, d = window.uvd[k, seen, :2], window.uvd[k, seen, 2]
        right_uv[k, seen] = find_in_right(frame.pair, uv, d, surface_slopes(frame.disparity, uv))
    return right_uv
