"""Finds the axes of a prior: those in which it agrees with what the cameras see."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Final, Literal, get_args

import numpy as np

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import (
    as_step,
    covariance_of,
    distance_in_sigmas,
    invert,
    step_covariance,
)
from recon.core.text import counted
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.prior import MAX_SIGMAS, MotionPrior
from recon.odometry.protocol import OdometryFrame
from recon.odometry.settings import PriorSettings
from recon.odometry.visual import VisualOdometry

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
    off = [_distances(priors, motion) for motion in _visual_motions(priors[tried[0]], frames)]
    if not off:
        return None
    sigmas: dict[str, float] = {
        axes: float(np.median([one[axes] for one in off])) for axes in tried
    }
    best = min(tried, key=lambda axes: sigmas[axes])
    if sigmas[best] > MAX_SIGMAS:
        misfits = ", ".join(f"{axes} axes {sigmas[axes]:.1f}" for axes in priors)
        raise RegistrationError(
            "the prior does not fit what the cameras see",
            got=f"{misfits} standard deviations off in {counted(len(off), 'motion')}",
            expected=f"at most {MAX_SIGMAS:g}",
            hint="it must be the path of this rig, in metres and on its clock; see "
            "odometry.prior.axes, and odometry.prior.sigma_m if it is no better",
        )
    return FoundAxes(best, sigmas, len(off))


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


def _distances(priors: Mapping[Axes, MotionPrior], seen: _VisualMotion) -> dict[Axes, float]:
    """How far each prior is from a visual motion, in standard deviations."""
    return {axes: _distance(prior, seen) for axes, prior in priors.items()}


def _distance(prior: MotionPrior, seen: _VisualMotion) -> float:
    expected = prior.motion(seen.from_s, seen.to_s)
    if expected is None:
        return float("inf")
    off = as_step(invert(expected) @ seen.T_from_to)
    # The standard deviations are those from frame to frame; independent ones add in squares.
    own = seen.frames * step_covariance(*prior.sigmas(expected))
    return distance_in_sigmas(off, own + seen.covariance)
