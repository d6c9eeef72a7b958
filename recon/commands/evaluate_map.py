"""`recon evaluate map` without its command line: compare a map with a reference cloud."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from recon.commands.evaluate_trajectory import TOLERANCE_S
from recon.core.errors import EvaluationError, FormatError, SettingsError
from recon.core.geometry.alignment import fit_paths
from recon.core.geometry.se3 import angle_rad, invert
from recon.core.geometry.transform import transform_cloud
from recon.core.values import PointCloud, Trajectory
from recon.core.values.arrays import Float64
from recon.evaluation import associate, evaluate_map, register_cloud, within_reach
from recon.io.models.ply import read_ply
from recon.io.trajectory import holds_times, read_trajectory
from recon.run.directory import RECORD, RunDirectory
from recon.run.record import fingerprint, write_record
from recon.run.summary import plain

ReferenceFrame = Literal["camera", "map"]
_PATH = "trajectory_tum.txt"
# From half of either cloud near the other it is a fit; below a tenth of both it is none.
_FITS, _HARDLY_MEETS = 0.5, 0.1


@dataclass(frozen=True)
class MapFiles:
    """The clouds to compare, and how they are aligned.

    Attributes:
        run: A run's folder, or a PLY file. A PLY inside a run's folder is in that run's map axes;
            any other PLY is taken to be in the axes of the reference already.
        reference: A PLY file.
        frame: Axes of the reference: those of the first left camera, or the map's.
        align_to: Ground-truth poses of the run's cameras, in the axes of the reference; the run's
            path is aligned rigidly to them, and its map moves with it.
        icp: Whether the cloud is then aligned to the reference by ICP.
        thresholds_m: Distances below which a point counts as correct.
    """

    run: Path
    reference: Path
    frame: ReferenceFrame = "camera"
    align_to: Path | None = None
    icp: bool = False
    thresholds_m: tuple[float, ...] = (0.2,)


@dataclass(frozen=True, eq=False)
class MapComparison:
    """The result of a comparison, from which its clouds are coloured.

    Attributes:
        files: What was compared.
        cloud: The estimate, in the axes of the reference, aligned.
        reference: The reference.
        summary: The figures of ``summary.json``.
    """

    files: MapFiles
    cloud: PointCloud
    reference: PointCloud
    summary: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Estimate:
    """A cloud, and the run that it belongs to (None = no run)."""

    cloud: PointCloud
    folder: Path | None
    T_map_world: Float64 | None


Present = Callable[[MapComparison, RunDirectory], None]


def run_evaluate_map(
    files: MapFiles, out: Path | None = None, present: Present | None = None
) -> dict[str, Any]:
    """Compare a map with a reference cloud; with a folder, write the coloured clouds into it.

    Returns:
        The figures of the first threshold, those of each in ``by_threshold``, and how far the
        alignment moved the cloud.

    Raises:
        ReconError: A file cannot be read, the two cannot be compared, or the folder cannot be
            written; then no output is left behind.
    """
    if not files.thresholds_m:
        raise SettingsError("there is no threshold", where="--threshold")
    estimate = _read_estimate(files.run)
    cloud, path, found = _aligned(estimate, files)
    reference = replace(read_ply(files.reference), frame=cloud.frame)
    if files.icp:
        T, fitted = _icp_motion(cloud, reference, max(files.thresholds_m))
        cloud, path = transform_cloud(cloud, T, frame=cloud.frame), _moved(path, T)
        found |= fitted
    by_threshold = [plain(evaluate_map(cloud, reference, limit)) for limit in files.thresholds_m]
    found |= _in_reach(cloud, reference, path, by_threshold)
    doubt = _doubt(estimate, files, cloud, reference, by_threshold[0])
    warnings = [] if doubt is None else [doubt]
    summary = {**by_threshold[0], **found, "by_threshold": by_threshold, "warnings": warnings}
    if out is not None:
        _write(MapComparison(files, cloud, reference, summary), out, present)
    return summary


def _doubt(
    estimate: _Estimate,
    files: MapFiles,
    cloud: PointCloud,
    reference: PointCloud,
    figures: dict[str, Any],
) -> str | None:
    """A warning if the clouds are in different axes or far apart, so that figures are useless."""
    best = max(figures["precision"], figures["recall"])
    if best >= _FITS:
        return None
    T = estimate.T_map_world
    if T is not None and files.align_to is None and not files.icp:
        name, T_other = ("map", T) if files.frame == "camera" else ("camera", invert(T))
        moved = transform_cloud(cloud, T_other, frame=cloud.frame)
        f_score = evaluate_map(moved, reference, figures["threshold_m"]).f_score
        if f_score > max(2 * figures["f_score"], _HARDLY_MEETS):
            return (
                f"the reference seems to be in the axes of the {name}: there F would be "
                f"{f_score:.2f}; use --reference-frame {name}"
            )
    if best >= _HARDLY_MEETS:
        return None
    return (
        f"map and reference hardly meet: the median distance is {figures['median_m']:.3g} m; "
        "check --reference-frame, or align them with --align-to or --align icp"
    )


def _in_reach(
    cloud: PointCloud,
    reference: PointCloud,
    path: Trajectory | None,
    by_threshold: list[dict[str, Any]],
) -> dict[str, Any]:
    """Add the figures of the points within reach of the reference; return the share beyond."""
    if path is None:
        return {}
    judged = within_reach(cloud, reference, path)
    if not judged.any():
        return {"beyond_reach": 1.0}
    for found in by_threshold:
        part = evaluate_map(cloud.select(judged), reference, found["threshold_m"])
        found |= {"precision_in_reach": part.precision, "f_score_in_reach": part.f_score}
    return {"beyond_reach": float(1 - judged.mean())}


def _aligned(
    estimate: _Estimate, files: MapFiles
) -> tuple[PointCloud, Trajectory | None, dict[str, Any]]:
    """Cloud and path in the axes of the reference, and how they were moved."""
    if files.frame == "map" and files.align_to is not None:
        raise SettingsError(
            "--align-to needs a reference in the axes of the poses",
            where="--reference-frame",
            got="map",
            expected="camera",
        )
    T = np.eye(4)
    told: dict[str, Any] = {"alignment": "none"}
    if files.align_to is not None:
        T = _path_motion(estimate, files.align_to)
        told = {"alignment": "poses", **_size("path", T)}
    if estimate.folder is None or estimate.T_map_world is None:
        return estimate.cloud, None, told
    if files.frame == "map":
        return estimate.cloud, _moved(_path_of(estimate.folder), estimate.T_map_world), told
    cloud = transform_cloud(estimate.cloud, T @ invert(estimate.T_map_world), frame="camera")
    return cloud, _moved(_path_of(estimate.folder), T), told


def _path_of(folder: Path) -> Trajectory | None:
    """The path of a run, if it has one."""
    return read_trajectory(folder / _PATH) if (folder / _PATH).is_file() else None


def _moved(path: Trajectory | None, T: Float64) -> Trajectory | None:
    return None if path is None else Trajectory(T @ path.T_world_camera, path.timestamps_s)


def _path_motion(estimate: _Estimate, poses: Path) -> Float64:
    """The rigid motion that brings the run's path closest to ground truth."""
    if estimate.folder is None:
        raise EvaluationError(
            "a cloud without a run has no path to align", hint="give the folder of a run"
        )
    path, truth = read_trajectory(estimate.folder / _PATH), read_trajectory(poses)
    if holds_times(poses):
        path, truth = associate(path, truth, TOLERANCE_S)
    if len(path) != len(truth):
        raise EvaluationError(
            "run and true poses differ in length",
            where=poses,
            got=f"{len(truth)} poses",
            expected=f"{len(path)}",
        )
    return fit_paths(path, truth).T_to_from


def _icp_motion(
    cloud: PointCloud, reference: PointCloud, reach_m: float
) -> tuple[Float64, dict[str, Any]]:
    """The motion found by ICP, and its size."""
    T, share = register_cloud(cloud, reference, reach_m)
    # Measured at the centre of the map: a rotation about a far origin would look like a shift.
    middle = np.eye(4)
    middle[:3, 3] = cloud.xyz.mean(axis=0, dtype=np.float64)
    return T, {**_size("icp", invert(middle) @ T @ middle), "icp_share": share}


def _size(name: str, T: Float64) -> dict[str, Any]:
    moved_m, turned_deg = np.linalg.norm(T[:3, 3]), np.degrees(angle_rad(T))
    return {f"{name}_moved_m": float(moved_m), f"{name}_turned_deg": float(turned_deg)}


def _write(comparison: MapComparison, out: Path, present: Present | None) -> None:
    with RunDirectory.for_command("evaluate", out) as directory:
        comparison.summary["out"] = str(directory.folder)
        if present is not None:
            present(comparison, directory)
        directory.write_json("summary.json", comparison.summary)
        content = {
            "source": str(comparison.files.run),
            "inputs": fingerprint([comparison.files.reference]),
        }
        write_record(directory, "evaluate map", content)


def _read_estimate(run: Path) -> _Estimate:
    """The cloud, and the run that it belongs to, if any."""
    if run.is_dir():
        if not (run / RECORD).is_file():
            raise FormatError(
                "folder does not contain a finished run", where=run, expected=f"a {RECORD}"
            )
        return _Estimate(read_ply(run / "map" / "cloud.ply"), run, _read_axes(run / RECORD))
    folder = run.parent.parent
    if run.parent.name == "map" and (folder / RECORD).is_file():
        return _Estimate(read_ply(run), folder, _read_axes(folder / RECORD))
    return _Estimate(read_ply(run), None, None)


def _read_axes(record: Path) -> Float64:
    """T_map_world as the run recorded it."""
    try:
        T_map_world = np.array(json.loads(record.read_text(encoding="utf-8"))["T_map_world"], float)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError("record of the run has no T_map_world", where=record) from error
    if T_map_world.shape != (4, 4) or not np.isfinite(T_map_world).all():
        raise FormatError("T_map_world is not a 4x4 matrix", where=record)
    return T_map_world
