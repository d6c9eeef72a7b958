"""The reports of maps: of one drive, of several; and clouds coloured by their errors."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud, Trajectory
from recon.core.values.arrays import Float64
from recon.evaluation.drive_errors import DriveErrors
from recon.evaluation.map import nearest_distances
from recon.evaluation.map_comparison import MapComparison
from recon.export.make import Products
from recon.io.models.ply import write_ply
from recon.map.store.map_file import MapFile
from recon.map.store.session import Session
from recon.odometry.health import expected_drift
from recon.report import style
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
from recon.run.directory import RunDirectory
from recon.stereo.frame import ReconstructedFrame


def write_map_page(
    map_: MapFile,
    made: Products,
    errors: DriveErrors,
    sample: ReconstructedFrame,
    summary: Json,
    run: RunDirectory,
) -> None:
    """Write ``report.html`` of a map of one drive, with a frame of it in full."""
    write_page("map", run, summary, **map_content(map_, made, errors, sample))


def map_content(
    map_: MapFile, made: Products, errors: DriveErrors, sample: ReconstructedFrame
) -> Json:
    """Return what the page of a drive shows: map and path first, then the data behind them."""
    session, truth = map_.first, errors.true_path
    path, health, T_map_world = session.trajectory, session.health, session.T_map_world
    drift = expected_drift(path, health, session.camera)
    radius_share = 0.0 if drift is None else drift.radius_share
    true_path = {} if truth is None else {"true path": truth}
    return {
        **_map_content(made, {"path": path}, true_path, T_map_world),
        "path": path,
        "health": health,
        "metrics": errors.path,
        "figures": {
            "path": path_figure(path, truth, T_map_world, health, radius_share),
            "loops": _loops(session),
            "drift": None if truth is None else drift_figure(path, truth, health),
            "health": health_figure(health) if health else None,
        },
        "sample": stereo_figures(sample.pair, sample.disparity),
        "sample_frame": sample.pair.index,
    }


def write_joined_page(map_: MapFile, made: Products, summary: Json, run: RunDirectory) -> None:
    """Write ``report.html`` of a map of several drives: all paths on one grid."""
    paths = {f"session {number}": path for number, path in map_.paths.items()}
    write_page("joined", run, summary, **_map_content(made, paths, {}, map_.first.T_map_world))


def _map_content(
    made: Products,
    paths: dict[str, Trajectory],
    only_in_3d: dict[str, Trajectory],
    T_map_world: Float64,
) -> Json:
    """Return what the pages of all maps show: paths on the grid, and with others in 3-D."""
    from_above = {name: seen_from_above(path, T_map_world) for name, path in paths.items()}
    ways = [
        (name, apply(T_map_world, path.positions_m)) for name, path in (paths | only_in_3d).items()
    ]
    return {
        "grid": grid_figure(made.grid, from_above),
        "resolution_m": made.grid.resolution_m,
        "view": plot_scene(Scene(np.eye(4), made.cloud, made.mesh, ways)),
    }


def _loops(session: Session) -> bytes | None:
    pairs = [(loop["first"], loop["last"]) for loop in session.loops.get("closed", ())]
    if not pairs:
        return None
    return loops_figure(session.odometry, session.trajectory, pairs, session.T_map_world)


_SCALE_THRESHOLDS: Final = 2.0
"""The last colour of the scale corresponds to this multiple of the largest threshold."""


def write_map_errors(comparison: MapComparison, run: RunDirectory) -> None:
    """Write ``error.ply`` and ``missed.ply``, both in the axes of the reference.

    Map and reference are coloured by their distance to each other; ``quality`` is it in metres.
    """
    limit_m = _SCALE_THRESHOLDS * max(comparison.thresholds_m)
    cloud, reference = comparison.cloud, comparison.reference
    for name, points, others in (("error", cloud, reference), ("missed", reference, cloud)):
        distance_m = nearest_distances(points.xyz, others.xyz)
        rgb = style.colour_values(distance_m, style.ERROR_SCALE, (0.0, limit_m))
        coloured = replace(PointCloud(points.xyz, frame=points.frame), rgb=rgb)
        write_ply(run.path(f"{name}.ply"), coloured, quality=distance_m)
