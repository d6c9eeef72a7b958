"""Which lens model suits the views of a board."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import get_args

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.values.arrays import Float64
from recon.rig.calibrate.bundle import solve_scaled, squared_errors
from recon.rig.calibrate.stereo import Size, StereoFit, calibrate_stereo, expected_ratio
from recon.rig.settings import CalibrationSettings, LensKind


def _held_out(fit: StereoFit) -> Float64:
    """Return float64 (V,), mean squared error of each view if the rig is fitted to the others, px².

    A lens with too many coefficients fits the views well, and those that it has not seen worse.
    """
    info, (sums, counts) = fit.information, squared_errors(fit.views, fit.state)
    whole, errors = info.prior + info.matrices.sum(axis=0), sums.sum(axis=1)
    for number, (M, v) in enumerate(zip(info.matrices, info.vectors, strict=True)):
        step = solve_scaled(whole - M, v)  # back, from the solution to that without the view
        errors[number] += 2 * v @ step + step @ M @ step
    return np.asarray(errors / counts.sum(axis=1))


@dataclass(frozen=True)
class LensChoice:
    """How well a lens model suits the views of a rig."""

    held_out_px: float  # rms error of views that are left out of the fit
    coefficients: int  # of both cameras
    working_ratio: float  # expected depth error at the working distance, relative to it
    suits: bool  # whether no other model fits views that are left out better, beyond chance


def compare_lenses(
    fit: StereoFit, size: Size, settings: CalibrationSettings
) -> dict[str, LensChoice]:
    """Compare all lens models on the views of ``fit``, which has that of the settings.

    A model is left out if it does not fit all of these views.
    """
    fits, errors = {}, {}
    for model in get_args(LensKind):
        with suppress(CalibrationError):
            own = settings.model_copy(update={"model": model})
            other = fit if model == settings.model else calibrate_stereo(fit.views, size, own)
            if len(other.views) == len(fit.views):
                fits[model], errors[model] = other, _held_out(other)
    if not fits:
        return {}
    least = errors[min(errors, key=lambda model: float(errors[model].mean()))]
    found = {}
    for model, other in fits.items():
        worse = errors[model] - least
        found[model] = LensChoice(
            held_out_px=math.sqrt(float(errors[model].mean())),
            coefficients=sum(camera.distortion.size for camera in other.state.cameras),
            working_ratio=expected_ratio(other, settings),
            # One standard error of the mean of the difference.
            suits=bool(worse.mean() <= worse.std() / math.sqrt(len(worse))),
        )
    return found
