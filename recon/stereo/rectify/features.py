"""Subpixel feature matches between two images, for any geometry of the cameras."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.geometry.projection import map_pixels
from recon.core.values.arrays import Float32, Float64, Int32, UInt8
from recon.stereo.rectify.inspect import PairFeatures

_RATIO: Final = 0.75
_BLOCK: Final = 1024  # descriptors compared with all others at once
# Row error that the initial homographies may leave.
_ROWS_APART: Final = 12.0
_CONTRAST: Final = 0.02  # half of OpenCV's default: weak features are still located accurately


MOST_FEATURES: Final = 8000
"""Maximum number of features per image, where a caller does not say."""


def match_exactly(left: UInt8, right: UInt8, count: int = MOST_FEATURES) -> PairFeatures:
    """Return mutual best matches of SIFT features that pass the ratio test.

    Slower than `match_features`, but subpixel accurate and robust to rotation, scale and slant
    between the images.

    Args:
        left: uint8 (H, W).
        right: uint8 (H, W).
        count: Maximum number of features per image.

    Ref:
        Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=_CONTRAST)
    (left_uv, left_d), (right_uv, right_d) = (_describe(sift, side) for side in (left, right))
    if min(len(left_uv), len(right_uv)) < 2:
        return PairFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
    at = _mutual_best(left_d, right_d)
    both = np.hstack([left_uv[at[:, 0]], right_uv[at[:, 1]]])
    # SIFT returns a keypoint with two orientations twice.
    unique = np.unique(both, axis=0)
    return PairFeatures(np.array(unique[:, :2]), np.array(unique[:, 2:]))


def match_again(
    left: UInt8, right: UInt8, H_left: Float64, H_right: Float64, count: int = MOST_FEATURES
) -> PairFeatures:
    """Match images that homographies roughly align, for more and better matches.

    Args:
        left: uint8 (H, W), raw.
        right: uint8 (H, W), raw.
        H_left: float64 (3, 3), from raw pixels to pixels with roughly aligned rows.
        H_right: The same for the right image.
        count: Maximum number of features per image.

    Returns:
        Matches with nearly equal rows after alignment, in raw pixels.
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
    """Return int32 (N, 2), pairs that are each other's best match and pass the ratio test."""
    # SIFT descriptors are whole numbers: float32 sums of products are exact in any order.
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
