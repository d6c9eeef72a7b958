"""Figures of a run: path, drift, map, odometry health and timing. All return PNG bytes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from recon.core.geometry.se3 import angle_rad, apply, invert
from recon.core.values import UNKNOWN, OccupancyGrid, Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.protocol import OdometryHealth
from recon.report.canvas import (
    BAD,
    ESTIMATE,
    FAINT,
    HALF_IN,
    INK,
    TRUTH,
    WIDE_IN,
    new_figure,
    nice_length,
    style_plot,
    to_png,
    write_note,
)
from recon.report.colour import GRID_FREE, GRID_OCCUPIED, GRID_UNKNOWN, colour_grid, unit_colour
from recon.report.decimate import thin_grid

_X_LABEL = "x, forward at the start (m)"
_Y_LABEL = "y, left at the start (m)"
_MOST_CELLS = 2400  # of a grid's picture, a side: some for each of its pixels
_MARGIN_CELLS = 10
_PATH_MARGIN_M = 3.0


def trajectory_figure(
    estimate: Trajectory,
    truth: Trajectory | None,
    T_map_world: NDArray[Any],
    health: Sequence[OdometryHealth] = (),
) -> bytes:
    """Top view of the path in map axes; poses that are not trusted are marked.

    Args:
        estimate: The estimated path.
        truth: The true path, in the same world, or None.
        T_map_world: (4, 4), from world to map axes.
        health: One record per pose of ``estimate``, or none.
    """
    paths = [_seen_from_above(estimate, T_map_world)]
    if truth is not None:
        paths.append(_seen_from_above(truth, T_map_world))
    figure = new_figure(WIDE_IN, height_for(np.concatenate(paths)))
    axes = figure.subplots()
    if truth is not None:
        axes.plot(*paths[1].T, color=TRUTH, linewidth=3.5, alpha=0.75, label="truth")
    axes.plot(*paths[0].T, color=ESTIMATE, linewidth=1.8, label="estimate")
    mark_ends(axes, paths[0])
    bad = _bad_frames(health, len(estimate))
    if len(bad):
        label = f"not trusted ({len(bad)})"
        axes.plot(*paths[0][bad].T, "x", color=BAD, markersize=8, markeredgewidth=2, label=label)
    style_plot(axes, _X_LABEL, _Y_LABEL)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", frameon=False)
    return to_png(figure)


def loops_figure(
    before: Trajectory,
    after: Trajectory,
    loops: Sequence[tuple[int, int]],
    T_map_world: NDArray[Any],
) -> bytes:
    """The path before and after loop closure, and the gaps that were closed.

    Args:
        before: The path by odometry.
        after: The corrected path of the same frames.
        loops: The two frames of each loop.
        T_map_world: (4, 4), from world to map axes.
    """
    paths = [_seen_from_above(path, T_map_world) for path in (before, after)]
    figure = new_figure(WIDE_IN, height_for(np.concatenate(paths)))
    axes = figure.subplots()
    axes.plot(*paths[0].T, color=FAINT, linewidth=1.4, linestyle="--", label="odometry")
    axes.plot(*paths[1].T, color=ESTIMATE, linewidth=1.8, label="loops closed")
    for number, pair in enumerate(loops):
        ends = paths[0][list(pair)]
        label = f"loops ({len(loops)})" if number == 0 else None
        axes.plot(*ends.T, "o-", color=BAD, linewidth=0.8, markersize=2.5, label=label)
    mark_ends(axes, paths[1])
    style_plot(axes, _X_LABEL, _Y_LABEL)
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best", frameon=False)
    return to_png(figure)


def path_error_figure(
    estimate: Trajectory, truth: Trajectory, health: Sequence[OdometryHealth] = ()
) -> bytes:
    """Drift of position and rotation from ground truth, with both paths starting at the identity.

    Args:
        estimate: The estimated path.
        truth: The true path, with one pose per pose of ``estimate``.
        health: One record per pose, or none.
    """
    figure = new_figure(WIDE_IN, 4.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    if len(estimate) == len(truth):
        drift = invert(truth.T_world_camera) @ estimate.T_world_camera
        distance_m = truth.distances_m
        upper.plot(distance_m, np.linalg.norm(drift[:, :3, 3], axis=1), color=ESTIMATE)
        lower.plot(distance_m, np.degrees(angle_rad(drift)), color=ESTIMATE)
        bad = distance_m[_bad_frames(health, len(estimate))]
        for axes in (upper, lower):
            _shade(axes, bad, float(np.median(np.diff(distance_m))) if len(truth) > 1 else 1.0)
            axes.set_ylim(bottom=0)
    else:
        write_note(upper, f"{len(estimate)} poses, but {len(truth)} true ones: not compared")
    style_plot(upper, "", "position error (m)")
    style_plot(lower, "distance along the true path (m)", "rotation error (°)")
    return to_png(figure)


def grid_figure(
    grid: OccupancyGrid, trajectory: Trajectory | None, T_map_world: NDArray[Any]
) -> bytes:
    """The occupancy grid with the path; axes in metres, cropped to the known cells.

    Args:
        grid: The map.
        trajectory: The path of the camera, or None.
        T_map_world: (4, 4), from world to map axes.
    """
    grid = thin_grid(_crop_to_known(grid), _MOST_CELLS)
    x, y = grid.origin_m
    far = np.asarray(grid.cells.shape[::-1]) * grid.resolution_m + grid.origin_m
    corners = np.stack([grid.origin_m, far])
    path = None if trajectory is None else _seen_from_above(trajectory, T_map_world)
    if path is not None and len(path):
        corners = np.concatenate([corners, path - _PATH_MARGIN_M, path + _PATH_MARGIN_M])
    low, high = corners.min(axis=0), corners.max(axis=0)
    figure = new_figure(WIDE_IN, height_for(corners))
    axes = figure.subplots()
    axes.set_facecolor(unit_colour(GRID_UNKNOWN))
    axes.imshow(colour_grid(grid), extent=(x, float(far[0]), y, float(far[1])))
    if path is not None:
        axes.plot(*path.T, color=ESTIMATE, linewidth=1.6)
        mark_ends(axes, path)
    style_plot(axes, _X_LABEL, _Y_LABEL)
    axes.grid(visible=False)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    _draw_scale_bar(axes, low, high - low)
    figure.legend(handles=_grid_legend(), loc="outside lower center", ncols=3, frameon=False)
    return to_png(figure)


def timing_figure(stages: Mapping[str, float]) -> bytes:
    """Time and share of each stage, in the order of the mapping."""
    figure = new_figure(HALF_IN, max(1.6, 0.42 * len(stages) + 0.9))
    axes = figure.subplots()
    seconds = np.asarray(list(stages.values()), dtype=np.float64)
    total = max(float(seconds.sum()), 1e-12)
    bars = axes.barh(list(stages), seconds, color=ESTIMATE, height=0.62)
    labels = [f"{value:.2f} s · {value / total:.0%}" for value in seconds]
    axes.bar_label(bars, labels=labels, padding=4, color=INK)
    axes.invert_yaxis()
    axes.set_xlim(0, max(float(seconds.max(initial=0.0)), 1e-12) * 1.28)
    style_plot(axes, "time (s)", "")
    axes.grid(visible=False, axis="y")
    return to_png(figure)


def health_figure(health: Sequence[OdometryHealth]) -> bytes:
    """Odometry health of each frame; frames whose pose is not trusted are shaded red."""
    rows = (
        ("inlier tracks", [float(record.inliers) for record in health]),
        ("overlap with\nthe map (share)", [record.overlap for record in health]),
        ("ICP correction (m)", [record.correction_m for record in health]),
    )
    frames = np.arange(len(health))
    figure = new_figure(WIDE_IN, 5.6)
    all_axes = figure.subplots(len(rows), 1, sharex=True)
    for axes, (label, values) in zip(all_axes, rows, strict=True):
        known = np.isfinite(values)
        if known.any():
            # Values measured only every few frames have no neighbours to connect by a line.
            marker = "" if known.all() else "."
            axes.plot(frames, values, color=ESTIMATE, linewidth=1.3, marker=marker)
            axes.set_ylim(bottom=0)
        else:
            write_note(axes, "not measured")
        _shade(axes, _bad_frames(health, len(health)), 1.0)
        style_plot(axes, "", label)
    all_axes[-1].set_xlabel("frame", color=INK)
    figure.align_ylabels()
    return to_png(figure)


def _seen_from_above(trajectory: Trajectory, T_map_world: NDArray[Any]) -> Float64:
    """float64 (N, 2): x and y of the camera in map axes."""
    return np.asarray(apply(T_map_world, trajectory.positions_m)[:, :2])


def height_for(points: NDArray[Any]) -> float:
    """Height in inches of a wide figure that shows these (N, 2) points with equal axes."""
    extent = np.ptp(points, axis=0) if len(points) else np.ones(2)
    ratio = float(extent[1]) / max(float(extent[0]), 1e-9)
    return float(np.clip((WIDE_IN - 0.8) * ratio + 1.1, 3.0, 9.0))


def mark_ends(axes: Axes, path: NDArray[Any]) -> None:
    """Mark where a path (N, 2) starts and ends."""
    if len(path):
        axes.plot(*path[0], "o", color=ESTIMATE, markersize=9, markeredgecolor="white", zorder=5)
        axes.plot(*path[-1], "s", color=ESTIMATE, markersize=7, markeredgecolor="white", zorder=5)
        # One label above and one below, as a drive may end where it started.
        for place, text, up in ((path[0], "start", 9), (path[-1], "end", -18)):
            label = axes.annotate(
                text, place, textcoords="offset points", xytext=(0, up), ha="center", color=INK
            )
            label.set_path_effects([withStroke(linewidth=3, foreground="white")])


def _bad_frames(health: Sequence[OdometryHealth], poses: int) -> NDArray[np.intp]:
    """Indices of the poses that are not trusted."""
    records = health[:poses]
    return np.flatnonzero([not record.ok for record in records])


def _shade(axes: Axes, places: NDArray[Any], width: float) -> None:
    for place in places:
        axes.axvspan(place - 0.5 * width, place + 0.5 * width, color=BAD, alpha=0.2, linewidth=0)


def _crop_to_known(grid: OccupancyGrid) -> OccupancyGrid:
    """The part of a grid with all known cells, and a margin."""
    known = grid.cells != UNKNOWN
    if not known.any():
        return grid
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    top, left = max(rows[0] - _MARGIN_CELLS, 0), max(columns[0] - _MARGIN_CELLS, 0)
    x, y = grid.origin_m
    return OccupancyGrid(
        cells=grid.cells[
            top : rows[-1] + _MARGIN_CELLS + 1, left : columns[-1] + _MARGIN_CELLS + 1
        ],
        resolution_m=grid.resolution_m,
        origin_m=(x + left * grid.resolution_m, y + top * grid.resolution_m),
    )


def _draw_scale_bar(axes: Axes, low: NDArray[Any], size_m: NDArray[Any]) -> None:
    length = nice_length(float(size_m[0]) / 6)
    left, bottom = low + size_m * (0.03, 0.06)
    ends = [left, left + length]
    axes.plot(ends, [bottom, bottom], color=INK, linewidth=4, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} m",
        (left + length / 2, bottom),
        textcoords="offset points",
        xytext=(0, 5),
        ha="center",
        color=INK,
    )


def _grid_legend() -> list[Patch]:
    entries = (("free", GRID_FREE), ("occupied", GRID_OCCUPIED), ("unknown", GRID_UNKNOWN))
    return [
        Patch(facecolor=unit_colour(colour), edgecolor=FAINT, linewidth=0.5, label=label)
        for label, colour in entries
    ]
