"""What a comparison takes from the map that a result was made from: axes, path, doubts."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.io.trajectory import read_trajectory
from recon.map.store.map_file import MAP_FILE, MapFile
from recon.run.finished import made_from


@dataclass(frozen=True, eq=False)
class MapOfRun:
    """The map of a finished run, as far as comparisons need it.

    Attributes:
        T_map_world: float64 (4, 4), from world to map axes.
        path: Path of the cameras of the drive that began the map; None = unknown.
        doubts: What is not to be trusted in the map.
    """

    T_map_world: Float64
    path: Trajectory | None
    doubts: Sequence[str]


def map_of_run(folder: Path) -> MapOfRun:
    """Read what is needed from the map of a run; without one, from its record and path file."""
    if (folder / MAP_FILE).is_file():
        with closing(MapFile.open(folder)) as map_:
            return MapOfRun(map_.first.T_map_world, map_.first.trajectory, map_.doubts)
    T_map_world, doubts = made_from(folder)
    file = folder / "trajectory_tum.txt"
    path = read_trajectory(file) if file.is_file() else None
    return MapOfRun(T_map_world, path, doubts)


def doubts_of_file(file: Path) -> list[str]:
    """Return lines of what is not to be trusted in the map of the run that a file belongs to."""
    folder = next((one for one in file.absolute().parents[:3] if (one / MAP_FILE).is_file()), None)
    return [] if folder is None else list(map_of_run(folder).doubts)
