"""The stereo geometry that features of a drive show together: rows, swapped or delayed cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float32, Float64
from recon.look.sample import LARGEST_SKEW, MIN_FEATURES, Sample, Shifted, align_features, time_skew
from recon.stereo.rectify.epipolar import EpipolarAlignment, align_epipolar
from recon.stereo.rectify.features import PairFeatures, inspect_features, pool_features

_ByOffset = Mapping[int, Sequence[Shifted]]
_OFFSET_FACTOR: Final = 1.25  # agreement relative to offset 0 from which a delay is reported
_ALIKE: Final = 1.5  # agreement of the best offset relative to another that fits about as well
MOST_EPIPOLAR_ERROR_PX: Final = 1.5
"""Epipolar error from which a pair is not matched rightly. As far as cameras turn against each
other up and down, they turn to the side, which shifts every disparity and is seen nowhere."""
_LEAST_PAIRS: Final = 3  # of which half would have to be wrong for the spread to be
_SIGMAS: Final = 1.4826  # of a normal distribution, from its median absolute deviation


@dataclass(frozen=True, eq=False)
class Geometry:
    """Stereo geometry measured from the features of a drive."""

    pairs: int  # whose features were matched
    features: PairFeatures  # of all pairs; if one camera is delayed, of pairs shifted by the offset
    matched: int  # number of features matched in pairs as recorded
    alignment: EpipolarAlignment | None  # epipolar errors; None if there are too few features
    disparity_px: Float64  # (M,), of the features whose rows agree; 0 is at infinity
    swapped_ratio: float  # of near features, farther right in the right image; NaN = too few
    out_of_step: bool  # whether images of other moments fit better
    offset: int  # delay of the right camera in whole frames
    # its delay in parts of a frame, and the standard error; None if unknown, or whole frames
    skew: tuple[float, float] | None


def measure_geometry(sample: Sample, camera: RectifiedCamera) -> Geometry:
    """Measure the geometry from the features of all pairs."""
    each = [features for features, _ in sample.matched]
    features, by_offset = pool_features(each), sample.by_offset
    matched = len(features)
    alignment = align_features(features, camera)
    skew = time_skew(each, [flow for _, flow in sample.matched], camera, alignment)
    offset = _best_offset(by_offset, skew, camera)
    if offset:
        features, skew = pool_features(one.features for one in by_offset[offset]), None
        alignment = align_features(features, camera)
    disparity_px = np.zeros(0)
    if alignment is not None:
        rows = alignment.turned_rows(features.right_uv, camera) - features.left_uv[:, 1]
        shift = features.left_uv[:, 0] - features.right_uv[:, 0] + camera.doffs_px
        aligned = np.abs(rows) < max(1.0, 3 * alignment.residual_px)
        disparity_px = shift[aligned].astype(np.float64)
    return Geometry(
        pairs=len(each),
        features=features,
        matched=matched,
        alignment=alignment,
        disparity_px=disparity_px,
        swapped_ratio=inspect_features(features, camera.doffs_px, MIN_FEATURES).negative_ratio,
        out_of_step=bool(offset) or _best_fit(by_offset)[1] > _OFFSET_FACTOR,
        offset=offset,
        skew=skew,
    )


def _best_offset(
    by_offset: _ByOffset, skew: tuple[float, float] | None, camera: RectifiedCamera
) -> int:
    """Return the offset that fits best, if it fits clearly better than none.

    A delay of half a frame fits both neighbours badly; it is a skew, which moving features show.
    """
    best, times = _best_fit(by_offset)
    best = _best_moving(by_offset, best, camera)
    if abs(best) == 1:
        found, flows, _ = zip(*by_offset[best], strict=True)
        left = time_skew(found, flows, camera, align_features(pool_features(found), camera))
        if left is not None:
            return best if abs(left[0]) < 1 - LARGEST_SKEW else 0
        if skew is not None and 4 * skew[1] < abs(skew[0]) < LARGEST_SKEW:
            return 0
    return best if times > _OFFSET_FACTOR else 0


def _best_moving(by_offset: _ByOffset, best: int, camera: RectifiedCamera) -> int:
    """Return, of offsets that fit about as well as the best, that where moving rows fit best.

    Where little moves, or what is ahead comes nearer, neighbouring frames match as well.
    """
    fit = {offset: sum(n.agreeing for n in at) / len(at) for offset, at in by_offset.items()}
    sigmas = {}
    for offset in (offset for offset in fit if _ALIKE * fit[offset] >= fit[best]):
        found, flows, _ = zip(*by_offset[offset], strict=True)
        skew = time_skew(found, flows, camera, align_features(pool_features(found), camera))
        if skew is not None and abs(skew[0]) < 1 - LARGEST_SKEW:
            sigmas[offset] = skew[1]
    return min(sigmas, key=lambda offset: sigmas[offset], default=best)


def _best_fit(by_offset: _ByOffset) -> tuple[int, float]:
    """Return the offset that fits best, and how many times as well as none; 1 if few do."""
    # Offsets were tried on different numbers of pairs.
    total = {offset: sum(n.agreeing for n in at) for offset, at in by_offset.items()}
    fit = {offset: number / len(by_offset[offset]) for offset, number in total.items()}
    best = max(fit, key=lambda offset: (fit[offset], -abs(offset)), default=0)
    if total.get(best, 0) < MIN_FEATURES:
        return best, 1.0
    return best, fit[best] / max(fit.get(0, 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class Rigidity:
    """Epipolar errors, right minus left row, of some pairs of a drive."""

    frames: tuple[int, ...]
    epipolar_error_px: Float64  # (N,), mean of the features of each pair
    # (N,), median of what is left when the rotation that all pairs show is taken away: with a roll
    # alone, rows depend on where features are
    apart_px: Float64

    @property
    def spread_px(self) -> float:
        """Robust standard deviation; 0 where too few pairs show it."""
        if len(self.frames) < _LEAST_PAIRS:
            return 0.0
        return _SIGMAS * float(np.median(np.abs(self.apart_px - np.median(self.apart_px))))

    @property
    def kept(self) -> bool:
        return self.spread_px <= MOST_EPIPOLAR_ERROR_PX

    def describe(self) -> str:
        """Return in words how the cameras moved; of pairs that are not rigid."""
        rows = zip(self.frames, self.epipolar_error_px, strict=True)
        found = ", ".join(f"{row:+.0f} px in frame {frame}" for frame, row in rows)
        return (
            "the cameras move against each other, or their images are of different moments: the "
            f"right image is too low by {found}; no calibration holds for such a drive: fix both "
            "to one bar, and trigger them together"
        )


def measure_rigidity(
    sample: Sample, camera: RectifiedCamera, common: EpipolarAlignment | None
) -> Rigidity:
    """Measure the epipolar error of each pair of which most features agree on one.

    ``common`` is the rotation that all pairs together show, None = none.
    """
    found: dict[int, tuple[float, float]] = {}
    for one in sample.pairs:
        seen = one.features
        aligned = align_epipolar(seen.left_uv, seen.right_uv, camera)
        if aligned is not None and 2 * aligned.agreeing > len(seen):
            right: Float32 | Float64 = seen.right_uv[:, 1]
            if common is not None:
                right = common.turned_rows(seen.right_uv, camera)
            left_px = float(np.median(right - seen.left_uv[:, 1]))
            found[one.index] = (aligned.mean_px, left_px)
    epipolar_error_px, apart_px = np.array([*found.values()]).reshape(-1, 2).T
    return Rigidity(tuple(found), epipolar_error_px, apart_px)
