"""The report of the seed paper's experiments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from recon.commands.config import dump_config
from recon.commands.paper import ExperimentResult, PaperRun
from recon.core.errors import CalibrationError
from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud, RectifiedCamera
from recon.evaluation.paper.methods import AS_PRINTED, CORRECTED, TITLES, MethodResult, PatchFigure
from recon.evaluation.paper.scenes import camera_of_table_1
from recon.report.blocks import run_blocks
from recon.report.figures import (
    depth_figure,
    disparity_figure,
    error_figure,
    is_wide,
    pair_figure,
)
from recon.report.html import (
    Block,
    FigureBlock,
    ReportContent,
    SceneBlock,
    Section,
    TableBlock,
)
from recon.report.paper_figures import depth_curve_figure, patches_figure, surface_figure
from recon.report.scene3d import T_UPRIGHT_CAMERA, Scene, plot_scene
from recon.run.machine import versions

_ERROR_LIMIT_PX: Final = 4.0
_MAX_POINTS: Final = 20_000
_NEAR_SHARE: Final = 0.9
_LOOK_FROM: Final = (-1.15, 0.4, 0.4)  # relative to the centre of a cloud, in its longest side
_UNKNOWN: Final = "–"
_TABLE_1_HEADER: Final = (
    "",
    "focal length, as printed",
    "baseline",
    "disparities",
    "true focal length",
    "doffs",
    "depth error of the printed row",
)


def paper_report(run: PaperRun, command: str = "") -> ReportContent:
    """Compose the report: Table 1, then each experiment with all its methods."""
    tried = "the corrected method"
    if run.config.paper.as_printed:
        tried = "the method as printed beside the corrected one"
    sections = [
        Section("Table 1", [_table_1(run)]),
        *(_experiment_section(result, run.config.paper.bad_px) for result in run.experiments),
        Section("Run", run_blocks(_of_the_run(run))),
    ]
    return ReportContent(
        title="Experiments 2 to 4 of the paper",
        subtitle=f"Middlebury scenes of {run.folder.name or run.folder}; {tried}",
        command=command,
        warnings=run.warnings,
        figures=_figures(run),
        sections=sections,
        config=dump_config(run.config, "paper"),
        versions=versions(),
    )


def _of_the_run(run: PaperRun) -> dict[str, object]:
    """The part of the summary about the run itself; experiments have their own sections."""
    return {k: v for k, v in run.summary.items() if k not in {"experiments", "table_1"}}


def _figures(run: PaperRun) -> list[tuple[str, str]]:
    """Depth error of each experiment, with the corrected and the last method."""
    figures = []
    for result in run.experiments:
        for one in dict.fromkeys((result.methods[0], result.methods[-1])):
            if one.depth is not None:
                label = f"{result.experiment.scene}: median depth error, {TITLES[one.method]}"
                figures.append((label, f"{one.depth.median_error_percent:.2f} %"))
    return figures


def _table_1(run: PaperRun) -> TableBlock:
    rows = []
    for result in run.experiments:
        row, error = result.experiment.table_1, result.table_1_depth_error_percent
        rows.append(
            (
                f"{row.experiment} {row.scene}",
                f"{row.doffs_px:.7g}",
                f"{row.baseline_mm:.7g} mm",
                _UNKNOWN if row.ndisp is None else str(row.ndisp),
                f"{row.focal_px:.7g} px",
                f"{row.doffs_px:.7g} px",
                _UNKNOWN if error is None else f"{error:.1f} %",
            )
        )
    caption = (
        "Read from the scenes' calib.txt. The printed column of focal lengths is doffs, the "
        "difference of the principal points. The last column is the "
        "median error that the printed row alone makes: with the true disparities."
    )
    return TableBlock("As printed, and corrected", _TABLE_1_HEADER, rows, caption, wide=True)


def _experiment_section(result: ExperimentResult, bad_px: float) -> Section:
    camera = result.experiment.camera
    blocks: list[Block] = [
        FigureBlock(
            "Input pair",
            pair_figure(result.methods[0].pair),
            "Rectified: a point is on the same row in both images.",
        ),
        _methods_table(result),
    ]
    for one in result.methods:
        blocks += _map_blocks(result, one)
    blocks.append(
        FigureBlock(
            "The effect of the patch size",
            patches_figure(result.patches, bad_px),
            "Against the truth, at pixels seen by both cameras; the last panel counts all pixels. "
            "Shares are of all compared pixels, with or without a value. Corrected: the matcher "
            "sad with a window of that size and its checks, which reject doubtful pixels.",
        )
    )
    blocks.append(_curve_block(result))
    blocks += [_patches_table(name, figures, bad_px) for name, figures in result.patches.items()]
    blocks += [_scene_block(one) for one in _worth_turning(result)]
    intro = (
        f"{camera.width_px} × {camera.height_px} px, focal length {camera.focal_px:.7g} px, "
        f"baseline {1000 * camera.baseline_m:.7g} mm, doffs {camera.doffs_px:.7g} px"
    )
    return Section(result.experiment.title, blocks, intro)


def _methods_table(result: ExperimentResult) -> TableBlock:
    header = (
        "method",
        "pixels with a value",
        "off by more than 1 px",
        "mean error",
        "median depth",
        "true median depth",
        "median depth error",
    )
    rows = [_method_row(one) for one in result.methods]
    caption = (
        "Against the truth at pixels seen by both cameras; errors are those of the pixels where "
        "a method has a value. Limits in pixels of this size."
    )
    return TableBlock("The methods side by side", header, rows, caption, wide=True)


def _method_row(one: MethodResult) -> tuple[str, ...]:
    valid = f"{100 * float(one.disparity.valid.mean()):.1f} %"
    metrics, depth = one.metrics, one.depth
    of_disparity = (_UNKNOWN, _UNKNOWN)
    if metrics is not None:
        of_disparity = (f"{metrics.bad[1.0]:.1f} %", f"{metrics.avgerr_px:.2f} px")
    of_depth = (_UNKNOWN, _UNKNOWN, _UNKNOWN)
    if depth is not None:
        of_depth = (
            f"{depth.median_m:.3f} m",
            f"{depth.true_median_m:.3f} m",
            f"{depth.median_error_percent:.2f} %",
        )
    return (TITLES[one.method], valid, *of_disparity, *of_depth)


def _map_blocks(result: ExperimentResult, one: MethodResult) -> list[Block]:
    """Disparity, depth, error and surface of one method."""
    title, wide = TITLES[one.method], is_wide(one.disparity.values.shape)
    blocks: list[Block] = [
        FigureBlock(
            f"Disparity map, {title}",
            disparity_figure(one.disparity, one.pair.camera),
            "Red is near, black is unknown.",
            wide,
        ),
        FigureBlock(
            f"Depth map, {title}", depth_figure(one.depth_m), "Metres along the optical axis.", wide
        ),
        FigureBlock(
            f"Disparity as a surface, {title}",
            surface_figure(one.disparity),
            "Fig. 6's kind of view: the picture lies flat, the disparity is its height.",
            wide=False,
        ),
    ]
    if result.experiment.truth is not None:
        error = np.abs(one.disparity.values - result.experiment.truth.values)
        caption = f"Blue is right, red is off by {_ERROR_LIMIT_PX:g} pixels or more."
        figure = error_figure(error, _ERROR_LIMIT_PX)
        blocks.append(FigureBlock(f"Disparity error, {title}", figure, caption, wide))
    return blocks


def _curve_block(result: ExperimentResult) -> FigureBlock:
    camera = result.experiment.camera
    found = result.methods[0].disparity.values
    return FigureBlock(
        "Depth against disparity",
        depth_curve_figure(camera, believed_camera(camera), found),
        "Fig. 24-26's kind of curve. With doffs for the focal length, and none added to d, both "
        "scale and shape are wrong.",
        wide=False,
    )


def believed_camera(camera: RectifiedCamera) -> RectifiedCamera | None:
    """The camera according to Table 1, or None if doffs cannot be a focal length."""
    try:
        return camera_of_table_1(camera)
    except CalibrationError:
        return None


def _patches_table(method: str, figures: Sequence[PatchFigure], bad_px: float) -> TableBlock:
    header = ("patch", "with a value", f"right within {bad_px:g} px", "wrong", "mean error")
    rows = [
        (
            f"{one.patch_px} px",
            _percent(one.valid_percent),
            _percent(one.right_percent),
            _percent(one.bad_percent),
            _UNKNOWN if one.avgerr_px is None else f"{one.avgerr_px:.2f} px",
        )
        for one in figures
    ]
    return TableBlock(f"Patches, {TITLES[method]}", header, rows)


def _percent(value: float | None) -> str:
    return _UNKNOWN if value is None else f"{value:.1f} %"


def _worth_turning(result: ExperimentResult) -> list[MethodResult]:
    """The corrected result, and that of the printed geometry with absolute differences."""
    return [one for one in result.methods if one.method != AS_PRINTED and len(one.cloud)]


def _scene_block(one: MethodResult) -> SceneBlock:
    cloud = one.cloud
    caption = "Seen from the side of the left camera, turned so that z is up. Drag to turn."
    if one.method != CORRECTED:
        # Integer disparities near 0 give layers far behind everything, which would shrink the rest.
        cloud = cloud.select(cloud.xyz[:, 2] <= np.quantile(cloud.xyz[:, 2], _NEAR_SHARE))
        caption += f" The farthest {1 - _NEAR_SHARE:.0%} of the points are left out here."
    scene = Scene(T_UPRIGHT_CAMERA, cloud, eye_m=_beside_camera(cloud))
    return SceneBlock(f"Point cloud, {TITLES[one.method]}", plot_scene(scene, _MAX_POINTS), caption)


def _beside_camera(cloud: PointCloud) -> tuple[float, float, float]:
    """A viewpoint that shows the whole cloud, view axes: slightly left of and above the camera."""
    low, high = np.quantile(apply(T_UPRIGHT_CAMERA, cloud.xyz), (0.01, 0.99), axis=0)
    x, y, z = ((low + high) / 2 + float((high - low).max()) * np.array(_LOOK_FROM)).tolist()
    return x, y, z
