"""Visual odometry: features tracked through a short window of stereo frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import (
    Motion,
    as_step,
    covariance_of,
    distance_in_sigmas,
    invert,
    step_covariance,
)
from recon.core.text import counted
from recon.core.values import Disparity
from recon.core.values.arrays import Float64, tree_of
from recon.odometry.features import (
    VisualState,
    empty_window,
    feature_disparity,
    follow_points,
    known_disparity,
    observe_points,
    points_of,
    replenish,
)
from recon.odometry.pose import (
    MIN_INLIERS,
    TrackWindow,
    adjust,
    enough_agree,
    locate_camera,
    misfits,
    newest_health,
    newest_information,
)
from recon.odometry.prior import MAX_SIGMAS, MotionPrior
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult, pose_in
from recon.stereo.rectify.features import match_features

_FRAMES: Final = 6  # frames adjusted together
_RELOCATE_FEATURES: Final = 2000  # features matched over the whole image where tracking fails
_NOTHING: Final = "nothing to follow in the image"


@dataclass(frozen=True, eq=False)
class VisualEstimate:
    """A pose and its uncertainty."""

    result: OdometryResult  # pose and health
    # float64 (6, 6) of a step (translation in metres, rotation vector in radians) in camera axes:
    # of the tracks if they are as uncertain as assumed, or of the prior where there are none; None
    # where the pose is extrapolated
    information: Float64 | None


@dataclass(frozen=True, eq=False)
class _Seen:
    """A frame that was registered."""

    window: TrackWindow
    tracks: int
    note: str = ""


class VisualOdometry:
    """Tracks the camera by features.

    Args:
        prior: Motion by other sensors: it predicts where features are, bridges frames without any,
            and refuses features that contradict it.
    """

    def __init__(self, prior: MotionPrior | None = None) -> None:
        self._prior = prior
        self._state: VisualState | None = None

    def register(self, frame: OdometryFrame) -> OdometryResult:
        return self.track(frame).result

    def track(self, frame: OdometryFrame) -> VisualEstimate:
        """Register the next frame, with the uncertainty of its pose.

        Where features cannot be tracked, they are matched over the whole image: after a gap, or
        once the view is clear again. Where that fails too, a frame with features of its own begins
        a new path, at the predicted pose; a frame without any is skipped, and the next one is
        matched with the last that was registered.
        """
        state = self._state
        if state is None:
            return self._first(frame)
        time_s = frame.pair.timestamp_s
        prior_motion = self._prior_motion(state.motion.timestamp_s, time_s)
        motion = state.motion.drifted(time_s)
        if prior_motion is not None:
            motion = state.motion.moved(state.motion.T_world_camera @ prior_motion, time_s)
        predicted = motion.T_world_camera
        seen = self._by_tracking(state, frame, predicted) or self._by_matching(
            state, frame, predicted
        )
        if seen is None:
            return self._lost(state, frame, motion, prior_motion)
        if self._contradicts(state, seen, frame):
            what = "features contradict the prior"
            return self._lost(state, frame, motion, prior_motion, what)
        T_world_camera = seen.window.T_world_camera[-1].copy()
        window = replenish(seen.window.trimmed(_FRAMES), frame)
        motion = state.motion.moved(T_world_camera, time_s)
        self._state = VisualState(window, frame.pair.left, frame.disparity, motion, time_s)
        camera = frame.pair.camera
        health = newest_health(seen.window, camera, seen.tracks, seen.note)
        information = newest_information(seen.window, camera)
        return VisualEstimate(OdometryResult(T_world_camera, health), information)

    @property
    def window(self) -> TrackWindow:
        """The last frames that were registered; without points before the first one."""
        return empty_window(np.eye(4)) if self._state is None else self._state.window

    def state(self) -> dict[str, Any]:
        last = self._state
        if last is None:
            return {"last": None}
        parts = {name: tree_of(getattr(last, name)) for name in ("window", "disparity", "motion")}
        return {"last": {**parts, "left": last.left, "seen_s": last.seen_s}}

    def restore(self, state: dict[str, Any]) -> None:
        last, self._state = state["last"], None
        if last is not None:
            for name in ("T_world_camera", "T_before_camera"):
                pose_in(last["motion"], name)
            self._state = VisualState(
                TrackWindow(**last["window"]),
                last["left"],
                Disparity(**last["disparity"]),
                Motion(**last["motion"]),
                float(last["seen_s"]),
            )

    def _first(self, frame: OdometryFrame) -> VisualEstimate:
        """Begin the path at a frame with enough features; those before it are skipped."""
        begun = self._begin(frame, Motion(np.eye(4), frame.pair.timestamp_s))
        points, health = len(begun.window.xyz_world), OdometryHealth()
        if points >= MIN_INLIERS:
            self._state = begun
        else:
            note = f"lost: {_NOTHING} ({counted(points, 'feature')}); skipped"
            health = OdometryHealth(ok=False, skipped=True, notes=(note,))
        return VisualEstimate(OdometryResult(np.eye(4), health), None)

    def _begin(self, frame: OdometryFrame, motion: Motion) -> VisualState:
        window = replenish(empty_window(motion.T_world_camera), frame)
        time_s = frame.pair.timestamp_s
        return VisualState(window, frame.pair.left, frame.disparity, motion, time_s)

    def _prior_motion(self, from_s: float, to_s: float) -> Float64 | None:
        return None if self._prior is None else self._prior.motion(from_s, to_s)

    def _contradicts(self, state: VisualState, seen: _Seen, frame: OdometryFrame) -> bool:
        """Whether the visual motion since the last registration contradicts the prior."""
        prior_motion = self._prior_motion(state.seen_s, frame.pair.timestamp_s)
        if prior_motion is None or self._prior is None:
            return False
        found = invert(state.window.T_world_camera[-1]) @ seen.window.T_world_camera[-1]
        off = as_step(invert(prior_motion) @ found)
        information = newest_information(seen.window, frame.pair.camera)
        both = covariance_of(information) + step_covariance(*self._prior.sigmas(prior_motion))
        return distance_in_sigmas(off, both) > MAX_SIGMAS

    def _by_tracking(
        self, state: VisualState, frame: OdometryFrame, predicted: Float64
    ) -> _Seen | None:
        """The frame, registered by tracking; None = that fails.

        The features that are followed give a pose, and the pose says where all of them are and how
        they look from there: those that were lost are found, and the others more closely.
        """
        window = state.window
        uv = follow_points(state, frame, predicted)
        tracks = np.flatnonzero(np.isfinite(uv[:, 0]))
        rough = locate_camera(window.xyz_world[tracks], uv[tracks], frame.pair.camera, predicted)
        if rough is None:
            return None
        uvd = observe_points(state, frame, uv, rough.T_world_camera)
        return self._register(window, uvd, frame, rough.T_world_camera)

    def _by_matching(
        self, state: VisualState, frame: OdometryFrame, predicted: Float64
    ) -> _Seen | None:
        """The frame, registered by matching over the whole image; None = that fails."""
        # Who is in a hurry would lose more frames to SIFT than it saves.
        found = match_features(
            state.left, frame.pair.left, _RELOCATE_FEATURES, any_scale=not frame.rough
        )
        uv, uv_now = found.left_uv, found.right_uv
        camera, T_world_then = frame.pair.camera, state.window.T_world_camera[-1]
        then = np.column_stack([uv, known_disparity(state.disparity, camera, uv)])
        now = np.column_stack([uv_now, feature_disparity(frame, uv_now)])
        known = np.isfinite(then[:, 2])
        then, now = then[known].astype(np.float64), now[known].astype(np.float64)
        window = empty_window(T_world_then).with_points(then, points_of(then, T_world_then, camera))
        seen = self._register(window, now, frame, predicted)
        if seen is None:
            return None
        return replace(seen, note="features were looked for in the whole image")

    def _register(
        self, window: TrackWindow, uvd: Float64, frame: OdometryFrame, predicted: Float64
    ) -> _Seen | None:
        """The window with the new frame added, if enough features agree on one motion."""
        camera = frame.pair.camera
        tracks = np.flatnonzero(np.isfinite(uvd[:, 0]))
        found = locate_camera(window.xyz_world[tracks], uvd[tracks, :2], camera, predicted)
        if found is None:
            return None
        uvd[tracks[~found.agree]] = np.nan
        window = adjust(window.with_frame(found.T_world_camera, uvd), camera)
        window = window.without_newest(misfits(window, camera))
        if not enough_agree(int(window.seen[-1].sum()), len(tracks)):
            return None
        return _Seen(window, len(tracks))

    def _lost(
        self,
        state: VisualState,
        frame: OdometryFrame,
        motion: Motion,
        prior_motion: Float64 | None,
        what: str = "no motion fits",
    ) -> VisualEstimate:
        """Continue the motion; a frame with enough features begins a new path there."""
        begun = self._begin(frame, motion)
        points = len(begun.window.xyz_world)
        sees = points >= MIN_INLIERS
        self._state = begun if sees else replace(state, motion=motion)
        why = f"{what if sees else _NOTHING} ({counted(points, 'feature')})"
        if prior_motion is None or self._prior is None:
            notes = (f"lost: {why}; {'the path begins anew' if sees else 'skipped'}",)
            health = OdometryHealth(ok=sees, skipped=not sees, begins=sees, notes=notes)
            return VisualEstimate(OdometryResult(motion.T_world_camera, health), None)
        sigma_m, sigma_deg = self._prior.sigmas(prior_motion)
        note = f"carried by the prior: {why}"
        health = OdometryHealth(sigma_m=sigma_m, sigma_deg=sigma_deg, notes=(note,))
        information = np.asarray(np.linalg.inv(step_covariance(sigma_m, sigma_deg)), np.float64)
        return VisualEstimate(OdometryResult(motion.T_world_camera, health), information)
