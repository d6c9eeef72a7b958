"""The map of a run beside a reference cloud: in its axes, with a warning where they seem wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from recon.core.errors import EvaluationError, RegistrationError, SettingsError
from recon.core.geometry.alignment import fit_paths
from recon.core.geometry.se3 import angle_rad, invert, transform_cloud
from recon.core.text import counted
from recon.core.values import PointCloud, Trajectory
from recon.core.values.arrays import Float64
from recon.evaluation.map import evaluate_map, register_cloud, within_reach
from recon.evaluation.map_of_run import map_of_run
from recon.evaluation.segments import TOLERANCE_S, associate
from recon.io.models.ply import read_ply
from recon.io.trajectory import holds_times, read_trajectory
from recon.places.places import drift_at_end, fit_to_path
from recon.run.directory import RECORD
from recon.run.finished import CLOUD

ReferenceFrame = Literal["camera", "map"]
# From half of either cloud near the other it is a fit; below a tenth of both it is none.
_FITS, _HARDLY_MEETS = 0.5, 0.1


@dataclass(frozen=True, eq=False)
class MapComparison:
    """The result of a comparison, from which its clouds are coloured."""

    cloud: PointCloud  # the estimate, in the axes of the reference, aligned
    reference: PointCloud  # the reference
    thresholds_m: tuple[float, ...]  # distances below which a point counts as correct
    summary: dict[str, Any]  # the figures of ``summary.json``


@dataclass(frozen=True, eq=False)
class MappedCloud:
    """A cloud, and the run that it belongs to."""

    cloud: PointCloud  # as read, in map axes if it is of a run
    path: Trajectory | None = None  # of the cameras; as read, in world axes; None = unknown
    T_map_world: Float64 | None = None  # (4, 4), from world to map axes; None = no run
    doubts: Sequence[str] = ()  # what is not to be trusted in the map of the run


def read_mapped_cloud(run: Path) -> MappedCloud:
    """Read the map of a run, by its folder, or a PLY file.

    A PLY inside a run's folder is in that run's map axes.
    """
    folder = run if run.is_dir() else run.parent.parent
    if not run.is_dir() and (run.parent.name != "map" or not (folder / RECORD).is_file()):
        return MappedCloud(read_ply(run))
    map_, cloud = map_of_run(folder), read_ply(run / CLOUD if run.is_dir() else run)
    return MappedCloud(cloud, map_.path, map_.T_map_world, map_.doubts)


def place_cloud(
    mapped: MappedCloud, frame: ReferenceFrame, align_to: Path | None
) -> tuple[MappedCloud, dict[str, Any]]:
    """Bring a map into the axes of its reference: those of the first left camera, or the map's.

    A cloud of no run is taken to be in them already. ``align_to`` are true poses of the run's
    cameras in these axes, to which its path is aligned rigidly. Also returns how it was aligned.
    """
    if frame == "map" and align_to is not None:
        raise SettingsError(
            "--align-to needs a reference in the axes of the poses",
            where="--reference-frame",
            got="map",
            expected="camera",
        )
    T_map_world = mapped.T_map_world
    if T_map_world is None and align_to is not None:
        raise EvaluationError(
            "a cloud without a run has no path to align", hint="give the folder of a run"
        )
    if T_map_world is None:
        return mapped, {"alignment": "none"}
    if frame == "map":
        return replace(mapped, path=_moved(mapped.path, T_map_world)), {"alignment": "none"}
    T = np.eye(4)
    how: dict[str, Any] = {"alignment": "none"}
    if align_to is not None:
        T = _path_motion(mapped, align_to)
        how = {"alignment": "poses", **_size("path", T)}
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
) -> tuple[MappedCloud, dict[str, Any], ReferenceFrame]:
    """Bring a map into the axes of its reference (`place_cloud`), and align it there by ICP.

    Of several ``frames``, the cloud is placed where most of its points have a partner within
    ``reach_m``. Returns the map, how it was aligned, and the axes.
    """
    found: list[tuple[MappedCloud, dict[str, Any], ReferenceFrame]] = []
    for frame in frames:
        placed, how = place_cloud(mapped, frame, align_to)
        try:
            fitted, moved = _fit_cloud(placed, reference, reach_m)
        except RegistrationError:
            if frame == frames[-1] and not found:
                raise
            continue
        found.append((fitted, {**how, "reference_frame": frame, **moved}, frame))
    return max(found, key=lambda each: each[1]["icp_share"])


def _fit_cloud(
    mapped: MappedCloud, reference: PointCloud, reach_m: float
) -> tuple[MappedCloud, dict[str, Any]]:
    reference = replace(reference, frame=mapped.cloud.frame)
    T, share = register_cloud(mapped.cloud, reference, reach_m)
    # Measured at the centre of the map: a rotation about a far origin would look like a shift.
    middle = np.eye(4)
    middle[:3, 3] = mapped.cloud.xyz.mean(axis=0, dtype=np.float64)
    figures = {**_size("icp", invert(middle) @ T @ middle), "icp_share": share}
    cloud = transform_cloud(mapped.cloud, T, frame=mapped.cloud.frame)
    return replace(mapped, cloud=cloud, path=_moved(mapped.path, T)), figures


def add_within_reach(
    mapped: MappedCloud, reference: PointCloud, by_threshold: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Add the figures of the points within reach of the reference; return the share beyond.

    Nothing is added where the path of the cameras is unknown.
    """
    if mapped.path is None:
        return {}
    judged = within_reach(mapped.cloud, reference, mapped.path)
    if not judged.any():
        return {"beyond_reach": 1.0}
    for found in by_threshold:
        part = evaluate_map(mapped.cloud.select(judged), reference, found["threshold_m"])
        found |= {"precision_in_reach": part.precision, "f_score_in_reach": part.f_score}
    return {"beyond_reach": float(1 - judged.mean())}


def doubt_axes(
    mapped: MappedCloud,
    reference: PointCloud,
    figures: Mapping[str, Any],
    frame: ReferenceFrame,
    *,
    aligned: bool,
) -> list[str]:
    """Return warnings if the clouds are in different axes or far apart: useless figures."""
    best = max(figures["precision"], figures["recall"])
    if best >= _FITS:
        return []
    cloud, T = mapped.cloud, mapped.T_map_world
    if T is not None and not aligned:
        name, T_other = ("map", T) if frame == "camera" else ("camera", invert(T))
        moved = transform_cloud(cloud, T_other, frame=cloud.frame)
        f_score = evaluate_map(moved, reference, figures["threshold_m"]).f_score
        if f_score > max(2 * figures["f_score"], _HARDLY_MEETS):
            found = f"the reference seems to be in the axes of the {name}: there F would be"
            return [f"{found} {f_score:.2f}; use --reference-frame {name}"]
    if best >= _HARDLY_MEETS:
        return []
    advice = "check --reference-frame, or align them with --align-to or --align icp"
    apart = f"the median distance is {figures['median_m']:.3g} m"
    return [f"map and reference hardly meet: {apart}; {advice}"]


def _path_motion(mapped: MappedCloud, poses: Path) -> Float64:
    """Return the rigid motion that brings the run's path closest to ground truth."""
    path, truth = mapped.path, read_trajectory(poses)
    if path is None:
        raise EvaluationError("the run has no path to align", hint="give one that has its map")
    if holds_times(poses):
        path, truth = associate(path, truth, TOLERANCE_S)
    if len(path) != len(truth):
        raise EvaluationError(
            "run and true poses differ in length",
            where=poses,
            got=counted(len(truth), "pose"),
            expected=f"{len(path)}",
        )
    fit = fit_to_path(path.positions_m, truth.positions_m, drift_at_end(path))
    fit.check(poses, "are these the poses of its cameras, in metres?")
    return fit_paths(path, truth).T_to_from


def _moved(path: Trajectory | None, T: Float64) -> Trajectory | None:
    return None if path is None else Trajectory(T @ path.T_world_camera, path.timestamps_s)


def _size(name: str, T: Float64) -> dict[str, Any]:
    moved_m, turned_deg = np.linalg.norm(T[:3, 3]), np.degrees(angle_rad(T))
    return {f"{name}_moved_m": float(moved_m), f"{name}_turned_deg": float(turned_deg)}
