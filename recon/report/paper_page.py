"""The report of the seed paper's experiments, and its figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.values import Disparity, RectifiedCamera
from recon.core.values.arrays import Float32
from recon.core.values.camera import depth_from_disparity
from recon.evaluation import paper
from recon.report import pair_page, style
from recon.report.page import write_page
from recon.report.scene import T_UPRIGHT_CAMERA, Json, Scene, plot_scene
from recon.run.directory import RunDirectory

_MAX_POINTS: Final = 20_000
_NEAR_RATIO: Final = 0.9  # as the caption says
# Dashed, as both printed methods give a value to the same pixels.
_LINES: Final = {
    paper.CORRECTED: (style.ESTIMATE, "-"),
    paper.ABSOLUTE: (style.TRUTH, "-"),
    paper.AS_PRINTED: (style.BAD, "--"),
}
_SURFACE_COLUMNS: Final = 220
_CURVE_SAMPLES: Final = 400


def write_paper_page(
    folder: Path,
    results: Sequence[tuple[paper.Experiment, Sequence[paper.MethodResult]]],
    summary: Mapping[str, Any],
    run: RunDirectory,
) -> None:
    """Write ``report.html`` of the seed paper's experiments on the scenes of a folder."""
    write_page(
        "paper",
        run,
        summary,
        folder=folder.name or folder,
        titles=paper.TITLES,
        drawn=[
            {
                "experiment": one,
                "pair": pair_page.pair_figure(methods[0].pair),
                "methods": {each.method: _draw_method(one, each) for each in methods},
                "patches": patches_figure(summary["experiments"][str(one.number)]["patches"]),
                "curve": depth_curve_figure(one.camera, methods[0].disparity.values),
            }
            for one, methods in results
        ],
        limit_px=pair_page.ERROR_LIMIT_PX,
        bad_px=paper.BAD_PX,
        # Experiments have their own sections.
        of_the_run={k: v for k, v in summary.items() if k not in {"experiments", "table_1"}},
    )


def _draw_method(one: paper.Experiment, result: paper.MethodResult) -> dict[str, Any]:
    """Draw disparity, depth, error and surface of one method."""
    values, truth = result.disparity.values, one.truth
    return {
        "wide": pair_page.is_wide(values.shape),
        "disparity": pair_page.disparity_figure(result.disparity, result.pair.camera),
        "depth": pair_page.depth_figure(result.depth_m),
        "surface": surface_figure(result.disparity),
        "error": None if truth is None else pair_page.error_figure(np.abs(values - truth.values)),
        # The cloud of the method as printed is not worth turning.
        "view": None if result.method == paper.AS_PRINTED else _view(result),
    }


def _view(result: paper.MethodResult) -> Json | None:
    cloud = result.cloud
    if len(cloud) and result.method != paper.CORRECTED:
        # Integer disparities near 0 give layers far behind everything, which would shrink the rest.
        cloud = cloud.select(cloud.xyz[:, 2] <= np.quantile(cloud.xyz[:, 2], _NEAR_RATIO))
    return plot_scene(Scene(T_UPRIGHT_CAMERA, cloud), _MAX_POINTS)


@style.styled
def surface_figure(disparity: Disparity) -> bytes:
    """Draw the disparity map as a surface over the image, height = disparity; gaps stay open.

    Ref: Fig. 6 of the seed paper.
    """
    height, width = disparity.values.shape
    step = max(1, math.ceil(width / _SURFACE_COLUMNS))
    values = disparity.values[::step, ::step].astype(np.float64)
    rows, columns = np.mgrid[0:height:step, 0:width:step]
    limits = style.value_range(values)
    colours = style.colour_values(values, style.DISPARITY_SCALE, limits)
    figure = style.bare_figure(style.HALF_IN, 5.2)
    axes: Any = figure.add_axes((0.02, 0.02, 0.9, 0.98), projection="3d")
    faces = np.dstack([colours / 255.0, np.isfinite(values)])  # gaps are transparent
    look = {"rstride": 1, "cstride": 1, "linewidth": 0, "antialiased": False, "shade": False}
    axes.plot_surface(columns, rows, np.clip(values, *limits), facecolors=faces, **look)
    # Seen like the image: row 0 is far and on top.
    axes.set(xlabel="column (px)", ylabel="row (px)", zlabel="disparity (px)", ylim=(height, 0))
    axes.set_box_aspect((1.0, height / width, 0.45), zoom=1.0)
    axes.view_init(elev=55.0, azim=-72.0)
    return style.to_png(figure, f"A surface of heights {style.spread(values, ' px')}")


@style.styled
def depth_curve_figure(camera: RectifiedCamera, disparities_px: Float32) -> bytes:
    """Draw depth by disparity, with the true camera and that of Table 1; shade what occurs.

    Ref: Fig. 24-26 of the seed paper.
    """
    last = float(camera.ndisp or np.nanmax(disparities_px, initial=1.0))
    d = np.linspace(last / _CURVE_SAMPLES, last, _CURVE_SAMPLES)
    figure, axes = style.subplots(style.HALF_IN, 4.2)
    f, doffs = f"f = {camera.focal_px:.7g} px", f"doffs = {camera.doffs_px:.7g} px"
    look = {"linewidth": 2.2, "label": f"Z = f·b / (d + doffs), {f}, {doffs}"}
    axes.plot(d, depth_from_disparity(d, camera), color=style.ESTIMATE, **look)
    if camera.doffs_px > 0:
        believed = paper.camera_of_table_1(camera)
        look["label"] = f"as printed: Z = f·b / d, f = {believed.focal_px:.7g} px"
        axes.plot(d, depth_from_disparity(d, believed), color=style.BAD, **look)
    known = disparities_px[np.isfinite(disparities_px)]
    if known.size:
        low, high = np.percentile(known, (1.0, 99.0))
        look = {"color": style.FAINT, "alpha": 0.13, "linewidth": 0}
        axes.axvspan(low, high, label="disparities found", **look)
    axes.set(yscale="log", xlabel="disparity d (px)", ylabel="depth Z (m, logarithmic)")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    figure.legend(loc="outside lower center", fontsize=9)
    return style.to_png(figure)


@style.styled
def patches_figure(patches: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Draw the effect of the patch size: wrong pixels, mean error, pixels with a value."""
    panels = {
        f"off by more than {paper.BAD_PX:g} px (%)": "bad_percent",
        "mean error (px)": "avgerr_px",
        "pixels with a value (%)": "valid_percent",
    }
    figure, row = style.subplots(style.WIDE_IN, 3.8, columns=3)
    for axes, (label, name) in zip(row, panels.items(), strict=True):
        for method, tried in patches.items():
            known = [(one["patch_px"], one[name]) for one in tried if one[name] is not None]
            colour, dashes = _LINES[method]
            axes.plot(*np.reshape(known, (-1, 2)).T, dashes, color=colour, marker="o", markersize=4)
        if all(one[name] is None for tried in patches.values() for one in tried):
            style.write_note(axes, "no truth to compare with")
        axes.set(xlabel="patch (px)", ylabel=label, ylim=(0, None))
    titles = [paper.TITLES[name] for name in patches]
    figure.legend(row[-1].lines, titles, loc="outside lower center", ncols=3)
    return style.to_png(figure)
