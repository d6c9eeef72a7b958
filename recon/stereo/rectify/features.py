"""Features matched between two images, and whether they show a rectified pair.

A stereo matcher searches along one row, in one direction: of swapped or misaligned images it finds
nothing or, worse, wrong matches.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.text import counted
from recon.core.values import RectifiedPair
from recon.core.values.arrays import Bool, Float32, Float64, Int32, UInt8, freeze

_RATIO: Final = 0.8  # Lowe's test: the best distance is below this fraction of the second best
_EXACT_RATIO: Final = 0.75
_CONTRAST: Final = 0.02  # half of OpenCV's default: weak features are still located accurately
_BLOCK: Final = 1024  # descriptors compared with all others at once
_ROUGH_PX: Final = 3.0  # that features of coarse levels may be off; farther are wrong matches
_ROWS_APART: Final = 12.0  # epipolar error that the initial homographies may leave
MOST_FEATURES: Final = 8000  # maximum number of features per image, where a caller does not say


@dataclass(frozen=True, eq=False)
class PairFeatures:
    """Features matched between two images."""

    left_uv: Float32  # (N, 2), columns and rows in the left (or first) image, pixels
    right_uv: Float32  # (N, 2), the same features in the right (or second) image

    def __post_init__(self) -> None:
        freeze(self, "left_uv", np.float32, (None, 2))
        freeze(self, "right_uv", np.float32, (len(self.left_uv), 2))

    def __len__(self) -> int:
        return len(self.left_uv)

    def select(self, which: NDArray[Any]) -> PairFeatures:
        """Return the matches of a boolean mask (N,)."""
        return PairFeatures(self.left_uv[which], self.right_uv[which])


NO_FEATURES: Final = PairFeatures(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))


def pool_features(found: Iterable[PairFeatures]) -> PairFeatures:
    """Return the matches of several pairs together."""
    parts = [NO_FEATURES, *found]
    sides = ([part.left_uv for part in parts], [part.right_uv for part in parts])
    return PairFeatures(np.concatenate(sides[0]), np.concatenate(sides[1]))


def match_features(
    first: UInt8, second: UInt8, count: int, *, any_scale: bool = False
) -> PairFeatures:
    """Match features between two images: mutual best matches that pass the ratio test.

    Positions in the second image have subpixel accuracy. ``any_scale`` = the scale may differ much
    between the images: uses SIFT, which takes ten times as long as ORB.

    Ref: Rublee et al., "ORB: an efficient alternative to SIFT or SURF", ICCV 2011;
    Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
    """
    detector: cv2.Feature2D = (
        cv2.SIFT.create(nfeatures=count, contrastThreshold=_CONTRAST)
        if any_scale
        else cv2.ORB.create(nfeatures=count, fastThreshold=10)
    )
    (uv, bits), (other_uv, other_bits) = (_describe(detector, side) for side in (first, second))
    if len(uv) < 2 or len(other_uv) < 2:
        return NO_FEATURES
    matcher = cv2.BFMatcher(detector.defaultNorm())
    there = _distinct(matcher.knnMatch(bits, other_bits, k=2))
    back = _distinct(matcher.knnMatch(other_bits, bits, k=2))
    mutual = [(i, j) for i, j in there.items() if back.get(j) == i]
    at = np.array(mutual, dtype=np.int64).reshape(-1, 2)
    matched = PairFeatures(uv[at[:, 0]], other_uv[at[:, 1]])
    # Tracking cannot refine a patch that changed its scale; SIFT is accurate enough.
    return matched if any_scale else _refined(first, second, matched)


def match_exactly(left: UInt8, right: UInt8, count: int = MOST_FEATURES) -> PairFeatures:
    """Return mutual best matches of SIFT features that pass a stricter ratio test.

    Slower than `match_features`, but subpixel accurate and robust to rotation, scale and slant.
    """
    sift = cv2.SIFT.create(nfeatures=count, contrastThreshold=_CONTRAST)
    (left_uv, left_d), (right_uv, right_d) = (_describe(sift, side) for side in (left, right))
    if min(len(left_uv), len(right_uv)) < 2:
        return NO_FEATURES
    at = _mutual_best(left_d, right_d)
    both = np.hstack([left_uv[at[:, 0]], right_uv[at[:, 1]]])
    # SIFT returns a keypoint with two orientations twice.
    unique = np.unique(both, axis=0)
    return PairFeatures(np.array(unique[:, :2]), np.array(unique[:, 2:]))


def match_again(
    left: UInt8, right: UInt8, H_left: Float64, H_right: Float64, count: int = MOST_FEATURES
) -> PairFeatures:
    """Match raw images that homographies roughly align, for more and better matches.

    ``H_left`` and ``H_right`` are from raw pixels to pixels with roughly aligned rows, where
    matches have nearly equal rows; the matches are in raw pixels.
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


def exposed_as(model: UInt8, image: UInt8) -> UInt8:
    """Return an image with the brightness and contrast of ``model``: tracking needs them equal."""
    gain = float(model.std()) / max(float(image.std()), 1.0)
    shift = float(model.mean()) - gain * float(image.mean())
    return np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=shift), dtype=np.uint8)


def _describe(detector: cv2.Feature2D, image: UInt8) -> tuple[Float32, NDArray[Any]]:
    """Return positions (N, 2) and descriptors (N, C) of the features of an image."""
    keypoints, bits = detector.detectAndCompute(image, None)
    uv = np.array([point.pt for point in keypoints], dtype=np.float32).reshape(-1, 2)
    return uv, np.zeros((0, 1), np.uint8) if bits is None else np.asarray(bits)


def _distinct(candidates: Sequence[Sequence[cv2.DMatch]]) -> dict[int, int]:
    return {
        best.queryIdx: best.trainIdx
        for best, second in candidates
        if best.distance < _RATIO * second.distance
    }


def _refined(first: UInt8, second: UInt8, found: PairFeatures) -> PairFeatures:
    """Return subpixel positions in the second image; matches that move too far are dropped."""
    if not len(found):
        return found
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        first,
        exposed_as(first, second),
        found.left_uv[:, None],
        found.right_uv[:, None].copy(),
        winSize=(15, 15),
        maxLevel=0,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    there = there.reshape(-1, 2)
    kept = (status.ravel() > 0) & (np.abs(there - found.right_uv).max(axis=1) <= _ROUGH_PX)
    return PairFeatures(found.left_uv[kept], there[kept].astype(np.float32))


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
    chosen = (least < _EXACT_RATIO**2 * second_best) & (back[best] == np.arange(len(left)))
    return np.stack([np.flatnonzero(chosen).astype(np.int32), best[chosen]], axis=1)


_NEAR_PX: Final = 1.0  # of smaller disparities: too far away to show that cameras are swapped
_OUTLIER_PX: Final = 3.0  # between the epipolar error of a wrong match and that of the others
INSPECTED: Final = 1000  # maximum number of features per image of a pair that is inspected
_MIN_FEATURES: Final = 40  # with fewer matched features there is no verdict
_WARN_EPIPOLAR_PX: Final = 1.0  # median epipolar error that gives a warning, in pixels
SWAPPED_RATIO: Final = 0.8  # of near features with negative disparity: swapped cameras


@dataclass(frozen=True)
class PairInspection:
    """How well a pair is rectified, from features matched over the whole image. NaN = unknown."""

    features: int  # number of matched features that agree on one epipolar error
    epipolar_error_px: float  # median of right minus left row; 0 if the rows are aligned
    near: int  # number of features near enough to show whether the cameras are swapped
    #: Fraction of those with a negative disparity: about 0, or about 1 if the cameras are swapped.
    negative_ratio: float


def inspect_pair(pair: RectifiedPair) -> PairInspection:
    """Measure how well a pair that should be rectified is."""
    features = match_features(pair.left, pair.right, INSPECTED)
    return inspect_features(features, pair.camera.doffs_px)


def inspect_features(
    features: PairFeatures, doffs_px: float = 0.0, min_features: int = _MIN_FEATURES
) -> PairInspection:
    """Measure how well matches of pairs of one rig fit a rectified one; NaN with too few features.

    ``doffs_px`` (``cx_right - cx_left``) is added to disparities so that 0 is at infinity.
    """
    shift = features.right_uv - features.left_uv
    agree = _agreeing(shift[:, 1])
    rows, disparity = shift[agree, 1], doffs_px - shift[agree, 0]
    near = np.abs(disparity) > _NEAR_PX
    known = len(rows) >= min_features
    middle = float(np.median(rows)) if known else float("nan")
    enough = near.sum() >= min_features
    negative = float(np.mean(disparity[near] < 0)) if enough else float("nan")
    return PairInspection(len(rows), middle, int(near.sum()), negative)


def check_inspection(inspection: PairInspection, where: str | None = None) -> tuple[str, ...]:
    """Return warnings about a pair; none if it is good or has too few features."""
    if inspection.negative_ratio >= SWAPPED_RATIO:
        raise CalibrationError(
            "left and right images are swapped",
            where=where,
            got=f"{100 * inspection.negative_ratio:.0f} % of {counted(inspection.near, 'feature')} "
            "farther right in the right image",
            expected="farther left",
            hint="give the left camera's images first (or un-mirror the images)",
        )
    if abs(inspection.epipolar_error_px) >= _WARN_EPIPOLAR_PX:
        side = "low" if inspection.epipolar_error_px > 0 else "high"
        line = (
            "left and right rows are not aligned: the right image is "
            f"{abs(inspection.epipolar_error_px):.0f} px too {side} (expected "
            f"under {_WARN_EPIPOLAR_PX:g} px); depth will be poor or wrong: recon audit --repair "
            "FILE writes a calibration of the pairs that aligns them"
        )
        return (line,)
    return ()


def _agreeing(row_shift: Float32) -> Bool:
    """Return bool (N,), features whose epipolar error is close to the most common one."""
    if not len(row_shift):
        return np.zeros(0, np.bool_)
    ordered = np.sort(row_shift)
    until = np.searchsorted(ordered, ordered + 2 * _OUTLIER_PX, side="right")
    first = int(np.argmax(until - np.arange(len(ordered))))
    middle = np.median(ordered[first : until[first]])
    return np.asarray(np.abs(row_shift - middle) <= _OUTLIER_PX)


def map_pixels(H: Float64, pixels: NDArray[Any]) -> Float64:
    """Return float64 (N, 2), pixels (N, 2) mapped by a homography (3, 3)."""
    mapped = pixels.astype(np.float64) @ H[:, :2].T + H[:, 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
