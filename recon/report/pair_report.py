"""The report of one pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from recon.core.geometry.triangulation import depth_from_disparity
from recon.core.values import (
    Disparity,
    DisparityMetrics,
    DisparityTruth,
    PointCloud,
    RectifiedPair,
    TriangleMesh,
)
from recon.report.blocks import (
    FigureFormats,
    known_figures,
    run_blocks,
    scene_blocks,
    stereo_blocks,
)
from recon.report.figures import error_figure, is_wide
from recon.report.html import Block, FigureBlock, ReportContent, Section, TableBlock
from recon.report.scene3d import T_UPRIGHT_CAMERA, Scene

ERROR_LIMIT_PX: Final = 4.0
_FIGURES: Final[FigureFormats] = MappingProxyType(
    {
        "seconds": ("Run time", "{:.2f} s"),
        "points": ("Points", "{:,}"),
        "faces": ("Triangles", "{:,}"),
        "mesh_coverage": ("Points on the mesh", "{:.1%}"),
        "peak_memory_mb": ("Peak memory", "{:,.0f} MB"),
    }
)


@dataclass(frozen=True, eq=False)
class PairReportInputs:
    """Inputs of the report of one pair; None = the run does not have it.

    Attributes:
        source: Name of the pair for the user.
        pair: The rectified pair.
        disparity: The estimated disparity.
        truth: True disparity of the left image.
        metrics: Comparison of the two.
        cloud: The points, frame ``camera``.
        mesh: The surface, frame ``camera``.
        summary: The content of ``summary.json``.
        command: The command line, or "".
        config: The effective configuration as text.
        warnings: Warnings of the run.
        versions: Versions of the packages used.
    """

    source: str
    pair: RectifiedPair
    disparity: Disparity
    truth: DisparityTruth | None = None
    metrics: DisparityMetrics | None = None
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    command: str = ""
    config: str = ""
    warnings: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict)


def pair_report(inputs: PairReportInputs) -> ReportContent:
    """Compose the report of one pair: disparity, accuracy and 3-D view."""
    camera = inputs.pair.camera
    scene = Scene(T_UPRIGHT_CAMERA, inputs.cloud, inputs.mesh, eye_m=_beside_camera(inputs))
    sections = (
        Section("Disparity", stereo_blocks(inputs.pair, inputs.disparity)),
        Section("Against the truth", _truth_blocks(inputs)),
        Section("Cloud", scene_blocks(scene, "Seen from the left camera, turned so that z is up.")),
        Section("Run", run_blocks(inputs.summary)),
    )
    return ReportContent(
        title=f"Stereo pair {inputs.source}",
        subtitle=(
            f"{camera.width_px} × {camera.height_px} px, focal length {camera.focal_px:.1f} px "
            f"({camera.field_of_view_deg:.0f}° wide), {_baseline(inputs)}, "
            f"doffs {camera.doffs_px:.4g} px"
        ),
        command=inputs.command,
        warnings=inputs.warnings,
        figures=_figures(inputs),
        sections=sections,
        config=inputs.config,
        versions=inputs.versions,
    )


def _baseline(inputs: PairReportInputs) -> str:
    if inputs.summary.get("up_to_scale"):
        return "baseline unknown: every m in this report is one baseline"
    return f"baseline {inputs.pair.camera.baseline_m:.4g} m"


def _beside_camera(inputs: PairReportInputs) -> tuple[float, float, float]:
    """A viewpoint slightly behind, left of and above the camera, from which depth is visible."""
    depth_m = depth_from_disparity(inputs.disparity.values, inputs.pair.camera)
    known = depth_m[np.isfinite(depth_m)]
    far = float(np.median(known)) if known.size else 1.0
    return (-0.1 * far, 0.25 * far, 0.25 * far)


def _figures(inputs: PairReportInputs) -> list[tuple[str, str]]:
    figures = [("Pixels with a disparity", f"{100 * inputs.disparity.valid.mean():.1f} %")]
    if inputs.metrics is not None:
        figures.append(("Mean error", f"{inputs.metrics.avgerr_px:.2f} px"))
        figures += [
            (f"Off by more than {t:g} px", f"{b:.1f} %") for t, b in inputs.metrics.bad.items()
        ]
    return figures + known_figures(inputs.summary, _FIGURES)


def _truth_blocks(inputs: PairReportInputs) -> list[Block]:
    blocks: list[Block] = []
    if inputs.truth is not None and inputs.truth.values.shape == inputs.disparity.values.shape:
        error = np.abs(inputs.disparity.values - inputs.truth.values)
        caption = f"Blue is right, red is off by {ERROR_LIMIT_PX:g} pixels or more."
        blocks.append(
            FigureBlock(
                "Disparity error",
                error_figure(error, ERROR_LIMIT_PX),
                caption,
                is_wide(error.shape),
            )
        )
    if inputs.metrics is not None:
        blocks.append(_metrics_table(inputs.metrics))
    return blocks


def _metrics_table(metrics: DisparityMetrics) -> TableBlock:
    rows = [(f"off by more than {t:g} px", f"{share:.2f} %") for t, share in metrics.bad.items()]
    rows += [
        ("without a value", f"{metrics.invalid:.2f} %"),
        ("mean absolute error", f"{metrics.avgerr_px:.3f} px"),
        ("root mean square error", f"{metrics.rms_px:.3f} px"),
        ("pixels compared", f"{metrics.pixels:,}"),
    ]
    return TableBlock("Disparity against truth", ("figure", "value"), rows)
