"""The report of one pair, and its results as colour images."""

from __future__ import annotations

import numpy as np

from recon.core.geometry.projection import depth_from_disparity
from recon.io.images.image import write_image
from recon.report.colour import colour_confidence, colour_disparity, colour_reasons
from recon.report.page import write_page
from recon.report.pair_figures import ERROR_LIMIT_PX, error_figure, stereo_figures
from recon.report.scene import T_UPRIGHT_CAMERA, Json, Scene, plot_scene
from recon.run.directory import RunDirectory
from recon.stereo.frame import PairRun


def write_pair_page(result: PairRun, run: RunDirectory) -> None:
    """Write ``report.html`` of a pair, and its results as colour images."""
    write_disparity_images(result, run)
    write_page("pair", run, **pair_content(result))


def write_disparity_images(result: PairRun, run: RunDirectory) -> None:
    """Write disparity, confidence and reasons of a pair as colour images."""
    images = {
        "disparity_colour.png": colour_disparity(result.disparity.values),
        "confidence_colour.png": colour_confidence(result.disparity.confidence),
        "reason_colour.png": colour_reasons(result.disparity.reason),
    }
    for name, image in images.items():
        write_image(run.path(f"disparity/{name}"), image)


def pair_content(result: PairRun) -> Json:
    """Return what the page of a pair shows: disparity, accuracy and 3-D view."""
    scene = Scene(T_UPRIGHT_CAMERA, result.cloud, result.mesh, eye_m=_beside_camera(result))
    error: bytes | None = None
    if result.truth is not None and result.truth.values.shape == result.disparity.values.shape:
        error = error_figure(np.abs(result.disparity.values - result.truth.values))
    return {
        "run": result,
        "warnings": result.warnings,
        "result": stereo_figures(result.pair, result.disparity),
        "error": error,
        "limit_px": ERROR_LIMIT_PX,
        "view": plot_scene(scene),
    }


def _beside_camera(result: PairRun) -> tuple[float, float, float]:
    """Return a viewpoint behind, left of and above the camera, from which depth is visible."""
    depth_m = depth_from_disparity(result.disparity.values, result.pair.camera)
    known = depth_m[np.isfinite(depth_m)]
    far = float(np.median(known)) if known.size else 1.0
    return (-0.1 * far, 0.25 * far, 0.25 * far)
