"""The rig of a drive, refined by what its motion shows, and what that says of the rig given.

Rigs are seldom as they were calibrated: lenses were fitted to a board, and cameras turned since. On
a drive that is the largest error of the path, and the drive itself shows it.

Ref: Cvisic et al., "Recalibrating the KITTI dataset camera setup for improved odometry accuracy",
ECMR 2021.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import make_transform
from recon.core.progress import stage
from recon.core.summary import Figures, inline, optional
from recon.core.text import metres
from recon.core.values import RectifiedCamera, Rig, Trajectory
from recon.core.values.arrays import Float64
from recon.look.fault import NAMES, TURN, RigFault, active, spread_pixels, without_fault
from recon.look.fit import FittedFault, fit_fault
from recon.look.geometry import Rigidity
from recon.look.length import BaselineFigures, SeenBaseline
from recon.look.tracks import FRAMES, StereoTracks
from recon.odometry.settings import RigSettings
from recon.sources.source import StereoSource
from recon.stereo.frame import StereoSettings
from recon.stereo.rectify.epipolar import as_raw
from recon.stereo.rectify.lens import project_raw
from recon.stereo.rectify.rectifier import RectificationSettings, turns_of

MIN_WINDOWS: Final = 6  # fewer windows do not show how much they contradict each other
DEPTHS: Final = (1.0, 3.0)  # times the typical one, for which the depth error is stated
_PASSES: Final = 2  # a rig that was far off is matched, and fitted, once more
_FAR_OFF_PX: Final = 1.0  # what features moved by, root mean square, if it was
_LEAST_PX: Final = 0.05  # no matcher sees less; images are not warped for it
_FIELD: Final = (16, 8)  # places across and down the image at which rigs are compared
MOST_DEPTH_PERCENT: Final = 2.0
"""Error of the depth from which the rig given is called wrong."""
LEAST_FRAMES: Final = MIN_WINDOWS * FRAMES  # of a drive whose rig is refined
MOST_TIME_OFFSET: Final = 0.1  # frames from which right images are said to be late
LATER: Final = "after the left ones"  # in what is said of them
MOVES: Final = (
    "what is wrong with the rig moves with what is seen instead of staying in the image, as in "
    "stabilised images: no calibration repairs that, so at most rows are aligned, and depth and "
    "the length of the path stay off; record images as sensors see them"
)


@dataclass(frozen=True, eq=False)
class RigChange:
    """What a rig saw otherwise than it is seen now, at places of its rectified left image."""

    depth_m: float  # of what is seen
    off_px: Float64  # (rows, columns), disparity as given minus as refined; NaN = not in both views
    epipolar_error_px: Float64  # the same of the rows of right minus left

    @property
    def mean_px(self) -> float:
        return float(np.nanmean(self.off_px))

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.nanmean(self.off_px**2)))

    @property
    def epipolar_rms_px(self) -> float:
        return float(np.sqrt(np.nanmean(self.epipolar_error_px**2)))

    @property
    def moved_px(self) -> float:
        """By how far features of the right image move against the left one, root mean square."""
        return float(np.hypot(self.rms_px, self.epipolar_rms_px))


@dataclass(frozen=True)
class Measured(Figures):
    """A value and its standard deviation."""

    mean: float
    sigma: float


@dataclass(frozen=True)
class ImageError(Figures):
    """An error over an image, in pixels: its mean with a standard deviation, and its rms."""

    mean: float
    sigma: float
    rms: float


@dataclass(frozen=True)
class Delay(Figures):
    """By how much right images are taken later than left ones."""

    frames: float
    sigma: float  # in frames
    seconds: float


@dataclass(frozen=True)
class Parameter(Figures):
    """A parameter of a rig, in radians or as a fraction, with standard deviations."""

    prior: float
    value: float
    sigma: float


@dataclass(frozen=True, kw_only=True)
class MotionFigures(Figures):
    """How a rig differs from its calibration, as the motion of a drive shows it."""

    begun_with: str | None  # which drive of the map it begins with; None = the calibration
    windows: int
    fixed: bool
    pitch_deg: float  # of the right camera, as are the next
    yaw_deg: float
    roll_deg: float
    focal_percent: float
    disparity_px: ImageError
    epipolar_error_px: float  # epipolar error, root mean square over the image
    right_time_offset: Delay
    depth_percent: Mapping[str, Measured]  # by depth in metres; infinite = behind infinity
    parameters: Mapping[str, Parameter]
    not_visible: str = "baseline"


@dataclass(frozen=True, kw_only=True)
class RigFigures(Figures):
    """The rig of a drive: whether it was refined, and what the drive shows of it."""

    refined: bool
    motion: MotionFigures | None = inline(None)
    baseline: BaselineFigures | None = optional()  # where lengths were measured


@dataclass(frozen=True, eq=False)
class RefinedRig:
    """The rig of a drive as given, and as the drive shows it."""

    given: Rig
    calibration: Rig  # to be used: that given where the drive shows no other, or it is to be kept
    camera: RectifiedCamera  # rectified views of the rig given
    fitted: FittedFault | None = None  # None: nothing was measured
    changes: tuple[RigChange, ...] = ()  # at `DEPTHS`
    sigma_px: float = float("nan")  # of the mean disparity
    begun_with: str | None = None  # the drive whose rig this one began with
    period_s: float = float("nan")  # of frames; NaN = not known
    baseline: SeenBaseline | None = None  # None: no length was measured
    rigidity: Rigidity | None = None  # None: not measured

    @property
    def refined(self) -> bool:
        """Whether another rig than was given is used."""
        return self.calibration is not self.given

    @property
    def not_rigid(self) -> tuple[str, ...]:
        """What to know first of all of cameras that move against each other; else empty."""
        known = self.rigidity
        return () if known is None or known.kept else (known.describe(),)

    @property
    def length_ratio(self) -> float | None:
        """Standard deviation of the length of the path that is left to the rig used, as a ratio.

        Without the baseline, unless lengths that were measured changed it; None if nothing was.
        """
        if self.fitted is None:
            return None
        by, own = self.fitted.lengthening, self.fitted.length
        if np.isnan(own):  # fitted by an earlier version
            own = float(np.sqrt(by @ self.fitted.covariance @ by))
        kept = 0.0 if self.refined else float(by @ self.fitted.values)
        wider = self.baseline.sigma if self.baseline is not None and self.baseline.ratio else 0.0
        return float(np.sqrt(own**2 + kept**2 + wider**2))

    def applied(self, source: StereoSource) -> StereoSource:
        """Return the drive with the refined rig, marked if its cameras are not rigid."""
        rigid = not self.not_rigid
        if rigid and not self.refined:
            return source
        return source.with_calibration(self.calibration, rigid=rigid)

    def with_baseline(self, seen: SeenBaseline, settings: RigSettings) -> RefinedRig:
        """Return the rig with the baseline that lengths show; if it is to be kept, it says so."""
        use = settings.refine and seen.ratio != 0.0
        rig = seen.applied(self.calibration) if use else self.calibration
        return replace(self, calibration=rig, baseline=seen)

    def poses(
        self, given: Trajectory, settings: RectificationSettings, *, of_raw: bool = False
    ) -> Trajectory:
        """Return poses of the rectified left camera as given, or the raw one, for the refined."""
        before = np.eye(3) if of_raw else turns_of(self.given, settings).R_left
        now = turns_of(self.calibration, settings).R_left
        turned = make_transform(before @ now.T, np.zeros(3))
        return replace(given, T_world_camera=given.T_world_camera @ turned)

    def true_path(self, source: StereoSource, settings: RectificationSettings) -> Trajectory | None:
        """Return the true path of the rectified left camera of the refined rig, if it is known."""
        if source.truth is None or source.truth.trajectory is None:
            return None
        return self.poses(source.truth.trajectory, settings, of_raw=source.truth_of_raw)

    def depth_percent(self, change: RigChange) -> tuple[float, float]:
        """Return by how much depth was off on average, and the standard deviation, in per cent.

        Of what is at the depth of ``change``; positive = it seemed farther away, infinite = behind
        infinity.
        """
        disparity_px = self.camera.focal_px * self.camera.baseline_m / change.depth_m
        given_px = disparity_px + change.mean_px
        if given_px <= 0.0:
            return float("inf"), float("inf")
        ratio = disparity_px / given_px
        return 100.0 * (ratio - 1.0), 100.0 * ratio * self.sigma_px / given_px

    def rms_percent(self, depth_m: float) -> float:
        """Return the depth error there, root mean square over the image; 0 if none is known.

        Infinite where some of it seems to be behind infinity.
        """
        if not self.changes:
            return 0.0
        disparity_px = self.camera.focal_px * self.camera.baseline_m / depth_m
        given_px = disparity_px + self.changes[0].off_px
        if np.nanmin(given_px) <= 0.0:
            return float("inf")
        return 100.0 * float(np.sqrt(np.nanmean((disparity_px / given_px - 1.0) ** 2)))

    def wrong_at(self, depth_m: float) -> bool:
        """Return whether depth there is off by more than 2 %, and two standard deviations."""
        percent = self.rms_percent(depth_m)
        return percent > MOST_DEPTH_PERCENT and self.changes[0].rms_px > 2.0 * self.sigma_px

    @property
    def wrong(self) -> bool:
        """Whether depth is off so far where most features are."""
        return bool(self.changes) and self.wrong_at(self.changes[0].depth_m)

    @property
    def late(self) -> str:
        """By how much right images are taken later than left ones, in words; "" if hardly."""
        fitted = self.fitted
        if fitted is None or not abs(fitted.time_offset) > max(
            MOST_TIME_OFFSET, 4.0 * fitted.time_offset_sigma
        ):
            return ""
        frames = f"{fitted.time_offset:+.2f} ± {1.96 * fitted.time_offset_sigma:.2f} frames"
        known = np.isfinite(self.period_s)
        return frames + (f" ({1e3 * self.period_s * fitted.time_offset:+.0f} ms)" if known else "")

    def figures(self) -> RigFigures:
        """Return what differs."""
        baseline = None if self.baseline is None else self.baseline.figures()
        if self.fitted is None:
            return RigFigures(refined=self.refined, baseline=baseline)
        fitted, last = self.fitted, self.changes[-1]
        values, sigmas = fitted.values, np.sqrt(np.diag(fitted.covariance))
        turned = dict(zip(TURN, np.degrees(values).tolist(), strict=False))
        rows = zip(NAMES, values, sigmas, RigFault(self.camera).sigmas, strict=True)
        motion = MotionFigures(
            begun_with=self.begun_with,
            windows=fitted.windows,
            fixed=fitted.fixed,
            pitch_deg=turned["pitch"],
            yaw_deg=turned["yaw"],
            roll_deg=turned["roll"],
            focal_percent=-100.0 * float(values[3]),
            disparity_px=ImageError(last.mean_px, self.sigma_px, last.rms_px),
            epipolar_error_px=last.epipolar_rms_px,
            right_time_offset=Delay(
                fitted.time_offset, fitted.time_offset_sigma, self.period_s * fitted.time_offset
            ),
            depth_percent={
                f"{change.depth_m:g}": Measured(*self.depth_percent(change))
                for change in self.changes
            },
            parameters={
                name: Parameter(float(prior), float(value), float(sigma))
                for name, value, sigma, prior in rows
            },
        )
        return RigFigures(refined=self.refined, motion=motion, baseline=baseline)

    def describe(self, depth_m: float) -> str:
        """Return in words what the drive shows of the rig given, and what it does to a depth."""
        near = self.changes[0]
        off = f"{near.mean_px:+.2f} ± {1.96 * self.sigma_px:.2f} px"
        percent = self.rms_percent(depth_m)
        depth = f"by {percent:.0f} %" if np.isfinite(percent) else "up to behind infinity"
        off += f" off, {near.rms_px:.2f} px rms over the image"
        return f"disparities are {off}, depth {depth} at {metres(depth_m)}"

    def warnings(self, known: Sequence[str] = ()) -> list[str]:
        """Return what the user should know of a rig, and does not from lines that are ``known``."""
        late = f"right images are taken {self.late} {LATER}: moving objects get a wrong depth, "
        late += "which no calibration repairs; trigger both cameras together"
        lines = [late] if self.late and not any(LATER in line for line in known) else []
        if self.fitted is not None and not self.fitted.fixed:
            lines.append(MOVES)
        if self.baseline is not None and self.baseline.ratio:
            lines.append(self.baseline.describe(used=self.refined))
        if not self.wrong:
            return lines
        shows = "the motion shows" if self.begun_with is None else f"{self.begun_with} showed"
        used = f"used is the rig that {shows} (--set rig.refine=off keeps the calibration)"
        used = used if self.refined else "used is the calibration as it is"
        return [
            f"the rig is not as calibrated: {self.describe(self.changes[0].depth_m)}; {used}",
            *lines,
        ]


@dataclass(frozen=True, eq=False)
class KnownRig:
    """What a drive showed of its rig, for later drives of the same one."""

    given: Rig
    calibration: Rig  # the refined one; that given where the drive showed nothing else
    fitted: FittedFault
    name: str = ""  # of the drive

    def is_of(self, given: Rig) -> bool:
        """Return whether this is the rig with that calibration, to the last bit."""
        rigs = (self.given, given)
        one, other = (json.dumps(asdict(rig), default=np.ndarray.tolist) for rig in rigs)
        return one == other

    def described(self, settings: RectificationSettings) -> RefinedRig:
        """Return the rig with how it differs from the one given."""
        return _described(self.given, self.calibration, self.fitted, settings)

    def begun(self, settings: RectificationSettings) -> RefinedRig:
        """Return what another drive of the rig begins with, whose cameras run anew."""
        rig, none = self.described(settings), float("nan")
        fitted = replace(self.fitted, time_offset=none, time_offset_sigma=none, fixed=True)
        return replace(rig, fitted=fitted, begun_with=self.name)


@dataclass(frozen=True, eq=False)
class Tracked:
    """What the motion of a drive is fitted to: its tracks, and the rig that they were seen with."""

    tracks: Sequence[StereoTracks]
    rig: Rig
    turn: Float64  # what turned the right camera of that rig so that rows meet
    again: Callable[[Rig], Sequence[StereoTracks]]  # the same with another rig


def refine(
    begun: RefinedRig, seen: Tracked, config: StereoSettings, known: KnownRig | None
) -> RefinedRig:
    """Refine the rig that a drive began with by what its motion shows.

    A few windows of frames, from all over the drive, show how the right camera is turned, how long
    its focal length is, and what both lenses bend; see `recon.look.fault`. Where a drive shows
    little the rig stays.
    """
    values = np.zeros(len(NAMES)) if known is None else known.fitted.values.copy()
    values[: len(TURN)] += seen.turn
    refined, tracks = seen.rig, seen.tracks
    # A rig that has turned since is not as it was known.
    before = None if known is None or seen.turn.any() else known.fitted
    for left in reversed(range(_PASSES)):
        if len(tracks) < MIN_WINDOWS:
            return begun
        last, turns = refined, turns_of(refined, config.rectification)
        stage("fit the rig")
        fitted = fit_fault(tracks, RigFault(turns.camera), active(last), before, values)
        values = values + fitted.values
        refined, before = without_fault(last, turns, fitted.values), None
        change = compare_rigs(last, refined, DEPTHS[-1] * fitted.depth_m, config.rectification)
        if change.moved_px < _FAR_OFF_PX or not left:
            break
        tracks = seen.again(refined)
    fitted = replace(fitted, values=values)
    described = _described(begun.given, refined, fitted, config.rectification)
    return replace(
        described, begun_with=begun.begun_with, period_s=begun.period_s, rigidity=begun.rigidity
    )


def rig_shown(
    tracks: Sequence[StereoTracks], given: Rig, settings: RectificationSettings
) -> RefinedRig:
    """Return the rig as a drive showed it that was mapped with the one given, while it arrived."""
    turns = turns_of(given, settings)
    if len(tracks) < MIN_WINDOWS:
        return RefinedRig(given, given, turns.camera)
    fitted = fit_fault(tracks, RigFault(turns.camera), active(given))
    return _described(given, without_fault(given, turns, fitted.values), fitted, settings)


def _described(
    given: Rig, refined: Rig, fitted: FittedFault, settings: RectificationSettings
) -> RefinedRig:
    """Return a rig with how it differs from the one given, which it is if nothing does."""
    camera = turns_of(given, settings).camera
    changes = tuple(compare_rigs(given, refined, z * fitted.depth_m, settings) for z in DEPTHS)
    rig = refined if changes[-1].moved_px > _LEAST_PX else given
    # How the mean disparity follows the parameters of the fault.
    uv = spread_pixels(camera, _FIELD)
    right_uv, none = uv + np.array([camera.doffs_px, 0.0]), np.zeros(len(fitted.values))
    places = RigFault(camera).correct(uv, right_uv, none)
    by = (places.by_left - places.by_right)[..., 0, :].reshape(-1, len(none)).mean(axis=0)
    sigma_px = float(np.sqrt(by @ fitted.covariance @ by))
    return RefinedRig(given, rig, camera, fitted, changes, sigma_px)


def compare_rigs(
    given: Rig, refined: Rig, depth_m: float, settings: RectificationSettings
) -> RigChange:
    """Compare what two calibrations of a rig make of what one of them sees at a depth."""
    turns, now = turns_of(given, settings), turns_of(refined, settings)
    raw, raw_now = as_raw(given), as_raw(refined)
    camera, camera_now = turns.camera, now.camera
    uv = spread_pixels(camera, _FIELD).reshape(-1, 2)
    disparity_px = camera.focal_px * camera.baseline_m / depth_m
    right_uv = uv - [disparity_px - camera.doffs_px, 0.0]
    pixels = [
        project_raw(lens, np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(K).T @ R)
        for lens, at, K, R in zip(
            (raw.left, raw.right),
            (uv, right_uv),
            turns.matrices,
            (turns.R_left, turns.R_right),
            strict=True,
        )
    ]
    left = now.place(raw_now, pixels[0])
    right = now.place(raw_now, pixels[1], right=True)
    scale = (camera.focal_px * camera.baseline_m) / (camera_now.focal_px * camera_now.baseline_m)
    seen_px = scale * (left[:, 0] - right[:, 0] + camera_now.doffs_px)
    fields = (disparity_px - seen_px, left[:, 1] - right[:, 1])
    off_px, epipolar_error_px = (field.reshape(_FIELD[::-1]) for field in fields)
    return RigChange(depth_m, off_px, epipolar_error_px)
