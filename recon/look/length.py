"""The baseline of a rig, by lengths that wheels, a receiver or a tape measured along a drive.

No motion of the images shows it: a rig twice as wide sees the same drive through a world of twice
the size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from typing import Final, NamedTuple

import numpy as np

from recon.core.errors import RegistrationError, SettingsError
from recon.core.summary import Figures
from recon.core.text import counted
from recon.core.values import RectifiedCamera, Rig, Trajectory
from recon.core.values.arrays import Float64
from recon.core.work import look_ahead, serial_algebra
from recon.look.fault import shrink
from recon.look.tracks import tracked_parts
from recon.odometry.health import RIG_BASELINE, expected_drift, trusted_poses
from recon.odometry.prior import MotionPrior
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor, StereoSettings

_BASELINE_SIGMA: Final = 0.02
"""Fraction of a baseline, standard deviation beforehand: of one that was measured with a ruler."""

_SETTING: Final = "source.length"

KnownLength = tuple[int, int, float]
"""Two frames of a drive, and how far apart the left camera was in them, metres."""


@dataclass(frozen=True)
class BaselineFigures(Figures):
    """By how much the cameras are farther apart than given, per cent of the baseline."""

    percent: float  # what is corrected
    sigma_percent: float  # standard deviation of what is left
    measured_percent: float  # by how much the lengths are longer than the images alone say
    measured_sigma_percent: float


@dataclass(frozen=True)
class SeenBaseline:
    """By what ratio the cameras are farther apart than given, as measured lengths show it."""

    ratio: float  # what is to be corrected: 0 where chance explains what was measured
    sigma: float  # standard deviation of what is left
    longer: float  # by what ratio the lengths are longer than the images alone say
    longer_sigma: float

    def applied(self, rig: Rig) -> Rig:
        """Return a rig with the baseline as it was seen."""
        wider = 1.0 + self.ratio
        if isinstance(rig, RectifiedCamera):
            return replace(rig, baseline_m=wider * rig.baseline_m)
        T = rig.T_right_left.copy()
        T[:3, 3] *= wider
        return replace(rig, T_right_left=T)

    def describe(self, *, used: bool) -> str:
        """Return in words what was measured, and what became of it."""
        off = f"{100.0 * self.longer:+.2f} ± {196.0 * self.longer_sigma:.2f} %"
        use = f"used is one {100.0 * self.ratio:+.2f} %" if used else "used is that given"
        return f"measured lengths are {off} off those by the baseline as calibrated; {use}"

    def figures(self) -> BaselineFigures:
        ratios = (self.ratio, self.sigma, self.longer, self.longer_sigma)
        return BaselineFigures(*(100.0 * ratio for ratio in ratios))


def check_length(source: StereoSource, known: KnownLength) -> None:
    """Refuse a length between frames that a drive does not have, or not yet."""
    first, last, _ = known
    got = f"frames {first} and {last}"
    if source.live:
        what, hint = "frames to come show no baseline", "record the drive, and map it then"
        raise SettingsError(what, where=_SETTING, got=got, hint=hint)
    if not first < last < len(source):
        expected = f"two of {counted(len(source), 'frame')}, in order, counted from 0"
        raise SettingsError("no such frames", where=_SETTING, got=got, expected=expected)


def see_baseline(
    source: StereoSource,
    config: StereoSettings,
    measured: MotionPrior | KnownLength,
    rig_ratio: float | None = None,
) -> SeenBaseline | None:
    """Compare lengths that were measured along a drive with those that its images show.

    Of a path by other sensors, they are the distances between the ends of a few segments. What
    wheels are off by is common to all of them. None where that may be as much as baselines are off
    by, or where no segment can be compared.

    Args:
        source: The drive, with its rig refined.
        config: How pairs are matched.
        measured: Path by other sensors, or one length.
        rig_ratio: As for `expected_drift`, which says how certain lengths by the images are.

    Raises:
        RegistrationError: Odometry is lost between two frames, or they are at one place.
    """
    if isinstance(measured, MotionPrior):
        common = measured.settings.sigma_ratio
        if source.live or common >= _BASELINE_SIGMA:
            return None
        parts = tracked_parts(len(source))
        segments = [_seen(source, config, start, stop, rig_ratio) for start, stop in parts]
        beside = [None if one is None else _beside(one, measured) for one in segments]
        lengths = [length for length in beside if length is not None]
    else:
        common, lengths = 0.0, [_between(source, config, measured, rig_ratio)]
    if not lengths:
        return None
    # What the rig is the reason of is common to all lengths, as is what wheels are off by.
    seen_m, known_m, sigma_m, rig_m = np.array(lengths).T
    longer, weight = known_m / seen_m - 1.0, (seen_m / sigma_m) ** 2
    mean = float(weight @ longer / weight.sum())
    scatter = float(weight @ (longer - mean) ** 2) / max(len(longer) - 1, 1)
    apart = np.sqrt(max(1.0, scatter) / weight.sum())
    sigma = float(np.linalg.norm([apart, common, np.mean(rig_m / seen_m)]))
    likely = mean / (1.0 + (sigma / _BASELINE_SIGMA) ** 2)
    beforehand = np.array([_BASELINE_SIGMA])
    kept, squares, _ = shrink(np.array([likely]), np.array([[sigma**-2]]), beforehand)
    return SeenBaseline(float(kept[0]), float(np.sqrt(squares[0, 0])), mean, sigma)


class _Seen(NamedTuple):
    """How far apart the ends of a segment are, by its images, and when it was."""

    length_m: float
    sigma_m: float
    rig_m: float  # standard deviation that the rig is the reason of
    frames: int
    from_s: float
    to_s: float


def _seen(
    source: StereoSource, config: StereoSettings, start: int, stop: int, rig_ratio: float | None
) -> _Seen | None:
    """Return what visual odometry shows of a segment; None = it is lost there, or nothing moves."""
    odometry, reconstructor = VisualOdometry(), FrameReconstructor(source.calibration, config)
    found, times_s = list[OdometryResult](), list[float]()
    pairs = islice(source.frames(start), stop - start)
    with serial_algebra():
        for pair, disparity in look_ahead(reconstructor.match, pairs):
            found.append(odometry.register(OdometryFrame(pair, disparity)))
            times_s.append(pair.timestamp_s)
    path = Trajectory(np.stack([one.T_world_camera for one in found]), np.array(times_s))
    health = [one.health for one in found]
    drift = expected_drift(path, health, reconstructor.camera, rig_ratio)
    if drift is None or not trusted_poses(health).all():
        return None
    length_m = float(np.linalg.norm(path.positions_m[-1] - path.positions_m[0]))
    sigma, rig = drift.percent / 100.0, drift.rig_percent / 100.0
    own_m, rig_m = (
        path.path_length_m * np.sqrt(max(whole**2 - part**2, 0.0))
        for whole, part in ((sigma, rig), (rig, RIG_BASELINE))
    )
    return _Seen(length_m, float(own_m), float(rig_m), len(found), times_s[0], times_s[-1])


def _between(
    source: StereoSource, config: StereoSettings, known: KnownLength, rig_ratio: float | None
) -> Float64:
    """Return the distance between two frames: seen, measured, its standard deviation, the rig's."""
    first, last, length_m = known
    seen = _seen(source, config, first, last + 1, rig_ratio)
    if seen is None or seen.length_m <= 2.0 * seen.sigma_m:
        why = "odometry is lost between them" if seen is None else "they are at one place"
        what = "the length between two frames shows no baseline"
        raise RegistrationError(what, where=_SETTING, got=f"frames {first} and {last}: {why}")
    return np.array([seen.length_m, length_m, seen.sigma_m, seen.rig_m])


def _beside(seen: _Seen, prior: MotionPrior) -> Float64 | None:
    """Return the same of a segment and of a prior; None = it has a gap, or nothing moved."""
    known = prior.motion(seen.from_s, seen.to_s)
    # It is stated from frame to frame; independent errors add in squares.
    own_m = prior.settings.sigma_m * np.sqrt(seen.frames - 1)
    sigma_m = float(np.hypot(seen.sigma_m, own_m))
    if known is None or seen.length_m <= 2.0 * sigma_m:
        return None
    return np.array([seen.length_m, np.linalg.norm(known[:3, 3]), sigma_m, seen.rig_m])
