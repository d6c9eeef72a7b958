"""Light that differs between left and right, evened before they are compared.

Gradients grow with light, and are what windows compare. What exposure and curve of a sensor do
depends on the grey level alone, what a vignette does is smooth in the image: where both images,
made small, match, these are fitted, and kept where more matches with them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import match_small

# Difference of brightness (logarithm) that half of the blocks need: parallax alone makes half.
_ALIKE: Final = 0.1
_FAIR: Final = 8, 247  # grey levels between which a ratio says something
_MATCHING: Final = 0.05  # deviation of ratios (logarithm) where pixels match: surfaces shine
_LEAST_MATCHES: Final = 200
_RIDGE: Final = 0.01  # weight of no change, of that of all matches
_MOST_CHANGE: Final = 1.5  # logarithm; where nothing matches a fit may lead anywhere


class EveningMatcher:
    """Evens the light of pairs for another matcher, by each pair alone."""

    def __init__(self, matcher: Matcher) -> None:
        self._matcher = matcher

    def match(self, pair: RectifiedPair) -> Disparity:
        return self._matcher.match(even(pair))


def even(pair: RectifiedPair) -> RectifiedPair:
    """Return a pair whose right image has the light of the left one; as it is where it has."""
    if min(pair.left.shape) < 32:  # of so small ones little is known
        return pair
    sparse = pair.left[::4, ::4], pair.right[::4, ::4]
    few = [cv2.resize(each, (4, 4), interpolation=cv2.INTER_AREA) for each in sparse]
    if np.median(np.abs(np.diff(np.log(np.add(few, 1.0)), axis=0))) < _ALIKE:
        return pair
    small, values = match_small(pair)
    found = fit_light(small, values)
    if found is not None:
        again = match_small(replace(small, right=relit(small.right, found)))[1]
        # What is as bright matches better; of an offset gradients know nothing, and nothing does.
        better = np.isfinite(again).sum() > np.isfinite(values).sum()
        found = fit_light(small, again) if better else None
    if found is None:
        return pair
    rgb = None if pair.right_rgb is None else relit(pair.right_rgb, found)
    return replace(pair, right=relit(pair.right, found), right_rgb=rgb)


def fit_light(pair: RectifiedPair, values: Float32) -> Float64 | None:
    """Return the weights (7,) of `_terms` of the right image that give log(left / right).

    ``values`` is the disparity, NaN = none; None where too little matches.
    """
    v, u = np.nonzero(np.isfinite(values))
    at = np.clip(np.rint(u - values[v, u]).astype(np.int64), 0, values.shape[1] - 1)
    both = np.stack([pair.left[v, u], pair.right[v, at]]).astype(np.float64)
    fair = (both.min(axis=0) > _FAIR[0]) & (both.max(axis=0) < _FAIR[1])
    if fair.sum() < _LEAST_MATCHES:
        return None
    y, x = (2 * each[fair] / size - 1 for each, size in zip((v, at), values.shape, strict=True))
    terms, ratio = _terms(both[1, fair], x, y), np.log(both[0, fair] / both[1, fair])
    found, weight = np.zeros(len(terms)), np.ones(len(ratio))
    for _ in range(4):
        normal = (terms * weight) @ terms.T + _RIDGE * weight.sum() * np.eye(len(terms))
        found = np.linalg.solve(normal, (terms * weight) @ ratio)
        # Cauchy's weights: what shines, or is matched wrongly, hardly counts.
        weight = 1 / (1 + ((ratio - found @ terms) / _MATCHING) ** 2)
    return found


def relit(image: UInt8, weights: Float64) -> UInt8:
    """Return an image, (H, W) or (H, W, 3), in the light that `fit_light` found."""
    levels, where = np.arange(256.0), np.linspace(-1, 1, 32)
    x, y = np.tile(where, 32), np.repeat(where, 32)
    changes = weights[:2] @ _terms(levels, levels, levels)[:2], weights[2:] @ _terms(x, x, y)[2:]
    curve, field = (np.exp(np.clip(one, -_MOST_CHANGE, _MOST_CHANGE)) for one in changes)
    light = cv2.resize(field.reshape(32, 32).astype(np.float32), image.shape[1::-1])
    lit = cv2.LUT(image, (levels * curve).astype(np.float32))
    return np.asarray(cv2.convertScaleAbs(lit * (light if image.ndim == 2 else light[..., None])))


def _terms(levels: Float64, x: Float64, y: Float64) -> Float64:
    """Return float64 (7, N): exposure, curve, and a field, from -1 to 1."""
    level = np.log(np.maximum(levels, 1.0) / 128.0)
    return np.stack([np.ones_like(x), level, x, y, x * x, x * y, y * y])
