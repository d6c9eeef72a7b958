"""The pipeline behind `recon mesh`: a PLY or a run in, a surface in several formats out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import Any

from recon.commands.config import ReconConfig, dump_config
from recon.commands.finished_run import (
    CLOUD,
    OCTOMAP,
    PAIR_CLOUD,
    camera_of_pair,
    is_pair_run,
    open_run,
    refuse_as_target,
)
from recon.core.values import RectifiedCamera
from recon.core.values.cloud import Frame
from recon.export.mesh import (
    MeshSettings,
    check_coverage,
    mesh_coverage,
    reconstruct_mesh,
    reconstruct_view,
)
from recon.export.mesh.drive_mesh import write_drive_mesh
from recon.export.mesh.tile_store import TileStore
from recon.io.atomic import atomic_path, write_text
from recon.io.models.mesh import check_mesh_formats, read_mesh, write_mesh
from recon.io.models.mlp import write_mlp
from recon.io.models.ply import read_ply, read_ply_pieces, write_ply
from recon.io.occupancy.octomap_leaves import octomap_pieces
from recon.run.directory import RunDirectory
from recon.run.machine import use_threads
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost


@dataclass(frozen=True)
class MeshOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        out: Result folder; None = a new one below ``outputs/``.
        formats: File suffixes without the dot, such as ``("ply", "glb")``.
        threads: Threads to use; None = all cores.
    """

    out: Path | None = None
    formats: tuple[str, ...] = ("ply",)
    threads: int | None = None


def run_mesh(source: Path, config: ReconConfig, options: MeshOptions) -> dict[str, Any]:
    """Reconstruct the surface of a cloud file or of a run's map, and write a MeshLab project.

    A cloud file is meshed in one piece, since its scale is unknown; the cloud of a pair as
    `recon pair` does. The map of a run is meshed in tiles, and faces in observed free space are
    removed.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The cloud cannot be read or gives no surface, a format is unknown, or the
            folder cannot be written; nothing is left behind.
    """
    start = time.perf_counter()
    threads = use_threads(options.threads)
    check_mesh_formats(options.formats)
    watch = Stopwatch()
    cloud_path, camera = source, None
    if source.is_dir():
        refuse_as_target(source, options.out)
        if is_pair_run(source):
            cloud_path, camera = source / PAIR_CLOUD, camera_of_pair(source)
        else:
            cloud_path = open_run(source).folder / CLOUD
    frame: Frame | None = None if source.is_file() else "camera" if camera else "map"
    with RunDirectory.for_command("mesh", options.out) as directory:
        if frame == "map":
            figures = _mesh_run(source, config.mesh, directory, threads, watch)
        else:
            figures = _mesh_cloud(cloud_path, camera, config.mesh, directory, watch)
        with watch.stage("write"):
            whole = directory.path("mesh/mesh.ply")
            others = [suffix for suffix in dict.fromkeys(options.formats) if suffix != "ply"]
            for suffix in others:
                write_mesh(directory.path(f"mesh/mesh.{suffix}"), read_mesh(whole), frame)
            write_text(directory.path("config.yaml"), dump_config(config, "mesh"))
        summary = {
            "cloud": str(cloud_path),
            **figures,
            **cost(watch, time.perf_counter() - start),
            "out": str(directory.folder),
        }
        directory.write_json("summary.json", summary)
        record = {
            "source": str(source),
            "inputs": fingerprint([cloud_path]),
            "timings": watch.seconds,
        }
        write_record(directory, "mesh", record)
    return summary


def _mesh_cloud(
    path: Path,
    camera: RectifiedCamera | None,
    settings: MeshSettings,
    directory: RunDirectory,
    watch: Stopwatch,
) -> dict[str, Any]:
    """Mesh a cloud file in one piece, as its camera saw it if it is that of a pair."""
    with watch.stage("read"):
        cloud = read_ply(path)
        write_ply(directory.path("mesh/cloud.ply"), cloud)
    with watch.stage("mesh"):
        if camera is None:
            mesh, coverage = reconstruct_mesh(cloud, settings), None
        else:
            mesh = reconstruct_view(cloud, camera, settings)
            coverage = mesh_coverage(mesh, cloud)
    write_mesh(directory.path("mesh/mesh.ply"), mesh)
    layers = {name: directory.path(f"mesh/{name}.ply") for name in ("mesh", "cloud")}
    write_mlp(directory.path("mesh/mesh.mlp"), layers, None if camera is None else "camera")
    figures = {
        "points": len(cloud),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
    }
    if coverage is None:
        return {**figures, "warnings": []}
    return {**figures, "mesh_coverage": coverage, "warnings": list(check_coverage(coverage))}


def _mesh_run(
    run: Path, settings: MeshSettings, directory: RunDirectory, threads: int, watch: Stopwatch
) -> dict[str, Any]:
    """Mesh the map of a run tile by tile and write the surface."""
    warnings = []
    store = TileStore(directory.state("mesh"), settings.tile_m)
    layer = directory.path("mesh/cloud.ply")
    with watch.stage("read"):
        for cloud in read_ply_pieces(run / CLOUD):
            store.put_cloud(cloud)
        with atomic_path(layer) as temporary:
            copyfile(run / CLOUD, temporary)
        if settings.free_space and (run / OCTOMAP).is_file():
            for voxels in octomap_pieces(run / OCTOMAP):
                store.put_voxels(voxels)
        elif settings.free_space:
            warnings.append(f"the run has no {OCTOMAP}: free space is not known")
    with watch.stage("mesh"):
        written = write_drive_mesh(store, settings, directory, layer, threads)
    return {
        "points": store.total,
        "vertices": written.vertices,
        "faces": written.faces,
        "tiles": len(written.tiles),
        "warnings": [*warnings, *written.warnings],
    }
