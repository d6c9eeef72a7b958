"""The map of a finished run: its cloud, and its occupancy from the rays or the OctoMap it kept."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon.io.models.ply import read_ply_pieces
from recon.io.occupancy.octomap import octomap_pieces
from recon.map.sessions.placed import PlacedMap, place_map
from recon.map.settings import DriveSettings
from recon.map.store.map import MAP_FILE, Map
from recon.map.tiles import Tiles
from recon.run.finished import CLOUD, OCTOMAP, FinishedRun


@dataclass(frozen=True, eq=False)
class FinishedMap(PlacedMap):
    """The map of a run, ready to be made into products again; its path is empty if it is not read.

    Attributes:
        files: What was read.
        warnings: What the run lacks.
    """

    files: tuple[Path, ...]
    warnings: tuple[str, ...] = ()


Place = Callable[[Map, DriveSettings], PlacedMap]
"""Cuts a map into tiles, without its cloud."""


def place_here(map_: Map, config: DriveSettings) -> PlacedMap:
    """Cut a map into tiles in this process, without its cloud."""
    return place_map(map_, config, fuse=False)


def doubts_of(run: FinishedRun) -> list[str]:
    """Return lines of what is not to be trusted in the map of a run, or that it was made from.

    Raises:
        FormatError: The map is damaged.
    """
    if not (run.folder / MAP_FILE).is_file():
        return list(run.doubts)
    return doubts_of_file(run.folder / MAP_FILE)


def doubts_of_file(file: Path) -> list[str]:
    """Return lines of what is not to be trusted in the map of the run that a file belongs to.

    Raises:
        FormatError: The map is damaged.
    """
    folder = next((one for one in file.absolute().parents[:3] if (one / MAP_FILE).is_file()), None)
    if folder is None:
        return []
    with closing(Map.open(folder)) as map_:
        return map_.doubts


def map_from_rays(run: FinishedRun, config: DriveSettings, place: Place) -> FinishedMap:
    """Build the occupancy of a run again from the rays in its map; the cloud is that of the run.

    Args:
        run: The run.
        config: Its settings.
        place: Cuts its map into tiles, perhaps on several processes.

    Raises:
        FormatError: The run kept no rays, or is damaged.
        SettingsError: The settings need finer or longer rays than it kept.
    """
    placed = place(Map.open(run.folder), config)
    for cloud in read_ply_pieces(run.folder / CLOUD):
        placed.tiles.put_cloud(cloud)
    files = tuple(run.folder / name for name in (MAP_FILE, CLOUD))
    return FinishedMap(placed.tiles, placed.path_m, placed.trusted, files)


def map_as_written(run: FinishedRun, config: DriveSettings, *, voxels: bool) -> FinishedMap:
    """Read the cloud of a run, and the voxels that its OctoMap has.

    Args:
        run: The run.
        config: Its settings.
        voxels: Whether voxels are needed; a run without an OctoMap is warned of then.

    Raises:
        FormatError: A file of the run is missing or damaged.
    """
    octomap, warnings = run.folder / OCTOMAP, []
    tiles = Tiles(config, run.T_map_world)
    for cloud in read_ply_pieces(run.folder / CLOUD):
        tiles.put_cloud(cloud)
    if voxels and octomap.is_file():
        for piece in octomap_pieces(octomap):
            tiles.put_voxels(piece)
    elif voxels:
        warnings.append(f"the run has no {OCTOMAP}: free space is not known")
    nowhere = np.zeros((0, 3))
    return FinishedMap(tiles, nowhere, np.zeros(0, bool), (run.folder / CLOUD,), tuple(warnings))
