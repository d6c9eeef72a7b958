"""The pipeline behind `recon mesh`: a PLY or a run in, a surface in several formats out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from shutil import copyfile
from typing import Any

from recon.errors import SettingsError
from recon.formats.atomic import atomic_path, write_text
from recon.formats.mesh import MESH_SUFFIXES, read_mesh, write_mesh
from recon.formats.mlp import write_mlp
from recon.formats.octomap_leaves import octomap_pieces
from recon.formats.ply import read_ply, read_ply_pieces, write_ply
from recon.meshing import MeshSettings, reconstruct_mesh
from recon.pipeline.config import ReconConfig, dump_config
from recon.pipeline.drive_mesh import write_drive_mesh
from recon.pipeline.finished_run import CLOUD, OCTOMAP, open_run, refuse_as_target
from recon.pipeline.machine import use_threads
from recon.pipeline.record import fingerprint, write_record
from recon.pipeline.run_directory import RunDirectory
from recon.pipeline.stopwatch import Stopwatch
from recon.pipeline.summary import cost
from recon.pipeline.tile_store import TileStore


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

    A cloud file is meshed in one piece, since its scale is unknown. The map of a run is meshed in
    tiles, and faces in observed free space are removed.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The cloud cannot be read or gives no surface, a format is unknown, or the
            folder cannot be written; nothing is left behind.
    """
    start = time.perf_counter()
    threads = use_threads(options.threads)
    _check_formats(options.formats)
    watch = Stopwatch()
    cloud_path = source
    if source.is_dir():
        cloud_path = open_run(source).folder / CLOUD
        refuse_as_target(source, options.out)
    with RunDirectory.for_command("mesh", options.out) as directory:
        if source.is_dir():
            figures = _mesh_run(source, config.mesh, directory, threads, watch)
        else:
            figures = _mesh_cloud(source, config.mesh, directory, watch)
        with watch.stage("write"):
            whole = directory.path("mesh/mesh.ply")
            others = [suffix for suffix in dict.fromkeys(options.formats) if suffix != "ply"]
            for suffix in others:
                write_mesh(directory.path(f"mesh/mesh.{suffix}"), read_mesh(whole))
            write_text(directory.path("config.yaml"), dump_config(config))
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
    path: Path, settings: MeshSettings, directory: RunDirectory, watch: Stopwatch
) -> dict[str, Any]:
    """Mesh a cloud file in one piece and write the surface."""
    with watch.stage("read"):
        cloud = read_ply(path)
        write_ply(directory.path("mesh/cloud.ply"), cloud)
    with watch.stage("mesh"):
        mesh = reconstruct_mesh(cloud, settings)
    write_mesh(directory.path("mesh/mesh.ply"), mesh)
    layers = {name: directory.path(f"mesh/{name}.ply") for name in ("mesh", "cloud")}
    write_mlp(directory.path("mesh/mesh.mlp"), layers)
    return {
        "points": len(cloud),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "warnings": [],
    }


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


def _check_formats(formats: tuple[str, ...]) -> None:
    unknown = [name for name in formats if f".{name}" not in MESH_SUFFIXES]
    if unknown:
        raise SettingsError(
            "unknown mesh format",
            where="--format",
            got=unknown[0],
            expected=", ".join(suffix.lstrip(".") for suffix in MESH_SUFFIXES),
        )
