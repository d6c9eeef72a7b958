"""Figures of a drive: paths, drift, grid and odometry health. All return PNG bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from recon.core.geometry.se3 import angle_rad, apply, invert
from recon.core.text import counted
from recon.core.values import FREE, UNKNOWN, OccupancyGrid, Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.protocol import OdometryHealth
from recon.report import style

Line = tuple[Float64, Mapping[str, Any]]  # points (N, 2) and how matplotlib draws them
_MAP_LABELS: Final = ("x, forward at the start (m)", "y, left at the start (m)")
_MOST_CELLS: Final = 2400  # of a grid's figure, a side: some for each of its pixels
_MARGIN_CELLS: Final = 10
_PATH_MARGIN_M: Final = 3.0
_CIRCLES: Final = 5  # along a path, of its expected drift
ESTIMATE_LINE: Final = {"color": style.ESTIMATE, "linewidth": 1.8, "label": "estimate"}
TRUTH_LINE: Final = {"color": style.TRUTH, "linewidth": 3.5, "alpha": 0.75, "label": "truth"}


def path_figure(
    estimate: Trajectory,
    truth: Trajectory | None,
    T_map_world: NDArray[Any],
    health: Sequence[OdometryHealth] = (),
    radius_ratio: float = 0.0,
) -> bytes:
    """Draw the path in map axes from above, untrusted poses marked, circles of 95 % certainty."""
    path = seen_from_above(estimate, T_map_world)
    lines: list[Line] = [(path, ESTIMATE_LINE)]
    if radius_ratio > 0.0:
        look = {"color": style.ESTIMATE, "linewidth": 0.8, "label": "95 % (expected drift)"}
        lines.append((_circles(path, radius_ratio * estimate.distances_m), look))
    if truth is not None:
        lines.insert(0, (seen_from_above(truth, T_map_world), TRUTH_LINE))
    visual_m = np.array([record.visual_m or (np.nan,) * 3 for record in health]).reshape(-1, 3)
    if np.isfinite(visual_m).any():
        look = {"color": style.FAINT, "linewidth": 1.4, "linestyle": "--", "label": "visual alone"}
        lines.append((apply(T_map_world, visual_m)[:, :2], look))
    bad = _bad_frames(health, len(estimate))
    if len(bad):
        look = {"marker": "x", "linestyle": "", "markersize": 8, "markeredgewidth": 2}
        look |= {"color": style.BAD, "label": f"not trusted ({len(bad)})"}
        lines.append((path[bad], look))
    return top_view(lines, path, _MAP_LABELS)


def _circles(path: Float64, radii_m: Float64) -> Float64:
    """Return circles around some poses of a path (N, 2), evenly along it, NaN in between."""
    at = np.linspace(0, len(path) - 1, _CIRCLES + 1).astype(np.int64)[1:]
    angle = np.append(np.linspace(0.0, 2.0 * np.pi, 49), np.nan)
    round_ = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.asarray(path[at, None] + radii_m[at, None, None] * round_).reshape(-1, 2)


def loops_figure(
    before: Trajectory,
    after: Trajectory,
    loops: Sequence[tuple[int, int]],
    T_map_world: NDArray[Any],
) -> bytes:
    """Draw the path before and after loop closure, and the gaps that were closed."""
    odometry, closed = (seen_from_above(path, T_map_world) for path in (before, after))
    gaps = [np.concatenate([odometry[list(pair)], [[np.nan, np.nan]]]) for pair in loops]
    joined = np.concatenate([np.zeros((0, 2)), *gaps])
    faint = {"color": style.FAINT, "linewidth": 1.4, "linestyle": "--", "label": "odometry"}
    look = {"marker": "o", "linewidth": 0.8, "markersize": 2.5, "color": style.BAD}
    lines: list[Line] = [
        (odometry, faint),
        (closed, {**ESTIMATE_LINE, "label": "loops closed"}),
        (joined, {**look, "label": f"loops ({len(loops)})"}),
    ]
    return top_view(lines, closed, _MAP_LABELS)


@style.styled
def top_view(lines: Sequence[Line], path: Float64, labels: tuple[str, str]) -> bytes:
    """Draw lines in a plane with equal axes, with the start and end of one path."""
    height_in = _height_in(np.concatenate([points for points, _ in lines]))
    figure, axes = style.subplots(style.WIDE_IN, height_in)
    for points, look in lines:
        axes.plot(*points.T, **look)
    _mark_ends(axes, path)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(loc="best")
    return style.to_png(figure)


@style.styled
def drift_figure(
    estimate: Trajectory, truth: Trajectory, health: Sequence[OdometryHealth] = ()
) -> bytes:
    """Draw the drift of position and rotation, with both paths starting at the identity."""
    if len(estimate) != len(truth):
        figure, axes = style.subplots(style.WIDE_IN, 4.6)
        poses = f"{counted(len(estimate), 'pose')}, but {counted(len(truth), 'true one')}"
        style.write_note(axes, f"{poses}: not compared")
        return style.to_png(figure)
    drift = invert(truth.T_world_camera) @ estimate.T_world_camera
    position_m, rotation_deg = np.linalg.norm(drift[:, :3, 3], axis=1), np.degrees(angle_rad(drift))
    figure, rows = errors_along(truth, position_m, rotation_deg)
    bad = truth.distances_m[_bad_frames(health, len(estimate))]
    width = float(np.median(np.diff(truth.distances_m))) if len(truth) > 1 else 1.0
    for axes in rows:
        style.shade(axes, bad, width)
    return style.to_png(figure)


def errors_along(
    truth: Trajectory, position_m: ArrayLike, rotation_deg: ArrayLike
) -> tuple[Figure, list[Axes]]:
    """Draw errors of position and rotation along the true path; also return their axes."""
    labels = ("position error (m)", "rotation error (°)")
    figure, rows = style.stacked(4.6, "distance along the true path (m)", labels)
    for axes, errors in zip(rows, (position_m, rotation_deg), strict=True):
        axes.plot(truth.distances_m, errors)
        axes.set_ylim(bottom=0)
    return figure, rows


@style.styled
def grid_figure(grid: OccupancyGrid, paths: Mapping[str, Float64]) -> bytes:
    """Draw the known cells of a grid, in metres, with paths (N, 2) by their names."""
    grid = thin_grid(_crop_to_known(grid), _MOST_CELLS)
    near = np.asarray(grid.origin_m)
    far = near + np.asarray(grid.cells.shape[::-1]) * grid.resolution_m
    path = np.concatenate([np.zeros((0, 2)), *paths.values()])
    corners = np.concatenate([[near, far], path - _PATH_MARGIN_M, path + _PATH_MARGIN_M])
    low, high = corners.min(axis=0), corners.max(axis=0)
    figure, axes = style.subplots(style.WIDE_IN, _height_in(corners))
    axes.set_facecolor(style.unit_colour(style.GRID_UNKNOWN))
    axes.imshow(style.colour_grid(grid), extent=(near[0], far[0], near[1], far[1]))
    lines = [axes.plot(*way.T, linewidth=1.6, label=name)[0] for name, way in paths.items()]
    for way in paths.values():
        _mark_ends(axes, way)
    axes.grid(visible=False)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set(xlabel=_MAP_LABELS[0], ylabel=_MAP_LABELS[1])
    colours = (style.GRID_FREE, style.GRID_OCCUPIED, style.GRID_UNKNOWN)
    keys = map(style.colour_key, ("free", "occupied", "unknown"), colours)
    named = lines if len(lines) > 1 else []
    figure.legend(handles=[*keys, *named], loc="outside lower center", ncols=3)
    (width_m, height_m), known = far - near, grid.cells != UNKNOWN
    free = f"{100 * (grid.cells[known] == FREE).mean():.0f} % of them free" if known.any() else ""
    size = f"{width_m:.3g} by {height_m:.3g} m, {100 * known.mean():.0f} % of the cells known"
    return style.to_png(figure, ", ".join(filter(None, [f"Grid of {size}", free])))


@style.styled
def health_figure(health: Sequence[OdometryHealth]) -> bytes:
    """Draw the odometry health of each frame; frames with an untrusted pose are shaded red."""
    drawn = {
        "inlier tracks": [float(record.inliers) for record in health],
        "reprojection\nerror (px)": [record.reprojection_px for record in health],
        "standard deviation\nof the motion (m)": [record.sigma_m for record in health],
    }
    figure, rows = style.stacked(5.6, "frame", [*drawn])
    for axes, values in zip(rows, drawn.values(), strict=True):
        known = np.isfinite(values)
        if known.any():
            # A value between frames without one has no neighbour to connect by a line.
            axes.plot(values, linewidth=1.3, marker="" if known.all() else ".")
            axes.set_ylim(bottom=0)
        else:
            style.write_note(axes, "not measured")
        style.shade(axes, _bad_frames(health, len(health)), 1.0)
    figure.align_ylabels()
    return style.to_png(figure)


def seen_from_above(trajectory: Trajectory, T_map_world: NDArray[Any]) -> Float64:
    """Return float64 (N, 2): x and y of the camera in map axes."""
    return np.asarray(apply(T_map_world, trajectory.positions_m)[:, :2])


def _height_in(points: NDArray[Any]) -> float:
    """Return the height in inches of a wide figure that shows points (N, 2) with equal axes."""
    extent = np.nanmax(points, axis=0) - np.nanmin(points, axis=0) if len(points) else np.ones(2)
    ratio = float(extent[1]) / max(float(extent[0]), 1e-9)
    return float(np.clip((style.WIDE_IN - 0.8) * ratio + 1.1, 3.0, 9.0))


def _mark_ends(axes: Axes, path: NDArray[Any]) -> None:
    # One label above and one below, as a drive may end where it started.
    ends = ((0, "start", 9, "o", 9), (-1, "end", -18, "s", 7))
    for number, text, up, marker, size in ends if len(path) else ():
        place = path[number]
        look: dict[str, Any] = {"color": style.ESTIMATE, "markeredgecolor": "white", "zorder": 5}
        axes.plot(*place, marker=marker, markersize=size, **look)
        label = axes.annotate(text, place, (0, up), textcoords="offset points", ha="center")
        label.set_path_effects([withStroke(linewidth=3, foreground="white")])


def _bad_frames(health: Sequence[OdometryHealth], poses: int) -> NDArray[np.intp]:
    return np.flatnonzero([not record.ok for record in health[:poses]])


def _crop_to_known(grid: OccupancyGrid) -> OccupancyGrid:
    known = np.argwhere(grid.cells != UNKNOWN)
    if not len(known):
        return grid
    top, left = np.maximum(known.min(axis=0) - _MARGIN_CELLS, 0).tolist()
    bottom, right = (known.max(axis=0) + _MARGIN_CELLS + 1).tolist()
    x, y = grid.origin_m
    origin_m = (x + left * grid.resolution_m, y + top * grid.resolution_m)
    return OccupancyGrid(grid.cells[top:bottom, left:right], grid.resolution_m, origin_m)


def thin_grid(grid: OccupancyGrid, limit: int) -> OccupancyGrid:
    """Return a grid of at most ``limit`` larger cells a side; no obstacle in it is lost."""
    factor = math.ceil(max(grid.cells.shape) / limit)
    if factor <= 1:
        return grid
    rows, columns = (np.arange(0, size, factor) for size in grid.cells.shape)
    # Unknown is -1, free 0 and occupied larger, so the maximum is kept.
    cells = np.maximum.reduceat(np.maximum.reduceat(grid.cells, rows, axis=0), columns, axis=1)
    return OccupancyGrid(cells, grid.resolution_m * factor, grid.origin_m)
