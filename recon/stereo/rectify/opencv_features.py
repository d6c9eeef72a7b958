"""Feature matching between two images: mutual, distinctive matches of ORB or SIFT.

An adapter because two stages need it: rectification to inspect pairs, odometry to relocalise.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.values.arrays import Float32, UInt8

_RATIO: Final = 0.8
"""Lowe's ratio test: the best distance must be below this share of the second best."""

_ROUGH_PX: Final = 3.0
"""Features of coarse pyramid levels are a few pixels off; larger shifts are wrong matches."""


def match_features(
    first: UInt8, second: UInt8, count: int, *, any_scale: bool = False
) -> tuple[Float32, Float32]:
    """Match features between two images: mutual best matches that pass the ratio test.

    Args:
        first: uint8 (H, W).
        second: uint8 (H, W).
        count: Maximum number of features per image.
        any_scale: Whether the scale may differ much between the images: uses SIFT, which takes
            ten times as long as ORB.

    Returns:
        float32 (N, 2) and (N, 2), columns and rows in the first and in the second image, the
        second with subpixel accuracy.

    Ref:
        Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011;
        Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """
    detector: cv2.Feature2D = (
        cv2.SIFT.create(nfeatures=count, contrastThreshold=0.02)
        if any_scale
        else cv2.ORB.create(nfeatures=count, fastThreshold=10)
    )
    (uv, bits), (other_uv, other_bits) = (_describe(detector, side) for side in (first, second))
    if len(uv) < 2 or len(other_uv) < 2:
        return np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32)
    matcher = cv2.BFMatcher(detector.defaultNorm())
    there = _distinct(matcher.knnMatch(bits, other_bits, k=2))
    back = _distinct(matcher.knnMatch(other_bits, bits, k=2))
    mutual = [(i, j) for i, j in there.items() if back.get(j) == i]
    at = np.array(mutual, dtype=np.int64).reshape(-1, 2)
    matched = uv[at[:, 0]], other_uv[at[:, 1]]
    # Tracking cannot refine a patch that changed its scale; SIFT is accurate enough.
    return matched if any_scale else _refined(first, second, *matched)


def exposed_as(model: UInt8, image: UInt8) -> UInt8:
    """Return an image with the brightness and contrast of another, since tracking needs them equal.

    Args:
        model: uint8 (H, W), reference for mean and standard deviation.
        image: uint8 (H, W).
    """
    gain = float(model.std()) / max(float(image.std()), 1.0)
    shift = float(model.mean()) - gain * float(image.mean())
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=shift), dtype=np.uint8)


def _describe(detector: cv2.Feature2D, image: UInt8) -> tuple[Float32, NDArray[Any]]:
    """Return positions (N, 2) and descriptors (N, C) of the features of an image."""
    keypoints, bits = detector.detectAndCompute(image, None)
    uv = np.array([point.pt for point in keypoints], dtype=np.float32).reshape(-1, 2)
    return uv, np.zeros((0, 1), np.uint8) if bits is None else np.asarray(bits)


def _distinct(candidates: Sequence[Sequence[cv2.DMatch]]) -> dict[int, int]:
    """Return best matches that pass the ratio test."""
    return {
        best.queryIdx: best.trainIdx
        for best, second in candidates
        if best.distance < _RATIO * second.distance
    }


def _refined(
    first: UInt8, second: UInt8, uv: Float32, other_uv: Float32
) -> tuple[Float32, Float32]:
    """Matches with subpixel positions in the second image; those that move too far are dropped."""
    if not len(uv):
        return uv, other_uv
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        exposed_as(first, second),
        uv[:, None],
        other_uv[:, None].copy(),
        winSize=(15, 15),
        maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    there = there.reshape(-1, 2)
    kept = (status.ravel() > 0) & (np.abs(there - other_uv).max(axis=1) <= _ROUGH_PX)
    return uv[kept], there[kept].astype(np.float32)
