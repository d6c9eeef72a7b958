"""The report of a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.values import (
    Disparity,
    OccupancyGrid,
    PointCloud,
    RectifiedPair,
    Trajectory,
    TrajectoryMetrics,
    TriangleMesh,
)
from recon.core.values.arrays import Float64
from recon.map.drive_loops import DriveLoops
from recon.odometry.protocol import OdometryHealth
from recon.report.blocks import (
    FigureFormats,
    known_figures,
    metrics_table,
    run_blocks,
    scene_blocks,
    stereo_blocks,
)
from recon.report.html import Block, FigureBlock, ReportContent, Section, TableBlock
from recon.report.plots import (
    grid_figure,
    health_figure,
    loops_figure,
    path_error_figure,
    trajectory_figure,
)
from recon.report.scene3d import Scene

_MAX_NOTES: Final = 20
_NOTES_CAPTION: Final = (
    "Why a correction by ICP was not applied (usual where the visual estimate is good), or why a "
    "pose is not trusted."
)
_FIGURES: Final[FigureFormats] = MappingProxyType(
    {
        "fps": ("Mapping rate", "{:.1f} fps"),
        "seconds": ("Run time", "{:.1f} s"),
        "peak_memory_mb": ("Peak memory", "{:,.0f} MB"),
        "field_of_view_deg": ("Field of view of the rectified images", "{:.0f}°"),
        "points": ("Points in the map", "{:,}"),
        "faces": ("Triangles", "{:,}"),
    }
)

_OCCUPANCY_ROWS: Final = (
    ("occupied voxels, precision", "voxels", "precision"),
    ("occupied voxels, recall", "voxels", "recall"),
    ("occupied cells of the grid, intersection over union", "grid", "iou_occupied"),
    ("free cells of the grid, intersection over union", "grid", "iou_free"),
    ("occupied cells that the grid calls free", "grid", "occupied_called_free"),
)


@dataclass(frozen=True, eq=False)
class MapReportInputs:
    """Inputs of the report of a drive; None = the run does not have it.

    Attributes:
        source: Name of the source for the user.
        trajectory: The estimated path.
        T_map_world: float64 (4, 4), from world to map axes (x forward, z up).
        samples: One or a few pairs with their disparities.
        health: One record per frame.
        truth: True path in the same world.
        metrics: Comparison of the two paths.
        grid: The occupancy grid.
        cloud: The fused cloud, frame ``map``.
        mesh: The surface, map axes.
        summary: The content of ``summary.json``.
        command: The command line, or "".
        config: The effective configuration as text.
        loops: Result of the loop closure.
        warnings: Warnings of the run.
        versions: Versions of the packages used.
    """

    source: str
    trajectory: Trajectory
    T_map_world: Float64
    samples: Sequence[tuple[RectifiedPair, Disparity]] = ()
    health: Sequence[OdometryHealth] = ()
    truth: Trajectory | None = None
    metrics: TrajectoryMetrics | None = None
    grid: OccupancyGrid | None = None
    cloud: PointCloud | None = None
    mesh: TriangleMesh | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    command: str = ""
    config: str = ""
    loops: DriveLoops | None = None
    warnings: Sequence[str] = ()
    versions: Mapping[str, str] = field(default_factory=dict)


def map_report(inputs: MapReportInputs) -> ReportContent:
    """Compose the report of a drive: map and path first, then the data behind them."""
    sections = [
        Section("Map", _map_blocks(inputs)),
        Section("Path", _path_blocks(inputs)),
        *(
            Section(f"Stereo, frame {pair.index}", stereo_blocks(pair, disparity))
            for pair, disparity in inputs.samples
        ),
        Section("Run", run_blocks(inputs.summary)),
    ]
    length = f"{inputs.trajectory.path_length_m:.1f} m"
    return ReportContent(
        title=f"Map of {inputs.source}",
        subtitle=f"{len(inputs.trajectory)} frames, {length} of path",
        command=inputs.command,
        warnings=inputs.warnings,
        figures=_figures(inputs),
        sections=sections,
        config=inputs.config,
        versions=inputs.versions,
    )


def _figures(inputs: MapReportInputs) -> list[tuple[str, str]]:
    figures: list[tuple[str, str]] = [("Path", f"{inputs.trajectory.path_length_m:.1f} m")]
    if inputs.metrics is not None:
        figures.append(("Drift (t_rel)", f"{inputs.metrics.t_rel_percent:.2f} %"))
        figures.append(("Position error (ATE)", f"{inputs.metrics.ate_m:.2f} m"))
    if inputs.health:
        lost = sum(not record.ok for record in inputs.health)
        figures.append(("Frames not trusted", f"{lost} of {len(inputs.health)}"))
    if inputs.loops is not None and inputs.loops.found:
        moved = f"{float(inputs.loops.corrections_m.max()):.2f} m"
        closed = f"{len(inputs.loops.closure.closed)} of {inputs.loops.found}"
        figures.append(("Loops closed, path moved by", f"{closed}, {moved}"))
    return figures + known_figures(inputs.summary, _FIGURES)


def _map_blocks(inputs: MapReportInputs) -> list[Block]:
    paths = [("path", _in_map_axes(inputs.trajectory, inputs.T_map_world))]
    if inputs.truth is not None:
        paths.append(("true path", _in_map_axes(inputs.truth, inputs.T_map_world)))
    scene = Scene(np.eye(4), inputs.cloud, inputs.mesh, paths)
    blocks = scene_blocks(
        scene, "The fused point cloud in the map frame, with the path of the camera."
    )
    if inputs.grid is not None:
        caption = (
            f"Seen from above, cells of {inputs.grid.resolution_m:g} m; "
            "the line is the path of the camera."
        )
        figure = grid_figure(inputs.grid, inputs.trajectory, inputs.T_map_world)
        blocks.append(FigureBlock("Occupancy grid", figure, caption))
    return blocks + _occupancy_table(inputs.summary.get("occupancy"))


def _occupancy_table(found: Mapping[str, Any] | None) -> list[Block]:
    """Voxels and grid compared with ground truth, if it is known."""
    if not found:
        return []
    rows = [
        (label, *(_share(found[part + end].get(key)) for end in ("", "_exact")))
        for label, part, key in _OCCUPANCY_ROWS
    ]
    caption = (
        f"Of what at least {found['least_frames']} frames saw, in cells of "
        f"{found['resolution_m']:g} m. Shares: 1 is best, for the last row 0."
    )
    head = ("figure", "within one cell", "exact cell")
    return [TableBlock("Occupancy against truth", head, rows, caption)]


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"


def _in_map_axes(path: Trajectory, T_map_world: Float64) -> Float64:
    return np.asarray(apply(T_map_world, path.positions_m))


def _path_blocks(inputs: MapReportInputs) -> list[Block]:
    drawn = trajectory_figure(inputs.trajectory, inputs.truth, inputs.T_map_world, inputs.health)
    blocks: list[Block] = [
        FigureBlock("Path from above", drawn, "In the map frame; both axes have the same scale.")
    ]
    if inputs.loops is not None and inputs.loops.closure.closed:
        blocks.append(_loops_block(inputs.loops, inputs.T_map_world))
    if inputs.truth is not None:
        error = path_error_figure(inputs.trajectory, inputs.truth, inputs.health)
        caption = "Both paths start at the same pose, so this is the accumulated drift."
        blocks.append(FigureBlock("Error along the path", error, caption))
    if inputs.health:
        caption = "What each pose is based on; frames whose pose is not trusted are shaded red."
        blocks.append(FigureBlock("Health of the odometry", health_figure(inputs.health), caption))
    return blocks + _tables(inputs)


def _loops_block(loops: DriveLoops, T_map_world: Float64) -> Block:
    closed = loops.closure.closed
    pairs = [(loop.first, loop.last) for loop in closed]
    drawn = loops_figure(loops.odometry, loops.closure.trajectory, pairs, T_map_world)
    moved = f"{float(loops.corrections_m.max()):.2f} m"
    caption = (
        f"{len(closed)} loops were closed, with {loops.keyframes} keyframes. That moved the path "
        f"by up to {moved}. Each red line joins the two positions that odometry gave to one place."
    )
    return FigureBlock("Loops", drawn, caption)


def _tables(inputs: MapReportInputs) -> list[Block]:
    tables: list[Block] = []
    if inputs.metrics is not None:
        tables.append(metrics_table(inputs.metrics))
    notes = [
        (str(frame), "; ".join(record.notes) or "no measurement")
        for frame, record in enumerate(inputs.health)
        if record.notes or not record.ok
    ]
    if notes:
        shown = notes[:_MAX_NOTES]
        first = f" The first {len(shown)} of {len(notes)}." if len(notes) > len(shown) else ""
        caption = f"{_NOTES_CAPTION}{first}"
        tables.append(TableBlock("Notes of the odometry", ("frame", "note"), shown, caption))
    return tables
