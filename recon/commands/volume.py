"""`recon volume`: how much was dug and heaped up between two runs, or lies above a plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from recon.core.errors import SettingsError
from recon.core.machine import available_cores
from recon.core.summary import Rows, Summary, inline
from recon.core.values import PointCloud, join_clouds
from recon.export.volume import VolumeFigures, volume_between
from recon.io.files import StrPath
from recon.map.changes.compare import compare, gather
from recon.map.cut import Rectangle
from recon.map.map import Map
from recon.map.sessions.placed import place_map, settings_of


@dataclass(frozen=True, kw_only=True)
class VolumeSummary(Summary):
    """What `recon volume` found; places and heights are in the map axes of the run."""

    run: str
    other: str | None
    height_m: float | None  # of the plane
    within_m: Sequence[float] | None
    cell_m: float
    volume: VolumeFigures = inline()

    def rows(self) -> Rows:
        found = self.volume
        return [
            ("net", f"{found.net_m3:.3f} m³ ± {found.sigma_m3:.3f} m³"),
            ("cut", f"{found.cut_m3:.3f} m³"),
            ("fill", f"{found.fill_m3:.3f} m³"),
            ("area", f"{found.compared_m2:.1f} m², {found.not_compared_m2:.1f} m² not compared"),
        ]


def run_volume(
    run: StrPath,
    other: StrPath | None = None,
    *,
    height_m: float | None = None,
    within_m: Sequence[float] | None = None,
    threads: int | None = None,
) -> VolumeSummary:
    """Return how much was dug and heaped up: what `recon volume` does.

    Args:
        run: Folder of a finished run, or a map file.
        other: That of a later one through the same place, linked as by `run_diff`; or
        height_m: the height of a level plane below the run.
        within_m: Smallest x and y, largest x and y; None = everywhere.
        threads: Threads to use; None = all cores.

    Raises:
        ReconError: Not one of a run and a height is given, the rectangle is none, a map is damaged,
            the runs share no place, or there is no cell to compare.
    """
    if (other is None) == (height_m is None):
        what, expected = "nothing to compare with, or two things", "either a later run or --height"
        raise SettingsError(what, where="--height", expected=expected)
    within = None
    if within_m is not None:
        if len(within_m) != 4 or not (within_m[0] < within_m[2] and within_m[1] < within_m[3]):
            what, expected = "not a rectangle", "X0,Y0,X1,Y1 with X0 < X1 and Y0 < Y1"
            raise SettingsError(what, where="--within", got=within_m, expected=expected)
        within = Rectangle((within_m[0], within_m[1]), (within_m[2], within_m[3]))
    before: PointCloud | float
    cores = threads or available_cores()
    with Map.open(run) as first:
        settings = settings_of(first.first)
        if other is None:
            tiles = place_map(first, settings, cores).tiles
            before, after = float(height_m or 0.0), join_clouds(tile.cloud for tile in tiles)
        else:
            with Map.open(other) as second, Map.temporary() as both:
                found = compare(both, gather(both, first, second), cores)
            before, after = found.before.cloud, found.after.cloud
    cell_m = settings.occupancy.resolution_m
    return VolumeSummary(
        run=str(run),
        other=None if other is None else str(other),
        height_m=height_m,
        within_m=within_m,
        cell_m=cell_m,
        volume=volume_between(before, after, cell_m, within),
    )
