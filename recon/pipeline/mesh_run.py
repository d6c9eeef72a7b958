"""`recon mesh` without its command line: any PLY in, a surface in several formats out."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon.errors import SettingsError
from recon.formats.atomic import write_text
from recon.formats.mesh import MESH_SUFFIXES, write_mesh
from recon.formats.mlp import write_mlp
from recon.formats.ply import read_ply, write_ply
from recon.meshing import reconstruct_mesh
from recon.pipeline.config import ReconConfig, dump_config
from recon.pipeline.machine import use_threads
from recon.pipeline.record import fingerprint, write_record
from recon.pipeline.run_directory import RunDirectory
from recon.pipeline.stopwatch import Stopwatch
from recon.pipeline.summary import cost


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


def run_mesh(cloud_path: Path, config: ReconConfig, options: MeshOptions) -> dict[str, Any]:
    """Reconstruct the surface of a cloud file and write it, with a MeshLab project.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The cloud cannot be read or gives no surface, a format is unknown, or the
            folder cannot be written; then nothing is left behind.
    """
    start = time.perf_counter()
    use_threads(options.threads)
    _check_formats(options.formats)
    watch = Stopwatch()
    with watch.stage("read"):
        cloud = read_ply(cloud_path)
    with RunDirectory.for_command("mesh", options.out) as directory:
        with watch.stage("mesh"):
            mesh = reconstruct_mesh(cloud, config.mesh)
        with watch.stage("write"):
            for suffix in dict.fromkeys(("ply", *options.formats)):
                write_mesh(directory.path(f"mesh/mesh.{suffix}"), mesh)
            write_ply(directory.path("mesh/cloud.ply"), cloud)
            layers = {name: directory.path(f"mesh/{name}.ply") for name in ("mesh", "cloud")}
            write_mlp(directory.path("mesh/mesh.mlp"), layers)
            write_text(directory.path("config.yaml"), dump_config(config))
        summary = {
            "cloud": str(cloud_path),
            "points": len(cloud),
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "warnings": [],
            **cost(watch, time.perf_counter() - start),
            "out": str(directory.folder),
        }
        directory.write_json("summary.json", summary)
        record = {
            "source": str(cloud_path),
            "inputs": fingerprint([cloud_path]),
            "timings": watch.seconds,
        }
        write_record(directory, "mesh", record)
    return summary


def _check_formats(formats: tuple[str, ...]) -> None:
    unknown = [name for name in formats if f".{name}" not in MESH_SUFFIXES]
    if unknown:
        raise SettingsError(
            "unknown mesh format",
            where="--format",
            got=unknown[0],
            expected=", ".join(suffix.lstrip(".") for suffix in MESH_SUFFIXES),
        )
