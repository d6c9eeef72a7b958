"""The report of a drive."""

from __future__ import annotations

import numpy as np

from recon.core.geometry.se3 import apply
from recon.export.map_run import MapRun
from recon.report.drive_figures import (
    drift_figure,
    grid_figure,
    health_figure,
    loops_figure,
    path_figure,
    seen_from_above,
)
from recon.report.page import write_page
from recon.report.pair_figures import stereo_figures
from recon.report.scene import Json, Scene, plot_scene
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
