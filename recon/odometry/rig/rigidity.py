"""Whether two cameras are rigid to each other, by the epipolar error of pairs of a drive."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np

from recon.core.values.arrays import Float64
from recon.sources.source import StereoSource
from recon.stereo.rectify.features import match_features
from recon.stereo.rectify.rectifier import Rectifier
from recon.stereo.rectify.row_alignment import align_rows

MOST_ROWS_PX: Final = 1.5
"""Epipolar error from which a pair is not matched rightly. As far as cameras turn against each
other up and down, they turn to the side, which shifts every disparity and is seen nowhere."""
_PAIRS: Final = 6
_LEAST_PAIRS: Final = 3  # of which half would have to be wrong for the spread to be
_REACH: Final = 600  # frames from the start that they are among: a video is decoded up to each
_FEATURES: Final = 800  # per image
_SIGMAS: Final = 1.4826  # of a normal distribution, from its median absolute deviation


@dataclass(frozen=True, eq=False)
class Rigidity:
    """Epipolar errors, right minus left row, of some pairs of a drive."""

    frames: tuple[int, ...]
    rows_px: Float64  # (N,), mean of the features of each pair

    @property
    def spread_px(self) -> float:
        """Robust standard deviation; 0 where too few pairs show it."""
        if len(self.frames) < _LEAST_PAIRS:
            return 0.0
        return _SIGMAS * float(np.median(np.abs(self.rows_px - np.median(self.rows_px))))

    @property
    def kept(self) -> bool:
        return self.spread_px <= MOST_ROWS_PX

    def describe(self) -> str:
        """Return in words how the cameras moved; of pairs that are not rigid."""
        rows = zip(self.frames, self.rows_px, strict=True)
        found = ", ".join(f"{row:+.0f} px in frame {frame}" for frame, row in rows)
        return (
            "the cameras move against each other, or their images are of different moments: the "
            f"right image is too low by {found}; no calibration holds for such a drive: fix both "
            "to one bar, and trigger them together"
        )


def measure_rigidity(source: StereoSource, rectifier: Rectifier) -> Rigidity:
    """Measure the epipolar error of a few pairs, evenly spread over a drive."""
    found: dict[int, float] = {}
    for number in np.unique(np.linspace(0, min(len(source), _REACH) - 1, _PAIRS).astype(int)):
        for pair in map(rectifier.rectify, islice(source.frames(int(number)), 1)):
            features = match_features(pair.left, pair.right, _FEATURES)
            aligned = align_rows(features.left_uv, features.right_uv, rectifier.camera)
            if aligned is not None and 2 * aligned.agreeing > len(features):
                found[int(number)] = aligned.mean_px
    return Rigidity(tuple(found), np.array([*found.values()]))
