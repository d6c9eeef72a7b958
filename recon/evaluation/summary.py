"""What comparisons with the truth found, and what the terminal says of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from recon.core.summary import Figures, Rows, RunSummary, Summary, inline, optional, shown_path
from recon.core.text import counted, metres
from recon.core.values import MapMetrics, OccupancyMetrics, TrajectoryMetrics, VoxelMetrics
from recon.core.values.arrays import Float64

ReferenceFrame = Literal["camera", "map"]


@dataclass(frozen=True, kw_only=True)
class TrajectoryEvaluation(RunSummary):
    """How a path differs from the true one."""

    metrics: TrajectoryMetrics = inline()
    T_truth_estimate: Float64  # (4, 4), or with a scale: what aligned the estimate
    rotation_deg: float  # root mean square over the poses
    roll: str  # whether the alignment fixes the roll
    associated: Literal["by time", "in order"]
    estimate_poses: int
    true_poses: int

    def rows(self) -> Rows:
        found = self.metrics
        ends = dict.fromkeys((min(found.segment_lengths_m), max(found.segment_lengths_m)))
        segments = f"segments of {' to '.join(f'{length_m:.3g}' for length_m in ends)} m"
        turned = f"{found.r_rel_deg_per_100m:.2g}°/100 m"
        worst = f"median {metres(found.ate_median_m)}, at most {metres(found.ate_max_m)}"
        path = f"{counted(found.frames, 'pose')}, {metres(found.path_length_m)} of path"
        again = "the same with --out FOLDER, for a report with plots"
        return [
            (f"{path}, compared {self.associated}, alignment {found.alignment}",),
            *self.folder_row(),
            ("drift", f"{found.t_rel_percent:.3g} %, {turned} ({segments})"),
            ("ATE", f"{metres(found.ate_m)} (RMS), {worst}"),
            ("RPE", f"{metres(found.rpe_m)}, {found.rpe_deg:.2g}° from frame to frame"),
            ("next", again if self.out is None else self.open_report()),
        ]


@dataclass(frozen=True, kw_only=True)
class Placement(Figures):
    """How a map was brought into the axes of its reference."""

    alignment: Literal["none", "poses"] = "none"
    path_moved_m: float | None = optional()
    path_turned_deg: float | None = optional()
    reference_frame: ReferenceFrame | None = optional()  # where ICP finds more
    icp_moved_m: float | None = optional()
    icp_turned_deg: float | None = optional()
    icp_ratio: float | None = optional()  # fraction of the points with a partner


@dataclass(frozen=True, kw_only=True)
class ThresholdFigures(Figures):
    """Errors of a map at one threshold; of the points within reach of the reference, too."""

    metrics: MapMetrics = inline()
    precision_in_reach: float | None = optional()
    f_score_in_reach: float | None = optional()


@dataclass(frozen=True, kw_only=True)
class MapEvaluation(RunSummary):
    """How a map differs from a reference cloud."""

    first: ThresholdFigures = inline()  # at the first threshold
    placement: Placement = inline()
    beyond_reach: float | None = optional()  # fraction of the points that the reference cannot have
    by_threshold: Sequence[ThresholdFigures]

    def rows(self) -> Rows:
        found = self.first.metrics
        shown = [
            (f"at {one.metrics.threshold_m:g} m", _precision(one)) for one in self.by_threshold[:2]
        ]
        beyond = self.beyond_reach
        far = "" if beyond is None else f", {100 * beyond:.0f} % beyond the reference"
        near = f"median {metres(found.median_m)}, 95 % within {metres(found.p95_m)}{far}"
        again = "the same with --out FOLDER, for clouds coloured by error"
        return [
            (f"{found.points:,} points compared with {found.reference_points:,} of the reference",),
            *self.folder_row(),
            ("distance", near),
            *shown,
            *([] if self.out is None else [("clouds", "error.ply, missed.ply, coloured by error")]),
            ("next", again if self.out is None else f"meshlab {shown_path(self.out, 'error.ply')}"),
        ]


def _precision(one: ThresholdFigures) -> str:
    found = one.metrics
    return (
        f"precision {100 * found.precision:.1f} %, recall {100 * found.recall:.1f} %, "
        f"F-score {100 * found.f_score:.1f} %"
    )


@dataclass(frozen=True, kw_only=True)
class DisparityEvaluation(Summary):
    """How a disparity map differs from the truth, with the measures of Middlebury and KITTI."""

    pixels: int
    invalid: float  # per cent of the pixels without a value
    sparse: Mapping[str, Any]  # errors of the pixels with a value, by name
    dense: Mapping[str, Any]  # with holes filled
    confidence: Mapping[str, Any] | None = optional()  # how well it predicts the errors

    def rows(self) -> Rows:
        rated = self.confidence
        rows: Rows = [
            (f"{self.pixels:,} pixels compared, {self.invalid:.1f} % without a value",),
            ("measured", _errors(self.sparse)),
            ("filled", _errors(self.dense)),
        ]
        if rated is not None:
            rows.append(("confidence", f"ECE {rated['ece']:.3f}, AUSE {rated['ause']:.3f}"))
        return [*rows, ("next", "the same with --json or --verbose, for all figures")]


def _errors(found: Mapping[str, Any]) -> str:
    bad = f"{found['bad']['2']:.1f} % off by > 2 px"
    return f"mean error {found['avgerr']:.2f} px, {bad}, D1 {found['d1']:.1f} %"


@dataclass(frozen=True, kw_only=True)
class OccupancyEvaluation(RunSummary):
    """How occupancy differs from the truth."""

    metrics: OccupancyMetrics = inline()

    def rows(self) -> Rows:
        found, cell = self.metrics, f"{self.metrics.resolution_m:g} m"
        voxels, exact, grid = found.voxels, found.voxels_exact, found.grid
        seen = f"that {counted(found.least_frames, 'frame')} or more saw"
        ious = f"IoU of occupied {_percent(grid.iou_occupied)}, of free {_percent(grid.iou_free)}"
        return [
            (f"{voxels.voxels:,} voxels of {cell} compared, {seen}",),
            ("voxels", f"{_found(voxels)}, within a cell"),
            ("exactly", _found(exact)),
            ("grid", ious),
            ("missed", f"{_percent(grid.occupied_called_free)} of what is occupied is called free"),
            ("next", "the same with --picture FILE.png, for the grid with its errors"),
        ]


def _found(voxels: VoxelMetrics) -> str:
    return f"precision {_percent(voxels.precision)}, recall {_percent(voxels.recall)}"


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.1f} %"
