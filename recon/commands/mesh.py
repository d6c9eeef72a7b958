"""`recon mesh`: a PLY or a run in, a surface in several formats out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recon.commands.config import ReconConfig, run_settings
from recon.export.remake import Wanted, mesh_cloud, remake_map
from recon.io.models.mesh import check_mesh_formats
from recon.run.finished import (
    PAIR_CLOUD,
    camera_of_pair,
    is_pair_run,
    open_run,
    refuse_as_target,
)
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
        config: Settings of the mesh.
        formats: File suffixes without the dot, such as ``("ply", "glb")``.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The cloud cannot be read or gives no surface, a format is unknown, or the
            folder cannot be written; nothing is left behind.
    """
    check_mesh_formats(formats)
    cloud, camera, mapped = source, None, None
    if source.is_dir():
        refuse_as_target(source, out)
        if is_pair_run(source):
            cloud, camera = source / PAIR_CLOUD, camera_of_pair(source)
        else:
            mapped = open_run(source)
    with Run("mesh", out, config, threads=threads) as run:
        if mapped is not None:
            wanted = Wanted(["mesh"], config.mesh, formats)
            return remake_map(mapped, run_settings(source), wanted, run)
        figures = mesh_cloud(cloud, camera, config.mesh, run, formats)
        figures = {"cloud": str(cloud), **figures}
        run.finish(figures, source=str(source), inputs=[cloud])
    return figures
