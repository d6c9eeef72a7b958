"""Features that two pictures share, to a fraction of a pixel, whatever lies between the cameras."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.rectification.inspect import PairFeatures
from recon.structures.arrays import Float32, UInt8

_RATIO: Final = 0.75
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
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    back = {m.queryIdx: m.trainIdx for m in matcher.match(right_d, left_d)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in matcher.knnMatch(left_d, right_d, k=2)
        if best.distance < _RATIO * second.distance and back.get(best.trainIdx) == best.queryIdx
    ]
    at = np.array(pairs, dtype=np.int64).reshape(-1, 2)
    both = np.hstack([left_uv[at[:, 0]], right_uv[at[:, 1]]])
    # SIFT gives a place with two directions twice.
    unique = np.unique(both, axis=0)
    return PairFeatures(np.array(unique[:, :2]), np.array(unique[:, 2:]))


def _describe(sift: cv2.SIFT, image: UInt8) -> tuple[Float32, Float32]:
    keypoints, descriptors = sift.detectAndCompute(image, None)
    uv = np.array([point.pt for point in keypoints], dtype=np.float32).reshape(-1, 2)
    return uv, np.zeros((0, 128), np.float32) if descriptors is None else descriptors
