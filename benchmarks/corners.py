"""The errors of several paths of one drive, by how they differ from each other.

Where errors of paths do not depend on each other, their mean squares add: two paths differ by
``D_ab = E_a + E_b``. Three paths have three differences, and so each its own error; more are solved
by least squares. An estimate may be negative: then the error is *not resolved*, and it is not set
to zero.

What paths share is in no difference. The truth is the one path that no program made, so what all
programs share (the calibration: its scale, where the camera looks) counts as the truth's. Of a
covariance c that two of three paths have, both squares lose c, and the third gains it: the truth's,
if two programs share it. Of four paths both lose two thirds, and each of the others gains one; but
then the differences contradict each other (`Split.shared`), unless all programs share alike.

Ref: Gray & Allan, "A method for estimating the frequency stability of an individual oscillator",
Frequency Control Symposium 1974 (the three-cornered hat); Premoli & Tavella, "A revisited
three-cornered hat method for estimating frequency standard instability", IEEE Trans. Instrum. Meas.
42, 1993 (errors that are not independent).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import checkout  # noqa: F401 - what is measured
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from recon.core.geometry.se3 import invert
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.evaluation.trajectory import Segments

COMPONENTS: Final[dict[str, list[int]]] = {
    "translation": [0, 1, 2],
    "along": [2],
    "across": [0],
    "up": [1],
    "rotation": [3, 4, 5],
}
"""Columns of `differences`: axes of the left camera where a segment begins (right, down, ahead)."""

LEAST_INDEPENDENT: Final = 3
"""Segments side by side that a drive must hold for an interval: fewer do not show their spread."""
_DRAWS: Final = 1000
_CONFIDENCE: Final = 0.95
_SURE: Final = 0.998
"""That of contradictions between differences: there are dozens of them in a drive."""


@dataclass(frozen=True, eq=False)
class Split:
    """Mean squares of the errors of P paths; intervals are NaN where a drive holds too little.

    Attributes:
        squares: float64 (P, 3), estimate and 95 % interval of each path; may be negative.
        pairs: The two paths of each difference.
        between: float64 (pairs, 3), the same of their mean squared difference.
        beyond: float64 (pairs, 3), by how much that is more than the squares of both errors, with
            99.8 %; zero for three paths. Below zero, the two share errors.
    """

    squares: Float64
    pairs: list[tuple[int, int]]
    between: Float64
    beyond: Float64

    def shared(self) -> list[tuple[int, int]]:
        """Pairs of programs (path 0 is the truth) whose errors surely depend on each other."""
        # Of three paths it is zero but for rounding.
        below = self.beyond[:, 2] < -1e-9 * self.between[:, 0].mean()
        return [pair for pair, is_so in zip(self.pairs, below, strict=True) if is_so and pair[0]]


def differences(paths: Sequence[Trajectory], segments: Segments) -> Float64:
    """How the motion of each path over each segment differs from that of the first path.

    float64 (P, N, 6): per cent of the segment's length, in the axes of the path's own camera where
    the segment begins; degrees per 100 m, as a rotation vector. Differences of two rows are those
    of two paths (of rotations: to the square of a small angle).
    """
    motions = np.stack(
        [
            invert(path.T_world_camera[segments.first]) @ path.T_world_camera[segments.last]
            for path in paths
        ]
    )
    apart_m = motions[:, :, :3, 3] - motions[0, :, :3, 3]
    turns = np.swapaxes(motions[0, :, :3, :3], 1, 2) @ motions[:, :, :3, :3]
    degrees = np.degrees(Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_rotvec())
    both = np.concatenate([apart_m, degrees.reshape(apart_m.shape)], axis=2)
    return np.asarray(100.0 * both / segments.length_m[:, None])


def independent(segments: Segments, path_m: float) -> int:
    """How many of the longest segments fit into a path side by side."""
    return int(path_m / segments.length_m.max()) if len(segments.first) else 0


def split(off: Float64, segments: Segments, path_m: float) -> Split:
    """Split the differences (P, N, columns) into the errors of the paths, see this module."""
    pairs = list(combinations(range(len(off)), 2))
    squares = np.stack([((off[a] - off[b]) ** 2).sum(axis=1) for a, b in pairs], axis=1)
    adds = np.array([[float(path in pair) for path in range(len(off))] for pair in pairs])
    solve = np.linalg.pinv(adds)
    maps = (solve, np.eye(len(pairs)), np.eye(len(pairs)) - adds @ solve)
    mean, drawn = squares.mean(axis=0), _resampled(squares, segments)
    count = independent(segments, path_m)
    own, between, beyond = (
        _with_interval(each @ mean, drawn @ each.T, count, confidence)
        for each, confidence in zip(maps, (_CONFIDENCE, _CONFIDENCE, _SURE), strict=True)
    )
    return Split(own, pairs, between, beyond)


def _resampled(squares: Float64, segments: Segments) -> Float64:
    """Means (draws, pairs) of blocks of starts, each at least as long as a segment, drawn anew.

    Segments that overlap are not independent, but blocks are nearly so. The path is closed to a
    circle, so that all starts are drawn alike.

    Ref: Politis & Romano, "A circular block-resampling procedure for stationary data", 1992.
    """
    starts, which = np.unique(segments.first, return_inverse=True)
    sums = np.zeros((len(starts), squares.shape[1] + 1))
    np.add.at(sums, which, np.column_stack([squares, np.ones(len(squares))]))
    step = max(1, int(np.diff(starts).min())) if len(starts) > 1 else 1
    size = min(len(starts), int(np.ceil((segments.last - segments.first).max() / step)))
    rng = np.random.default_rng(0)
    first = rng.integers(0, len(starts), (_DRAWS, -(-len(starts) // size)))
    drawn = (first[:, :, None] + np.arange(size)).reshape(_DRAWS, -1)[:, : len(starts)]
    total = sums[drawn % len(starts)].sum(axis=1)
    return np.asarray(total[:, :-1] / total[:, -1:])


def _with_interval(estimate: Float64, drawn: Float64, count: int, confidence: float) -> Float64:
    """Estimate and interval (N, 3), as wide as few independent segments make it (Student)."""
    if count < LEAST_INDEPENDENT:
        none = np.full(len(estimate), np.nan)
        return np.column_stack([estimate, none, none])
    wide = student.ppf(0.5 + confidence / 2.0, count - 1) * np.sqrt(count / (count - 1.0))
    half = wide * drawn.std(axis=0)
    return np.column_stack([estimate, estimate - half, estimate + half])
