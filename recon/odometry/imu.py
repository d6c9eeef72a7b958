"""An inertial unit as a guide: its gyro says how the camera turns, its accelerometer what is up.

Where it goes is not integrated: the camera goes on as it did, as surely as it does in this drive.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from typing import Final

import numpy as np

from recon.core.geometry.se3 import Motion, hat, invert, make_transform
from recon.core.summary import Figures
from recon.core.values import ImuRecord, Trajectory
from recon.core.values.arrays import Float64
from recon.core.work import FEW, serial_algebra, side_by_side
from recon.odometry.guide import MAX_SIGMAS, Guided
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

_MOST_STEPS: Final = 5.0  # usual steps between two samples; over a longer gap nothing is known


@dataclass(frozen=True, eq=False)
class Gyro:
    """How a gyro says that a camera turned.

    Unknowns are ordered as steps of: the turn to camera axes (3), the bias (3), the delay (1).
    """

    record: ImuRecord
    R_camera_imu: Float64  # (3, 3), to the axes of the rectified left camera
    bias: Float64  # (3,), radians per second, in its own axes
    time_offset_s: float = 0.0  # its stamps are later than those of images of the same moment

    def knows(self, from_s: float, to_s: float) -> bool:
        """Return whether it measured all the time between two times of images."""
        first, last = self._samples(from_s, to_s)
        times_s = self.record.timestamps_s[first : last + 1]
        covered = len(times_s) > 1 and times_s[0] <= from_s + self.time_offset_s
        covered = covered and times_s[-1] >= to_s + self.time_offset_s
        return bool(covered and np.diff(times_s).max() <= _MOST_STEPS * self._step_s)

    def turned(self, from_s: float, to_s: float) -> tuple[Float64, Float64]:
        """Return ``R_from_to`` (3, 3) of the camera, and its derivative (3, 7) by the unknowns.

        The derivative is of a small turn in the axes at the end.
        """
        first, last = self._samples(from_s, to_s)
        times_s = self.record.timestamps_s[first : last + 1] + 0.0
        rates = self.record.gyro[first : last + 1] - self.bias
        ends = np.array([from_s, to_s]) + self.time_offset_s
        inside = (times_s > ends[0]) & (times_s < ends[1])
        at_ends = np.stack([np.interp(ends, times_s, rate) for rate in rates.T], axis=1)
        times_s = np.concatenate([ends[:1], times_s[inside], ends[1:]])
        rates = np.concatenate([at_ends[:1], rates[inside], at_ends[1:]])
        steps_s = np.diff(times_s)
        R = turns_after(0.5 * (rates[1:] + rates[:-1]) * steps_s[:, None])
        C, R_end = self.R_camera_imu, R[-1]
        lasting = np.einsum("n,nij->ij", steps_s, 0.5 * (R[1:] + R[:-1]))
        turn = C @ R_end @ C.T
        by_turn = turn.T - np.eye(3)
        by_bias = -C @ R_end.T @ lasting
        by_late = C @ (at_ends[1] - R_end.T @ at_ends[0])
        return turn, np.column_stack([by_turn, by_bias, by_late])

    def stepped(self, step: Float64) -> Gyro:
        """Return the gyro after a step (7,) of the unknowns."""
        turn = turns_after(step[None, :3])[-1] @ self.R_camera_imu
        return Gyro(self.record, turn, self.bias + step[3:6], self.time_offset_s + float(step[6]))

    def _samples(self, from_s: float, to_s: float) -> tuple[int, int]:
        """Return the samples before and after, as far as there are any."""
        times_s, time_offset_s = self.record.timestamps_s, self.time_offset_s
        first = int(np.searchsorted(times_s, from_s + time_offset_s, side="right")) - 1
        return max(first, 0), int(np.searchsorted(times_s, to_s + time_offset_s, side="left"))

    @cached_property
    def _step_s(self) -> float:
        return float(np.median(np.diff(self.record.timestamps_s)))


def turns_after(vectors: Float64) -> Float64:
    """Return the rotations (N + 1, 3, 3) after none, one, … all of the rotation vectors (N, 3)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    K = hat(vectors)
    # sinc is 1 at 0
    half = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    steps = np.eye(3) + np.sinc(angle / np.pi) * K + half * (K @ K)
    turns = np.empty((len(vectors) + 1, 3, 3))
    turns[0] = np.eye(3)
    for k, step in enumerate(steps):
        np.matmul(turns[k], step, out=turns[k + 1])
    return turns


@dataclass(frozen=True, kw_only=True)
class GuideFigures(Figures):
    """What is known of an inertial unit, and of how a drive moved."""

    bias_rad_per_s: Sequence[float]
    bias_sigma_rad_per_s: float
    noise_deg_per_root_s: float
    acceleration_m_per_s2: float


@dataclass(frozen=True, eq=False)
class ImuGuide:
    """A gyro whose errors are known, and how steadily the camera moves."""

    gyro: Gyro
    covariance: Float64  # (7, 7) of the unknowns of the gyro
    noise: float  # radians per square root of a second
    unsteady: float  # acceleration along an axis, rms, metres per second squared; inf = not known
    step_m: float  # standard deviation of a motion that is seen
    up: Float64 | None = None  # (3,), upwards in the axes of the first frame; None = not known
    scale: float = 1.0  # size of the scene against a road
    arm_m: Float64 = field(default_factory=lambda: np.zeros(3))  # where the unit is, camera axes

    def guide(self, last: Motion, seen: Motion, to_s: float) -> Guided | None:
        """Return the turn since the last frame that was seen, and the same velocity as before."""
        del last
        lasting_s = to_s - seen.timestamp_s
        if not lasting_s > 0 or not self.gyro.knows(seen.timestamp_s, to_s):
            return None
        R, J = self.gyro.turned(seen.timestamp_s, to_s)
        covariance = np.zeros((6, 6))
        covariance[3:, 3:] = J @ self.covariance @ J.T + self.noise**2 * lasting_s * np.eye(3)
        sigma_m = _UNKNOWN_M
        if seen.interval_s > 0:
            # A velocity is the mean since the frame before, and changes meanwhile.
            changed_m = self.unsteady * lasting_s * 0.5 * (lasting_s + seen.interval_s)
            sigma_m = float(np.hypot(changed_m, self.step_m * lasting_s / seen.interval_s))
            sigma_m = min(sigma_m, _UNKNOWN_M)
        covariance[:3, :3] = sigma_m**2 * np.eye(3)
        moved_m = lasting_s * seen.velocity
        return Guided(
            seen.T_world_camera @ make_transform(R, moved_m), covariance, True, self.scale
        )

    def figures(self) -> GuideFigures:
        """Return what is known of the unit and of the motion."""
        return GuideFigures(
            bias_rad_per_s=self.gyro.bias.tolist(),
            bias_sigma_rad_per_s=float(np.sqrt(np.diag(self.covariance)[3:6].max())),
            noise_deg_per_root_s=float(np.rad2deg(self.noise)),
            acceleration_m_per_s2=self.unsteady,
        )


_UNKNOWN_M: Final = 1e3  # how far off a position is that nothing is known of


_G: Final = 9.81  # metres per second squared; on Earth within 0.03
_UP_SPAN_S: Final = 10.0  # how long accelerations are integrated
_LEAST_SPAN_S: Final = 0.3
_PLACE_M: Final = 0.005  # standard deviation of a position, beside what the path adds up
_FORCE: Final = 0.1  # that of the bias of an accelerometer, metres per second squared
_SHAKEN_S: Final = 0.2  # over which forces are averaged: frames are not lost for less
_PARTS: Final = 6  # parts of a drive that are looked at
_MOST_UP_DEG: Final = 2.0  # standard deviation up to which up is known


def find_up(gyro: Gyro, run: ImuSpan, arm_m: Float64) -> tuple[Float64 | None, float]:
    """Return what is up (3,) in the axes of the first pose, and how well that is known, degrees.

    The forces that were measured, turned by the gyro and integrated twice, and gravity, take the
    camera from pose to pose; ``arm_m`` is where the unit is in camera axes. None = it is not known.
    """
    path, begin_s = run.path, float(run.path.timestamps_s[0])
    near = path.timestamps_s <= begin_s + _UP_SPAN_S
    ends_s = path.timestamps_s[near] - begin_s
    short = near.sum() < 4 or ends_s[-1] < _LEAST_SPAN_S
    lost = not np.isfinite(run.sigma_m[: near.sum() - 1]).all()
    if short or lost or not gyro.knows(begin_s, begin_s + ends_s[-1]):
        return None, float("nan")
    times_s, speed = _integrated(gyro, begin_s, float(ends_s[-1]))
    fallen_m = _summed(speed, times_s)
    arms_m = path.T_world_camera[near, :3, :3] @ arm_m
    moved_m = path.positions_m[near] + arms_m - (path.positions_m[0] + arms_m[0])
    by_force = np.stack([np.interp(ends_s, times_s, axis) for axis in fallen_m.T], axis=1)
    # Unknown are the first velocity and gravity.
    A = np.column_stack([ends_s, 0.5 * ends_s**2])[1:]
    place_m = np.sqrt(np.cumsum(run.sigma_m**2))[: len(A)] + _PLACE_M
    weight = 1.0 / np.hypot(place_m, 0.5 * _FORCE * ends_s[1:] ** 2)
    found = np.linalg.lstsq(weight[:, None] * A, weight[:, None] * (moved_m - by_force)[1:])[0]
    covariance = np.linalg.inv((weight[:, None] * A).T @ (weight[:, None] * A))
    gravity, sigma = found[1], float(np.hypot(np.sqrt(covariance[1, 1]), _FORCE))
    sigma_deg = float(np.rad2deg(sigma / _G))
    wrong = abs(float(np.linalg.norm(gravity)) - _G) > MAX_SIGMAS * sigma
    if wrong or sigma_deg > _MOST_UP_DEG:
        return None, sigma_deg
    return -gravity / np.linalg.norm(gravity), sigma_deg


def up_of_drive(
    guide: ImuGuide, path: Trajectory, sigma_m: Float64
) -> tuple[Float64 | None, float]:
    """Return what is up (3,) in the axes of a path, all along it, and how well, degrees.

    ``sigma_m`` (N - 1,) are standard deviations of its steps. Of accelerations nothing is left on
    average; what the accelerometer is off stays. None = it is not known anywhere.
    """
    times_s, T, ups = path.timestamps_s, path.T_world_camera, []
    starts_s = np.arange(times_s[0], times_s[-1], _UP_SPAN_S)
    for first in np.unique(np.searchsorted(times_s, starts_s)).tolist():
        rest = Trajectory(invert(T[first]) @ T[first:], times_s[first:])
        run = ImuSpan(rest, sigma_m[first:], np.zeros_like(sigma_m[first:]))
        up, _ = find_up(guide.gyro, run, guide.arm_m)
        if up is not None:
            ups.append(T[first, :3, :3] @ up)
    if not ups:
        return None, float("nan")
    up = np.mean(ups, axis=0) / np.linalg.norm(np.mean(ups, axis=0))
    spread = np.sqrt(np.mean(1.0 - np.square(np.stack(ups) @ up)) / len(ups))
    return up, float(np.rad2deg(np.hypot(spread, _FORCE / _G)))


def doubt_forces(record: ImuRecord) -> tuple[str, ...]:
    """Return a line for the user if forces show no gravity: in another unit, or not measured."""
    usual = float(np.median(np.linalg.norm(record.accel, axis=1)))
    line = f"IMU: its forces, {usual:.2g} m/s² at the median, show no gravity (are they in g?): "
    return () if 0.5 * _G < usual < 2.0 * _G else (f"{line}its gyro alone is used",)


def accelerations(gyro: Gyro) -> float:
    """Return the acceleration of the camera along an axis, rms over parts of a drive.

    What changes of the forces, beside the turn, is of the motion; what shakes it is averaged out.
    """
    if doubt_forces(gyro.record):
        return float("inf")
    begin_s, end_s = gyro.record.timestamps_s[[0, -1]] - gyro.time_offset_s
    found = []
    for start_s in np.linspace(begin_s, max(begin_s, end_s - _UP_SPAN_S), _PARTS):
        span_s = min(_UP_SPAN_S, float(end_s - start_s))
        if span_s > 2 * _SHAKEN_S and gyro.knows(start_s, start_s + span_s):
            times_s, speed = _integrated(gyro, start_s, span_s)
            at_s = np.arange(0.0, span_s, _SHAKEN_S)
            at = np.stack([np.interp(at_s, times_s, axis) for axis in speed.T], axis=1)
            found.append(np.var(np.diff(at, axis=0) / _SHAKEN_S, axis=0))
    return float(np.sqrt(np.mean(found))) if found else float("inf")


def _integrated(gyro: Gyro, begin_s: float, span_s: float) -> tuple[Float64, Float64]:
    """Return times (N,) since a moment, and the speed (N, 3) that the measured forces give by then.

    In the axes of the camera at that moment; gravity is among the forces.
    """
    times_s = gyro.record.timestamps_s - gyro.time_offset_s - begin_s
    inside = (times_s > 0) & (times_s < span_s)
    at_s = np.concatenate([[0.0], times_s[inside], [span_s]])
    rates, forces = (
        np.stack([np.interp(at_s, times_s, axis) for axis in values.T], axis=1)
        for values in (gyro.record.gyro - gyro.bias, gyro.record.accel)
    )
    R = turns_after(0.5 * (rates[1:] + rates[:-1]) * np.diff(at_s)[:, None])
    return at_s, _summed(np.einsum("nij,nj->ni", R, forces) @ gyro.R_camera_imu.T, at_s)


def _summed(values: Float64, times_s: Float64) -> Float64:
    """Return the integral (N, 3) of values at some times."""
    summed = np.zeros_like(values)
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(times_s)[:, None]
    summed[1:] = np.cumsum(steps, axis=0)
    return summed


_FIRST_FRAMES: Final = 24  # frames from the first on, by which up is found
_SEEN_PARTS: Final = 4  # more parts, up to the end of the drive
_FRAMES: Final = 12  # frames of each


@dataclass(frozen=True, eq=False)
class ImuSpan:
    """Poses of consecutive frames whose motions are trusted, and how well these are known."""

    path: Trajectory
    sigma_m: Float64  # (N - 1,), of each motion
    sigma_rad: Float64  # (N - 1,)


def seen_runs(source: StereoSource, reconstructor: FrameReconstructor) -> list[ImuSpan]:
    """Return runs from all over a drive, in order."""

    def seen(part: tuple[int, int]) -> list[ImuSpan]:
        odometry, runs = VisualOdometry(), [list[tuple[float, OdometryResult]]()]
        for pair in islice(source.frames(part[0]), part[1]):
            frame = OdometryFrame(*reconstructor.match_roughly(pair))
            found = odometry.register(frame)
            if found.health.begins or not found.health.ok:
                runs.append([])
            if found.health.ok:
                runs[-1].append((frame.pair.timestamp_s, found))
        return [_run(run) for run in runs if len(run) > 1]

    rest = np.linspace(
        _FIRST_FRAMES, max(_FIRST_FRAMES, len(source) - _FRAMES), _SEEN_PARTS
    ).astype(int)
    parts = [(0, _FIRST_FRAMES), *((int(start), _FRAMES) for start in np.unique(rest))]
    with serial_algebra():
        return [run for runs in side_by_side(seen, parts, threads=FEW) for run in runs]


def _run(found: list[tuple[float, OdometryResult]]) -> ImuSpan:
    path = Trajectory(
        np.stack([result.T_world_camera for _, result in found]), np.array([t for t, _ in found])
    )
    sigmas = np.array([(r.health.sigma_m, np.deg2rad(r.health.sigma_deg)) for _, r in found[1:]])
    return ImuSpan(path, *sigmas.T)
