"""`recon mesh`: a PLY or a run in, a surface in several formats out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recon.commands.config import ReconConfig, run_settings
from recon.commands.export import run_export
from recon.export.pair import finish_cloud_run, mesh_cloud
from recon.io.models.mesh import check_mesh_formats
from recon.run.finished import PAIR_CLOUD, camera_of_pair, is_pair_run, refuse_as_target
from recon.run.run import Run


def run_mesh(
    source: Path,
    config: ReconConfig,
    *,
    formats: Sequence[str] = ("ply",),
    out: Path | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Reconstruct the surface of a cloud file or of a run's map, and write a MeshLab project.

    A cloud file is meshed in one piece, since its scale is unknown; the cloud of a pair as
    `recon pair` does. The map of a run is meshed in pieces, and faces in observed free space are
    removed.

    Args:
        source: A PLY file, or the folder of a run of map, demo or pair.
        config: Settings of the mesh; the rest is that of the run.
        formats: File suffixes without the dot, such as ``("ply", "glb")``.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.

    Returns:
        The figures of ``summary.json``.
    """
    check_mesh_formats(formats)
    cloud, camera = source, None
    if source.is_dir():
        refuse_as_target(source, out)
        if not is_pair_run(source):
            settings = run_settings(source).model_copy(update={"mesh": config.mesh})
            return run_export(
                source,
                settings,
                products=["mesh"],
                formats=formats,
                out=out,
                threads=threads,
                command="mesh",
            )
        cloud, camera = source / PAIR_CLOUD, camera_of_pair(source)
    with Run("mesh", out, config, threads=threads) as run:
        return finish_cloud_run(
            source, cloud, run, mesh_cloud(cloud, camera, config.mesh, run, formats)
        )
