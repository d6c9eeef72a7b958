"""`recon occupancy`: the grid and the OctoMap of a run with other settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, check_changes, run_settings
from recon.export.remake import Wanted, remake_map
from recon.io.files import StrPath
from recon.run.finished import open_run, refuse_as_target
from recon.run.run import Run

REMADE: Final = ("occupancy", "grid", "ground", "submaps")
"""Sections of the configuration that may differ from those of the run."""


def run_occupancy(
    run: StrPath,
    config: ReconConfig | None = None,
    *,
    out: StrPath | None = None,
    threads: int | None = None,
) -> dict[str, Any]:
    """Rebuild voxels and grid of a run with other settings, and write them.

    Args:
        run: Folder of the run that mapped the drive.
        config: Its settings with changes, such as ``load_config(f"{run}/config.yaml",
            ["occupancy.resolution_m=0.1"])``; None = its own.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: The run kept no rays or is damaged, a setting needs finer or longer rays than
            it kept or has no effect, or the folder cannot be written; nothing is left behind.
    """
    folder = Path(run)
    source, ran = open_run(folder), run_settings(folder)
    refuse_as_target(folder, out)
    settings = config or ran
    check_changes(ran, settings, REMADE)
    with Run("occupancy", out, settings, threads=threads) as made:
        return remake_map(source, settings, Wanted(["octomap", "grid"], settings.mesh), made)
