"""The reports of maps and of paths, and clouds coloured by their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress, cycle
from typing import Any, Final

import numpy as np

from recon.core.geometry.se3 import apply
from recon.core.text import counted, metres
from recon.core.values import PointCloud, Trajectory, TrajectoryMetrics
from recon.core.values.arrays import Float64
from recon.evaluation.map import DriveErrors, MapComparison, nearest_distances
from recon.evaluation.trajectory import TrajectoryComparison
from recon.export.make import Products
from recon.io.atomic import write_bytes
from recon.io.models.ply import write_ply
from recon.look.rig import RefinedRig
from recon.map.changes.compare import Comparison
from recon.map.localize.localizer import State
from recon.map.localize.sequence import LocalizedDrive, LocalizeResult
from recon.map.store.map_file import MapFile
from recon.odometry.health import expected_drift
from recon.odometry.protocol import OdometryHealth
from recon.report import drive_figures as figures
from recon.report import style
from recon.report.changes_page import changes_table
from recon.report.page import last_part, run_figures, run_section, write_page
from recon.report.pair_page import stereo_blocks
from recon.report.rig_part import rig_section
from recon.report.scene import Points, Scene
from recon.report.sections import Block, Image, Page, Row, Section, Table, View3D, known, row_of
from recon.run.directory import RunDirectory
from recon.stereo.frame import ReconstructedFrame

Json = Mapping[str, Any]


def map_page(
    map_: MapFile,
    made: Products,
    errors: DriveErrors,
    sample: ReconstructedFrame,
    rig: RefinedRig,
    found: Json,
) -> Page:
    """Return the page of a drive: map and path, the rig, and a frame of it in full."""
    session, truth, loops = map_.first, errors.true_path, found.get("loops")
    joined, T_map_world = map_.joined(session), session.T_map_world
    path, odometry = (one.select(joined) for one in (session.trajectory, session.odometry))
    health = tuple(compress(session.health, joined))
    number = np.cumsum(joined) - 1  # of each frame among those that are joined
    drift = expected_drift(path, health, session.camera, rig.length_ratio)
    radius_ratio = 0.0 if drift is None else drift.radius_ratio
    closed = [(loop["first"], loop["last"]) for loop in session.loops.get("closed", ())]
    pairs = [(int(number[a]), int(number[b])) for a, b in closed if joined[a] and joined[b]]
    on_path: list[Block] = [
        Image("Path from above",
              figures.path_figure(path, truth, T_map_world, health, radius_ratio),
              "In the map frame; both axes have the same scale."),
        Image("Loops", figures.loops_figure(odometry, path, pairs, T_map_world) if pairs else None,
              _loops_caption(loops) if loops else ""),
        Image("Error along the path",
              None if truth is None else figures.drift_figure(path, truth, health),
              "Both paths start at the same pose, so this is the accumulated drift."),
        Image("Health of the odometry", figures.health_figure(health) if health else None,
              "What each pose is based on; frames whose pose is not trusted are shaded red."),
        *path_errors(errors.path),
        _odometry_notes(health),
    ]  # fmt: skip
    true_path = {} if truth is None else {"true path": truth}
    in_map = _map_blocks(made, {"path": path}, true_path, T_map_world)
    sections = [
        Section("Map", [*in_map, *_occupancy_errors(found.get("occupancy"))]),
        Section("Path", on_path),
        rig_section(rig),
        Section(f"Stereo, frame {sample.pair.index}", stereo_blocks(sample.pair, sample.disparity)),
        run_section(found),
    ]
    subtitle = f"{counted(len(path), 'frame')}, {metres(path.path_length_m)} of path"
    shown = _drive_figures(path, health, errors.path, found)
    return Page(f"Map of {last_part(found['source'])}", subtitle, shown, sections, found)


def _drive_figures(
    path: Trajectory,
    health: Sequence[OdometryHealth],
    errors: TrajectoryMetrics | None,
    found: Json,
) -> list[tuple[str, str]]:
    """Return the headline figures of a drive."""
    loops, sfm, bad = found.get("loops"), found.get("sfm"), sum(not one.ok for one in health)
    shown = [("Path", metres(path.path_length_m))]
    if errors is not None:
        shown.append(("Drift (t_rel)", known("{:.2f} %", errors.t_rel_percent)))
        shown.append(("Position error (ATE)", metres(errors.ate_m)))
    shown.append(("Frames not trusted", f"{bad} of {len(health)}" if health else ""))
    if loops and loops["found"]:
        moved = f"{loops['closed']} of {loops['found']}, {metres(loops['largest_correction_m'])}"
        shown.append(("Loops closed, path moved by", moved))
    if sfm:
        placed = f"{sfm['registered']} of {sfm['pairs']}, to {sfm['reprojection_px']:.2f} px"
        shown.append(("Placed by structure from motion", placed))
    return [
        *shown,
        ("Mapping rate", known("{:.1f} fps", found.get("fps"))),
        *run_figures(found),
        ("Field of view of the rectified images", known("{:.0f}°", found.get("field_of_view_deg"))),
        *_size_figures(found),
    ]


def _size_figures(found: Json) -> list[tuple[str, str]]:
    points, faces = found.get("points"), found.get("faces") or None
    return [("Points in the map", known("{:,}", points)), ("Triangles", known("{:,}", faces))]


def _loops_caption(loops: Json) -> str:
    closed, keyframes = counted(loops["closed"], "loop"), counted(loops["keyframes"], "keyframe")
    return (
        f"{closed} closed, with {keyframes}. That moved the path by up to "
        f"{metres(loops['largest_correction_m'])}. Each red line joins the two positions that "
        "odometry gave to one place."
    )


def _occupancy_errors(found: Json | None) -> list[Table]:
    if not found:
        return []
    named = (
        ("occupied voxels, precision", "voxels", "precision"),
        ("occupied voxels, recall", "voxels", "recall"),
        ("occupied cells of the grid, intersection over union", "grid", "iou_occupied"),
        ("free cells of the grid, intersection over union", "grid", "iou_free"),
        ("occupied cells that the grid calls free", "grid", "occupied_called_free"),
    )
    form = "{:.3f}"
    rows = [
        row_of(label, found, [(form, part, key), (form, f"{part}_exact", key)])
        for label, part, key in named
    ]
    seen = f"Of what at least {counted(found['least_frames'], 'frame')} saw"
    caption = f"{seen}, in cells of {found['resolution_m']:g} m. 1 is best, for the last row 0."
    head = ("figure", "within one cell", "exact cell")
    return [Table("Occupancy against truth", head, rows, caption=caption)]


def _odometry_notes(health: Sequence[OdometryHealth]) -> Table:
    notes = [
        (str(frame), "; ".join(record.notes) or "no measurement")
        for frame, record in enumerate(health)
        if record.notes or not record.ok
    ]
    caption = "Where features were looked for in the whole image, and why a pose is not trusted."
    return _first_rows("Notes of the odometry", ("frame", "note"), notes, caption)


def _first_rows(title: str, head: Row, rows: Sequence[Row], caption: str = "") -> Table:
    """Return a table of the first rows of many, which says so."""
    if len(rows) > _MOST_ROWS:
        caption = f"{caption} The first {_MOST_ROWS} of {len(rows)}.".lstrip()
    return Table(title, head, rows[:_MOST_ROWS], caption=caption)


def path_errors(of: TrajectoryMetrics | None) -> list[Table]:
    """Return the table of the errors of a path."""
    if of is None:
        return []
    lengths = ", ".join(f"{length_m:.3g}" for length_m in of.segment_lengths_m)
    rows = [
        ("relative translation error (t_rel)", f"{of.t_rel_percent:.3f} %"),
        ("relative rotation error (r_rel)", f"{of.r_rel_deg_per_100m:.3f} °/100 m"),
        ("absolute trajectory error (ATE)", metres(of.ate_m)),
        ("frame to frame, translation (RPE)", metres(of.rpe_m)),
        ("frame to frame, rotation (RPE)", f"{of.rpe_deg:.4f} °"),
        ("length of the true path", metres(of.path_length_m)),
        ("segments", f"{of.segments} of {lengths} m"),
    ]
    return [Table("Path against truth", ("figure", "value"), rows)]


def write_joined_page(
    map_: MapFile, made: Products, summary: Json, run: RunDirectory, found: Comparison | None = None
) -> None:
    """Write ``report.html`` of a map of several drives: all paths on one grid."""
    drives, links = summary["sessions"], summary["links"]
    paths = {f"session {number}": path for number, path in map_.paths.items()}
    columns = {
        "number": "number", "drive": "name", "frames": "frames", "placed": "frames_placed",
        "length (m)": "length_m", "measured positions": "positions", "in the map": "linked",
    }  # fmt: skip
    texts = [
        {**one, "length_m": f"{one['length_m']:.1f}", "linked": "yes" if one["linked"] else "no"}
        for one in drives
    ]
    rows = [[str(one[key]) for key in columns.values()] for one in texts]
    places = [(name, str(count)) for name, count in links["pairs"].items()]
    note = f"{links['refused']} more contradict the others."
    sections = [
        Section("Map", _map_blocks(made, paths, {}, map_.first.T_map_world)),
        Section("Drives", [
            Table("Sessions", [*columns], rows),
            Table("Places that two drives saw", ("drives", "places"), places, caption=note),
        ]),
        *([] if found is None else [Section("What changed", [changes_table(found.objects)])]),
        run_section(summary),
    ]  # fmt: skip
    shown = [
        ("Drives in the map", f"{sum(one['linked'] for one in drives)} of {len(drives)}"),
        ("Places seen by two drives", known("{:,}", links["count"])),
        ("From measured positions (RMS)", known("{:.3g} m", summary["positions_misfit_rms_m"])),
        ("Points that moved", known("{:,}", summary.get("points_removed"))),
        *_size_figures(summary),
        *run_figures(summary),
    ]
    frames = counted(summary["frames"], "frame")
    subtitle = f"{frames}, {metres(summary['path_length_m'])} of path"
    title = f"Map of {counted(len(drives), 'drive')}"
    write_page(Page(title, subtitle, shown, sections, summary), run)


def _map_blocks(
    made: Products,
    paths: dict[str, Trajectory],
    only_in_3d: dict[str, Trajectory],
    T_map_world: Float64,
) -> list[Block]:
    """Return the blocks of all maps: paths on the grid, and with others in 3-D."""
    ways = {n: apply(T_map_world, one.positions_m) for n, one in (paths | only_in_3d).items()}
    in_3d = tuple(
        Points(name, PointCloud(way.astype(np.float32), np.tile(colour, (len(way), 1))))
        for (name, way), colour in zip(ways.items(), cycle(_PATH_COLOURS), strict=False)
    )
    points = () if made.cloud is None else (Points("cloud", made.cloud),)
    grid = figures.grid_figure(made.grid, {name: ways[name][:, :2] for name in paths})
    whose = "the path of the camera" if "path" in paths else "the paths of the drives"
    return [
        View3D("In 3-D", Scene(points, made.mesh, in_3d),
               f"The fused point cloud in the map frame, with {whose}."),
        Image("Occupancy grid", grid,
              f"Seen from above, cells of {made.grid.resolution_m:g} m, with {whose}."),
    ]  # fmt: skip


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
    of, seen = comparison.metrics, "Dots are means, bars the middle half of the segments."
    rows = [
        (
            f"{x.length_m:g} m",
            f"{x.t_rel_percent:.3f}",
            f"{x.r_rel_deg_per_100m:.3f}",
            str(x.segments),
        )
        for x in of.by_length
    ]
    head = ("length", "translation (%)", "rotation (°/100 m)", "segments")
    no_roll = "" if comparison.roll_axis is None else _NO_ROLL
    sections = [
        Section("Paths", [
            Image("From above", drawn["path"], ALIGNED[of.alignment]),
            Image("Error along the path", drawn["error_along_path"],
                  f"Of each pose, after the alignment. {no_roll}"),
        ]),
        Section("Relative errors", [
            Image("Translation", drawn["translation_by_length"], seen),
            Image("Rotation", drawn["rotation_by_length"], seen),
            Table("By length of the segments", head, rows),
            *path_errors(of),
        ]),
    ]  # fmt: skip
    shown = [
        ("Drift (t_rel)", known("{:.2f} %", of.t_rel_percent)),
        ("Rotation drift (r_rel)", known("{:.2f} °/100 m", of.r_rel_deg_per_100m)),
        ("Position error (ATE)", metres(of.ate_m)),
        ("Scale", known("{:.4f}", of.scale)),
    ]
    poses = f"{counted(of.frames, 'pose')} compared {summary['associated']}"
    subtitle = f"{poses}, {metres(of.path_length_m)} of true path"
    write_page(Page(" against ".join(names), subtitle, shown, sections, summary), run)


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


_PATH_COLOURS: Final = np.array([(255, 82, 82), (255, 183, 77), (129, 199, 132)], np.uint8)
_MOST_ROWS: Final = 20  # of a table about frames
ALIGNED: Final = {
    "none": "Nothing is aligned.",
    "origin": "The estimate is moved so that both begin in the same pose.",
    "se3": "The estimate is moved as a whole (rotation, translation) to lie closest.",
    "sim3": "The estimate is moved and scaled as a whole to lie closest.",
    "upright": "The estimate is moved as a whole to lie closest, and turned about z alone.",
}
_NO_ROLL: Final = (
    "The path is straight, so its positions do not fix the roll about it: the rotation error is "
    "without a roll common to all poses, which cannot be observed here."
)
_SHADES: Final = {State.SEARCHING: style.FAINT, State.COASTING: style.TRUTH, State.LOST: style.BAD}


def write_localize_page(result: LocalizeResult, run: RunDirectory) -> None:
    """Write ``report.html`` of a drive in a map."""
    path, T_map_world, found = (
        result.drive.trajectory,
        result.drive.T_map_world,
        result.summary.to_json(),
    )
    drawn = None
    if result.grid is not None:
        ways = {"path": figures.seen_from_above(path, T_map_world)}
        drawn = figures.grid_figure(result.grid, ways)
    elif len(path):
        drawn = figures.path_figure(path, None, T_map_world)
    notes = [
        (str(frame.index), frame.located.state.value, frame.located.note)
        for frame in result.drive.frames
        if frame.located.note
    ]
    blocks: list[Block] = [
        Image("In the map", drawn, "Seen from above, in the axes of the map; the line joins the "
              "frames that have a pose."),
        Image("Certainty", certainty_figure(result.drive),
              "Orange frames are coasting: their pose is by odometry alone. Grey ones are "
              "searching, red ones are where the drive was lost; they have no pose."),
        _first_rows("Frames that the map does not confirm", ("frame", "state", "why"), notes),
    ]  # fmt: skip
    first, sigma_m, tracked = (
        found[key] for key in ("first_fix_frame", "median_sigma_m", "frames_tracking")
    )
    slow_s = found["seconds_per_frame"]["p95"]
    shown = [
        ("Frames tracked", f"{tracked} of {found['frames']}"),
        ("First fix", "none" if first is None else f"frame {first}"),
        ("Frames coasting", str(found["frames_coasting"])),
        ("Times lost", str(found["frames_lost"])),
        ("Standard deviation of a position", "" if sigma_m is None else metres(sigma_m)),
        ("Time to locate a frame, 95 %", known("{:.0f} ms", slow_s and 1000 * slow_s)),
        *run_figures(found),
    ]
    title = f"{last_part(result.name)} in the map {last_part(result.map_name)}"
    subtitle = f"{tracked} of {counted(found['frames'], 'frame')} tracked"
    sections = [Section("Path", blocks), run_section(found)]
    write_page(Page(title, subtitle, shown, sections, found), run)


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
