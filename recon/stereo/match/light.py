"""Light that differs between left and right, evened before they are compared.

Gradients grow with light, and are what windows compare. What exposure and curve of a sensor do
depends on the grey level alone, what a vignette does is smooth in the image: where both images,
made small, match, these are fitted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import cv2
import numpy as np

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32, Float64, UInt8
from recon.stereo.match.protocol import Matcher

_LEAST_SIDE_PX: Final = 32  # of smaller images little is known
_BLOCKS: Final = (4, 4)
_ALIKE: Final = 0.1
"""Difference of brightness (logarithm) that half of the blocks need: parallax alone makes half."""
_FAIR: Final = 8, 247  # grey levels between which a ratio says something
_MATCHING: Final = 0.05  # deviation of ratios (logarithm) where pixels match: surfaces shine
_LEAST_MATCHES: Final = 200
_ROUNDS: Final = 4
_RIDGE: Final = 0.01  # weight of no change, of that of all matches
_MOST_CHANGE: Final = 1.5  # logarithm; where nothing matches a fit may lead anywhere
_OF_LEVELS: Final = 2  # terms that depend on the grey level alone
_FIELD_PX: Final = 32  # sides of a field before it is enlarged

Rough = Callable[[RectifiedPair], tuple[RectifiedPair, Float32]]
"""What matches a pair at a small size: that pair, and its trusted disparity (h, w), or NaN."""


class EveningMatcher:
    """Evens the light of pairs for another matcher, by each pair alone."""

    def __init__(self, matcher: Matcher, rough: Rough) -> None:
        self._matcher, self._rough = matcher, rough

    def match(self, pair: RectifiedPair) -> Disparity:
        return self._matcher.match(even(pair, self._rough))


def even(pair: RectifiedPair, rough: Rough) -> RectifiedPair:
    """Return a pair whose right image has the light of the left one; as it is where it has."""
    if min(pair.left.shape) < _LEAST_SIDE_PX:
        return pair
    blocks = [
        cv2.resize(image[::4, ::4], _BLOCKS, interpolation=cv2.INTER_AREA).astype(np.float64)
        for image in (pair.left, pair.right)
    ]
    apart = np.abs(np.log((blocks[0] + 1.0) / (blocks[1] + 1.0)))
    if np.median(apart) < _ALIKE:
        return pair
    small, values = rough(pair)
    found = fit_light(small, values)
    if found is None:
        return pair
    # What is as bright matches better.
    values = rough(replace(small, right=relit(small.right, found)))[1]
    again = fit_light(small, values)
    found = found if again is None else again
    rgb = None if pair.right_rgb is None else relit(pair.right_rgb, found)
    return replace(pair, right=relit(pair.right, found), right_rgb=rgb)


def fit_light(pair: RectifiedPair, values: Float32) -> Float64 | None:
    """Return the weights (7,) of `_terms` of the right image that give log(left / right).

    ``values`` is the disparity, NaN = none; None where too little matches.
    """
    v, u = np.nonzero(np.isfinite(values))
    at = np.clip(np.rint(u - values[v, u]).astype(np.int64), 0, values.shape[1] - 1)
    ours, others = pair.left[v, u].astype(np.float64), pair.right[v, at].astype(np.float64)
    fair = (np.minimum(ours, others) > _FAIR[0]) & (np.maximum(ours, others) < _FAIR[1])
    if fair.sum() < _LEAST_MATCHES:
        return None
    height, width = values.shape
    x, y = 2 * at[fair] / max(width - 1, 1) - 1, 2 * v[fair] / max(height - 1, 1) - 1
    terms = _terms(others[fair], x, y)
    ratio = np.log(ours[fair] / others[fair])
    found, weight = np.zeros(len(terms)), np.ones(len(ratio))
    for _ in range(_ROUNDS):
        normal = (terms * weight) @ terms.T + _RIDGE * weight.sum() * np.eye(len(terms))
        found = np.linalg.solve(normal, (terms * weight) @ ratio)
        # Cauchy's weights: what shines, or is matched wrongly, hardly counts.
        weight = 1 / (1 + ((ratio - found @ terms) / _MATCHING) ** 2)
    return found


def relit(image: UInt8, weights: Float64) -> UInt8:
    """Return an image, (H, W) or (H, W, 3), in the light that `fit_light` found."""
    height, width = image.shape[:2]
    levels, where = np.arange(256.0), np.linspace(-1, 1, _FIELD_PX)
    curve = levels * _factor(weights, _terms(levels, levels, levels), slice(_OF_LEVELS))
    y, x = np.meshgrid(where, where, indexing="ij")
    field = _factor(weights, _terms(x, x, y), slice(_OF_LEVELS, None))
    light = cv2.resize(field, (width, height), interpolation=cv2.INTER_LINEAR)
    lit = cv2.LUT(image, curve.astype(np.float32))
    lit *= light if image.ndim == 2 else light[..., None]
    return np.asarray(cv2.convertScaleAbs(lit))


def _factor(weights: Float64, terms: Float64, some: slice) -> Float32:
    change = np.tensordot(weights[some], terms[some], 1)
    return np.exp(np.clip(change, -_MOST_CHANGE, _MOST_CHANGE)).astype(np.float32)


def _terms(levels: Float64, x: Float64, y: Float64) -> Float64:
    """Return float64 (7, …): exposure, curve, and a field, from -1 to 1."""
    level = np.log(np.maximum(levels, 1.0) / 128.0)
    return np.stack([np.ones_like(x), level, x, y, x * x, x * y, y * y])
