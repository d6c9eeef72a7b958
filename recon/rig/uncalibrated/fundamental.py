"""Fundamental matrix: robust estimation, refinement, and rectifying homographies."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import cv2
import numpy as np

from recon.core.geometry.se3 import exp_so3, hat
from recon.core.least_squares import Problem, minimise
from recon.core.values.arrays import Bool, Float64

_FEWEST: Final = 8
# With little parallax, a wide threshold accepts a wrong geometry: several are tried.
_DRAWS: Final = (
    (cv2.USAC_MAGSAC, 1.0), (cv2.USAC_MAGSAC, 0.5), (cv2.USAC_MAGSAC, 0.25), (cv2.RANSAC, 1.0),
)  # fmt: skip
# Rounds of reweighting, and steps of each.
_REWEIGHTED: Final = 30
_ROUNDS: Final = 6
_STEP: Final = 1e-6
# A change of the parameters, radians, below which reweighting ends.
_STILL: Final = 1e-8
_LEAST_GAIN: Final = 1e-3
# Errors below about this size, in pixels, are weighted alike.
_SMALLEST_PX: Final = 0.1


def find_fundamental(
    left_px: Float64, right_px: Float64, inlier_px: float
) -> tuple[Float64 | None, Bool]:
    """Estimate the fundamental matrix robustly (RANSAC, MAGSAC++) and refine it on its inliers.

    Args:
        left_px: float64 (N, 2).
        right_px: float64 (N, 2), the matching pixels.
        inlier_px: Largest distance of an inlier from its epipolar line.

    Returns:
        float64 (3, 3) with ``right.T @ F @ left = 0``, or None; and bool (N,), the inliers.
    """
    none = np.zeros(len(left_px), bool)
    if len(left_px) < _FEWEST:
        return None, none
    drawn = [_draw(left_px, right_px, inlier_px * share, method) for method, share in _DRAWS]
    fitted = [_fit_agreeing(F, left_px, right_px, inlier_px) for F in drawn if F is not None]
    guesses = [F for F in fitted if F is not None]
    if not guesses:
        return None, none
    apart = [np.abs(line_distances(F, left_px, right_px)) for F in guesses]
    best = int(np.argmin([np.minimum(each, inlier_px).sum() for each in apart]))
    return guesses[best], np.asarray(apart[best] <= inlier_px)


def _draw(left_px: Float64, right_px: Float64, inlier_px: float, method: int) -> Float64 | None:
    try:
        F, _ = cv2.findFundamentalMat(left_px, right_px, method, inlier_px, 0.9999, 10000)
    except cv2.error:  # no model found
        return None
    return None if F is None or F.shape != (3, 3) else np.asarray(F, dtype=np.float64)


def _fit_agreeing(
    F: Float64, left_px: Float64, right_px: Float64, inlier_px: float
) -> Float64 | None:
    """Fit to the inliers, and again to the inliers of that fit."""
    for _ in range(2):
        agreeing = np.abs(line_distances(F, left_px, right_px)) <= inlier_px
        if agreeing.sum() < _FEWEST:
            return None
        F = fit_fundamental(F, left_px[agreeing], right_px[agreeing])
    return F


def line_distances(F: Float64, left_px: Float64, right_px: Float64) -> Float64:
    """Return float64 (N,), signed Sampson distances: the error of each match to first order.

    Ref: Hartley and Zisserman 2004, equation 11.9.
    """
    ones = np.ones((len(left_px), 1))
    left, right = np.hstack([left_px, ones]), np.hstack([right_px, ones])
    in_right, in_left = left @ F.T, right @ F
    size = np.sqrt((in_right[:, :2] ** 2).sum(axis=1) + (in_left[:, :2] ** 2).sum(axis=1))
    return np.asarray((right * in_right).sum(axis=1) / np.maximum(size, 1e-300))


def fit_fundamental(F: Float64, left_px: Float64, right_px: Float64) -> Float64:
    """Refine the seven parameters of a fundamental matrix, minimising absolute distances.

    Args:
        F: float64 (3, 3), initial guess.
        left_px: float64 (N, 2), inliers.
        right_px: float64 (N, 2), the matching pixels.

    Ref: Bartoli and Sturm 2004, "Non-linear estimation of the fundamental matrix with minimal
        parameters".
    """
    N = _normalising(np.concatenate([left_px, right_px]))
    a, b = (uv @ N[:2, :2].T + N[:2, 2] for uv in (left_px, right_px))
    inverse = np.linalg.inv(N)
    U, S, Vt = np.linalg.svd(inverse.T @ F @ inverse)
    U, V = U * np.sign(np.linalg.det(U)), Vt.T * np.sign(np.linalg.det(Vt))

    def matrix(step: Float64) -> Float64:
        angle = np.arctan2(S[1], S[0]) + step[6]
        middle = np.diag([np.cos(angle), np.sin(angle), 0.0])
        return np.asarray(U @ exp_so3(step[:3]) @ middle @ (V @ exp_so3(step[3:6])).T)

    def apart(step: Float64) -> Float64:
        return np.asarray(line_distances(matrix(step), a, b) / N[0, 0])

    step = np.zeros(7)
    for _ in range(_REWEIGHTED):
        error = np.abs(apart(step))
        weights = 1.0 / np.maximum(error, _SMALLEST_PX + np.median(error))
        before, step = step, _fit_weighted(apart, step, weights)
        if np.abs(step - before).max() < _STILL:
            break
    return np.asarray(N.T @ matrix(step) @ N)


def _fit_weighted(apart: Callable[[Float64], Float64], start: Float64, weights: Float64) -> Float64:
    """Return the step (7,) of least weighted squares, from numerical derivatives."""

    def linearise(step: Float64) -> tuple[Float64, Float64]:
        error = apart(step)
        J = np.stack([(apart(step + _STEP * e) - error) / _STEP for e in np.eye(len(step))], axis=1)
        return J.T @ (J * weights[:, None]), J.T @ (weights * error)

    def solve(step: Float64, normal: tuple[Float64, Float64], damping: float) -> Float64:
        A, a = normal
        return step - np.linalg.lstsq(A + damping * np.diag(np.diag(A)), a, rcond=1e-12)[0]

    return minimise(
        Problem(
            cost=lambda step: float(weights @ apart(step) ** 2),
            linearise=linearise,
            step=solve,
        ),
        start,
        rounds=_ROUNDS,
        min_gain=_LEAST_GAIN,
    )


def epipoles(F: Float64) -> tuple[Float64, Float64]:
    """Return float64 (3,) twice, homogeneous: the epipoles in the left and in the right image."""
    U, _, Vt = np.linalg.svd(F)
    return Vt[2], U[:, 2]


def level_homographies(F: Float64, size: tuple[int, int]) -> tuple[Float64, Float64]:
    """Return homographies that bring matching pixels of both images onto the same row.

    Never divides by the last coordinate of an epipole, which is almost zero if the rows are nearly
    aligned already.

    Args:
        F: float64 (3, 3), ``right.T @ F @ left = 0``.
        size: (width, height) of the images.

    Returns:
        float64 (3, 3) for the left and for the right image. They align rows only: the columns of
        the left image are arbitrary.

    Ref: Hartley 1999, "Theory and practice of projective rectification".
    """
    to_middle = np.array([[1, 0, -(size[0] - 1) / 2], [0, 1, -(size[1] - 1) / 2], [0, 0, 1.0]])
    e = to_middle @ epipoles(F)[1]
    e = e * (np.sign(e[0]) or 1.0)  # the smaller rotation
    reach = float(np.hypot(e[0], e[1]))
    c, s = e[:2] / reach
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    away = np.array([[1, 0, 0], [0, 1, 0], [-e[2] / reach, 0, 1.0]])
    H_right = away @ turn @ to_middle
    # H_right @ [e]x @ F gives the rows of the left image; its first row affects columns alone and
    # may be replaced by any other.
    e = epipoles(F)[1]
    _, second, third = H_right @ hat(e) @ F
    first = np.cross(second, third)
    H_left = np.stack([first * (np.linalg.norm(second) / np.linalg.norm(first)), second, third])
    return _facing(H_left, size), _facing(H_right, size)


def _facing(H: Float64, size: tuple[int, int]) -> Float64:
    """Return the homography scaled so that the image centre maps to a last coordinate of 1."""
    return np.asarray(H / (H[2] @ [(size[0] - 1) / 2, (size[1] - 1) / 2, 1.0]))


def _normalising(pixels: Float64) -> Float64:
    """Return float64 (3, 3) that centres pixels and scales them to a mean distance of √2."""
    middle = pixels.mean(axis=0)
    scale = np.sqrt(2) / max(float(np.linalg.norm(pixels - middle, axis=1).mean()), 1e-12)
    return np.array([[scale, 0, -scale * middle[0]], [0, scale, -scale * middle[1]], [0, 0, 1.0]])
