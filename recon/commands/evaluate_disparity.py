"""`recon evaluate disparity`: compare a disparity map with ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import EvaluationError
from recon.core.values import Disparity, DisparityTruth, Reason
from recon.core.values.arrays import Float32
from recon.evaluation.disparity import evaluate_disparity
from recon.evaluation.middlebury.score import curve_figures, dense_map, named_figures
from recon.io.images.disparity import read_disparity, read_pfm
from recon.io.images.image import read_grey_levels
from recon.run.summary import plain

_COUNTED: Final = 255


def run_evaluate_disparity(
    estimate: Path,
    truth: Path,
    mask: Path | None = None,
    *,
    scale: float = 1.0,
    confidence: Path | None = None,
) -> dict[str, Any]:
    """Compare one disparity map file (PFM or 16-bit PNG) with another: `recon evaluate disparity`.

    Args:
        estimate: The map; holes are filled for the dense figures, KITTI's ``d1`` among them.
        truth: Ground truth of the same size.
        mask: An image that is 255 where pixels are compared; None = all with ground truth.
        scale: Pixels of the size that figures are given in per pixel here.
        confidence: PFM of the map's confidence, in [0, 1]; a pixel is correct if its error is at
            most one pixel of the map.
    """
    values, true = read_disparity(estimate), read_disparity(truth)
    counted = np.isfinite(true) if mask is None else read_grey_levels(mask) == _COUNTED
    if counted.shape != true.shape:
        raise EvaluationError(
            "mask and truth differ in size", where=mask, got=counted.shape, expected=true.shape
        )
    known = DisparityTruth(true, counted)
    found = evaluate_disparity(values, known, scale=scale)
    figures: dict[str, Any] = {"pixels": found.pixels, "invalid": found.invalid}
    for name, metrics in (
        ("sparse", found),
        ("dense", evaluate_disparity(dense_map(values), known, scale=scale)),
    ):
        figures[name] = {**named_figures(metrics), "d1": metrics.d1}
    if confidence is not None:
        compared = np.where(counted, true, np.float32(np.nan))
        rated = _rated(values, confidence)
        figures["confidence"] = curve_figures(
            rated, DisparityTruth(compared, np.isfinite(compared)), limit_px=1.0
        )
    return dict(plain(figures))


def _rated(values: Float32, path: Path) -> Disparity:
    """Return a disparity map with the confidence read from a file."""
    confidence = read_pfm(path)
    if confidence.shape != values.shape:
        raise EvaluationError(
            "confidence and map differ in size",
            where=path,
            got=confidence.shape,
            expected=values.shape,
        )
    known = np.isfinite(values)
    if not ((confidence[known] >= 0) & (confidence[known] <= 1)).all():
        raise EvaluationError("confidence is not between 0 and 1", where=path)
    return Disparity(
        values=values,
        confidence=np.where(known, confidence, np.float32(0)),
        sigma_px=np.full(values.shape, np.nan, np.float32),
        reason=np.where(known, np.uint8(Reason.VALID), np.uint8(Reason.AMBIGUOUS)),
    )
