"""An interrupted run, and what is kept in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from recon.commands.config import load_config
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.map.drive.mapper import FrameResult
from recon.run.progress import Silent
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.scenery.kitti import write_kitti

DRIVE = {"frames": 6, "width_px": 256, "height_px": 96, "focal_px": 150.0}
STATE = Path(".partial") / ".state"


class _Stops(Silent):
    """A progress that interrupts a run at its fourth frame."""

    def on_step(self, result: FrameResult) -> None:
        if result.index == 3:
            raise KeyboardInterrupt


def interrupt_run(folder: Path) -> None:
    """Write a drive to ``folder/drive`` and an interrupted run of it to ``folder/run``."""
    write_kitti(SyntheticSource(StreetScene(smooth_edges=False, **DRIVE)), folder / "drive")
    config = load_config(None, ["checkpoints.every_frames=1", "submaps.length_m=1"])
    source, options = MapOptions(source=folder / "drive", mesh=False).open(config)
    options = replace(options, audit=False, out=folder / "run", progress=_Stops())
    with pytest.raises(KeyboardInterrupt):
        run_map(source, config, options)
