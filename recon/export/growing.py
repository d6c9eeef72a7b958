"""A map while it is made: grid, costs and points of what is in its file, as far as it has grown."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from recon.core.errors import MappingError, ReconError
from recon.core.geometry.se3 import apply, transform_cloud
from recon.core.values import UNKNOWN, OccupancyGrid, PointCloud, join_clouds
from recon.core.values.arrays import tree_of
from recon.core.work import serial_algebra, work_in_background
from recon.export.cloud import even_sample
from recon.export.costmap import make_costmap
from recon.export.occupancy import Flattening, paste
from recon.map.builders import Submap
from recon.map.cut import Rectangle
from recon.map.map import Map
from recon.map.sessions.placed import place_map, settings_of
from recon.map.store.session import Session
from recon.map.store.trees import from_bytes, to_bytes


@dataclass(frozen=True, eq=False)
class MapSoFar:
    """What was made of a map."""

    grid: OccupancyGrid
    costs: OccupancyGrid | None  # None = they cannot be made
    cloud: PointCloud  # new points, frame ``map``
    note: str = ""  # why there is no costmap


class GrowingMap:
    """Makes grid and costs anew where a map has grown, and keeps the rest.

    A finished map is made once, and whole. One that is made by a drive grows by submaps; what is in
    reach of new ones is made again from all submaps that see it.
    """

    def __init__(self, path: Path, *, finished: bool = False) -> None:
        self._path, self.finished = path, finished
        self._submaps = 0
        self._grid: OccupancyGrid | None = None
        self._costs: OccupancyGrid | None = None

    def update(self) -> MapSoFar | None:
        """Return the map with what is new in it; None = there is nothing."""
        with Map.open(self._path) as map_:
            first, self._submaps = self._submaps, len(map_.first.submaps)
            if first == self._submaps:
                return None
            session, new, only, changed = map_.first, range(first, self._submaps), None, None
            settings = settings_of(session)
            if not self.finished:
                only, changed = _around(session, new, settings.occupancy.max_range_m)
            placed, note = place_map(map_, settings, only=only), ""
            self._grid = _pasted(self._grid, Flattening(placed).grid()[0], changed)
            try:
                self._costs = _pasted(self._costs, make_costmap(map_, placed)[0], changed)
            except MappingError as error:
                note = f"no costmap: {error}"
            if self.finished:
                cloud = even_sample(placed.tiles)
            else:
                cloud = join_clouds(submap_cloud(session, session.submaps[n]) for n in new)
            return MapSoFar(self._grid, self._costs, cloud, note)


class MapBeside:
    """Does what `GrowingMap` does in a process of the lowest priority, which ends with this one.

    In a thread it would delay others: who is seldom given a core, and holds Python's lock.
    """

    def __init__(self, path: Path, *, finished: bool = False) -> None:
        self.finished = finished
        code = f"from {__name__} import _serve; _serve()"
        words, pipe = [sys.executable, "-c", code, str(path), str(int(finished))], subprocess.PIPE
        self._process = subprocess.Popen(words, stdin=pipe, stdout=pipe, start_new_session=True)

    def update(self) -> MapSoFar | None:
        """Wait for the map with what is new in it; None = there is nothing."""
        asked, answers = (cast("IO[bytes]", p) for p in (self._process.stdin, self._process.stdout))
        try:
            asked.write(b"\n")
            asked.flush()
            text = json.loads(answers.readline())
        except (ValueError, OSError) as error:
            raise MappingError("the process that makes the map has ended") from error
        found = from_bytes(text, lambda size: bytearray(answers.read(size)), 0)
        if "error" in found:
            raise MappingError(found["error"])
        return _map_in(found) if found else None

    def close(self) -> None:
        """End the process, which may work on a map that nobody waits for."""
        self._process.kill()
        self._process.communicate()


def _serve() -> None:
    """Answer each line that is read with what is new of a map."""
    work_in_background()
    path, finished = sys.argv[1:]
    growing = GrowingMap(Path(path), finished=finished == "1")
    answers = sys.stdout.buffer
    sys.stdout = sys.stderr
    for _ in sys.stdin:
        try:
            with serial_algebra():
                found = tree_of(growing.update()) or {}
        except ReconError as error:
            found = {"error": str(error)}
        text, content = to_bytes(found, compress=False)
        try:
            answers.writelines([json.dumps(text).encode(), b"\n", *content])
            answers.flush()
        except BrokenPipeError:  # who asked was killed: nobody is left to be told
            os._exit(0)


def _map_in(tree: dict[str, Any]) -> MapSoFar:
    grid, costs = (
        one and OccupancyGrid(one["cells"], one["resolution_m"], tuple(one["origin_m"]))
        for one in (tree["grid"], tree["costs"])
    )
    return MapSoFar(grid, costs, PointCloud(**tree["cloud"]), tree["note"])


def _around(session: Session, new: range, reach_m: float) -> tuple[list[int], Rectangle]:
    """Return the submaps in reach of what is in reach of new ones, and where that may be."""
    path_m = apply(session.T_map_world, session.odometry.positions_m)[:, :2]
    paths = [path_m[one.first_frame :][: one.frames] for one in session.submaps.entries]
    there = np.concatenate(paths[new.start :])
    (x0, y0), (x1, y1) = there.min(axis=0).tolist(), there.max(axis=0).tolist()
    changed = Rectangle((x0, y0), (x1, y1)).wider(reach_m)
    seen = changed.wider(reach_m)
    return [number for number, own in enumerate(paths) if seen.contains(own).any()], changed


def submap_cloud(session: Session, submap: Submap) -> PointCloud:
    """Return the points of a submap of a drive that is being mapped, frame ``map``."""
    settings = settings_of(session)
    sums = submap.fused.cloud(settings.fusion.voxel_m, settings.fusion.min_count)
    return transform_cloud(sums, session.T_map_world, frame="map")


def _pasted(
    old: OccupancyGrid | None, new: OccupancyGrid, changed: Rectangle | None
) -> OccupancyGrid:
    """Return a grid with what another one, of the same cells, says of a rectangle."""
    if old is None or changed is None:
        return new
    cell_m = new.resolution_m
    corners = [np.rint(np.array(grid.origin_m) / cell_m).astype(int) for grid in (old, new)]
    ends = [
        corner + grid.cells.shape[::-1] for corner, grid in zip(corners, (old, new), strict=True)
    ]
    low, high = np.minimum(*corners), np.maximum(*ends)
    cells = np.full((high - low)[::-1], UNKNOWN, np.int8)
    paste(cells, low, old, low, high)
    begin, end = np.array(changed.low) / cell_m, np.array(changed.high) / cell_m
    paste(cells, low, new, np.floor(begin).astype(int), np.ceil(end).astype(int))
    return OccupancyGrid(cells, cell_m, (float(low[0] * cell_m), float(low[1] * cell_m)))
