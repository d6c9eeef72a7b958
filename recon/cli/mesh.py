"""`recon mesh`: a mesh of any cloud, or of the map of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt


@opt.takes_groups
def mesh(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="CLOUD|RUN",
            help="PLY point cloud (normals and colours are used), or the folder of a run.",
        ),
    ],
    out: opt.Out = None,
    formats: opt.Formats = None,
    *,
    shared: opt.Shared,
) -> None:
    """Reconstruct a surface mesh from a PLY point cloud, or from a run of map or pair.

    Screened Poisson reconstruction, trimmed where there are no points. The map
    of a run is meshed in tiles, and surfaces in space that the cameras saw to
    be free are removed. The cloud of a pair is meshed as recon pair does.

    Examples:
      recon mesh cloud.ply --format obj --format glb
      recon mesh outputs/map/latest --set mesh.target_faces=500000
    """
    with shared.one_line_errors():
        from recon.commands.config import PAIR_DEFAULTS, load_config
        from recon.commands.mesh import run_mesh
        from recon.run.finished import is_pair_run

        defaults = PAIR_DEFAULTS if source.is_dir() and is_pair_run(source) else None
        settings = load_config(shared.config, shared.changes, defaults)
        summary = run_mesh(
            source, settings, formats=tuple(formats or ("ply",)), out=out, threads=shared.threads
        )
    shared.show(summary)
