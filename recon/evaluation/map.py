"""Accuracy and completeness of maps beside reference clouds, and of drives beside their truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recon.core.errors import EvaluationError, RegistrationError, SettingsError
from recon.core.geometry.alignment import fit_paths
from recon.core.geometry.se3 import angle_rad, invert, transform_cloud
from recon.core.lazy import Lazy, quiet_open3d
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
from recon.core.values.arrays import Bool, Float32, Float64
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
from recon.stereo import open3d_clouds

o3d = Lazy("open3d")

_BAND_PERCENT: Final = (0.1, 99.9)
_BAND_M: Final = 0.2
_ITERATIONS, _NORMAL_NEIGHBOURS, _CONVERGED = 60, 20, 1e-7  # of ICP


def evaluate_map(
    cloud: PointCloud, reference: PointCloud, threshold_m: float, voxel_m: float | None = None
) -> MapMetrics:
    """Compare a cloud with a reference in the same frame.

    Both are first reduced to one point per voxel, so that dense regions do not dominate: a stereo
    cloud has a hundred times more points on a wall at 3 m than on one at 30 m.

    Args:
        cloud: The estimate.
        reference: The cloud taken as true; surfaces that it lacks count against the precision.
        threshold_m: Distance below which a point counts as correct.
        voxel_m: Voxel size; None = half of the threshold.

    Raises:
        EvaluationError: A cloud is empty, the frames differ, or the threshold is not positive.

    Ref: Knapitsch et al., "Tanks and Temples", ACM TOG 36(4), 2017, section 4.
    """
    _check(cloud, reference, threshold_m)
    voxel_m = threshold_m / 2 if voxel_m is None else voxel_m
    estimate_xyz, reference_xyz = _thinned(cloud, voxel_m), _thinned(reference, voxel_m)
    to_reference_m = nearest_distances(estimate_xyz, reference_xyz)
    precision = float(np.mean(to_reference_m < threshold_m))
    recall = float(np.mean(nearest_distances(reference_xyz, estimate_xyz) < threshold_m))
    found = precision + recall
    return MapMetrics(
        threshold_m=threshold_m,
        precision=precision,
        recall=recall,
        f_score=2 * precision * recall / found if found else 0.0,
        median_m=float(np.median(to_reference_m)),
        p95_m=float(np.percentile(to_reference_m, 95)),
        points=len(estimate_xyz),
        reference_points=len(reference_xyz),
    )


def within_reach(cloud: PointCloud, reference: PointCloud, path: Trajectory) -> Bool:
    """Return which points are within the heights, relative to the path, that the reference covers.

    A LiDAR sees little above its own height: points there can be neither confirmed nor refuted.
    """
    low_m, high_m = np.percentile(_heights_m(reference.xyz, path), _BAND_PERCENT)
    heights_m = _heights_m(cloud.xyz, path)
    return np.asarray((heights_m >= low_m - _BAND_M) & (heights_m <= high_m + _BAND_M))


def _heights_m(xyz: Float32, path: Trajectory) -> Float64:
    """Return float64 (N,): height above the nearest camera, along its y axis."""
    nearest = open3d_clouds.nearest(xyz, path.positions_m)[0][:, 0]
    down = path.T_world_camera[nearest, :3, 1]
    return np.asarray(-np.einsum("ni,ni->n", down, xyz - path.positions_m[nearest]))


def nearest_distances(xyz: Float32, reference_xyz: Float32) -> Float32:
    """Return float32 (N,), the distance of each point to the nearest of the reference, metres."""
    return open3d_clouds.nearest(xyz, reference_xyz)[1][:, 0]


def _check(cloud: PointCloud, reference: PointCloud, threshold_m: float) -> None:
    if not (isinstance(cloud, PointCloud) and isinstance(reference, PointCloud)):
        raise EvaluationError(
            "only point clouds can be compared",
            got=f"{type(cloud).__name__} and {type(reference).__name__}",
            expected="two PointClouds, such as of read_ply",
        )
    for name, points in (("estimated", cloud), ("reference", reference)):
        if len(points) == 0:
            raise EvaluationError(f"the {name} cloud is empty")
    if cloud.frame != reference.frame:
        got, hint = f"{cloud.frame} and {reference.frame}", "transform one of them first"
        raise EvaluationError("the clouds are in different frames", got=got, hint=hint)
    if not (np.isfinite(threshold_m) and threshold_m > 0):
        raise EvaluationError("the threshold is not positive", got=f"{threshold_m:g} m")


def _thinned(cloud: PointCloud, voxel_m: float) -> Float32:
    return open3d_clouds.voxel_downsample(cloud.xyz, np.zeros((len(cloud), 0)), voxel_m)[0]


def icp(
    xyz: NDArray[Any], reference_xyz: NDArray[Any], reaches_m: tuple[float, ...]
) -> tuple[Float64, float]:
    """Align points (N, 3) to a reference cloud by robust point-to-plane ICP, from where they are.

    ``reaches_m``: largest distance of partners in each pass, decreasing. Returns
    ``T_reference_points``, and the fraction of the points that have a partner in the last pass.

    Ref: Chen & Medioni, "Object modelling by registration of multiple range images", 1992;
    robust weights: Babin et al., "Analysis of robust functions for registration algorithms", 2019.
    """
    registration = o3d.pipelines.registration
    # Far from the origin, a small rotation about it is a large motion: centre both clouds.
    centre = np.mean(reference_xyz, axis=0, dtype=np.float64)
    source, target = _cloud(xyz - centre), _cloud(reference_xyz - centre)
    criteria = registration.ICPConvergenceCriteria(_CONVERGED, _CONVERGED, _ITERATIONS)
    T, fitness = np.eye(4), 0.0
    with quiet_open3d():
        target.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS))
        for reach_m in reaches_m:
            kernel = registration.TukeyLoss(k=reach_m)
            estimation = registration.TransformationEstimationPointToPlane(kernel)
            found = registration.registration_icp(source, target, reach_m, T, estimation, criteria)
            T, fitness = np.asarray(found.transformation).copy(), float(found.fitness)
            if fitness == 0 or not np.isfinite(T).all():
                expected = f"clouds within {reach_m:g} m of each other"
                raise RegistrationError("ICP found no corresponding points", expected=expected)
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = centre, -centre
    return there @ T @ back, fitness


def _cloud(xyz: NDArray[Any]) -> Any:
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(xyz, dtype=np.float64)))


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
        with MapFile.open(folder) as map_:
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

    ``align_to`` are true poses of the run's cameras in these axes, to which its path is aligned.
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

    Of several ``frames`` it is that in which most points have a partner within ``reach_m``.
    """
    found: list[tuple[MappedCloud, Placement]] = []
    for frame in frames:
        placed, how = place_cloud(mapped, frame, align_to)
        cloud, axes = placed.cloud, placed.cloud.frame
        try:
            _check(cloud, replace(reference, frame=axes), reach_m)
            xyz, reference_xyz = (_thinned(one, reach_m / 2) for one in (cloud, reference))
            # Only the errors of its shape are left.
            T, ratio = icp(xyz, reference_xyz, (10 * reach_m, 3 * reach_m, reach_m))
        except RegistrationError:
            if frame == frames[-1] and not found:
                raise
            continue
        # Measured at the centre of the map: a rotation about a far origin would look like a shift.
        middle = np.eye(4)
        middle[:3, 3] = cloud.xyz.mean(axis=0, dtype=np.float64)
        moved_m, turned_deg = _size(invert(middle) @ T @ middle)
        moved = replace(how, icp_moved_m=moved_m, icp_turned_deg=turned_deg, icp_ratio=ratio)
        cloud, path = transform_cloud(cloud, T, frame=axes), _moved(placed.path, T)
        fitted = replace(placed, cloud=cloud, path=path)
        found.append((fitted, replace(moved, reference_frame=frame)))
    return max(found, key=lambda each: each[1].icp_ratio or 0.0)


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

    ``true_path`` is that of the camera of the map. Poses that were given are no estimate: a drift
    of 0 % would mislead.
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
