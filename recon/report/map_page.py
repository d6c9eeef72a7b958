"""The reports of maps and of paths, and clouds coloured by their errors."""

from __future__ import annotations

from dataclasses import replace
from itertools import compress
from typing import Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.values import PointCloud, Trajectory
from recon.core.values.arrays import Float64
from recon.evaluation.map import DriveErrors, MapComparison, nearest_distances
from recon.evaluation.trajectory import TrajectoryComparison
from recon.export.make import Products
from recon.io.atomic import write_bytes
from recon.io.models.ply import write_ply
from recon.look.rig import RefinedRig
from recon.map.localize.localizer import State
from recon.map.localize.sequence import LocalizedDrive, LocalizeResult
from recon.map.store.map_file import MapFile
from recon.odometry.health import expected_drift
from recon.report import drive_figures as figures
from recon.report import style
from recon.report.page import write_page
from recon.report.pair_page import stereo_figures
from recon.report.rig_part import rig_content
from recon.report.scene import Json, Scene, plot_scene
from recon.run.directory import RunDirectory
from recon.stereo.frame import ReconstructedFrame


def map_content(
    map_: MapFile,
    made: Products,
    errors: DriveErrors,
    sample: ReconstructedFrame,
    rig: RefinedRig,
) -> Json:
    """Return what the page of a drive shows: map and path, the rig, and a frame of it in full."""
    session, truth = map_.first, errors.true_path
    joined, T_map_world = map_.joined(session), session.T_map_world
    path, odometry = (one.select(joined) for one in (session.trajectory, session.odometry))
    health = tuple(compress(session.health, joined))
    number = np.cumsum(joined) - 1  # of each frame among those that are joined
    drift = expected_drift(path, health, session.camera, rig.length_ratio)
    radius_ratio = 0.0 if drift is None else drift.radius_ratio
    closed = [(loop["first"], loop["last"]) for loop in session.loops.get("closed", ())]
    pairs = [(int(number[a]), int(number[b])) for a, b in closed if joined[a] and joined[b]]
    true_path = {} if truth is None else {"true path": truth}
    return {
        **_map_content(made, {"path": path}, true_path, T_map_world),
        "path": path,
        "health": health,
        "metrics": errors.path,
        "figures": {
            "path": figures.path_figure(path, truth, T_map_world, health, radius_ratio),
            "loops": figures.loops_figure(odometry, path, pairs, T_map_world) if pairs else None,
            "drift": None if truth is None else figures.drift_figure(path, truth, health),
            "health": figures.health_figure(health) if health else None,
        },
        "rig": rig_content(rig),
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
    ways = {n: apply(T_map_world, one.positions_m) for n, one in (paths | only_in_3d).items()}
    return {
        "grid": figures.grid_figure(made.grid, {name: ways[name][:, :2] for name in paths}),
        "resolution_m": made.grid.resolution_m,
        "view": plot_scene(Scene(np.eye(4), made.cloud, made.mesh, [*ways.items()])),
    }


def write_map_errors(comparison: MapComparison, run: RunDirectory) -> None:
    """Write ``error.ply`` and ``missed.ply``, coloured by distance, in axes of the reference."""
    limit_m = 2.0 * max(comparison.thresholds_m)
    cloud, reference = comparison.cloud, comparison.reference
    for name, points, others in (("error", cloud, reference), ("missed", reference, cloud)):
        distance_m = nearest_distances(points.xyz, others.xyz)
        rgb = style.colour_values(distance_m, style.ERROR_SCALE, (0.0, limit_m))
        coloured = replace(PointCloud(points.xyz, frame=points.frame), rgb=rgb)
        write_ply(run.path(f"{name}.ply"), coloured, quality=distance_m)


def write_trajectory_page(
    comparison: TrajectoryComparison, names: tuple[str, str], summary: Json, run: RunDirectory
) -> None:
    """Write ``report.html`` of a path compared with its truth, and its figures as PNG files."""
    drawn = {
        "path": compared_paths_figure(comparison),
        "error_along_path": pose_errors_figure(comparison),
        "translation_by_length": errors_by_length_figure(comparison, rotation=False),
        "rotation_by_length": errors_by_length_figure(comparison, rotation=True),
    }
    for name, png in drawn.items():
        write_bytes(run.path(f"{name}.png"), png)
    content = {"comparison": comparison, "names": names, "figures": drawn}
    write_page("trajectory", run, summary, **content)


def compared_paths_figure(comparison: TrajectoryComparison) -> bytes:
    """Draw both paths on the two world axes along which the true one extends farthest."""
    true_m = comparison.truth.positions_m
    axes = widest_axes(true_m)
    truth, estimate = true_m[:, axes], comparison.estimate.positions_m[:, axes]
    first, second = (f"{'xyz'[axis]} (m)" for axis in axes)
    return figures.top_view(
        [(truth, figures.TRUTH_LINE), (estimate, figures.ESTIMATE_LINE)], truth, (first, second)
    )


@style.styled
def pose_errors_figure(comparison: TrajectoryComparison) -> bytes:
    """Draw position and rotation error of each aligned pose, along the true path."""
    degrees = np.degrees(comparison.rotation_errors_rad)
    figure, (upper, _) = figures.errors_along(
        comparison.truth, comparison.position_errors_m, degrees
    )
    mean_m = comparison.metrics.ate_m
    upper.axhline(mean_m, color=style.FAINT, linestyle="--", label="root mean square")
    upper.legend(loc="best")
    return style.to_png(figure)


@style.styled
def errors_by_length_figure(comparison: TrajectoryComparison, *, rotation: bool) -> bytes:
    """Draw the relative error of the segments by length: mean and interquartile range."""
    values = comparison.segment_deg_per_100m if rotation else comparison.segment_percent
    lengths = np.unique(comparison.segments.length_m)
    groups = [values[comparison.segments.length_m == length] for length in lengths]
    quarters = np.array([np.percentile(group, (25, 75)) for group in groups])
    figure, axes = style.subplots(style.HALF_IN, 3.4)
    # One bar per length, as a line shows nothing for one or two lengths.
    axes.vlines(lengths, *quarters.T, color=style.ESTIMATE, alpha=0.35, linewidth=8)
    axes.plot(lengths, [float(np.mean(group)) for group in groups], "o-")
    margin = max(10.0, 0.05 * float(np.ptp(lengths)))
    axes.set_xlim(max(0.0, lengths[0] - margin), lengths[-1] + margin)
    label = "rotation error (°/100 m)" if rotation else "translation error (%)"
    axes.set(xlabel="length of the segments (m)", ylabel=label, ylim=(0, None))
    return style.to_png(figure)


def widest_axes(positions_m: Float64) -> list[int]:
    """Return the two axes along which a path extends farthest, in order of the axes."""
    return sorted(np.argsort(-np.ptp(positions_m, axis=0), kind="stable")[:2].tolist())


_SHADES: Final = {State.SEARCHING: style.FAINT, State.COASTING: style.TRUTH, State.LOST: style.BAD}


def write_localize_page(result: LocalizeResult, run: RunDirectory) -> None:
    """Write ``report.html`` of a drive in a map."""
    path, T_map_world = result.drive.trajectory, result.drive.T_map_world
    drawn = {"certainty": certainty_figure(result.drive), "path": None}
    if result.grid is not None:
        ways = {"path": figures.seen_from_above(path, T_map_world)}
        drawn["path"] = figures.grid_figure(result.grid, ways)
    elif len(path):
        drawn["path"] = figures.path_figure(path, None, T_map_world)
    write_page("localize", run, result.summary.to_json(), result=result, figures=drawn)


@style.styled
def certainty_figure(drive: LocalizedDrive) -> bytes:
    """Draw standard deviations of each pose, and what confirms it; the others are shaded."""
    known = [frame.located for frame in drive.frames]
    inliers = [float(x.inliers) if x.covariance is not None else np.nan for x in known]
    labels = ("standard deviation\nof the position (m)", "features that\nagree")
    figure, rows = style.stacked(4.4, "frame", labels)
    for axes, values in zip(rows, ([x.sigma_m for x in known], inliers), strict=True):
        axes.plot(values, marker=".")
        axes.set_ylim(bottom=0)
        axes.set_xlim(-0.5, len(known) - 0.5)
        for state, colour in _SHADES.items():
            style.shade(axes, [n for n, x in enumerate(known) if x.state == state], 1.0, colour)
    figure.align_ylabels()
    return style.to_png(figure)
