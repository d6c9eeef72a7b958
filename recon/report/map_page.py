"""The reports of maps: of one drive, of several; and clouds coloured by their errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud
from recon.evaluation.map import nearest_distances
from recon.evaluation.map_comparison import MapComparison
from recon.export.joined import JoinedMap
from recon.export.map_run import MapRun
from recon.io.models.ply import write_ply
from recon.report.drive_figures import (
    drift_figure,
    grid_figure,
    health_figure,
    loops_figure,
    path_figure,
    seen_from_above,
)
from recon.report.page import write_page
from recon.report.pair_page import stereo_figures
from recon.report.scene import Json, Scene, plot_scene
from recon.report.style import ERROR_SCALE, colour_values
from recon.run.directory import RunDirectory


def write_map_page(result: MapRun, run: RunDirectory) -> None:
    """Write ``report.html`` of a drive."""
    write_page("map", run, **map_content(result))


def map_content(result: MapRun) -> Json:
    """Return what the page of a drive shows: map and path first, then the data behind them."""
    sample = result.mapped.sample
    return {
        "run": result,
        "warnings": result.warnings,
        "figures": _figures(result),
        "view": _view(result),
        "sample": stereo_figures(sample.pair, sample.disparity),
    }


def _figures(result: MapRun) -> dict[str, bytes | None]:
    path, health, T_map_world = (
        result.mapped.trajectory,
        result.mapped.health,
        result.mapped.T_map_world,
    )
    truth = None if result.truth is None else result.truth.trajectory
    drift = result.mapped.expected_drift
    radius_share = 0.0 if drift is None else drift.radius_share
    return {
        "grid": grid_figure(result.grid, {"path": seen_from_above(path, T_map_world)}),
        "path": path_figure(path, truth, T_map_world, health, radius_share),
        "loops": _loops(result),
        "drift": None if truth is None else drift_figure(path, truth, health),
        "health": health_figure(health) if health else None,
    }


def _loops(result: MapRun) -> bytes | None:
    loops = result.mapped.loops
    if loops is None or not loops.closure.closed:
        return None
    pairs = [(loop.first, loop.last) for loop in loops.closure.closed]
    return loops_figure(loops.odometry, loops.closure.trajectory, pairs, result.mapped.T_map_world)


def _view(result: MapRun) -> Json | None:
    drives = [("path", result.mapped.trajectory)]
    if result.truth is not None and result.truth.trajectory is not None:
        drives.append(("true path", result.truth.trajectory))
    paths = [
        (name, np.asarray(apply(result.mapped.T_map_world, path.positions_m)))
        for name, path in drives
    ]
    return plot_scene(Scene(np.eye(4), result.cloud, result.mesh, paths))


def write_joined_page(joined: JoinedMap, summary: dict[str, Any], run: RunDirectory) -> None:
    """Write ``report.html`` of a map of several drives: all paths on one grid."""
    T_map_world, made = joined.map.first.T_map_world, joined.made
    named = {f"session {number}": path for number, path in joined.paths.items()}
    from_above = {name: seen_from_above(path, T_map_world) for name, path in named.items()}
    ways = [(name, np.asarray(apply(T_map_world, p.positions_m))) for name, p in named.items()]
    write_page(
        "joined",
        run,
        run=summary,
        warnings=summary["warnings"],
        grid=grid_figure(made.grid, from_above),
        resolution_m=made.grid.resolution_m,
        view=plot_scene(Scene(np.eye(4), made.cloud, made.mesh, ways)),
    )


_SCALE_THRESHOLDS: Final = 2.0
"""The last colour of the scale corresponds to this multiple of the largest threshold."""


def write_map_errors(comparison: MapComparison, run: RunDirectory) -> None:
    """Write ``error.ply`` and ``missed.ply``, both in the axes of the reference.

    The first is the map, coloured by the distance of each point to the reference; the second is
    the reference, coloured by the distance to the map. ``quality`` is the distance in metres.
    """
    limit_m = _SCALE_THRESHOLDS * max(comparison.thresholds_m)
    cloud, reference = comparison.cloud, comparison.reference
    for name, points, others in (("error", cloud, reference), ("missed", reference, cloud)):
        distance_m = nearest_distances(points.xyz, others.xyz)
        rgb = colour_values(distance_m, ERROR_SCALE, (0.0, limit_m))
        coloured = replace(PointCloud(points.xyz, frame=points.frame), rgb=rgb)
        write_ply(run.path(f"{name}.ply"), coloured, quality=distance_m)
