"""The report of the seed paper's experiments."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud, RectifiedCamera
from recon.evaluation.paper.methods import AS_PRINTED, BAD_PX, CORRECTED, TITLES, MethodResult
from recon.evaluation.paper.result import ExperimentResult, PaperRun
from recon.evaluation.paper.scenes import camera_of_table_1
from recon.io.images.image import write_image
from recon.report.colour import colour_disparity
from recon.report.images import (
    depth_figure,
    disparity_figure,
    error_figure,
    is_wide,
    pair_figure,
)
from recon.report.page import write_page
from recon.report.paper_figures import depth_curve_figure, patches_figure, surface_figure
from recon.report.scene import T_UPRIGHT_CAMERA, Json, Scene, plot_scene
from recon.run.directory import RunDirectory

_ERROR_LIMIT_PX: Final = 4.0
_MAX_POINTS: Final = 20_000
_NEAR_SHARE: Final = 0.9  # the caption of the clouds says so
_LOOK_FROM: Final = (-1.15, 0.4, 0.4)  # relative to the centre of a cloud, in its longest side


def write_paper_page(run: PaperRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of the seed paper's experiments, and each disparity in colour.

    Raises:
        OutputError: A file cannot be written.
    """
    for result in run.experiments:
        for one in result.methods:
            path = directory.path(f"{result.experiment.folder}/{one.method}/disparity_colour.png")
            write_image(path, colour_disparity(one.disparity.values))
    write_page(
        "paper",
        directory,
        run=run,
        titles=TITLES,
        drawn=[_drawn(result) for result in run.experiments],
        limit_px=_ERROR_LIMIT_PX,
        bad_px=BAD_PX,
        # Experiments have their own sections.
        of_the_run={k: v for k, v in run.summary.items() if k not in {"experiments", "table_1"}},
        warnings=run.warnings,
    )


def believed_camera(camera: RectifiedCamera) -> RectifiedCamera | None:
    """The camera according to Table 1, or None if doffs cannot be a focal length."""
    try:
        return camera_of_table_1(camera)
    except CalibrationError:
        return None


def _drawn(result: ExperimentResult) -> dict[str, Any]:
    """The figures of an experiment."""
    camera, first = result.experiment.camera, result.methods[0]
    return {
        "pair": pair_figure(first.pair),
        "methods": [_drawn_method(result, one) for one in result.methods],
        "patches": patches_figure(result.patches, BAD_PX),
        "curve": depth_curve_figure(camera, believed_camera(camera), first.disparity.values),
    }


def _drawn_method(result: ExperimentResult, one: MethodResult) -> dict[str, Any]:
    """Disparity, depth, error and surface of one method."""
    error: bytes | None = None
    if result.experiment.truth is not None:
        error_px = np.abs(one.disparity.values - result.experiment.truth.values)
        error = error_figure(error_px, _ERROR_LIMIT_PX)
    return {
        "method": one.method,
        "wide": is_wide(one.disparity.values.shape),
        "disparity": disparity_figure(one.disparity, one.pair.camera),
        "depth": depth_figure(one.depth_m),
        "surface": surface_figure(one.disparity),
        "error": error,
        "near": one.method != CORRECTED,
        # The cloud of the method as printed is not worth turning.
        "view": None if one.method == AS_PRINTED else _view(one),
    }


def _view(one: MethodResult) -> Json | None:
    cloud = one.cloud
    if len(cloud) and one.method != CORRECTED:
        # Integer disparities near 0 give layers far behind everything, which would shrink the rest.
        cloud = cloud.select(cloud.xyz[:, 2] <= np.quantile(cloud.xyz[:, 2], _NEAR_SHARE))
    eye_m = _beside_camera(cloud) if len(cloud) else None
    return plot_scene(Scene(T_UPRIGHT_CAMERA, cloud, eye_m=eye_m), _MAX_POINTS)


def _beside_camera(cloud: PointCloud) -> tuple[float, float, float]:
    """A viewpoint that shows the whole cloud, view axes: slightly left of and above the camera."""
    low, high = np.quantile(apply(T_UPRIGHT_CAMERA, cloud.xyz), (0.01, 0.99), axis=0)
    x, y, z = ((low + high) / 2 + float((high - low).max()) * np.array(_LOOK_FROM)).tolist()
    return x, y, z
