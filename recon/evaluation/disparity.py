"""How far a disparity map is from the truth, counted as Middlebury counts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.errors import EvaluationError
from recon.structures import Disparity, DisparityMetrics, DisparityTruth
from recon.structures.arrays import Bool, Float32

_THRESHOLDS_PX = (0.5, 1.0, 2.0, 4.0)


def evaluate_disparity(
    estimate: Disparity | Float32,
    truth: DisparityTruth,
    thresholds_px: Sequence[float] = _THRESHOLDS_PX,
    *,
    occluded: bool = False,
) -> DisparityMetrics:
    """Compare a disparity map with the truth, over the pixels whose truth is known.

    ``bad[t]`` is the share of all those pixels that have a value off by more than ``t``; pixels
    without a value count as invalid and not as bad, so ``bad + invalid`` is the whole loss.

    Args:
        estimate: A disparity, or its values: float32 (H, W), pixels, NaN = none.
        truth: The truth at the same size.
        thresholds_px: The limits of ``bad``, in pixels of this size.
        occluded: Count the pixels too that only the left camera sees.

    Raises:
        EvaluationError: The sizes differ, or no pixel has a known truth.

    Ref: Scharstein et al., Middlebury Stereo Evaluation SDK 1.6, ``evaldisp``.
    """
    values = estimate.values if isinstance(estimate, Disparity) else estimate
    counted = _counted(values, truth, occluded=occluded)
    with np.errstate(invalid="ignore"):
        error_px = np.abs(values[counted].astype(np.float64) - truth.values[counted])
    known = np.isfinite(error_px)
    error_px, pixels = error_px[known], len(error_px)
    return DisparityMetrics(
        bad={float(t): 100 * float(np.sum(error_px > t)) / pixels for t in thresholds_px},
        invalid=100 * (1 - len(error_px) / pixels),
        avgerr_px=float(np.mean(error_px)) if len(error_px) else float("nan"),
        rms_px=float(np.sqrt(np.mean(error_px**2))) if len(error_px) else float("nan"),
        pixels=pixels,
    )


def _counted(values: Float32, truth: DisparityTruth, *, occluded: bool) -> Bool:
    """bool (H, W), the pixels that are compared."""
    if values.shape != truth.values.shape:
        raise EvaluationError(
            "disparity and truth differ in size",
            got=f"disparity {values.shape}",
            expected=f"{truth.values.shape}",
        )
    counted = np.isfinite(truth.values) & (truth.nonocc | occluded)
    if not counted.any():
        raise EvaluationError("no pixel has a known truth to compare with")
    return np.asarray(counted)
