"""Map a drive: trajectory, fused cloud, Nav2 grid, OctoMap, mesh.

    python examples/02_map_a_drive.py [DRIVE [FOLDER]]

DRIVE is a folder in the KITTI odometry layout; without one, a street is rendered.
"""

from __future__ import annotations

import sys
from pathlib import Path

import recon


def main(drive: str | None, folder: Path) -> None:
    """Map a drive and print the main results."""
    # Any setting has a dotted key; the `config.yaml` of a run lists them all.
    config = recon.load_config(overrides=["fusion.voxel_m=0.1", "street.frames=20"])
    source = recon.open_source(drive) if drive else recon.SyntheticSource(config.street)

    run = recon.run_map(source, config, recon.MapOptions(out=folder))

    print(f"{len(run.mapped.trajectory)} frames, {run.summary.path_length_m:.1f} m")
    print(f"{run.summary.made.cloud.points} points, grid of {run.grid.cells.shape} cells")
    if run.metrics is not None:
        print(f"position error {run.metrics.ate_m:.3f} m (rms)")
    for warning in run.warnings:
        print(f"warning: {warning}")
    print(f"results in {folder}")


if __name__ == "__main__":
    drive, folder, *_ = [*sys.argv[1:], *([None] * 2)]
    main(drive, Path(folder or "outputs/examples/map_a_drive"))
