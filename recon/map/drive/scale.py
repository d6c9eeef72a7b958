"""How large a scene is against a road: lengths that are not set follow from it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

from recon.core.errors import ReconError
from recon.core.values import Recorded, Rig
from recon.map.fusion import FusionSettings
from recon.map.settings import SCALES
from recon.stereo.frame import FrameReconstructor, StereoSettings

_ROAD_DEPTH_M: Final = 12.5  # that of the mean disparity on a road: KITTI's have 11 to 14 m
_LIKE_A_ROAD: Final = 2.0  # times as deep, or less deep: still the lengths of a road
_MOST_VOXELS: Final = 5.0
"""Standard deviation of a depth in one frame, in voxels, which some tens of frames average out."""
_SERIES: Final = [float(f"{n}e{k}") for k in range(-6, 4) for n in (1, 2, 5)]


@dataclass(frozen=True)
class SceneScale:
    """What frames of a drive show of its size."""

    scale: float = 1.0  # against a road
    depth_m: float | None = None  # typical depth; None = nothing was matched, or looked at


def measure_scene(pairs: Iterable[Recorded], rig: Rig, settings: StereoSettings) -> SceneScale:
    """Measure how large what a drive shows is, on a few of its pairs."""
    reconstructor, depths = FrameReconstructor(rig, settings), []
    camera = reconstructor.camera
    for pair in pairs:
        with suppress(ReconError):  # that it cannot be matched is said when it is mapped
            _, disparity = reconstructor.match(pair)
            found = disparity.values[disparity.measured] + camera.doffs_px
            if len(found) and found.mean() > 0.0:
                depth_m = camera.focal_px * camera.baseline_m / float(found.mean())
                sigma_px = float(np.median(disparity.sigma_px[disparity.measured]))
                depths.append((depth_m, depth_m * sigma_px / float(found.mean())))
    if not depths:
        return SceneScale()
    depth_m, sigma_m = np.median(depths, axis=0).tolist()
    return SceneScale(scale_of(depth_m, sigma_m), depth_m)


def scale_of(depth_m: float, sigma_m: float) -> float:
    """Return the scale of scenes of a typical depth, and of its deviation in a frame.

    It is 1 up to twice and half of a road's depth, so that drives on roads share maps, else the
    nearest of the series 1, 2, 5; or the least at which the rig can place points in voxels: in
    finer ones noise would spread what it sees.
    """
    ratio = depth_m / _ROAD_DEPTH_M
    nearest = min(_SERIES, key=lambda scale: abs(math.log(ratio / scale)))
    if 1.0 / _LIKE_A_ROAD < ratio < _LIKE_A_ROAD:
        nearest = 1.0
    least = sigma_m / (_MOST_VOXELS * FusionSettings().voxel_m)
    placed = next((scale for scale in _SERIES if scale >= least), _SERIES[-1])
    return float(np.clip(max(nearest, placed), *SCALES))
