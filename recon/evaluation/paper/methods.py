"""The methods that `recon paper` runs on each experiment, and the effect of the patch size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final

import numpy as np

from recon.core.geometry.projection import depth_from_disparity
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    RectifiedCamera,
    RectifiedPair,
)
from recon.core.values.arrays import Float32
from recon.evaluation.disparity import evaluate_disparity
from recon.evaluation.paper.printed import match_as_printed
from recon.evaluation.paper.scenes import Experiment, camera_of_table_1
from recon.evaluation.paper.settings import PaperConfig
from recon.stereo.cloud.back_project import CloudSettings, back_project
from recon.stereo.frame import FrameReconstructor
from recon.stereo.match.sad import SadMatcher, SadSettings
from recon.stereo.rectify.grey import to_grey
from recon.stereo.rectify.rectifier import Rectifier

CORRECTED: Final = "corrected"
ABSOLUTE: Final = "absolute"
AS_PRINTED: Final = "as_printed"
TITLES: Final[Mapping[str, str]] = MappingProxyType(
    {
        CORRECTED: "corrected",
        ABSOLUTE: "as printed, but absolute differences",
        AS_PRINTED: "as printed",
    }
)
BAD_PX: Final = 1.0
"""Disparity error above which a pixel counts as wrong."""

# Keeps every point of the printed method, regardless of range and uncertainty.
_EVERY_POINT: Final = CloudSettings(min_range_m=0.0, max_range_m=None, max_relative_sigma=None)


@dataclass(frozen=True)
class DepthFigures:
    """Depths of a method against the ground truth, over pixels that have both.

    Attributes:
        median_m: Median of the estimated depths.
        true_median_m: Median of the true depths of the same pixels.
        median_error_percent: Median of the absolute error, in per cent of the true depth.
        median_ratio: Median of estimated ÷ true depth; 1 = correct scale.
        pixels: Number of pixels compared.
    """

    median_m: float
    true_median_m: float
    median_error_percent: float
    median_ratio: float
    pixels: int


@dataclass(frozen=True, eq=False)
class MethodResult:
    """Result of one method on one experiment.

    Attributes:
        method: A key of `TITLES`.
        pair: The grey images, with the camera that the method assumes.
        disparity: The disparity map.
        depth_m: float32 (H, W), metres; NaN = unknown.
        cloud: The points in camera axes.
        metrics: Errors of the disparity, or None without ground truth.
        depth: Errors of the depth, or None.
    """

    method: str
    pair: RectifiedPair
    disparity: Disparity
    depth_m: Float32
    cloud: PointCloud
    metrics: DisparityMetrics | None
    depth: DepthFigures | None


@dataclass(frozen=True)
class PatchFigure:
    """Result for one patch size; the last three are None without ground truth.

    Attributes:
        patch_px: Edge of the patch.
        valid_percent: Share of all pixels that have a value.
        bad_percent: Share of pixels with known truth whose error exceeds the limit.
        right_percent: Share of the same pixels whose error is within the limit.
        avgerr_px: Mean absolute error of those that have a value.
    """

    patch_px: int
    valid_percent: float
    bad_percent: float | None
    right_percent: float | None
    avgerr_px: float | None


def methods_of(config: PaperConfig) -> tuple[str, ...]:
    """Return the methods that a configuration selects."""
    return tuple(TITLES) if config.paper.as_printed else (CORRECTED,)


def apply_method(
    method: str, experiment: Experiment, config: PaperConfig, threads: int | None = None
) -> MethodResult:
    """Reconstruct one experiment by one method.

    Args:
        method: ``corrected`` is our matcher with the scene's calibration. ``absolute`` and
            ``as_printed`` find integer disparities in Eq. 6 grey images, without and with the
            misprint of Eq. 9-10, and both use Table 1's focal length as printed.
        experiment: The scene.
        config: Settings of the stages, and of the experiments.
        threads: Threads for our matcher; None = all cores.
    """
    if method == CORRECTED:
        frame = FrameReconstructor(experiment.camera, config, threads=threads).reconstruct(
            experiment.pair
        )
        return _result(method, experiment, frame.pair, frame.disparity, frame.cloud)
    pair = _printed_pair(experiment)
    disparity = _match(method, pair, config.paper.patch_px, config, threads)
    pair = replace(pair, camera=camera_of_table_1(pair.camera))
    cloud = back_project(disparity, pair, _EVERY_POINT, normals=False)
    return _result(method, experiment, pair, disparity, cloud)


def try_patches(
    method: str, experiment: Experiment, config: PaperConfig, threads: int | None = None
) -> list[PatchFigure]:
    """Run a method with each patch size in the settings; ``corrected`` uses the matcher `sad`."""
    pair = _grey_pair(method, experiment, config)
    figures = []
    for patch_px in config.paper.patches_px:
        if patch_px <= min(pair.left.shape):
            found = _match(method, pair, patch_px, config, threads)
            figures.append(_patch_figure(patch_px, found, experiment.truth))
    return figures


def compare_depth(
    depth_m: Float32, truth: DisparityTruth, camera: RectifiedCamera
) -> DepthFigures | None:
    """Compare depths with the truth at pixels seen by both cameras; None = no pixel has both.

    Args:
        depth_m: float32 (H, W), metres; NaN = unknown.
        truth: True disparity.
        camera: The true geometry.
    """
    true_m = depth_from_disparity(truth.values, camera)
    both = np.isfinite(depth_m) & np.isfinite(true_m) & truth.nonocc
    if not both.any():
        return None
    found, true = depth_m[both].astype(np.float64), true_m[both].astype(np.float64)
    return DepthFigures(
        median_m=float(np.median(found)),
        true_median_m=float(np.median(true)),
        median_error_percent=100 * float(np.median(np.abs(found - true) / true)),
        median_ratio=float(np.median(found / true)),
        pixels=int(both.sum()),
    )


def _result(
    method: str,
    experiment: Experiment,
    pair: RectifiedPair,
    disparity: Disparity,
    cloud: PointCloud,
) -> MethodResult:
    depth_m = depth_from_disparity(disparity.values, pair.camera)
    truth = experiment.truth
    return MethodResult(
        method=method,
        pair=pair,
        disparity=disparity,
        depth_m=depth_m,
        cloud=cloud,
        metrics=None if truth is None else evaluate_disparity(disparity, truth),
        depth=None if truth is None else compare_depth(depth_m, truth, experiment.camera),
    )


def _match(
    method: str, pair: RectifiedPair, patch_px: int, config: PaperConfig, threads: int | None
) -> Disparity:
    """Match by a method with the given patch size."""
    if method != CORRECTED:
        return match_as_printed(pair, patch_px, signed=method == AS_PRINTED)
    settings = {**config.matching.sad.model_dump(), "window_px": patch_px}
    return SadMatcher(SadSettings.parse(settings), threads).match(pair)


def _grey_pair(method: str, experiment: Experiment, config: PaperConfig) -> RectifiedPair:
    if method != CORRECTED:
        return _printed_pair(experiment)
    return Rectifier(experiment.camera, config.rectification).rectify(experiment.pair)


def _printed_pair(experiment: Experiment) -> RectifiedPair:
    """Return the images converted to grey by Eq. 6."""
    pair, rectifier = experiment.pair, Rectifier(experiment.camera)
    left, right = (to_grey(image, "paper") for image in rectifier.warp(pair))
    return replace(rectifier.rectify(pair), left=left, right=right)


def _patch_figure(patch_px: int, found: Disparity, truth: DisparityTruth | None) -> PatchFigure:
    valid_percent = 100 * float(found.valid.mean())
    if truth is None:
        return PatchFigure(patch_px, valid_percent, None, None, None)
    metrics = evaluate_disparity(found, truth, (BAD_PX,))
    bad = metrics.bad[BAD_PX]
    return PatchFigure(patch_px, valid_percent, bad, 100 - bad - metrics.invalid, metrics.avgerr_px)
