"""`recon occupancy`: the grid and the OctoMap of a run with other settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recon.commands.config import ReconConfig
from recon.commands.export import run_export
from recon.core.errors import FormatError
from recon.io.files import StrPath
from recon.run.finished import is_pair_run


def run_occupancy(
    run: StrPath,
    config: ReconConfig | None = None,
    *,
    out: StrPath | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Make voxels and grid of a run with other settings: what `recon occupancy` does.

    Args:
        run: Folder of the run that mapped the drive.
        config: As for `run_export`, like all that follows.
        out: As before.
        threads: As before.

    Raises:
        ReconError: As for `run_export`.
    """
    if is_pair_run(Path(run)):
        raise FormatError("the run made no map: it is one of recon pair", where=run)
    products = ("octomap", "grid")
    return run_export(run, config, products=products, out=out, threads=threads, command="occupancy")
