"""Fundamental matrix of two views: robust estimation, and refinement on the inliers."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from recon.core.geometry.se3 import exp_so3
from recon.core.least_squares import Problem, minimise
from recon.core.values.arrays import Bool, Float64
from recon.stereo.rectify.features import PairFeatures

_FEWEST: Final = 8
# With little parallax, a wide threshold accepts a wrong geometry: several are tried.
_DRAWS: Final = (
    (cv2.USAC_MAGSAC, 1.0), (cv2.USAC_MAGSAC, 0.5), (cv2.USAC_MAGSAC, 0.25), (cv2.RANSAC, 1.0),
)  # fmt: skip
_ROUNDS: Final = 50
_STILL: Final = 1e-7  # relative decrease of the cost at which the fit ends
_STEP: Final = 1e-6
_SMALLEST_PX: Final = 0.1  # errors below about this size are weighted alike


def find_fundamental(features: PairFeatures, inlier_px: float) -> tuple[Float64 | None, Bool]:
    """Estimate the fundamental matrix robustly (RANSAC, MAGSAC++) and refine it on its inliers.

    Returns:
        float64 (3, 3) with ``right.T @ F @ left = 0``, or None; and bool (N,), the matches that
        are at most ``inlier_px`` away from their epipolar lines.
    """
    left, right = features.left_uv.astype(np.float64), features.right_uv.astype(np.float64)
    best, distances = None, np.full(len(left), np.inf)
    for method, share in _DRAWS if len(left) >= _FEWEST else ():
        try:
            F, _ = cv2.findFundamentalMat(left, right, method, share * inlier_px, 0.9999, 10000)
        except cv2.error:  # no model found
            continue
        if F is None or F.shape != (3, 3):
            continue
        for _ in range(2):  # fitted to the inliers, and to those of that fit
            agreeing = np.abs(line_distances(F, left, right)) <= inlier_px
            if agreeing.sum() >= _FEWEST:
                F = fit_fundamental(F, left[agreeing], right[agreeing])
        apart = np.abs(line_distances(F, left, right))
        if np.minimum(apart, inlier_px).sum() < np.minimum(distances, inlier_px).sum():
            best, distances = F, apart
    return best, np.asarray(distances <= inlier_px)


def fit_fundamental(F: Float64, left_px: Float64, right_px: Float64) -> Float64:
    """Refine the seven parameters of a fundamental matrix, minimising absolute distances.

    Args:
        F: float64 (3, 3), initial guess.
        left_px: float64 (N, 2), inliers.
        right_px: float64 (N, 2), the matching pixels.

    Ref: Bartoli and Sturm 2004, "Non-linear estimation of the fundamental matrix with minimal
        parameters".
    """
    middle = np.concatenate([left_px, right_px]).mean(axis=0)
    scale = 1.0 / max(float(np.abs([left_px - middle, right_px - middle]).mean()), 1e-12)
    N = np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
    inverse = np.linalg.inv(N)
    U, S, Vt = np.linalg.svd(inverse.T @ F @ inverse)

    def moved(step: Float64) -> Float64:
        angle = np.arctan2(S[1], S[0]) + step[6]
        middle = np.diag([np.cos(angle), np.sin(angle), 0.0])
        return np.asarray(N.T @ U @ exp_so3(step[:3]) @ middle @ exp_so3(step[3:6]) @ Vt @ N)

    def apart(step: Float64) -> Float64:
        return line_distances(moved(step), left_px, right_px)

    def linearise(step: Float64) -> tuple[Float64, Float64]:
        error = apart(step)
        J = np.stack([(apart(step + _STEP * e) - error) / _STEP for e in np.eye(7)], axis=1)
        weighted = J / np.hypot(error, small_px)[:, None]
        return weighted.T @ J, weighted.T @ error

    def solve(step: Float64, normal: tuple[Float64, Float64], damping: float) -> Float64:
        A, a = normal
        return step - np.linalg.lstsq(A + damping * np.diag(np.diag(A)), a, rcond=1e-12)[0]

    small_px = _SMALLEST_PX + float(np.median(np.abs(apart(np.zeros(7)))))
    cost = Problem(lambda step: float(np.hypot(apart(step), small_px).sum()), linearise, solve)
    return moved(minimise(cost, np.zeros(7), rounds=_ROUNDS, min_gain=_STILL))


def line_distances(F: Float64, left_px: Float64, right_px: Float64) -> Float64:
    """Return float64 (N,), signed Sampson distances: the error of each match to first order.

    Ref: Hartley and Zisserman 2004, equation 11.9.
    """
    ones = np.ones((len(left_px), 1))
    left, right = np.hstack([left_px, ones]), np.hstack([right_px, ones])
    in_right, in_left = left @ F.T, right @ F
    size = np.linalg.norm(np.hstack([in_right[:, :2], in_left[:, :2]]), axis=1)
    return np.asarray((right * in_right).sum(axis=1) / np.maximum(size, 1e-300))
