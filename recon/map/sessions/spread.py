"""The tiles of a finished map, made by several processes that share files.

First each cuts some submaps into tiles, into a file of its own; then each makes voxels and points
of some tiles from all these files, into another one. What comes of it is what one process makes:
parts are numbered by submap, and joined in that order wherever that is done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from recon.core.errors import MappingError
from recon.core.values.arrays import Float64
from recon.io.files import resolved
from recon.map.cut import Cutter, TileKey, TileParts
from recon.map.sessions.placed import PlacedMap, PlacedSubmaps, looks_in, with_path
from recon.map.settings import DriveSettings
from recon.map.store.map_file import MapFile
from recon.map.tiles import Tiles

Each = Callable[[Callable[[Any], None], Sequence[Any]], None]
"""Calls a function with each of several values, somewhere, and waits until all are done."""
_SHARE: Final = 4
"""Tasks for each process, so that none waits long for another."""


@dataclass(frozen=True)
class SubmapTask:
    """Submaps to be cut, for a process that can read the map.

    Attributes:
        map: File of the map.
        settings: The settings of its products.
        halvings: How often tiles are halved.
        numbers: The submaps.
        file: Where their parts go.
    """

    map: Path
    settings: DriveSettings
    halvings: int
    numbers: range
    file: Path


@dataclass(frozen=True, eq=False)
class TileTask:
    """Tiles whose content is to be made.

    Attributes:
        map: File of the map.
        parts: Files with what all submaps observed, in order.
        settings: The settings of the products.
        T_map_world: float64 (4, 4).
        halvings: How often tiles are halved.
        drives: Number of submaps of each drive.
        keys: The tiles.
        file: Where their content goes.
    """

    map: Path
    parts: tuple[Path, ...]
    settings: DriveSettings
    T_map_world: Float64
    halvings: int
    drives: tuple[int, ...]
    keys: tuple[TileKey, ...]
    file: Path


def place_map_on(
    map_: MapFile, settings: DriveSettings, folder: Path, each: Each, workers: int
) -> PlacedMap:
    """Do what `place_map` does, and make all tiles, on several processes.

    Args:
        map_: The map, in a file.
        settings: The settings of its products.
        folder: For files that all processes see; they are read as long as the tiles are used.
        each: The processes.
        workers: How many there are.
    """
    if map_.store.path is None:
        raise MappingError("other processes cannot read a temporary map")
    file = resolved(map_.store.path)
    placed, halvings, tiles = PlacedSubmaps(map_, settings), -1, None
    T_map_world, drives = map_.first.T_map_world, tuple(placed.drives)
    folder.mkdir(parents=True, exist_ok=True)
    while tiles is None:
        halvings += 1
        shares = _shares(range(len(placed)), workers)
        parts = tuple(folder / f"submaps-{halvings}-{n}" for n in range(len(shares)))
        each(
            cut_submaps,
            [
                SubmapTask(file, settings, halvings, share, part)
                for share, part in zip(shares, parts, strict=True)
            ],
        )
        tiles = Tiles.of_files(parts, settings, T_map_world, halvings=halvings, drives=drives)
    groups = _shares([tile.key for tile in tiles], workers)
    files = [folder / f"tiles-{n}" for n in range(len(groups))]
    each(
        make_tiles,
        [
            TileTask(file, parts, settings, T_map_world, halvings, drives, tuple(keys), made)
            for keys, made in zip(groups, files, strict=True)
        ],
    )
    tiles.adopt(files)
    return with_path(map_, tiles.with_looks(looks_in(map_, settings)))


def cut_submaps(task: SubmapTask) -> None:
    """Cut some submaps of a map into tiles."""
    with closing(MapFile.open(task.map)) as map_:
        placed = PlacedSubmaps(map_, task.settings)
        T = placed.corrections
        cutter = Cutter(task.settings, map_.first.T_map_world, task.halvings)
        parts = TileParts(cutter.edge_m, task.file)
        cut = cutter.cut(
            (placed[number] for number in task.numbers),
            parts,
            None if T is None else T[task.numbers.start : task.numbers.stop],
            first=task.numbers.start,
        )
        parts.save(cut.to_tree())


def make_tiles(task: TileTask) -> None:
    """Make the voxels and points of some tiles, and find the floors in them."""
    tiles = Tiles.of_files(
        task.parts,
        task.settings,
        task.T_map_world,
        halvings=task.halvings,
        drives=task.drives,
        path=task.file,
    )
    if tiles is not None:  # as known when the task was made
        with closing(MapFile.open(task.map)) as map_:
            tiles.with_looks(looks_in(map_, task.settings))
            for key in task.keys:
                tiles.make_voxels(key)
                tiles.cloud(key)
        tiles.save()


def _shares(items: Sequence[Any], workers: int) -> list[Any]:
    """Return items in shares of neighbours, several for each process."""
    count = max(1, min(len(items), _SHARE * workers))
    ends = [len(items) * n // count for n in range(count + 1)]
    return [items[a:b] for a, b in pairwise(ends)]
