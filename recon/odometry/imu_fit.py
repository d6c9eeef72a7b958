"""How an inertial unit lies to the camera, and how far it is off, by what the cameras see.

Turns between frames, as features see them, are compared with those that the gyro measured: at
which delay they fit, after which rotation, with which bias.

Ref: Kelly and Sukhatme, "A general framework for temporal calibration of multiple proprioceptive
and exteroceptive sensors", ISER 2010.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from recon.core.geometry.se3 import angle_rad, distance_in_sigmas, log_so3
from recon.core.summary import Figures, inline, named
from recon.core.text import counted
from recon.core.values import ImuRecord
from recon.core.values.arrays import Float64
from recon.odometry.guide import MAX_SIGMAS
from recon.odometry.imu import (
    GuideFigures,
    Gyro,
    ImuGuide,
    ImuSpan,
    accelerations,
    doubt_forces,
    find_up,
    turns_after,
)

_LAGS_S: Final = np.linspace(-0.5, 0.5, 101)  # delays that are tried first
_ROUNDS: Final = 15  # steps of the fit
_DONE: Final = 1e-7  # size of a step that is the last
LEAST_TURNS: Final = 8  # fewer say too little of seven unknowns
_DOUBTED: Final = 3.0  # standard deviations at which a turn counts half
_MEDIAN: Final = 1.538  # median length of an error in space, in standard deviations along an axis
NOISE: Final = 2e-3  # rad per square root of a second, to begin with
_BIAS: Final = 0.1  # rad/s, standard deviation of a bias before anything is seen
_TURN: Final = float(np.deg2rad(1.0))
_TIME_OFFSET_S: Final = 5e-3
"""Standard deviations of axes and stamps as they are stated, since boards bend and exposures last;
also those up to which what is found may take their place."""
STATED: Final = np.array([_TURN] * 3 + [_BIAS] * 3 + [_TIME_OFFSET_S])
_MIRRORED: Final = "its axes are left-handed"
_IN_DEGREES: Final = "its rates are in degrees per second"
_CONTRADICTED: Final = 2.0  # how much better a faulty file explains turns than a right one would
_UNEXPLAINED: Final = (
    0.3  # fraction of the turns (rms) that may be left where a gyro is that of a rig
)


@dataclass(frozen=True, kw_only=True)
class ImuFit(Figures):
    """What a drive shows of its inertial unit, beside what files state."""

    origin: str = named("from")
    time_offset_ms: float
    time_offset_sigma_ms: float
    axes_off_deg: float | None
    axes_sigma_deg: float
    guide: GuideFigures = inline()
    up_sigma_deg: float  # standard deviation of the vertical; NaN = not found


@dataclass(frozen=True)
class ImuFigures(Figures):
    """Whether an inertial unit was used, and what the drive shows of it."""

    used: bool
    found: ImuFit | None = inline(None)


@dataclass(frozen=True, eq=False)
class FittedImu:
    """What the drive shows of its inertial unit."""

    guide: ImuGuide | None  # None = it cannot be used
    lines: tuple[str, ...] = ()  # what the user should know of it
    found: ImuFit | None = None  # None = nothing was fitted

    def figures(self) -> ImuFigures:
        return ImuFigures(self.guide is not None, self.found)


def fit_imu(
    record: ImuRecord,
    stamps_s: Float64,
    see: Callable[[], Sequence[ImuSpan]],
    T_stated: Float64 | None,
) -> FittedImu:
    """Return the guide that an inertial unit is, corrected where the drive shows how.

    Args:
        record: What it measured.
        stamps_s: Times (N,) of the frames of the drive.
        see: Gives what cameras see of the motion in some parts of it.
        T_stated: From its axes to those of the rectified left camera (4, 4), as files say; None =
            they do not.
    """
    motions, gaps = _coverage(record, stamps_s)
    notes = (*record.notes, *gaps, *doubt_forces(record))
    if not motions:
        return FittedImu(None, notes)
    runs = see()
    turns = _turns_of(runs, record)
    if len(turns) < LEAST_TURNS:
        seen = f"{len(turns)} of at least {LEAST_TURNS} motions"
        return _unused("the cameras see too little to know its bias by", seen, notes)
    free = _free_fit(record, turns, T_stated)
    turned = float(np.sqrt(np.mean([angle_rad(turn.R) ** 2 for turn in turns])))
    sigma = float(np.median([turn.sigma for turn in turns]))
    if free.misfit > max(_UNEXPLAINED * turned, MAX_SIGMAS * sigma):
        left = f"{np.rad2deg(free.misfit):.2g}° of turns of {np.rad2deg(turned):.2g}° are left"
        return _unused("it does not turn as the cameras do, at any delay, in any axes", left, notes)
    faults = _faults(free, T_stated)
    if (faults or T_stated is None) and not free.certain:
        why = faults[0] if faults else "nothing states its axes"
        known = f"known to {free.sigma_deg:.1f}° and {free.sigma_ms:.0f} ms"
        return _unused(why, known, notes)
    fit = free
    if not faults and T_stated is not None:
        stated = replace(free.gyro, R_camera_imu=T_stated[:3, :3], time_offset_s=0.0)
        fit = _fitted(stated, turns, stated)
    begins = runs[0].path.timestamps_s[0] == stamps_s[0]
    arm_m = np.zeros(3) if T_stated is None else T_stated[:3, 3]
    up, up_deg = find_up(fit.gyro, runs[0], arm_m) if begins else (None, float("nan"))
    step_m = float(np.median(np.concatenate([run.sigma_m for run in runs])))
    unsteady = accelerations(fit.gyro)
    guide = ImuGuide(fit.gyro, fit.covariance, fit.noise, unsteady, step_m, up, arm_m=arm_m)
    lines = (*notes, *(f"IMU: {fault}; used as found" for fault in faults))
    found = ImuFit(
        origin=record.origin,
        time_offset_ms=1e3 * free.gyro.time_offset_s,
        time_offset_sigma_ms=free.sigma_ms,
        axes_off_deg=None if T_stated is None else free.axes_off_deg(T_stated),
        axes_sigma_deg=free.sigma_deg,
        guide=guide.figures(),
        up_sigma_deg=up_deg,
    )
    return FittedImu(guide, lines, found)


def _unused(why: str, got: str, notes: tuple[str, ...]) -> FittedImu:
    return FittedImu(None, (*notes, f"IMU not used: {why} ({got})"))


def _coverage(record: ImuRecord, stamps_s: Float64) -> tuple[int, tuple[str, ...]]:
    """Return how many motions between frames a record covers, and what the user should know."""
    gyro, times_s = Gyro(record, np.eye(3), np.zeros(3)), stamps_s.tolist()
    known = [gyro.knows(*ends) for ends in pairwise(times_s)]
    if all(known):
        return len(known), ()
    spans = [f"{t[0]:.3f} to {t[-1]:.3f} s" for t in (record.timestamps_s, stamps_s)]
    if not any(known):
        what = f"IMU not used: it measured from {spans[0]}, the frames are from {spans[1]}"
        return 0, (f"{what}; both must use the same clock",)
    gap_s = float(np.diff(record.timestamps_s).max())
    motions = f"{known.count(False)} of {counted(len(known), 'motion')} between frames"
    note = f"IMU: {motions} are not covered (it measured from {spans[0]}, the longest gap is "
    return known.count(True), (f"{note}{gap_s:.2g} s)",)


@dataclass(frozen=True, eq=False)
class _Turn:
    """How the camera turned between two frames, as features see it."""

    from_s: float
    to_s: float
    R: Float64  # (3, 3)
    sigma: float  # rad


@dataclass(frozen=True, eq=False)
class _Fit:
    """A gyro that fits turns."""

    gyro: Gyro
    covariance: Float64  # (7, 7)
    noise: float  # rad per square root of a second
    misfit: float  # median of what is left of the turns, rad
    fault: str = ""  # how its record differs from what was read, in words

    @property
    def sigma_deg(self) -> float:
        """Standard deviation of the axes, in the worst direction."""
        return float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1])))

    @property
    def sigma_ms(self) -> float:
        """That of the delay."""
        return float(1e3 * np.sqrt(self.covariance[6, 6]))

    @property
    def certain(self) -> bool:
        """Whether what was found may take the place of what is stated."""
        return np.deg2rad(self.sigma_deg) <= _TURN and self.sigma_ms <= 1e3 * _TIME_OFFSET_S

    def axes_off_deg(self, T_stated: Float64) -> float:
        return float(np.rad2deg(angle_rad(self.gyro.R_camera_imu @ T_stated[:3, :3].T)))


def _faults(fit: _Fit, T_stated: Float64 | None) -> list[str]:
    """Return what contradicts the files, in words."""
    gyro, P, lines = fit.gyro, fit.covariance, list[str]()
    if abs(gyro.time_offset_s) > MAX_SIGMAS * np.hypot(_TIME_OFFSET_S, np.sqrt(P[6, 6])):
        order = "later" if gyro.time_offset_s > 0 else "earlier"
        size = f"{abs(1e3 * gyro.time_offset_s):.0f} ± {1.96 * fit.sigma_ms:.0f} ms"
        lines.append(f"its stamps are {size} {order} than those of the images")
    if fit.fault:
        lines.append(fit.fault)
    if fit.fault != _MIRRORED and T_stated is not None:
        off = log_so3(gyro.R_camera_imu @ T_stated[:3, :3].T)
        if distance_in_sigmas(off, P[:3, :3] + _TURN**2 * np.eye(3)) > MAX_SIGMAS:
            size = f"{fit.axes_off_deg(T_stated):.0f} ± {1.96 * fit.sigma_deg:.1f}°"
            lines.append(f"its axes are turned by {size} from those stated")
    return lines


def _turns_of(runs: Sequence[ImuSpan], record: ImuRecord) -> list[_Turn]:
    """Return the turns of some runs, as far as the record covers them at any delay."""
    gyro, margin_s = Gyro(record, np.eye(3), np.zeros(3)), float(_LAGS_S[-1])
    turns = []
    for run in runs:
        R, times_s = run.path.T_world_camera[:, :3, :3], run.path.timestamps_s.tolist()
        for k, sigma in enumerate(run.sigma_rad.tolist()):
            if gyro.knows(times_s[k] - margin_s, times_s[k + 1] + margin_s):
                turns.append(_Turn(times_s[k], times_s[k + 1], R[k].T @ R[k + 1], sigma))
    return turns


def _free_fit(record: ImuRecord, turns: Sequence[_Turn], T_stated: Float64 | None) -> _Fit:
    """Return the gyro that fits turns best, as the file has it or with one of its usual faults."""
    mirrored = replace(record, gyro=-record.gyro, accel=-record.accel)
    in_degrees = replace(record, gyro=np.deg2rad(record.gyro))
    read = {"": record, _MIRRORED: mirrored, _IN_DEGREES: in_degrees}
    starts = [(fault, _aligned(one, turns)) for fault, one in read.items()]
    if T_stated is not None:
        starts.append(("", Gyro(record, T_stated[:3, :3], np.zeros(3))))
    fits = (replace(_fitted(start, turns), fault=fault) for fault, start in starts)
    return min(fits, key=lambda fit: fit.misfit * (_CONTRADICTED if fit.fault else 1.0))


def _aligned(record: ImuRecord, turns: Sequence[_Turn]) -> Gyro:
    """Return the gyro whose mean rates of turn fit best, of all delays, axes and biases.

    Ref: Kabsch, "A solution for the best rotation to relate two sets of vectors", 1976.
    """
    lasting = np.array([turn.to_s - turn.from_s for turn in turns])
    seen = np.stack([log_so3(turn.R) for turn in turns]) / lasting[:, None]
    measured = np.stack([_at_offsets(record, turn) for turn in turns]) / lasting[:, None, None]
    sigma = np.hypot([turn.sigma for turn in turns], NOISE * np.sqrt(lasting)) / lasting
    weight = 1.0 / (sigma**2 + (0.1 * _BIAS) ** 2)
    weight /= weight.sum()
    mean_seen, means = weight @ seen, np.einsum("n,nlk->lk", weight, measured)
    seen, measured = seen - mean_seen, measured - means
    U, strength, Vt = np.linalg.svd(np.einsum("n,ni,nlj->lij", weight, seen, measured))
    strength[:, 2] *= np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    left = np.einsum("n,nlk->l", weight, measured**2) - 2.0 * strength.sum(axis=1)
    best = int(np.argmin(left))
    R = U[best] @ Vt[best]
    return Gyro(record, R, means[best] - R.T @ mean_seen, float(_LAGS_S[best]))


def _at_offsets(record: ImuRecord, turn: _Turn) -> Float64:
    """Return the rotation vectors (L, 3) that a gyro measured at all delays, in its own axes."""
    times_s, margin_s = record.timestamps_s, float(_LAGS_S[-1])
    part = slice(
        int(np.searchsorted(times_s, turn.from_s - margin_s, side="right")) - 1,
        int(np.searchsorted(times_s, turn.to_s + margin_s)) + 1,
    )
    rates, at_s = record.gyro[part], times_s[part]
    R = turns_after(0.5 * (rates[1:] + rates[:-1]) * np.diff(at_s)[:, None])
    # The nearest sample is near enough to begin with.
    ends = [np.searchsorted(at_s, end_s + _LAGS_S) for end_s in (turn.from_s, turn.to_s)]
    turned = np.swapaxes(R[ends[0]], 1, 2) @ R[np.minimum(ends[1], len(R) - 1)]
    return np.stack([log_so3(one) for one in turned])


def _fitted(gyro: Gyro, turns: Sequence[_Turn], stated: Gyro | None = None) -> _Fit:
    """Return the gyro near to one that fits turns, perhaps with what is stated (Gauss-Newton)."""
    noise, information = NOISE, np.diag(1.0 / np.square([*[10.0] * 3, *[_BIAS] * 3, 10.0]))
    if stated is not None:
        information = np.diag(1.0 / STATED**2)
    for _ in range(_ROUNDS):
        H, g = information.copy(), np.zeros(7)
        if stated is not None:
            g = information @ np.concatenate(
                [
                    log_so3(stated.R_camera_imu @ gyro.R_camera_imu.T),
                    -gyro.bias,
                    [-gyro.time_offset_s],
                ]
            )
        left = []
        for turn in turns:
            expected, J = gyro.turned(turn.from_s, turn.to_s)
            off = log_so3(expected.T @ turn.R)
            lasting_s = turn.to_s - turn.from_s
            variance = turn.sigma**2 + noise**2 * lasting_s
            weight = 1.0 / (variance * (1.0 + off @ off / (variance * _DOUBTED**2)))
            H, g = H + weight * J.T @ J, g + weight * J.T @ off
            left.append((float(np.linalg.norm(off)), lasting_s))
        off_rad, lasting = np.array(left).T
        noise = max(float(np.median(off_rad / np.sqrt(lasting))) / _MEDIAN, 1e-5)
        step = np.linalg.solve(H, g)
        if np.abs(step).max() < _DONE:
            break
        gyro = gyro.stepped(step)
    return _Fit(gyro, np.asarray(np.linalg.inv(H)), noise, float(np.median(off_rad)))
