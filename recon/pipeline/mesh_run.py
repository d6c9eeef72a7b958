"""`recon mesh` without its command line: a PLY or a run in, a surface in several formats out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from recon.errors import SettingsError
from recon.formats.atomic import write_text
from recon.formats.mesh import MESH_SUFFIXES, read_mesh, write_mesh
from recon.formats.mlp import write_mlp
from recon.formats.octomap import read_octomap
from recon.formats.ply import read_ply, write_ply
from recon.meshing import MeshSettings, reconstruct_mesh
from recon.pipeline.config import ReconConfig, dump_config
from recon.pipeline.drive_mesh import write_drive_mesh
from recon.pipeline.finished_run import OCTOMAP, open_run
from recon.pipeline.machine import use_threads
from recon.pipeline.record import fingerprint, write_record
from recon.pipeline.run_directory import RunDirectory
from recon.pipeline.stopwatch import Stopwatch
from recon.pipeline.summary import cost
from recon.pipeline.tile_store import TileStore
from recon.structures import PointCloud

CLOUD: Final = "map/cloud.ply"


@dataclass(frozen=True)
class MeshOptions:
    """How a run is made, apart from the configuration.

    Attributes:
        out: Result folder; None = a new one below ``outputs/``.
        formats: File suffixes without the dot, such as ``("ply", "glb")``.
        threads: Threads to use; None = all cores.
    """

    out: Path | None = None
    formats: tuple[str, ...] = ("ply",)
    threads: int | None = None


def run_mesh(source: Path, config: ReconConfig, options: MeshOptions) -> dict[str, Any]:
    """Reconstruct the surface of a cloud file, or of a run's map, with a MeshLab project.

    The cloud of a file is meshed in one piece, since nothing is known of its scale. The map of a
    run is meshed in tiles, and cut where the run's cameras looked through.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The cloud cannot be read or gives no surface, a format is unknown, or the
            folder cannot be written; then nothing is left behind.
    """
    start = time.perf_counter()
    threads = use_threads(options.threads)
    _check_formats(options.formats)
    watch = Stopwatch()
    cloud_path = open_run(source).folder / CLOUD if source.is_dir() else source
    with watch.stage("read"):
        cloud = read_ply(cloud_path)
    with RunDirectory.for_command("mesh", options.out) as directory:
        write_ply(directory.path("mesh/cloud.ply"), cloud)
        if source.is_dir():
            figures = _mesh_run(source, cloud, config.mesh, directory, threads, watch)
        else:
            figures = _mesh_cloud(cloud, config.mesh, directory, watch)
        with watch.stage("write"):
            whole = directory.path("mesh/mesh.ply")
            others = [suffix for suffix in dict.fromkeys(options.formats) if suffix != "ply"]
            for suffix in others:
                write_mesh(directory.path(f"mesh/mesh.{suffix}"), read_mesh(whole))
            write_text(directory.path("config.yaml"), dump_config(config))
        summary = {
            "cloud": str(cloud_path),
            "points": len(cloud),
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
    cloud: PointCloud, settings: MeshSettings, directory: RunDirectory, watch: Stopwatch
) -> dict[str, Any]:
    """Write the surface of a cloud in one piece."""
    with watch.stage("mesh"):
        mesh = reconstruct_mesh(cloud, settings)
    write_mesh(directory.path("mesh/mesh.ply"), mesh)
    layers = {name: directory.path(f"mesh/{name}.ply") for name in ("mesh", "cloud")}
    write_mlp(directory.path("mesh/mesh.mlp"), layers)
    return {"vertices": len(mesh.vertices), "faces": len(mesh.faces), "warnings": []}


def _mesh_run(
    run: Path,
    cloud: PointCloud,
    settings: MeshSettings,
    directory: RunDirectory,
    threads: int,
    watch: Stopwatch,
) -> dict[str, Any]:
    """Write the surface of a run's map tile by tile."""
    warnings = []
    store = TileStore(directory.state("mesh"), settings.tile_m)
    with watch.stage("read"):
        store.put_cloud(cloud)
        if settings.free_space and (run / OCTOMAP).is_file():
            store.put_voxels(read_octomap(run / OCTOMAP))
        elif settings.free_space:
            warnings.append(f"the run has no {OCTOMAP}: free space is not known")
    with watch.stage("mesh"):
        layer = directory.path("mesh/cloud.ply")
        written = write_drive_mesh(store, settings, directory, layer, threads)
    return {
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
