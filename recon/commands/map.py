"""The pipeline behind `recon map`: a source in, a folder of maps out."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, dump_config
from recon.commands.finished_run import UNTRUSTED
from recon.commands.resume import begin_or_resume, identity_of, tell_how_to_resume
from recon.core.errors import EvaluationError, MeshingError
from recon.core.geometry.se3 import invert
from recon.core.values import (
    MapMetrics,
    OccupancyGrid,
    OccupancyMetrics,
    PointCloud,
    SequenceTruth,
    Trajectory,
    TrajectoryMetrics,
    TriangleMesh,
)
from recon.evaluation import evaluate_map, evaluate_trajectory
from recon.evaluation.occupancy_truth import compare_with_source
from recon.export.files import write_map
from recon.export.mesh import MeshSettings
from recon.export.mesh.drive_mesh import mesh_to_show, store_map, write_drive_mesh
from recon.io.atomic import write_text
from recon.io.trajectory import write_kitti_poses, write_tum
from recon.map import base_axes
from recon.map.empty import check_map
from recon.map.finished import keep_map
from recon.map.persistent import MAP_FILE
from recon.map.sequence import MappedSequence, map_sequence
from recon.map.workspace import Workspace
from recon.odometry.health import health_warnings
from recon.run.directory import RunDirectory
from recon.run.machine import use_threads
from recon.run.progress import SILENT, Progress
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost, plain
from recon.sources import IncompleteSource, StereoSource

SURFACE_THRESHOLD_M: Final = 0.2
"""Distance to the true surface below which a map point counts as correct."""


@dataclass(frozen=True, eq=False)
class MapRun:
    """Results of a run, from which its report is made.

    Attributes:
        name: Display name of the source.
        config: The configuration.
        mapped: Trajectory, health, fused cloud, voxels.
        cloud: Even sample of the fused cloud; all points of a small one. Frame ``map``.
        grid: The flat grid.
        camera_height_m: Height of the camera above the ground; None = unknown, or not steady.
        mesh: The surface in map axes, or None if none was requested, none could be made, or it
            does not fit in memory.
        truth: Ground truth of path and surface, as far as the source knows it.
        metrics: Errors against the true path, or None without one.
        map_metrics: Errors against the true surface, or None without one.
        occupancy_metrics: Errors against the true occupancy, or None without one.
        summary: The figures of ``summary.json``.
        warnings: Problems that did not stop the run.
    """

    name: str
    config: ReconConfig
    mapped: MappedSequence
    cloud: PointCloud
    grid: OccupancyGrid
    camera_height_m: float | None
    mesh: TriangleMesh | None
    truth: SequenceTruth | None
    metrics: TrajectoryMetrics | None
    map_metrics: MapMetrics | None
    occupancy_metrics: OccupancyMetrics | None
    summary: dict[str, Any]
    warnings: tuple[str, ...]

    def __repr__(self) -> str:
        made = f"{self.mapped}, {self.grid}, {self.mesh}"
        return f"MapRun({self.name!r}, {made}, {len(self.warnings)} warnings)"


@dataclass(frozen=True)
class MapOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        command: Command name, for the record and the default folder.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        known_poses: Poses to use instead of odometry, one per frame.
        prior: Motion of the left camera from another sensor, in the time base of the source.
        prior_origin: Where it is from, for the summary.
        mesh: Whether to reconstruct a surface.
        progress: Shown how far the run is.
        present: Writes figures and the report into the result folder.
        resume: Resume the unfinished run in ``out``.
        arguments: Command-line arguments, stored so that resuming need not repeat them.
        warnings: Findings of the audit of the source before the run.
    """

    command: str = "map"
    out: Path | None = None
    threads: int | None = None
    known_poses: Trajectory | None = None
    prior: Trajectory | None = None
    prior_origin: str = ""
    mesh: bool = True
    progress: Progress = SILENT
    present: Callable[[MapRun, RunDirectory], None] | None = None
    resume: bool = False
    arguments: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def run_map(source: StereoSource, config: ReconConfig, options: MapOptions) -> MapRun:
    """Map a source; write trajectory, clouds, grids, mesh, report, summary and record.

    Raises:
        ReconError: The source cannot be read or registered; nothing is left behind. Or the folder
            cannot be written or the memory limit is exceeded; the run can then be resumed.
    """
    start = time.perf_counter()
    threads = use_threads(options.threads)
    watch = Stopwatch()
    identity = identity_of(source, config, options.known_poses, options.prior)
    target = RunDirectory.for_command(options.command, options.out, resume=options.resume)
    with target as directory, tell_how_to_resume(directory), ExitStack() as made:
        map_ = made.enter_context(
            begin_or_resume(directory, source, config, identity, options.arguments)
        )
        mapped = map_sequence(
            source,
            config,
            known_poses=options.known_poses,
            prior=options.prior,
            progress=options.progress,
            workspace=Workspace(map_, watch, threads),
        )
        run = _finish(source, config, mapped, options, directory, watch)
        with watch.stage("write"):
            _write(run, directory)
            keep_map(map_, directory.path(MAP_FILE), config)
        run.summary.update(cost(watch, time.perf_counter() - start))
        if options.present is not None:
            options.progress.on_stage("report")
            with watch.stage("report"):
                options.present(run, directory)
            config.memory.check("report")
        run.summary.update(cost(watch, time.perf_counter() - start))
        run.summary["out"] = str(directory.folder)
        directory.write_json("summary.json", run.summary)
        with watch.stage("hash"):
            inputs = fingerprint(source.files)
        write_record(
            directory,
            options.command,
            {
                "source": source.name,
                "source_description": source.description,
                "inputs": inputs,
                "T_map_world": mapped.T_map_world.tolist(),
                UNTRUSTED: [n for n, record in enumerate(mapped.health) if not record.ok],
                "timings": watch.seconds,
                "peak_memory_mb": run.summary["peak_memory_mb"],
                "warnings": list(run.warnings),
            },
        )
    return run


def _finish(
    source: StereoSource,
    config: ReconConfig,
    mapped: MappedSequence,
    options: MapOptions,
    directory: RunDirectory,
    watch: Stopwatch,
) -> MapRun:
    """Make the products that need the whole drive; map files are written immediately."""
    warnings = [*options.warnings, *_left_out(source), *health_warnings(mapped.health)]
    if mapped.prior is not None:
        warnings += mapped.prior.warnings()
    if mapped.loops is not None:
        warnings += mapped.loops.warnings()
    options.progress.on_stage("map")
    check_map(mapped, source.name)
    written = write_map(mapped, directory, watch)
    warnings += written.warnings
    mesh, faces = None, 0
    if options.mesh:
        options.progress.on_stage("mesh")
        with watch.stage("mesh"):
            mesh, faces = _mesh(mapped, config.mesh, directory, options.threads, warnings)
        config.memory.check("mesh")
    truth = source.truth
    with watch.stage("compare"):
        # Given poses are not an estimate; reporting 0 % drift would be misleading.
        given = options.known_poses is not None
        metrics = None if given else _compare_paths(mapped.trajectory, truth, warnings)
        map_metrics = _compare_surfaces(mapped, truth, warnings)
        occupancy_metrics = compare_with_source(source, config, mapped, written.grid, warnings)
    run = MapRun(
        name=source.name,
        config=config,
        mapped=mapped,
        cloud=written.cloud,
        grid=written.grid,
        camera_height_m=written.camera_height_m,
        mesh=mesh,
        truth=truth,
        metrics=metrics,
        map_metrics=map_metrics,
        occupancy_metrics=occupancy_metrics,
        summary={},
        warnings=tuple(warnings),
    )
    odometry = "known poses" if given else config.odometry.method
    sizes = {"points": written.points, "voxels": written.voxels, "faces": faces}
    run.summary.update(odometry=odometry, **_summary(run), **sizes)
    if isinstance(source, IncompleteSource):
        run.summary["frames_left_out"] = source.left_out
    if mapped.prior is not None:
        run.summary["prior"] = {"from": options.prior_origin, **plain(mapped.prior)}
    return run


def _left_out(source: StereoSource) -> list[str]:
    """A warning if images of the source have no partner."""
    count = source.left_out if isinstance(source, IncompleteSource) else 0
    if not count:
        return []
    return [f"{count} {'image has' if count == 1 else 'images have'} no partner: left out"]


def _mesh(
    mapped: MappedSequence,
    settings: MeshSettings,
    directory: RunDirectory,
    threads: int | None,
    warnings: list[str],
) -> tuple[TriangleMesh | None, int]:
    """Write the surface; failure is only a warning, since the map is usable without one."""
    store = store_map(mapped, settings, directory.state("mesh"))
    # Each tile being meshed takes memory of its own.
    at_once = threads if mapped.config.memory.limit_mb is None else 1
    layer = directory.path("map/cloud.ply")
    try:
        written = write_drive_mesh(store, settings, directory, layer, at_once)
    except MeshingError as error:
        warnings.append(f"no mesh: {error}")
        return None, 0
    warnings += written.warnings
    return mesh_to_show(written, directory.path("mesh/mesh.ply")), written.faces


def _compare_paths(
    trajectory: Trajectory, truth: SequenceTruth | None, warnings: list[str]
) -> TrajectoryMetrics | None:
    if truth is None or truth.trajectory is None:
        return None
    try:
        return evaluate_trajectory(trajectory, truth.trajectory)
    except EvaluationError as error:
        warnings.append(f"not compared with the true path: {error}")
        return None


def _compare_surfaces(
    mapped: MappedSequence, truth: SequenceTruth | None, warnings: list[str]
) -> MapMetrics | None:
    if truth is None or truth.surface is None:
        return None
    try:
        # Loads the whole cloud, but only where the whole true surface is in memory as well.
        return evaluate_map(mapped.cloud, truth.surface, SURFACE_THRESHOLD_M)
    except EvaluationError as error:
        warnings.append(f"not compared with the true surface: {error}")
        return None


def _summary(run: MapRun) -> dict[str, Any]:
    frames, seconds = len(run.mapped.trajectory), run.mapped.seconds
    figures: dict[str, Any] = {
        "source": run.name,
        "frames": frames,
        "fps": frames / seconds if seconds > 0 else None,
        "path_length_m": run.mapped.trajectory.path_length_m,
        "frames_not_trusted": sum(not record.ok for record in run.mapped.health),
        "focal_px": run.mapped.camera.focal_px,
        "field_of_view_deg": run.mapped.camera.field_of_view_deg,
        "T_map_world": run.mapped.T_map_world.tolist(),
        "camera_height_m": run.camera_height_m,
        "T_base_camera": base_axes(run.mapped.T_map_world, run.camera_height_m).tolist(),
        "warnings": list(run.warnings),
    }
    if run.mapped.loops is not None:
        figures["loops"] = run.mapped.loops.figures()
    if run.metrics is not None:
        figures["trajectory"] = plain(run.metrics)
    if run.map_metrics is not None:
        figures["map"] = plain(run.map_metrics)
    if run.occupancy_metrics is not None:
        figures["occupancy"] = plain(run.occupancy_metrics)
    return figures


def _write(run: MapRun, directory: RunDirectory) -> None:
    path = directory.path
    write_kitti_poses(path("trajectory_kitti.txt"), run.mapped.trajectory)
    write_tum(path("trajectory_tum.txt"), run.mapped.trajectory)
    write_tum(path("trajectory_map_base_tum.txt"), _base_in_map(run))
    if run.mapped.loops is not None and run.mapped.loops.closure.closed:
        write_tum(path("trajectory_odometry_tum.txt"), run.mapped.loops.odometry)
        directory.write_json("loops.json", run.mapped.loops.edges())
    write_text(path("config.yaml"), dump_config(run.config, "map"))


def _base_in_map(run: MapRun) -> Trajectory:
    """The poses of the vehicle's base in the map, ``T_map_base``, as a trajectory."""
    path, T_map_world = run.mapped.trajectory, run.mapped.T_map_world
    T_camera_base = invert(base_axes(T_map_world, run.camera_height_m))
    return replace(path, T_world_camera=T_map_world @ path.T_world_camera @ T_camera_base)
