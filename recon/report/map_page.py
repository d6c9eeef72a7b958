"""The report of a drive."""

from __future__ import annotations

import numpy as np

from recon.core.geometry.se3 import apply
from recon.map.drive.map_run import MapRun
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


def write_map_page(run: MapRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of a drive.

    Raises:
        OutputError: The file cannot be written.
    """
    write_page("map", directory, **map_content(run))


def map_content(run: MapRun) -> Json:
    """Return what the page of a drive shows: map and path first, then the data behind them."""
    sample = run.mapped.sample
    return {
        "run": run,
        "warnings": run.warnings,
        "figures": _figures(run),
        "view": _view(run),
        "sample": stereo_figures(sample.pair, sample.disparity),
    }


def _figures(run: MapRun) -> dict[str, bytes | None]:
    path, health, T_map_world = run.mapped.trajectory, run.mapped.health, run.mapped.T_map_world
    truth = None if run.truth is None else run.truth.trajectory
    drift = run.mapped.expected_drift
    radius_share = 0.0 if drift is None else drift.radius_share
    return {
        "grid": grid_figure(run.grid, {"path": seen_from_above(path, T_map_world)}),
        "path": path_figure(path, truth, T_map_world, health, radius_share),
        "loops": _loops(run),
        "drift": None if truth is None else drift_figure(path, truth, health),
        "health": health_figure(health) if health else None,
    }


def _loops(run: MapRun) -> bytes | None:
    loops = run.mapped.loops
    if loops is None or not loops.closure.closed:
        return None
    pairs = [(loop.first, loop.last) for loop in loops.closure.closed]
    return loops_figure(loops.odometry, loops.closure.trajectory, pairs, run.mapped.T_map_world)


def _view(run: MapRun) -> Json | None:
    drives = [("path", run.mapped.trajectory)]
    if run.truth is not None and run.truth.trajectory is not None:
        drives.append(("true path", run.truth.trajectory))
    paths = [
        (name, np.asarray(apply(run.mapped.T_map_world, path.positions_m))) for name, path in drives
    ]
    return plot_scene(Scene(np.eye(4), run.cloud, run.mesh, paths))
