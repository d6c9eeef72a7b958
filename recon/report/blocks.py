"""Parts shared by the reports of several commands."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from recon.core.geometry.triangulation import depth_from_disparity
from recon.core.values import Disparity, RectifiedPair, TrajectoryMetrics
from recon.report.figures import (
    confidence_figure,
    depth_figure,
    disparity_figure,
    is_wide,
    pair_figure,
    reasons_figure,
)
from recon.report.html import Block, FigureBlock, SceneBlock, TableBlock
from recon.report.plots import timing_figure
from recon.report.scene3d import Scene, plot_scene

# Key of the summary -> label and format of its figure.
FigureFormats = Mapping[str, tuple[str, str]]
_NOT_TABULATED: Final = frozenset({"stages", "warnings", "findings"})
_HOW_TO_TURN: Final = (
    "Drag to rotate, scroll to zoom, drag with the right button to pan; click in the legend to "
    "show or hide a part."
)


def known_figures(summary: Mapping[str, Any], formats: FigureFormats) -> list[tuple[str, str]]:
    """Label and text of each figure of ``formats`` that is a finite number in the summary."""
    return [
        (label, template.format(summary[key]))
        for key, (label, template) in formats.items()
        if is_number(summary.get(key))
    ]


def stereo_blocks(pair: RectifiedPair, disparity: Disparity) -> list[Block]:
    """A pair and the results for its pixels."""
    wide = is_wide(disparity.values.shape)
    share = f"{100 * disparity.valid.mean():.1f} %"
    depth_m = depth_from_disparity(disparity.values, pair.camera)
    return [
        FigureBlock(
            "Input pair", pair_figure(pair), "Rectified: a point is on the same row in both images."
        ),
        FigureBlock(
            "Disparity",
            disparity_figure(disparity, pair.camera),
            f"Red is near, blue is far, black is unknown; {share} of the pixels have a value.",
            wide,
        ),
        FigureBlock(
            "Depth", depth_figure(depth_m), "The same in metres along the optical axis.", wide
        ),
        FigureBlock(
            "Why pixels have no disparity",
            reasons_figure(disparity),
            "The first check that each pixel failed, with its share of all pixels.",
            wide,
        ),
        FigureBlock(
            "Confidence",
            confidence_figure(disparity),
            "Estimated probability that the match is correct.",
            wide,
        ),
    ]


def scene_blocks(scene: Scene, caption: str) -> list[Block]:
    """The 3-D view, or nothing if the scene is empty."""
    empty_cloud = scene.cloud is None or not len(scene.cloud)
    empty_mesh = scene.mesh is None or not len(scene.mesh.faces)
    if empty_cloud and empty_mesh:
        return []
    return [SceneBlock("In 3-D", plot_scene(scene), f"{caption} {_HOW_TO_TURN}")]


def run_blocks(summary: Mapping[str, Any]) -> list[Block]:
    """Timing, and every figure of the summary."""
    blocks: list[Block] = []
    stages = {
        name: float(s) for name, s in dict(summary.get("stages") or {}).items() if is_number(s)
    }
    if stages:
        caption = "Wall-clock time of each stage. Stages that run in parallel are all counted."
        blocks.append(FigureBlock("Time by stage", timing_figure(stages), caption, wide=False))
    rows = list(_rows(summary))
    if rows:
        blocks.append(TableBlock("All figures", ("figure", "value"), rows))
    return blocks


def metrics_table(metrics: TrajectoryMetrics) -> TableBlock:
    """Errors of a path compared with the true one."""
    lengths = ", ".join(f"{length:.3g}" for length in metrics.segment_lengths_m)
    return TableBlock(
        "Path against truth",
        ("figure", "value"),
        (
            ("relative translation error (t_rel)", f"{metrics.t_rel_percent:.3f} %"),
            ("relative rotation error (r_rel)", f"{metrics.r_rel_deg_per_100m:.3f} °/100 m"),
            ("absolute trajectory error (ATE)", f"{metrics.ate_m:.3f} m"),
            ("frame to frame, translation (RPE)", f"{metrics.rpe_m:.4f} m"),
            ("frame to frame, rotation (RPE)", f"{metrics.rpe_deg:.4f} °"),
            ("length of the true path", f"{metrics.path_length_m:.1f} m"),
            ("segments", f"{metrics.segments} of {lengths} m"),
        ),
    )


def is_number(value: Any) -> bool:
    """Whether a value of a summary is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _rows(summary: Mapping[Any, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    """Names and texts of a nested mapping, one row per leaf."""
    for key, value in summary.items():
        if not prefix and key in _NOT_TABULATED:
            continue
        if isinstance(value, Mapping):
            yield from _rows(value, f"{prefix}{key}.")
        elif isinstance(value, Sequence) and any(isinstance(item, Mapping) for item in value):
            yield from _rows(dict(enumerate(value)), f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", _text(value)


def _text(value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(_text(item) for item in value) or "none"
    return str(value)
