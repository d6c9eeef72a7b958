"""Features that two pictures share, to a fraction of a pixel, whatever lies between the cameras."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.rectification.inspect import PairFeatures
from recon.rectification.shaping import map_pixels
from recon.structures.arrays import Float32, Float64, Int32, UInt8

_RATIO: Final = 0.75
_BLOCK: Final = 1024  # descriptors that are compared with all others at once
# Rows that a first guess may be off by.
_ROWS_APART: Final = 12.0
_CONTRAST: Final = 0.02  # half of OpenCV's: weak features still tell where they are


def match_exactly(left: UInt8, right: UInt8, count: int = 8000) -> PairFeatures:
    """Mutual best matches of SIFT features that stand out.

    Slower than `match_features`, but its places are exact and pictures may be turned, scaled and
    slanted against each other.

    Args:
        left: uint8 (H, W).
        right: uint8 (H, W).
        count: Features per picture at most.

    Ref:
        Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=_CONTRAST)
    (left_uv, left_d), (right_uv, right_d) = (_describe(sift, side) for side in (left, right))
    if min(len(left_uv), len(right_uv)) < 2:
        return PairFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
    at = _mutual_best(left_d, right_d)
    both = np.hstack([left_uv[at[:, 0]], right_uv[at[:, 1]]])
    # SIFT gives a place with two directions twice.
    unique = np.unique(both, axis=0)
    return PairFeatures(np.array(unique[:, :2]), np.array(unique[:, 2:]))


def match_again(
    left: UInt8, right: UInt8, H_left: Float64, H_right: Float64, count: int = 8000
) -> PairFeatures:
    """Match pictures that homographies have made alike already, for more and better matches.

    Args:
        left: uint8 (H, W), as recorded.
        right: uint8 (H, W), as recorded.
        H_left: float64 (3, 3), from recorded pixels to ones whose rows about correspond.
        H_right: The same of the right picture.
        count: Features per picture at most.

    Returns:
        Matches within some rows of each other, in recorded pixels.
    """
    size = (left.shape[1], left.shape[0])
    views = [
        np.asarray(cv2.warpPerspective(image, H, size, flags=cv2.INTER_CUBIC))
        for image, H in ((left, H_left), (right, H_right))
    ]
    found = match_exactly(views[0], views[1], count)
    near = np.abs(found.left_uv[:, 1] - found.right_uv[:, 1]) < _ROWS_APART
    back = [
        map_pixels(np.asarray(np.linalg.inv(H)), uv[near]).astype(np.float32)
        for H, uv in ((H_left, found.left_uv), (H_right, found.right_uv))
    ]
    return PairFeatures(back[0], back[1])


def _mutual_best(left: Float32, right: Float32) -> Int32:
    """int32 (N, 2), pairs that are each other's best and better than the second best by far."""
    # SIFT's numbers are whole: products of them are exact, whatever the order of a sum.
    right_sizes = (right**2).sum(axis=1)
    best, second_best = np.empty(len(left), np.int32), np.empty(len(left), np.float32)
    least = np.empty(len(left), np.float32)
    back, back_least = np.zeros(len(right), np.int32), np.full(len(right), np.inf, np.float32)
    for begin in range(0, len(left), _BLOCK):
        part = left[begin : begin + _BLOCK]
        rows = np.arange(len(part))
        squares = (part**2).sum(axis=1)[:, None] + right_sizes - 2 * (part @ right.T)
        nearest = squares.argmin(axis=0)
        closer = squares.min(axis=0) < back_least
        back[closer] = begin + nearest[closer]
        back_least[closer] = squares.min(axis=0)[closer]
        first = squares.argmin(axis=1)
        best[begin : begin + _BLOCK] = first
        least[begin : begin + _BLOCK] = squares[rows, first]
        squares[rows, first] = np.inf
        second_best[begin : begin + _BLOCK] = squares.min(axis=1)
    chosen = (least < _RATIO**2 * second_best) & (back[best] == np.arange(len(left)))
    return np.stack([np.flatnonzero(chosen).astype(np.int32), best[chosen]], axis=1)


def _describe(sift: cv2.SIFT, image: UInt8) -> tuple[Float32, Float32]:
    keypoints, descriptors = sift.detectAndCompute(image, None)
    uv = np.array([point.pt for point in keypoints], dtype=np.float32).reshape(-1, 2)
    return uv, np.zeros((0, 128), np.float32) if descriptors is None else descriptors
