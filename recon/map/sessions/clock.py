"""By how much the clock of measured positions is off beside that of the images of a drive.

A clock that is late shows where a drive changes its speed or bends. But drift looks much the same:
a path that comes out too long is off by more the farther it came, as it is by a late clock while
the drive speeds up. So drift is estimated with it, by how large it may be; what only drift or clock
together explain tells nothing of either, and makes the clock less certain.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import chi2, norm, t

from recon.core.geometry.alignment import fit_upright
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.places.places import SHARE, SIGMAS, TURN_DEG

_LARGEST_S: Final = 5.0  # clocks that differ by more are of another recording, or time zone
_STEP_S: Final = 0.25
_MOST_TRIED: Final = 20_000
_KEPT: Final = 0.75  # fraction of the positions that a fit is judged by: others may jump
_OF_KEPT: Final = float(chi2.cdf(chi2.ppf(_KEPT, 3), 5) / _KEPT)
"""Variance of normal errors among those kept, by that of all."""
_ROUNDS: Final = 3
_FEWEST: Final = 8
_NUDGE_S: Final = 0.05
_LEAST_GAIN: Final = 0.7  # of the misfit of all other clocks, for one far away to be believed
LEAST_SIGMA_M: Final = 0.01
"""However smooth positions are, no antenna is known better."""
_BENDS: Final = 12
"""Waves of a heading that drifts at random; those left out bend a path by less than a 500th of what
the longest one does."""
OursAt = Callable[[Float64], Float64]
"""Where the path has the antenna (M, 3), in map axes, at some times (M,)."""


def clock_error(
    path: Trajectory, rows: Float64, ours_at: OursAt, scale: float = 1.0
) -> tuple[float, float]:
    """Return by how many seconds the clock of positions is late, and the standard deviation.

    ``rows`` (N, 7) are times and positions. It is 0 where nothing shows an error: on a straight
    road at one speed, a clock that is off looks like another start.

    First comes the error by which the path fits best, rigidly, all positions but a quarter; then,
    from there, the most probable one if the path has drifted as well, and its standard deviation.

    Clocks that have no time in common, such as one since 1970 and one since the first image, are
    tried in all ways in which half of the drive was measured; one must fit better than all others.
    """
    first_s, last_s = path.timestamps_s[[0, -1]]
    times_s, there_m = rows[:, 0], rows[:, 1:4]
    apart = times_s[-1] < first_s or times_s[0] > last_s
    reach_s = min(_LARGEST_S, (last_s - first_s) / 4.0)
    tried_s = reach_s * np.linspace(-1.0, 1.0, 2 * round(reach_s / _STEP_S) + 1)
    if apart:
        low_s = min(times_s[0] - first_s, times_s[-1] - last_s) - (last_s - first_s) / 2.0
        high_s = max(times_s[0] - first_s, times_s[-1] - last_s) + (last_s - first_s) / 2.0
        if high_s - low_s > _STEP_S * _MOST_TRIED:
            return 0.0, 0.0
        tried_s = np.arange(low_s, high_s, _STEP_S)

    def during(time_offset_s: float) -> Bool:
        return np.asarray(
            (times_s - time_offset_s >= first_s) & (times_s - time_offset_s <= last_s)
        )

    most = max(int(during(time_offset_s).sum()) for time_offset_s in tried_s) if len(tried_s) else 0

    def misfit(time_offset_s: float) -> float:
        inner = during(time_offset_s)
        if inner.sum() < max(_FEWEST, most // 2):
            return np.inf
        return _kept_misfit(ours_at(times_s[inner] - time_offset_s), there_m[inner])[0]

    if most < _FEWEST:
        return 0.0, 0.0
    misfits_m = np.array([misfit(time_offset_s) for time_offset_s in tried_s])
    best_s = float(tried_s[np.argmin(misfits_m)])
    if best_s in (tried_s[0], tried_s[-1]):
        return 0.0, 0.0
    # From the best one: of a large number the search would see no small difference.
    found = minimize_scalar(
        lambda more_s: misfit(best_s + more_s), bounds=(-_STEP_S, _STEP_S), method="bounded"
    )
    begin_s = best_s + float(found.x)
    time_offset_s, sigma_s = _beside_drift(begin_s, rows[:, :4], ours_at, during, scale)
    sure = abs(time_offset_s) > SIGMAS * sigma_s
    if apart:
        others_m = misfits_m[np.abs(tried_s - best_s) > 2 * _STEP_S]
        sure &= misfit(time_offset_s) < _LEAST_GAIN * np.min(others_m)
    return (time_offset_s, sigma_s) if sure else (0.0, 0.0)


def _kept_misfit(ours_m: Float64, there_m: Float64) -> tuple[float, Bool]:
    """Return the misfit (RMS) of the positions that fit best, and which they are."""
    kept = np.ones(len(ours_m), np.bool_)
    for _ in range(_ROUNDS):
        T = fit_upright(ours_m[kept], there_m[kept]).T_to_from
        off_m = np.linalg.norm(apply(T, ours_m) - there_m, axis=1)
        kept = off_m <= np.quantile(off_m, _KEPT)
    return float(np.sqrt(np.mean(off_m[kept] ** 2))), kept


def _beside_drift(
    time_offset_s: float,
    rows: Float64,
    ours_at: OursAt,
    during: Callable[[float], Bool],
    scale: float,
) -> tuple[float, float]:
    """Return the clock error near one, and its standard deviation, if the path has drifted, too.

    Generalised least squares: of the errors after a rigid fit, those of clock and drift have known
    variances, and what is left is noise, of which what is alike in a row counts as fewer.
    ``during`` says which positions (N,) were measured along the path, by the clock error.
    """
    sigma_s = math.inf
    for _ in range(_ROUNDS):
        inner = during(time_offset_s)
        if inner.sum() < _FEWEST:
            return 0.0, math.inf
        times_s, there_m = rows[inner, 0], rows[inner, 1:]
        ours_m = ours_at(times_s - time_offset_s)
        kept = _kept_misfit(ours_m, there_m)[1]
        T = fit_upright(ours_m[kept], there_m[kept]).T_to_from
        nudges = (times_s[kept] - time_offset_s + nudge_s for nudge_s in (-_NUDGE_S, _NUDGE_S))
        behind_m, ahead_m = (apply(T, ours_at(nudged_s)) for nudged_s in nudges)
        placed_m = apply(T, ours_m[kept])
        drift = _drift(placed_m, scale)
        clock = (ahead_m - behind_m) / (2.0 * _NUDGE_S)
        parts = np.concatenate([clock[None], drift, (placed_m - there_m[kept])[None]])
        *columns, off = _not_rigid(parts, placed_m)
        A, noise, alike = np.stack(columns, axis=1), float(np.mean(off**2)), 0.0
        for _ in range(_ROUNDS):
            known = np.diag([noise / _LARGEST_S**2, *[noise] * len(drift)])
            inverse = np.linalg.inv(A.T @ A + known)
            values = inverse @ (A.T @ off)
            left = (off - A @ values).reshape(-1, 3)
            alike = float(np.sum(left[1:] * left[:-1]) / max(np.sum(left**2), 1e-12))
            alike = min(max(alike, 0.0), 0.99)
            freedom = max(1.0, left.size - 4 - np.trace(inverse @ A.T @ A))
            noise = float(np.sum(left**2)) / freedom / _OF_KEPT * (1.0 + alike) / (1.0 - alike)
            noise = max(noise, LEAST_SIGMA_M**2)
        time_offset_s += float(values[0])
        # Of few positions, noise is hardly known.
        few = t.isf(norm.sf(SIGMAS), freedom * (1.0 - alike) / (1.0 + alike)) / SIGMAS
        sigma_s = float(few * math.sqrt(noise * inverse[0, 0]))
    return time_offset_s, sigma_s


def _not_rigid(moves_m: Float64, places_m: Float64) -> Float64:
    """Return what of moves (K, N, 3) of places (N, 3) no upright rigid motion of all is (K, 3N)."""
    about_m = places_m - places_m.mean(axis=0)
    turned = np.column_stack([-about_m[:, 1], about_m[:, 0], np.zeros(len(about_m))])
    shifts = np.tile(np.eye(3)[:, None], (1, len(about_m), 1))
    rigid = np.linalg.qr(np.concatenate([shifts, turned[None]]).reshape(4, -1).T)[0]
    flat = moves_m.reshape(len(moves_m), -1)
    return np.asarray(flat - flat @ rigid @ rigid.T)


def _drift(placed_m: Float64, scale: float) -> Float64:
    """Return by how much a path (N, 3) may drift, float64 (modes, N, 3), each a sigma.

    Its length errs as a whole, its heading at random (`recon.places.places.drift_over`), as a sum
    of the waves of Karhunen and Loève.
    """
    steps_m = np.diff(placed_m, axis=0, prepend=placed_m[:1])
    so_far = np.cumsum(np.linalg.norm(steps_m, axis=1))
    length_m = max(float(so_far[-1]), 1e-9)
    aside_m = np.stack([-steps_m[:, 1], steps_m[:, 0], 0.0 * steps_m[:, 0]], axis=1)
    modes = [SHARE * (placed_m - placed_m[0])]
    for wave in math.pi * (np.arange(_BENDS) + 0.5):
        turn_rad = math.sqrt(2.0 * length_m / scale) / wave * np.sin(wave * so_far / length_m)
        modes.append(np.cumsum(math.radians(TURN_DEG) * turn_rad[:, None] * aside_m, axis=0))
    return np.stack(modes)
