"""Visual odometry: features tracked through a short window of stereo frames."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import Motion, as_step, covariance_of, distance_in_sigmas, invert
from recon.core.text import counted
from recon.core.values import Disparity, RectifiedCamera
from recon.core.values.arrays import Bool, Float64, tree_of
from recon.odometry.checked import most_sigma_m
from recon.odometry.features import (
    VisualState,
    empty_window,
    follow_points,
    known_disparity,
    observe_points,
    points_of,
    replenish,
    told_apart,
)
from recon.odometry.guide import MAX_SIGMAS, Guide, Guided
from recon.odometry.pose import (
    INDEPENDENCE,
    MIN_INLIERS,
    KnownPose,
    LocatedCamera,
    TrackWindow,
    adjust,
    enough_agree,
    locate_camera,
    misfits,
    newest_health,
    newest_information,
)
from recon.odometry.protocol import OdometryFrame, OdometryHealth, OdometryResult, pose_in
from recon.stereo.rectify.features import match_features

_FRAMES: Final = 6  # frames adjusted together
_RELOCATE_FEATURES: Final = 2000  # features matched over the whole image where tracking fails
_SIGMAS: Final = 2.0  # by which tracks for one of two motions outnumber those for the other
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
    rival: Float64 | None = None  # (4, 4), another pose that explains the image about as well

    @property
    def inliers(self) -> int:
        return int(self.window.seen[-1].sum())


class VisualOdometry:
    """Tracks the camera by features.

    Args:
        guide: Motion by other sensors: it predicts where features are, bridges frames without any,
            and refuses features that contradict it.
    """

    def __init__(self, guide: Guide | None = None) -> None:
        self._guide = guide
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
        guided = self._guided(state.motion, state.seen, time_s)
        motion = state.motion.drifted(time_s)
        if guided is not None:
            motion = state.motion.moved(guided.T_world_camera, time_s)
        expected = guided or Guided(motion.T_world_camera, np.eye(6))
        seen = self._by_tracking(state, frame, expected)
        seen = seen or self._by_matching(state, frame, expected)
        if seen is None:
            return self._lost(state, frame, motion, guided)
        if self._contradicts(state, seen, frame):
            what = f"features contradict {expected.name}"
            return self._lost(state, frame, motion, guided, what)
        T_world_camera = seen.window.T_world_camera[-1].copy()
        window = replenish(seen.window.trimmed(_FRAMES), frame)
        motion = state.motion.moved(T_world_camera, time_s)
        self._state = VisualState(window, frame.pair.left, frame.disparity, motion, motion)
        camera, known = frame.pair.camera, _held(expected)
        health = newest_health(seen.window, camera, seen.tracks, seen.note, known)
        information = newest_information(seen.window, camera, known=known)
        if seen.rival is not None:
            off = as_step(invert(T_world_camera) @ seen.rival)
            health, information = _doubted(health, information, off)
        return VisualEstimate(OdometryResult(T_world_camera, health), information)

    @property
    def window(self) -> TrackWindow:
        """The last frames that were registered; without points before the first one."""
        return empty_window(np.eye(4)) if self._state is None else self._state.window

    def state(self) -> dict[str, Any]:
        last = self._state
        if last is None:
            return {"last": None}
        names = ("window", "disparity", "motion", "seen")
        parts = {name: tree_of(getattr(last, name)) for name in names}
        return {"last": {**parts, "left": last.left}}

    def restore(self, state: dict[str, Any]) -> None:
        last, self._state = state["last"], None
        if last is not None:
            for motion in (last["motion"], last["seen"]):
                for name in ("T_world_camera", "T_before_camera"):
                    pose_in(motion, name)
            self._state = VisualState(
                TrackWindow(**last["window"]),
                last["left"],
                Disparity(**last["disparity"]),
                Motion(**last["motion"]),
                Motion(**last["seen"]),
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
        # How fast the camera moves is not seen in one frame.
        seen = Motion(motion.T_world_camera, frame.pair.timestamp_s)
        return VisualState(window, frame.pair.left, frame.disparity, motion, seen)

    def _guided(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        return None if self._guide is None else self._guide.guide(last, seen, to_s)

    def _contradicts(self, state: VisualState, seen: _Seen, frame: OdometryFrame) -> bool:
        """Whether the visual motion since the last registration contradicts the prior."""
        guided = self._guided(state.seen, state.seen, frame.pair.timestamp_s)
        if guided is None:
            return False
        information = newest_information(seen.window, frame.pair.camera)
        both = covariance_of(information) + guided.covariance
        return distance_in_sigmas(guided.off(seen.window.T_world_camera[-1]), both) > MAX_SIGMAS

    def _by_tracking(
        self, state: VisualState, frame: OdometryFrame, expected: Guided
    ) -> _Seen | None:
        """The frame, registered by tracking; None = that fails.

        The features that are followed give a pose, and the pose says where all of them are and how
        they look from there: those that were lost are found, and the others more closely. They may
        have slid: if the points that do not agree could tell, the expected motion is tried, too.
        """
        window, camera = state.window, frame.pair.camera
        uv = follow_points(state, frame, expected.T_world_camera)
        tracks = np.flatnonzero(np.isfinite(uv[:, 0]))
        rough = _locate(window.xyz_world[tracks], uv[tracks], camera, expected)
        if rough is None:
            return None
        seen = self._observed(state, frame, uv, rough.T_world_camera, expected)
        if seen is None:
            return None
        agree = seen.window.seen[-1]
        apart = told_apart(state, rough.T_world_camera, expected.T_world_camera, camera)
        if apart.sum() < MIN_INLIERS or _more(apart & agree, window.seen[-1] & ~agree):
            return seen
        nowhere = np.full_like(uv, np.nan)
        rival = self._observed(state, frame, nowhere, expected.T_world_camera, expected)
        return seen if rival is None else _better(seen, rival)

    def _observed(
        self, state: VisualState, frame: OdometryFrame, uv: Float64, T: Float64, expected: Guided
    ) -> _Seen | None:
        """The frame, registered by what is seen from a rough pose; None = too little agrees."""
        uvd = observe_points(state, frame, uv, T)
        if not expected.holds:
            expected = replace(expected, T_world_camera=T)
        seen = self._register(state.window, uvd, frame, expected)
        # Patches drift along edges together: of them, a few that agree with a turn may be wrong.
        return seen if seen is not None and enough_agree(seen.inliers, seen.tracks) else None

    def _by_matching(
        self, state: VisualState, frame: OdometryFrame, expected: Guided
    ) -> _Seen | None:
        """The frame, registered by matching over the whole image; None = that fails."""
        # Who is in a hurry would lose more frames to SIFT than it saves.
        found = match_features(
            state.left, frame.pair.left, _RELOCATE_FEATURES, any_scale=not frame.rough
        )
        uv, uv_now = found.left_uv, found.right_uv
        camera, T_world_then = frame.pair.camera, state.window.T_world_camera[-1]
        then = np.column_stack([uv, known_disparity(state.disparity, camera, uv)])
        now = np.column_stack([uv_now, known_disparity(frame.disparity, camera, uv_now)])
        known = np.isfinite(then[:, 2])
        then, now = then[known].astype(np.float64), now[known].astype(np.float64)
        window = empty_window(T_world_then).with_points(then, points_of(then, T_world_then, camera))
        by_turn = self._by_turn(state, frame, window, now, expected)
        seen = self._register(window, now, frame, expected)
        if seen is None or (by_turn is not None and by_turn.inliers > seen.inliers):
            seen = by_turn
        if seen is None:
            return None
        return replace(seen, note="features were looked for in the whole image")

    def _by_turn(
        self,
        state: VisualState,
        frame: OdometryFrame,
        matched: TrackWindow,
        uvd: Float64,
        expected: Guided,
    ) -> _Seen | None:
        """The frame, by what a few matches and a known turn say of where its features are."""
        rough = None
        if expected.holds:
            rough = expected.locate(matched.xyz_world, uvd[:, :2], frame.pair.camera)
        if rough is None:
            return None
        nowhere = np.full((len(state.window.xyz_world), 2), np.nan)
        uvd = observe_points(state, frame, nowhere, rough.T_world_camera)
        return self._register(state.window, uvd, frame, expected)

    def _register(
        self, window: TrackWindow, uvd: Float64, frame: OdometryFrame, expected: Guided
    ) -> _Seen | None:
        """The window with the new frame added, if enough features agree on one motion."""
        camera = frame.pair.camera
        tracks = np.flatnonzero(np.isfinite(uvd[:, 0]))
        found = _locate(window.xyz_world[tracks], uvd[tracks, :2], camera, expected)
        if found is None:
            return None
        uvd[tracks[~found.agree]] = np.nan
        window = window.with_frame(found.T_world_camera, uvd)
        window = adjust(window, camera, _held(expected))
        window = window.without_newest(misfits(window, camera))
        seen = _Seen(window, len(tracks))
        agree = (seen.inliers, seen.tracks)
        held = expected.holds and expected.enough_agree(*agree)
        return seen if held or enough_agree(*agree) else None

    def _lost(
        self,
        state: VisualState,
        frame: OdometryFrame,
        motion: Motion,
        guided: Guided | None,
        what: str = "no motion fits",
    ) -> VisualEstimate:
        """Continue the motion; a frame with enough features begins a new path there."""
        begun = self._begin(frame, motion)
        points = len(begun.window.xyz_world)
        sees = points >= MIN_INLIERS
        self._state = begun if sees else replace(state, motion=motion)
        why = f"{what if sees else _NOTHING} ({counted(points, 'feature')})"
        step_m = float(np.linalg.norm(motion.T_before_camera[:3, 3]))
        if guided is None or (guided.holds and guided.sigma_m > most_sigma_m(step_m, guided.scale)):
            notes = (f"lost: {why}; {'a new segment begins' if sees else 'skipped'}",)
            health = OdometryHealth(ok=sees, skipped=not sees, begins=sees, notes=notes)
            return VisualEstimate(OdometryResult(motion.T_world_camera, health), None)
        note = f"carried by {guided.name}: {why}"
        sigma_m, sigma_deg = guided.sigma_m, guided.sigma_deg
        health = OdometryHealth(sigma_m=sigma_m, sigma_deg=sigma_deg, notes=(note,))
        return VisualEstimate(OdometryResult(motion.T_world_camera, health), guided.information)


def _locate(
    xyz_world: Float64, uv: Float64, camera: RectifiedCamera, expected: Guided
) -> LocatedCamera | None:
    """Locate a camera by points; what fits more, alone or with a known turn."""
    held = expected.locate(xyz_world, uv, camera) if expected.holds else None
    alone = locate_camera(xyz_world, uv, camera, expected.T_world_camera)
    if held is None or alone is None:
        return held or alone
    return max(held, alone, key=lambda found: int(found.agree.sum()))


def _better(one: _Seen, other: _Seen) -> _Seen:
    """The motion that more tracks agree with; the other is its rival if that may be chance."""
    best, less = (one, other) if one.inliers >= other.inliers else (other, one)
    ours, theirs = best.window.seen[-1], less.window.seen[-1]
    clear = _more(ours & ~theirs, theirs & ~ours)
    return best if clear else replace(best, rival=less.window.T_world_camera[-1])


def _more(for_one: Bool, for_other: Bool) -> bool:
    """Whether so many more tracks (N,) are for one of two motions that it is no chance."""
    one, other = np.count_nonzero(for_one), np.count_nonzero(for_other)
    return bool(np.sqrt(INDEPENDENCE) * (one - other) > _SIGMAS * np.sqrt(one + other))


def _doubted(
    health: OdometryHealth, information: Float64, off: Float64
) -> tuple[OdometryHealth, Float64]:
    """Health and information of a pose where one that is ``off`` (6,) from it is as likely."""
    covariance = covariance_of(information)
    if distance_in_sigmas(off, covariance) <= MAX_SIGMAS:
        return health, information
    half = off / 2.0  # that each is off their mean
    sigma_m = float(np.hypot(health.sigma_m, np.linalg.norm(half[:3])))
    sigma_deg = float(np.hypot(health.sigma_deg, np.rad2deg(np.linalg.norm(half[3:]))))
    notes = (*health.notes, "another motion explains the image as well")
    health = replace(health, sigma_m=sigma_m, sigma_deg=sigma_deg, notes=notes)
    return health, np.asarray(np.linalg.inv(covariance + np.outer(half, half)))


def _held(expected: Guided) -> KnownPose | None:
    """What an adjustment takes of it."""
    return expected.known if expected.holds else None
