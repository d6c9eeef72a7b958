"""The motion of the camera by other sensors: wheels, an inertial unit, a satellite receiver.

Its axes are those in which it agrees with what the cameras see.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final, Literal, get_args

import numpy as np

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import (
    Motion,
    as_step,
    covariance_of,
    distance_in_sigmas,
    invert,
    make_transform,
    orthonormalise,
    part_of,
    step_covariance,
)
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.guide import MAX_SIGMAS, Guided
from recon.odometry.protocol import OdometryFrame
from recon.odometry.settings import PriorSettings
from recon.odometry.visual import VisualOdometry

_CAMERA_FROM_BODY: Final = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Camera axes (x right, y down, z forward) of body axes (x forward, y left, z up)."""

_MAX_GAP_S: Final = 1.0
"""Poses farther apart in time are not interpolated: a vehicle brakes or turns within it."""


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """A path of the same rig on the same clock, of which only relative motions are used."""

    path: Trajectory  # poses at any rate and in any world frame
    settings: PriorSettings  # axes, gaps, accuracy

    def __post_init__(self) -> None:
        if len(self.path) < 2:
            raise RegistrationError(
                "a prior of the motion needs two poses", got=f"{len(self.path)}", hint="see --prior"
            )

    def check_covers(self, stamps_s: Float64) -> None:
        """Refuse a path that gives no motion between the frames of a drive, taken at times (N,)."""
        known = np.array([self.knows(float(t)) for t in stamps_s])
        if len(stamps_s) < 2 or (known[1:] & known[:-1]).any():
            return
        spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (self.path.timestamps_s, stamps_s)]
        raise RegistrationError(
            "the prior does not cover the drive",
            got=f"poses from {spans[0]}",
            expected=f"frames from {spans[1]}, poses at most {_MAX_GAP_S:g} s apart",
            hint="both must use the same clock, in seconds",
        )

    def knows(self, time_s: float) -> bool:
        return self._pose_at(time_s) is not None

    def motion(self, from_s: float, to_s: float) -> Float64 | None:
        """T_from_to (4, 4) of the camera between two times; None = a gap in the path."""
        start, end = self._pose_at(from_s), self._pose_at(to_s)
        if start is None or end is None or not to_s > from_s:
            return None
        T = invert(start) @ end
        if self.settings.axes == "body":
            turn = make_transform(_CAMERA_FROM_BODY, np.zeros(3))
            T = turn @ T @ invert(turn)
        return orthonormalise(T)

    def guide(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        """Return where the path puts the camera, as sure as of a motion from frame to frame."""
        T = self.motion(last.timestamp_s, to_s)
        if T is None:
            return None
        return Guided(last.T_world_camera @ T, step_covariance(*self.sigmas(T)))

    def sigmas(self, T_from_to: Float64) -> tuple[float, float]:
        """Standard deviations of a motion: translation in metres, rotation in degrees."""
        s, length_m = self.settings, float(np.linalg.norm(T_from_to[:3, 3]))
        return s.sigma_m + s.sigma_ratio * length_m, s.sigma_deg

    def _pose_at(self, time_s: float) -> Float64 | None:
        """The pose (4, 4) at a time, interpolated; None = outside the path or in a gap."""
        times_s = self.path.timestamps_s
        if not times_s[0] <= time_s <= times_s[-1]:
            return None
        after = int(np.searchsorted(times_s, time_s, side="left"))
        T_after: Float64 = self.path.T_world_camera[after]
        if times_s[after] == time_s:
            return T_after
        gap_s = times_s[after] - times_s[after - 1]
        if gap_s > _MAX_GAP_S:
            return None
        T_before = self.path.T_world_camera[after - 1]
        ratio = float((time_s - times_s[after - 1]) / gap_s)
        return np.asarray(T_before @ part_of(invert(T_before) @ T_after, ratio))


Axes = Literal["camera", "body"]

_CLEAR: Final = 10.0
"""Standard deviations of a prior that a motion must exceed to distinguish two sets of axes."""
_ENOUGH: Final = 5  # motions compared; their median is not spoiled by two that are wrong
_MOST_FRAMES: Final = 100  # frames looked at; matching them takes about ten seconds


@dataclass(frozen=True)
class FoundAxes:
    """The axes of a prior."""

    axes: Axes  # those that explain the visual motion best
    # Median distance from the visual motion, standard deviations, for each set of axes
    sigmas: Mapping[str, float]
    motions: int  # number of motions compared


def find_axes(
    prior: Trajectory, frames: Iterable[OdometryFrame], settings: PriorSettings
) -> FoundAxes | None:
    """The axes in which a prior agrees with the visual motion of some frames.

    As many frames are read as are needed; ``settings.axes`` = auto tries all supported axes. None
    if the cameras do not see enough motion to decide.
    """
    tried: Sequence[Axes] = get_args(Axes) if settings.axes == "auto" else (settings.axes,)
    priors = {axes: MotionPrior(prior, _in_axes(settings, axes)) for axes in tried}
    motions = _visual_motions(priors[tried[0]], frames)
    if not motions:
        return None
    sigmas: dict[str, float] = {
        axes: float(np.median([_distance(prior, motion) for motion in motions]))
        for axes, prior in priors.items()
    }
    best = min(tried, key=lambda axes: sigmas[axes])
    if sigmas[best] > MAX_SIGMAS:
        misfits = ", ".join(f"{axes} axes {sigmas[axes]:.1f}" for axes in priors)
        raise RegistrationError(
            "the prior does not fit what the cameras see",
            got=f"{misfits} standard deviations off in {counted(len(motions), 'motion')}",
            expected=f"at most {MAX_SIGMAS:g}",
            hint="it must be the path of this rig, in metres and on its clock; see "
            "odometry.prior.axes, and odometry.prior.sigma_m if it is no better",
        )
    return FoundAxes(best, sigmas, len(motions))


def first_moving(prior: Trajectory, stamps_s: Float64, settings: PriorSettings) -> int:
    """The last frame before a prior moves; 0 if it never does."""
    path = MotionPrior(prior, _in_axes(settings, "camera"))
    start: float | None = None
    for index, stamp_s in enumerate(stamps_s.tolist()):
        if start is None:
            start = stamp_s if path.knows(stamp_s) else None
            continue
        motion = path.motion(start, stamp_s)
        if motion is not None and _in_sigmas(motion, settings) > 1:
            return index - 1
    return 0


@dataclass(frozen=True, eq=False)
class _VisualMotion:
    """A motion between two frames: ``T_from_to`` and its covariance (6, 6)."""

    from_s: float
    to_s: float
    frames: int
    T_from_to: Float64
    covariance: Float64


def _in_axes(settings: PriorSettings, axes: Axes) -> PriorSettings:
    return settings.model_copy(update={"axes": axes})


def _in_sigmas(T: Float64, settings: PriorSettings) -> float:
    """The size of a motion in standard deviations of a short one."""
    step = as_step(T)
    turned_deg = float(np.rad2deg(np.linalg.norm(step[3:])))
    return max(float(np.linalg.norm(step[:3])) / settings.sigma_m, turned_deg / settings.sigma_deg)


def _visual_motions(prior: MotionPrior, frames: Iterable[OdometryFrame]) -> list[_VisualMotion]:
    """Visual motions that are long enough, one after the other, where the prior is known."""
    odometry, motions = VisualOdometry(), []
    start: tuple[int, float, Float64] | None = None
    covariance = np.zeros((6, 6))
    for index, frame in enumerate(islice(frames, _MOST_FRAMES)):
        seen, time_s = odometry.track(frame), frame.pair.timestamp_s
        now = (index, time_s, seen.result.T_world_camera)
        if start is None or seen.information is None:
            start, covariance = now, np.zeros((6, 6))
            continue
        covariance = covariance + covariance_of(seen.information)
        expected = prior.motion(start[1], time_s)
        T = invert(start[2]) @ now[2]
        if expected is not None:
            # A prior that says too little, in kilometres, is contradicted by what is seen.
            size = max(_in_sigmas(motion, prior.settings) for motion in (expected, T))
            if size < _CLEAR:
                continue
            motions.append(_VisualMotion(start[1], time_s, index - start[0], T, covariance))
        start, covariance = now, np.zeros((6, 6))
        if len(motions) == _ENOUGH:
            break
    return motions


def _distance(prior: MotionPrior, seen: _VisualMotion) -> float:
    """How far a prior is from a visual motion, in standard deviations."""
    expected = prior.motion(seen.from_s, seen.to_s)
    if expected is None:
        return float("inf")
    off = as_step(invert(expected) @ seen.T_from_to)
    # The standard deviations are those from frame to frame; independent ones add in squares.
    own = seen.frames * step_covariance(*prior.sigmas(expected))
    return distance_in_sigmas(off, own + seen.covariance)
