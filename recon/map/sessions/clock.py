"""By how much the clock of measured positions is off beside that of the images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from scipy.optimize import minimize_scalar

from recon.core.geometry.alignment import fit_upright
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.core.values.arrays import Bool, Float64
from recon.places.places import SIGMAS

_LARGEST_S: Final = 5.0  # clocks that differ by more are of another recording, or time zone
_STEP_S: Final = 0.25
_MOST_TRIED: Final = 20_000
_KEPT: Final = 0.75  # fraction of the positions that a fit is judged by: others may jump
_ROUNDS: Final = 3
_FEWEST: Final = 8
_NUDGE_S: Final = 0.05
_LEAST_GAIN: Final = 0.7  # of the misfit that is left, for a clock to be believed


def clock_error(
    path: Trajectory, rows: Float64, ours_at: Callable[[Float64], Float64]
) -> tuple[float, float]:
    """Return by how many seconds the clock of positions is late, and the standard deviation.

    ``rows`` (N, 7) are times and positions, ``ours_at`` is where the path has the antenna (M, 3)
    at some times. It is 0 where nothing shows an error: on a straight road at one speed, a clock
    that is off looks like another start.

    The error is that by which the path fits best, rigidly, all positions but a quarter. Its
    standard deviation follows from the misfit and from how the path moves in other ways than a
    rigid body does as time goes on; positions in a row are off by the same, and count as fewer.

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
    time_offset_s = best_s + float(found.x)
    inner = during(time_offset_s)
    sigma_s = _sigma(times_s[inner] - time_offset_s, there_m[inner], ours_at)
    others_m = misfits_m[np.abs(tried_s - best_s) > 2 * _STEP_S] if apart else [misfit(0.0)]
    sure = abs(time_offset_s) > SIGMAS * sigma_s and found.fun < _LEAST_GAIN * np.min(others_m)
    return (time_offset_s, sigma_s) if sure else (0.0, 0.0)


def _kept_misfit(ours_m: Float64, there_m: Float64) -> tuple[float, Bool]:
    """Return the misfit (RMS) of the positions that fit best, and which they are."""
    kept = np.ones(len(ours_m), np.bool_)
    for _ in range(_ROUNDS):
        T = fit_upright(ours_m[kept], there_m[kept]).T_to_from
        off_m = np.linalg.norm(apply(T, ours_m) - there_m, axis=1)
        kept = off_m <= np.quantile(off_m, _KEPT)
    return float(np.sqrt(np.mean(off_m[kept] ** 2))), kept


def _sigma(times_s: Float64, there_m: Float64, ours_at: Callable[[Float64], Float64]) -> float:
    ours_m = ours_at(times_s)
    misfit_m, kept = _kept_misfit(ours_m, there_m)
    T = fit_upright(ours_m[kept], there_m[kept]).T_to_from
    off_m = (apply(T, ours_m) - there_m)[kept]
    ahead_m, behind_m = ours_at(times_s + _NUDGE_S)[kept], ours_at(times_s - _NUDGE_S)[kept]
    # What of the motion in time no rigid motion of the whole path is.
    rigid = apply(fit_upright(ahead_m, behind_m).T_to_from, ahead_m) - behind_m
    moves = rigid / (2.0 * _NUDGE_S)
    alike = float(np.sum(off_m[1:] * off_m[:-1]) / max(np.sum(off_m**2), 1e-12))
    alike = min(max(alike, 0.0), 0.99)
    independent = kept.sum() * (1.0 - alike) / (1.0 + alike)
    seen = np.sqrt(np.mean(np.sum(moves**2, axis=1)))
    return float(misfit_m / max(seen, 1e-9) / np.sqrt(max(independent, 1.0)))
