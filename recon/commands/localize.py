"""`recon localize`: find each frame of a drive in a map that is there already."""

from __future__ import annotations

from pathlib import Path

from recon.commands.config import ReconConfig, load_config
from recon.commands.map_options import MapOptions
from recon.core.values import OccupancyGrid
from recon.export.trajectories import export_localized
from recon.io.files import StrPath
from recon.io.models.nav2 import read_nav2
from recon.map.drive.workspace import Workspace
from recon.map.localize.localize_run import LocalizeRun
from recon.map.localize.sequence import StartPose, localize_sequence
from recon.map.store.map_file import MAP_FILE
from recon.map.verbs import Map
from recon.report.localize_page import write_localize_page
from recon.run.finished import GRID, figure_of, refuse_as_target
from recon.sources.live import LiveSource
from recon.sources.source import StereoSource


def run_localize(
    source: StereoSource,
    map_path: StrPath,
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
    *,
    start: StartPose | None = None,
) -> LocalizeRun:
    """Find the frames of a drive in a map, which is not changed: what `recon localize` does.

    Args:
        source: The drive.
        map_path: Folder of the run that made the map, or the map file itself.
        config: The configuration; None = the defaults.
        options: Options of the run; None = the defaults.
        start: Where the drive begins, roughly; None = anywhere in the map.

    Raises:
        ReconError: The map or the source cannot be read, or the folder cannot be written; nothing
            is left behind.
    """
    config, options = config or load_config(), options or MapOptions(command="localize")
    map_path = Path(map_path)
    refuse_as_target(map_path, options.out)
    with (
        Map.open(map_path, cache_bytes=config.memory.cache_bytes) as map_,
        options.run(config) as run,
    ):
        folder = map_path if map_path.is_dir() else None
        inputs = [*source.files, map_path if folder is None else folder / MAP_FILE]
        run.check_targets(inputs)
        workspace = Workspace(map_, run.watch, run.threads)
        drive = localize_sequence(source, workspace, config, start=start, progress=options.progress)
        grid = _grid_of(folder)
        made = LocalizeRun(source.name, str(map_path), drive, grid)
        made.summary.update(source=source.name, map_run=str(map_path), **drive.figures())
        made.summary["T_map_world"] = drive.T_map_world.tolist()
        made.summary["warnings"] = [*map_.doubts, *drive.warnings()]
        if isinstance(source, LiveSource):
            made.summary["live"] = source.figures()
            made.summary["warnings"] += source.warnings()
        with run.stage("write"):
            height_m = None if folder is None else figure_of(folder, "camera_height_m")
            export_localized(drive, height_m, run)
        with run.report(made.summary):
            write_localize_page(made, run)
        run.finish(made.summary, source=source.name, inputs=inputs)
    return made


def _grid_of(folder: Path | None) -> OccupancyGrid | None:
    """Return the grid of the run that made the map; None = there is none."""
    if folder is None or not (folder / GRID).is_file():
        return None
    return read_nav2(folder / GRID)
