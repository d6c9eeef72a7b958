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
from recon.report.page import run_section, write_page
from recon.report.scene import upright_scene
from recon.report.sections import Block, Image, Page, Section, Table, View3D, at, known, row_of
from recon.run.directory import RunDirectory

_MAX_POINTS: Final = 20_000
_NEAR_FRACTION: Final = 0.9
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
    experiments = summary["experiments"]
    figures = [
        (
            f"{found['scene']}: median depth error, {paper.TITLES[method]}",
            known("{:.2f} %", at(found["methods"][method], "depth", "median_error_percent")),
        )
        for found in experiments.values()
        # With the corrected method, and with the last.
        for method in (paper.CORRECTED, [*found["methods"]][-1])
    ]
    sections = [
        Section("Table 1", [_table_1(summary["table_1"])]),
        *(_experiment(one, methods, experiments[str(one.number)]) for one, methods in results),
        # Experiments have their own sections.
        run_section({k: v for k, v in summary.items() if k not in {"experiments", "table_1"}}),
    ]
    both = "the method as printed beside the corrected one"
    ways = both if summary["as_printed"] else "the corrected method"
    subtitle = f"Middlebury scenes of {folder.name or folder}; {ways}"
    title = "Experiments 2 to 4 of the paper"
    write_page(Page(title, subtitle, figures, sections, summary), run)


def _table_1(rows: Sequence[Mapping[str, Any]]) -> Table:
    head = (
        "", "focal length, as printed", "baseline", "disparities", "true focal length", "doffs",
        "depth error of the printed row",
    )  # fmt: skip
    columns = (
        ("{:.7g}", "printed", "focal_length"),
        ("{:.7g} mm", "printed", "baseline_mm"),
        ("{:d}", "printed", "ndisp"),
        ("{:.7g} px", "corrected", "focal_px"),
        ("{:.7g} px", "corrected", "doffs_px"),
        ("{:.1f} %", "depth_error_of_printed_percent"),
    )
    shown = [row_of(f"{row['experiment']} {row['scene']}", row, columns) for row in rows]
    caption = (
        "Read from the scenes' calib.txt. The printed column of focal lengths is doffs, the "
        "difference of the principal points. The last column is the median error that the printed "
        "row alone makes: with the true disparities."
    )
    return Table("As printed, and corrected", head, shown, caption=caption)


def _experiment(
    one: paper.Experiment, methods: Sequence[paper.MethodResult], found: Mapping[str, Any]
) -> Section:
    """Return an experiment: pair, methods beside each other, effect of the patch size, clouds."""
    camera = one.camera
    intro = (
        f"{camera.width_px} × {camera.height_px} px, focal length {camera.focal_px:.7g} px, "
        f"baseline {1000 * camera.baseline_m:.7g} mm, doffs {camera.doffs_px:.7g} px"
    )
    patches, values = found["patches"], methods[0].disparity.values
    blocks: list[Block] = [
        pair_page.pair_image(methods[0].pair),
        _method_table(found["methods"]),
        *(image for each in methods for image in _method_images(one, each)),
        Image("The effect of the patch size", patches_figure(patches),
              "Against the truth, at pixels seen by both cameras; the last panel counts all "
              "pixels. Percentages are of all compared pixels, with or without a value. "
              "Corrected: the matcher sad with a window of that size and its checks, which reject "
              "doubtful pixels."),
        Image("Depth against disparity", depth_curve_figure(camera, values),
              "Fig. 24-26's kind of curve. With doffs for the focal length, and none added to d, "
              "both scale and shape are wrong."),
        *(_patch_table(method, tried) for method, tried in patches.items()),
        # The cloud of the method as printed is not worth turning.
        *(_view(each) for each in methods if each.method != paper.AS_PRINTED),
    ]  # fmt: skip
    return Section(f"Experiment {one.number}: {found['scene']}", blocks, intro)


def _method_table(methods: Mapping[str, Any]) -> Table:
    head = (
        "method", "pixels with a value", "off by more than 1 px", "mean error", "median depth",
        "true median depth", "median depth error",
    )  # fmt: skip
    columns = (
        ("{:.1f} %", "valid_percent"),
        ("{:.1f} %", "disparity", "bad", "1.0"),
        ("{:.2f} px", "disparity", "avgerr_px"),
        ("{:.3f} m", "depth", "median_m"),
        ("{:.3f} m", "depth", "true_median_m"),
        ("{:.2f} %", "depth", "median_error_percent"),
    )
    rows = [row_of(paper.TITLES[method], one, columns) for method, one in methods.items()]
    caption = (
        "Against the truth at pixels seen by both cameras; errors are those of the pixels where a "
        "method has a value. Limits in pixels of this size."
    )
    return Table("The methods side by side", head, rows, caption=caption)


def _patch_table(method: str, tried: Sequence[Mapping[str, Any]]) -> Table:
    columns = {
        "with a value": ("{:.1f} %", "valid_percent"),
        f"right within {paper.BAD_PX:g} px": ("{:.1f} %", "right_percent"),
        "wrong": ("{:.1f} %", "bad_percent"),
        "mean error": ("{:.2f} px", "avgerr_px"),
    }
    rows = [row_of(f"{one['patch_px']} px", one, columns.values()) for one in tried]
    return Table(f"Patches, {paper.TITLES[method]}", ("patch", *columns), rows)


def _method_images(one: paper.Experiment, result: paper.MethodResult) -> list[Image]:
    """Return disparity, depth, surface and error of one method."""
    values, truth, title = result.disparity.values, one.truth, paper.TITLES[result.method]
    error = None if truth is None else pair_page.error_figure(np.abs(values - truth.values))
    return [
        Image(f"Disparity map, {title}",
              pair_page.disparity_figure(result.disparity, result.pair.camera),
              "Red is near, black is unknown."),
        Image(f"Depth map, {title}", pair_page.depth_figure(result.depth_m),
              "Metres along the optical axis."),
        Image(f"Disparity as a surface, {title}", surface_figure(result.disparity),
              "Fig. 6's kind of view: the image lies flat, the disparity is its height."),
        Image(f"Disparity error, {title}", error, pair_page.ERROR_CAPTION),
    ]  # fmt: skip


def _view(result: paper.MethodResult) -> View3D:
    cloud, caption = result.cloud, "Turned so that z is up."
    if result.method != paper.CORRECTED:
        caption += f" The farthest {1 - _NEAR_FRACTION:.0%} of the points are left out here."
    if len(cloud) and result.method != paper.CORRECTED:
        # Integer disparities near 0 give layers far behind everything, which would shrink the rest.
        cloud = cloud.select(cloud.xyz[:, 2] <= np.quantile(cloud.xyz[:, 2], _NEAR_FRACTION))
    title = f"Point cloud, {paper.TITLES[result.method]}"
    return View3D(title, upright_scene(cloud), caption, _MAX_POINTS)


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
    found_px = disparities_px[np.isfinite(disparities_px)]
    if found_px.size:
        low, high = np.percentile(found_px, (1.0, 99.0))
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
