"""The map of a run beside a reference cloud, in its axes; and a drive beside its source's truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from recon.core.errors import EvaluationError, RegistrationError, SettingsError
from recon.core.geometry.alignment import fit_paths
from recon.core.geometry.se3 import angle_rad, invert, transform_cloud
from recon.core.text import counted
from recon.core.values import (
    MapMetrics,
    OccupancyGrid,
    OccupancyMetrics,
    PointCloud,
    SequenceTruth,
    Trajectory,
    TrajectoryMetrics,
)
from recon.core.values.arrays import Float64
from recon.evaluation.map import evaluate_map, register_cloud, within_reach
from recon.evaluation.occupancy import evaluate_occupancy
from recon.evaluation.summary import Placement, ReferenceFrame, ThresholdFigures
from recon.evaluation.trajectory import TOLERANCE_S, associate, evaluate_trajectory
from recon.io.models.ply import read_ply
from recon.io.trajectory import holds_times, read_trajectory
from recon.map.drive.sequence import MappedSequence
from recon.map.ground.grid import drop_undecided
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MAP_FILE, MapFile
from recon.places.places import drift_at_end, fit_to_path
from recon.run.directory import RECORD
from recon.run.finished import CLOUD, made_from
from recon.sources.source import StereoSource

# From half of either cloud near the other it is a fit; below a tenth of both it is none.
_FITS, _HARDLY_MEETS = 0.5, 0.1


@dataclass(frozen=True, eq=False)
class MapComparison:
    """The result of a comparison, from which its clouds are coloured."""

    cloud: PointCloud  # the estimate, in the axes of the reference, aligned
    reference: PointCloud
    thresholds_m: tuple[float, ...]  # distances below which a point counts as correct


class MapOfRun(NamedTuple):
    """The map of a finished run, as far as comparisons need it."""

    path: Trajectory | None  # of the cameras of its first drive, world axes; None = unknown
    T_map_world: Float64  # (4, 4), from world to map axes
    doubts: Sequence[str]  # what is not to be trusted in the map


def map_of_run(folder: Path) -> MapOfRun:
    """Read what is needed from the map of a run; without one, from its record and path file."""
    if (folder / MAP_FILE).is_file():
        with closing(MapFile.open(folder)) as map_:
            first = map_.first
            path = first.trajectory.select(map_.joined(first))
            return MapOfRun(path, map_.first.T_map_world, map_.doubts)
    T_map_world, doubts = made_from(folder)
    file = folder / "trajectory_tum.txt"
    return MapOfRun(read_trajectory(file) if file.is_file() else None, T_map_world, doubts)


def doubts_of_file(file: Path) -> list[str]:
    """Return lines of what is not to be trusted in the map of the run that a file belongs to."""
    folder = next((one for one in file.absolute().parents[:3] if (one / MAP_FILE).is_file()), None)
    return [] if folder is None else list(map_of_run(folder).doubts)


@dataclass(frozen=True, eq=False)
class MappedCloud:
    """A cloud, and as in `MapOfRun` what is known of the run that it belongs to."""

    cloud: PointCloud  # as read, in map axes if it is of a run
    path: Trajectory | None = None
    T_map_world: Float64 | None = None  # None = no run
    doubts: Sequence[str] = ()


def read_mapped_cloud(run: Path) -> MappedCloud:
    """Read the map of a run, by its folder, or a PLY file: map axes if it is inside a run's."""
    folder, file = (run, run / CLOUD) if run.is_dir() else (run.parent.parent, run)
    if file is run and (run.parent.name != "map" or not (folder / RECORD).is_file()):
        return MappedCloud(read_ply(run))
    map_ = map_of_run(folder)
    return MappedCloud(read_ply(file), *map_)


def place_cloud(
    mapped: MappedCloud, frame: ReferenceFrame, align_to: Path | None
) -> tuple[MappedCloud, Placement]:
    """Bring a map into the axes of its reference; also return how it was aligned.

    ``align_to`` are true poses of the run's cameras in these axes, to which its path is aligned
    rigidly.
    """
    if frame == "map" and align_to is not None:
        what = "--align-to needs a reference in the axes of the poses"
        raise SettingsError(what, where="--reference-frame", got="map", expected="camera")
    T_map_world, T = mapped.T_map_world, np.eye(4)
    how = Placement()
    if T_map_world is None and align_to is not None:
        what = "a cloud without a run has no path to align"
        raise EvaluationError(what, hint="give the folder of a run")
    if T_map_world is None:
        return mapped, how
    if frame == "map":
        return replace(mapped, path=_moved(mapped.path, T_map_world)), how
    if align_to is not None:
        T = _path_motion(mapped, align_to)
        moved_m, turned_deg = _size(T)
        how = Placement(alignment="poses", path_moved_m=moved_m, path_turned_deg=turned_deg)
    cloud = transform_cloud(mapped.cloud, T @ invert(T_map_world), frame="camera")
    return replace(mapped, cloud=cloud, path=_moved(mapped.path, T)), how


def possible_frames(
    mapped: MappedCloud, frame: ReferenceFrame | None, align_to: Path | None
) -> Sequence[ReferenceFrame]:
    """Return the axes in which a reference may be, the likelier first."""
    if frame is not None:
        return (frame,)
    return ("camera",) if align_to or mapped.T_map_world is None else ("camera", "map")


def place_by_icp(
    mapped: MappedCloud,
    reference: PointCloud,
    frames: Sequence[ReferenceFrame],
    align_to: Path | None,
    reach_m: float,
) -> tuple[MappedCloud, Placement]:
    """Bring a map into the axes of its reference (`place_cloud`), and align it there by ICP.

    Of several ``frames``, the cloud is placed where most of its points have a partner within
    ``reach_m``: ``reference_frame`` of how it was aligned.
    """
    found: list[tuple[MappedCloud, Placement]] = []
    for frame in frames:
        placed, how = place_cloud(mapped, frame, align_to)
        try:
            fitted, moved = _fit_cloud(placed, reference, reach_m, how)
        except RegistrationError:
            if frame == frames[-1] and not found:
                raise
        else:
            found.append((fitted, replace(moved, reference_frame=frame)))
    return max(found, key=lambda each: each[1].icp_ratio or 0.0)


def _fit_cloud(
    mapped: MappedCloud, reference: PointCloud, reach_m: float, how: Placement
) -> tuple[MappedCloud, Placement]:
    reference = replace(reference, frame=mapped.cloud.frame)
    T, ratio = register_cloud(mapped.cloud, reference, reach_m)
    # Measured at the centre of the map: a rotation about a far origin would look like a shift.
    middle = np.eye(4)
    middle[:3, 3] = mapped.cloud.xyz.mean(axis=0, dtype=np.float64)
    moved_m, turned_deg = _size(invert(middle) @ T @ middle)
    how = replace(how, icp_moved_m=moved_m, icp_turned_deg=turned_deg, icp_ratio=ratio)
    cloud = transform_cloud(mapped.cloud, T, frame=mapped.cloud.frame)
    return replace(mapped, cloud=cloud, path=_moved(mapped.path, T)), how


def within_reach_too(
    mapped: MappedCloud, reference: PointCloud, found: Sequence[MapMetrics]
) -> tuple[list[ThresholdFigures], float | None]:
    """Add figures within reach of the reference, if the path is known; return also the rest.

    That is the fraction of points beyond reach.
    """
    alone = [ThresholdFigures(metrics=one) for one in found]
    if mapped.path is None:
        return alone, None
    judged = within_reach(mapped.cloud, reference, mapped.path)
    if not judged.any():
        return alone, 1.0
    near = mapped.cloud.select(judged)
    parts = [evaluate_map(near, reference, one.threshold_m) for one in found]
    both = [
        replace(one, precision_in_reach=part.precision, f_score_in_reach=part.f_score)
        for one, part in zip(alone, parts, strict=True)
    ]
    return both, float(1 - judged.mean())


def doubt_axes(
    mapped: MappedCloud,
    reference: PointCloud,
    figures: MapMetrics,
    frame: ReferenceFrame,
    *,
    aligned: bool,
) -> list[str]:
    """Return warnings if the clouds are in different axes or far apart: useless figures."""
    best = max(figures.precision, figures.recall)
    if best >= _FITS:
        return []
    cloud, T = mapped.cloud, mapped.T_map_world
    if T is not None and not aligned:
        name, T_other = ("map", T) if frame == "camera" else ("camera", invert(T))
        moved = transform_cloud(cloud, T_other, frame=cloud.frame)
        f_score = evaluate_map(moved, reference, figures.threshold_m).f_score
        if f_score > max(2 * figures.f_score, _HARDLY_MEETS):
            found = f"the reference seems to be in the axes of the {name}: there F would be"
            return [f"{found} {f_score:.2f}; use --reference-frame {name}"]
    if best >= _HARDLY_MEETS:
        return []
    advice = "check --reference-frame, or align them with --align-to or --align icp"
    apart = f"the median distance is {figures.median_m:.3g} m"
    return [f"map and reference hardly meet: {apart}; {advice}"]


def _path_motion(mapped: MappedCloud, poses: Path) -> Float64:
    path, truth = mapped.path, read_trajectory(poses)
    if path is None:
        raise EvaluationError("the run has no path to align", hint="give one that has its map")
    if holds_times(poses):
        path, truth = associate(path, truth, TOLERANCE_S)
    if len(path) != len(truth):
        got = counted(len(truth), "pose")
        what = "run and true poses differ in length"
        raise EvaluationError(what, where=poses, got=got, expected=f"{len(path)}")
    fit = fit_to_path(path.positions_m, truth.positions_m, drift_at_end(path))
    fit.check(poses, "are these the poses of its cameras, in metres?")
    return fit_paths(path, truth).T_to_from


def _moved(path: Trajectory | None, T: Float64) -> Trajectory | None:
    return None if path is None else Trajectory(T @ path.T_world_camera, path.timestamps_s)


def _size(T: Float64) -> tuple[float, float]:
    """Return by how many metres and degrees a transform moves and turns."""
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(angle_rad(T)))


_NEAR_M: Final = 0.2  # a map point of a road this near the true surface is correct
LEAST_FRAMES: Final = 3  # number of frames that must have seen a cell for it to be compared


@dataclass(frozen=True)
class DriveErrors:
    """Errors of a drive; None = the truth is not known, or cannot be compared with."""

    path: TrajectoryMetrics | None
    surface: MapMetrics | None
    occupancy: OccupancyMetrics | None
    warnings: tuple[str, ...] = ()  # what could not be compared
    true_path: Trajectory | None = None  # to be drawn


def compare_with_truth(
    source: StereoSource,
    mapped: MappedSequence,
    grid: OccupancyGrid,
    true_path: Trajectory | None,
    *,
    poses_given: bool,
) -> DriveErrors:
    """Compare a mapped drive and its grid with the truth that its source knows.

    ``true_path`` is that of the camera of the map. Poses that were given are no estimate, and 0 %
    drift would mislead: the paths are not compared.
    """
    warnings: list[str] = []

    def attempt(what: str, true: Any, compare: Callable[[Any], Any]) -> Any:
        try:
            return None if true is None else compare(true)
        except EvaluationError as error:
            warnings.append(f"not compared with the true {what}: {error}")

    truth = source.truth or SequenceTruth()
    path = None if poses_given else true_path
    own, near_m = mapped.trajectory.select(mapped.joined), mapped.config.scale * _NEAR_M
    cells = source.occupancy_truth(**occupancy_view(mapped.config, mapped.T_map_world))
    return DriveErrors(
        attempt("path", path, lambda true: evaluate_trajectory(own, true)),
        # Loads the whole cloud, but only where the whole true surface is in memory as well.
        attempt("surface", truth.surface, lambda true: evaluate_map(mapped.cloud, true, near_m)),
        attempt(
            "occupancy",
            cells,
            lambda true: evaluate_occupancy(drop_undecided(mapped.voxels), grid, true),
        ),
        tuple(warnings),
        true_path,
    )


def occupancy_view(
    config: DriveSettings, T_map_world: Float64, least_frames: int = LEAST_FRAMES
) -> dict[str, Any]:
    """Return the cells, axes and height band of a map, for `StereoSource.occupancy_truth`."""
    return {
        "resolution_m": config.occupancy.resolution_m,
        "band_m": (config.grid.min_height_m, config.grid.max_height_m),
        "range_m": config.occupancy.max_range_m,
        "least_frames": least_frames,
        "T_map_world": T_map_world,
    }
