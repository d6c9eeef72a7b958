"""The report of the seed paper's experiments, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from recon.core.errors import CalibrationError
from recon.core.geometry.projection import depth_from_disparity
from recon.core.geometry.se3 import apply
from recon.core.values import Disparity, PointCloud, RectifiedCamera
from recon.evaluation.paper.methods import (
    ABSOLUTE,
    AS_PRINTED,
    BAD_PX,
    CORRECTED,
    TITLES,
    MethodResult,
    PatchFigure,
)
from recon.evaluation.paper.result import ExperimentResult, PaperRun
from recon.evaluation.paper.scenes import camera_of_table_1
from recon.io.images.image import write_image
from recon.report.colour import DISPARITY_SCALE, colour_disparity, colour_values, value_range
from recon.report.page import write_page
from recon.report.pair_figures import (
    ERROR_LIMIT_PX,
    depth_figure,
    disparity_figure,
    error_figure,
    is_wide,
    pair_figure,
)
from recon.report.scene import T_UPRIGHT_CAMERA, Json, Scene, plot_scene
from recon.report.style import (
    BAD,
    ESTIMATE,
    FAINT,
    HALF_IN,
    INK,
    TRUTH,
    WIDE_IN,
    bare_figure,
    styled,
    to_png,
    write_note,
)
from recon.run.directory import RunDirectory

_MAX_POINTS: Final = 20_000
_NEAR_SHARE: Final = 0.9  # the caption of the clouds says so
_LOOK_FROM: Final = (-1.15, 0.4, 0.4)  # relative to the centre of a cloud, in its longest side
COLOURS: Final[Mapping[str, str]] = {CORRECTED: ESTIMATE, ABSOLUTE: TRUTH, AS_PRINTED: BAD}
_SURFACE_COLUMNS: Final = 220
_CURVE_SAMPLES: Final = 400
_ELEVATION_DEG: Final = 55.0
_AZIMUTH_DEG: Final = -72.0


def write_paper_page(result: PaperRun, run: RunDirectory) -> None:
    """Write ``report.html`` of the seed paper's experiments, and each disparity in colour.

    Raises:
        OutputError: A file cannot be written.
    """
    for one in result.experiments:
        for method in one.methods:
            path = run.path(f"{one.experiment.folder}/{method.method}/disparity_colour.png")
            write_image(path, colour_disparity(method.disparity.values))
    write_page(
        "paper",
        run,
        run=result,
        titles=TITLES,
        drawn=[_drawn(one) for one in result.experiments],
        limit_px=ERROR_LIMIT_PX,
        bad_px=BAD_PX,
        # Experiments have their own sections.
        of_the_run={k: v for k, v in result.summary.items() if k not in {"experiments", "table_1"}},
        warnings=result.warnings,
    )


def believed_camera(camera: RectifiedCamera) -> RectifiedCamera | None:
    """Return the camera according to Table 1, or None if doffs cannot be a focal length."""
    try:
        return camera_of_table_1(camera)
    except CalibrationError:
        return None


def _drawn(result: ExperimentResult) -> dict[str, Any]:
    """Draw the figures of an experiment."""
    camera, first = result.experiment.camera, result.methods[0]
    return {
        "pair": pair_figure(first.pair),
        "methods": [_drawn_method(result, one) for one in result.methods],
        "patches": patches_figure(result.patches),
        "curve": depth_curve_figure(camera, believed_camera(camera), first.disparity.values),
    }


def _drawn_method(result: ExperimentResult, one: MethodResult) -> dict[str, Any]:
    """Draw disparity, depth, error and surface of one method."""
    error: bytes | None = None
    if result.experiment.truth is not None:
        error_px = np.abs(one.disparity.values - result.experiment.truth.values)
        error = error_figure(error_px)
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
    """Return a viewpoint that shows the whole cloud, view axes: left of and above the camera."""
    low, high = np.quantile(apply(T_UPRIGHT_CAMERA, cloud.xyz), (0.01, 0.99), axis=0)
    x, y, z = ((low + high) / 2 + float((high - low).max()) * np.array(_LOOK_FROM)).tolist()
    return x, y, z


@styled
def surface_figure(disparity: Disparity) -> bytes:
    """Draw the disparity map as a surface over the image, height = disparity; gaps stay open.

    Ref: Fig. 6 of the seed paper.
    """
    step = max(1, math.ceil(disparity.values.shape[1] / _SURFACE_COLUMNS))
    height, width = disparity.values.shape
    values = disparity.values[::step, ::step].astype(np.float64)
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    limits = value_range(values)
    colours = colour_values(values, DISPARITY_SCALE, limits)
    figure = bare_figure(HALF_IN, 5.2)
    axes: Any = figure.add_axes((0.02, 0.02, 0.9, 0.98), projection="3d")
    axes.plot_surface(
        columns,
        rows,
        np.clip(values, *limits),
        facecolors=np.dstack([colours / 255.0, np.isfinite(values)]),  # gaps are transparent
        rstride=1,
        cstride=1,
        linewidth=0,
        antialiased=False,
        shade=False,
    )
    _style_surface(axes, width, height)
    return to_png(figure)


@styled
def depth_curve_figure(
    camera: RectifiedCamera, believed: RectifiedCamera | None, disparities_px: NDArray[Any]
) -> bytes:
    """Draw depth against disparity, with the true camera and the focal length of Table 1.

    Args:
        camera: The true camera.
        believed: The camera according to Table 1, or None.
        disparities_px: Disparities that occur, of any shape; their range is shaded.

    Ref: Fig. 24-26 of the seed paper.
    """
    last = float(camera.ndisp or np.nanmax(disparities_px, initial=1.0))
    d = np.linspace(last / _CURVE_SAMPLES, last, _CURVE_SAMPLES)
    figure = Figure((HALF_IN, 4.2))
    axes = figure.subplots()
    doffs = f"doffs = {camera.doffs_px:.7g} px"
    label = f"Z = f·b / (d + doffs), f = {camera.focal_px:.7g} px, {doffs}"
    axes.plot(d, depth_from_disparity(d, camera), color=ESTIMATE, linewidth=2.2, label=label)
    if believed is not None:
        label = f"as printed: Z = f·b / d, f = {believed.focal_px:.7g} px"
        axes.plot(d, depth_from_disparity(d, believed), color=BAD, linewidth=2.2, label=label)
    known = disparities_px[np.isfinite(disparities_px)]
    if known.size:
        low, high = np.percentile(known, (1.0, 99.0))
        axes.axvspan(low, high, color=FAINT, alpha=0.13, linewidth=0, label="disparities found")
    axes.set(yscale="log", xlabel="disparity d (px)", ylabel="depth Z (m, logarithmic)")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    figure.legend(loc="outside lower center", fontsize=9)
    return to_png(figure)


@styled
def patches_figure(patches: Mapping[str, Sequence[PatchFigure]]) -> bytes:
    """Draw the effect of the patch size: wrong pixels, mean error, pixels with a value."""
    figure = Figure((WIDE_IN, 3.8))
    panels = (
        (f"off by more than {BAD_PX:g} px (%)", "bad_percent"),
        ("mean error (px)", "avgerr_px"),
        ("pixels with a value (%)", "valid_percent"),
    )
    for axes, (label, name) in zip(figure.subplots(1, 3), panels, strict=True):
        _plot_patches(axes, patches, name)
        axes.set(xlabel="patch (px)", ylabel=label, ylim=(0, None))
    handles = [Line2D([], [], **_line(method), label=TITLES[method]) for method in patches]
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return to_png(figure)


def _plot_patches(axes: Axes, patches: Mapping[str, Sequence[PatchFigure]], name: str) -> None:
    known = False
    for method, figures in patches.items():
        values = [getattr(figure, name) for figure in figures]
        if any(value is not None and math.isfinite(value) for value in values):
            sizes = [figure.patch_px for figure in figures]
            axes.plot(sizes, values, **_line(method))
            axes.set_xticks(sizes)
            known = True
    if not known:
        write_note(axes, "no truth to compare with")


def _line(method: str) -> dict[str, Any]:
    """Return line style of a method; dashed if it coincides with another line."""
    # Both printed methods give a value to the same pixels.
    dashes = "--" if method == AS_PRINTED else "-"
    look = {"marker": "o", "markersize": 4, "linewidth": 1.6}
    return {"color": COLOURS[method], "linestyle": dashes, **look}


def _style_surface(axes: Any, width: int, height: int) -> None:
    """View the surface like the image: row 0 is far and on top."""
    axes.set_ylim(height, 0)
    axes.set_box_aspect((1.0, height / width, 0.45), zoom=1.0)
    axes.view_init(elev=_ELEVATION_DEG, azim=_AZIMUTH_DEG)
    for axis, label in ((axes.xaxis, "column"), (axes.yaxis, "row"), (axes.zaxis, "disparity")):
        axis.set_label_text(f"{label} (px)")
        axis.line.set_color(FAINT)
        axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
        axis.set_tick_params(labelsize=8, colors=INK)
