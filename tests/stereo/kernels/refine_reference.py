"""`recon.stereo.kernels.refine` in plain numpy and float64: the definition of its results."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon.stereo.kernels.minima import NO_COST, Minima
from recon.stereo.kernels.refine import (
    AMBIGUOUS,
    BORDER,
    LEFT_RIGHT,
    LOW_TEXTURE,
    OCCLUDED,
    OUT_OF_RANGE,
    SIGMA_LARGEST_PX,
    VALID,
    WRONG_PX,
    Refined,
    Rules,
)


def refine_minima_reference(minima: Minima, texture: NDArray[np.float32], rules: Rules) -> Refined:
    """Return all rows of `recon.stereo.kernels.refine.refine_minima`."""
    reason = _reasons(minima, texture, rules)
    keep = reason == VALID
    best, before, after, second = minima.costs.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = rules.minimum + minima.winner.astype(np.float64)
        values += _offsets(best, before, after, rules.fit)
        sigma = _sigmas(best, before, after, rules)
        margin = (second - best) / (rules.window_pixels + best)
        odds = rules.odds * np.sqrt(margin / (sigma * sigma * sigma))
        confidence = np.where(second < NO_COST, odds / (odds + 1.0), 0.0)
        if_wrong = np.maximum(sigma, WRONG_PX)
        mixed = np.sqrt(confidence * sigma**2 + (1.0 - confidence) * if_wrong**2)
    return Refined(
        values=np.where(keep, values, np.nan).astype(np.float32),
        confidence=np.where(keep, confidence, 0.0).astype(np.float32),
        sigma_px=np.where(keep, mixed, np.nan).astype(np.float32),
        reason=reason,
    )


def _reasons(minima: Minima, texture: NDArray[np.float32], rules: Rules) -> NDArray[np.uint8]:
    k = minima.winner.astype(np.int64)
    best, before, after, second = minima.costs.astype(np.int64)
    width = k.shape[1]
    right = np.arange(width) - rules.minimum - k
    place = np.clip(right, 0, width - 1)
    other = np.take_along_axis(minima.right_winner.astype(np.int64), place, axis=1)
    differs = (rules.left_right >= 0) & (np.abs(other - k) > rules.left_right)
    inside = (right > 0) & (right < width - 1)
    chosen = _chosen_beside(minima.right_winner, rules)
    ends = np.maximum(before, after) == NO_COST
    close = 100 * second <= best * (100 + rules.uniqueness)
    cases = [
        ((k == rules.ndisp) | np.isnan(texture), BORDER),
        (texture < rules.texture, LOW_TEXTURE),
        (ends & ((k == 0) | (k == rules.ndisp - 1) | inside), OUT_OF_RANGE),
        (ends, BORDER),
        (differs & chosen, LEFT_RIGHT),
        (differs, OCCLUDED),
        ((rules.uniqueness > 0) & close, AMBIGUOUS),
    ]
    conditions, codes = zip(*cases, strict=True)
    return np.asarray(np.select(conditions, codes, VALID), dtype=np.uint8)


def _chosen_beside(right_winner: NDArray[np.uint16], rules: Rules) -> NDArray[np.bool_]:
    height, width = right_winner.shape
    x = np.arange(width) + rules.minimum + right_winner.astype(np.int64)
    chosen = np.zeros((height, width), np.bool_)
    for aside in (-1, 0, 1):
        seen = (right_winner != rules.ndisp) & (x + aside >= 0) & (x + aside < width)
        chosen[np.nonzero(seen)[0], (x + aside)[seen]] = True
    return chosen


def _offsets(
    best: NDArray[Any], before: NDArray[Any], after: NDArray[Any], fit: bool
) -> NDArray[np.float64]:
    slope = np.maximum(before, after) - best
    return np.where(fit & (slope > 0), 0.5 * (before - after) / slope, 0.0)


def _sigmas(
    best: NDArray[Any], before: NDArray[Any], after: NDArray[Any], rules: Rules
) -> NDArray[np.float64]:
    slope = np.maximum(before, after) - best
    vertex = np.maximum(best - 0.5 * np.abs(before - after), 0.0)
    noise = 0.5 * np.pi * vertex / (slope * np.sqrt(rules.window_pixels))
    sigma = np.sqrt(rules.sigma_floor_px**2 + noise * noise)
    return np.where(slope > 0, np.minimum(sigma, SIGMA_LARGEST_PX), SIGMA_LARGEST_PX)
