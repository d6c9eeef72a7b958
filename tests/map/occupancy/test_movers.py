"""Moving objects leave no ghosts: later rays through a cell free it."""

from __future__ import annotations

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.geometry.se3 import make_transform
from recon.core.values import FREE, OCCUPIED, OccupancyGrid, join_clouds
from recon.export.cloud import export_cloud
from recon.map.drive.sequence import map_sequence
from recon.map.ground.grid import GridSettings, flatten
from recon.map.ground.surface import GroundSurface
from recon.map.occupancy.builder import OccupancyBuilder, OccupancySettings, thin_rays
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetScene
from tests.map.occupancy.test_moving import CAR, HEIGHT_M, T_MAP_WORLD, look

GROUND = GroundSurface(np.full((60, 60), -HEIGHT_M), 1.0, (-15.0, -30.0))


def _grid(cars: list[tuple[float, float] | None], step_m: float = 0.0) -> OccupancyGrid:
    """The grid after frames with the car at these places; the camera moves on by steps."""
    settings = OccupancySettings()
    builder = OccupancyBuilder(settings, T_MAP_WORLD)
    for index, car in enumerate(cars):
        z_m = index * step_m
        pose = make_transform(np.eye(3), np.array([0.0, 0.0, z_m]))
        # A street that ends at a wall; the car's rear is at (x, z).
        boxes = [] if car is None else [((car[0], 0.0, car[1] + 2.1), CAR)]
        cloud = look(boxes, z_m, index, wall_m=20.0)
        builder.integrate(thin_rays(cloud, settings).cloud(), pose)
    return flatten(builder.voxels(), GROUND, GridSettings())


def _cells(grid: OccupancyGrid, forward_m: tuple[float, float], left_m: tuple[float, float]):
    """The cells of a rectangle of the map."""
    (x0, x1), (y0, y1) = (
        np.rint((np.array(span) - origin) / grid.resolution_m).astype(int)
        for span, origin in zip((forward_m, left_m), grid.origin_m, strict=True)
    )
    return grid.cells[y0:y1, x0:x1]


CROSSING = [(x, 9.0) for x in np.arange(-7.0, 7.1, 0.7)]
LEADING = [(0.0, 6.0 + 0.8 * n) for n in range(18)]


def test_a_car_that_crosses_leaves_a_free_street() -> None:
    track = _cells(_grid([*CROSSING, *[None] * 3]), (9.0, 13.0), (-4.0, 4.0))
    assert (track == OCCUPIED).sum() == 0
    assert (track == FREE).mean() > 0.98


def test_a_parked_car_that_drives_away_is_forgotten() -> None:
    place = (9.0, 13.0), (-1.4, 1.4)
    parked = [(0.0, 9.0)] * 20
    away = [(x, 9.0) for x in np.arange(0.0, 7.1, 0.7)]
    before, after = _grid(parked), _grid([*parked, *away, *[None] * 20])
    assert (_cells(before, *place) == OCCUPIED).sum() > 8
    assert (_cells(after, *place) == OCCUPIED).sum() == 0
    assert (_cells(after, *place) == FREE).mean() > 0.98


def test_a_car_ahead_leaves_no_trail() -> None:
    # It drives on faster than the camera: where its rear was, later rays reach its new rear.
    grid = _grid(LEADING, step_m=0.3)
    trail = _cells(grid, (6.0, 17.0), (-1.4, 1.4))
    assert (trail == OCCUPIED).sum() == 0
    assert (trail == FREE).mean() > 0.95
    assert (_cells(grid, (19.2, 20.4), (-1.0, 1.0)) == OCCUPIED).any()  # where it is now


def test_a_car_that_stops_where_it_was_free_is_found_within_a_second() -> None:
    stopped = [(0.0, 9.05)] * 10
    # Ten frames; until then, what was free is at least no longer called so.
    place = (9.0, 9.2), (-0.8, 0.8)
    assert (_cells(_grid([*[None] * 20, *stopped]), *place) == OCCUPIED).all()
    assert not (_cells(_grid([*[None] * 20, *stopped[:4]]), *place) == FREE).any()


@pytest.mark.slow
def test_nothing_is_taken_for_moved_in_a_street_of_fences() -> None:
    scene = StreetScene(
        seed=4, frames=24, path="straight", fences=True, width_px=480, height_px=180, focal_px=270.0
    )
    source = SyntheticSource(scene)
    mapped = map_sequence(source, load_config(), known_poses=source.trajectory)
    removed = join_clouds(tile.removed for tile in mapped.tiles)
    cloud = join_clouds(tile.cloud for tile in mapped.tiles)
    assert len(cloud) > 20_000
    assert len(removed) <= 0.003 * len(cloud)


def test_without_rays_nothing_is_left_out_and_it_is_said(tmp_path) -> None:
    config = load_config(overrides=["occupancy.keep_rays=false"])
    source = SyntheticSource(StreetScene(frames=3, path="straight", width_px=160, height_px=64))
    mapped = map_sequence(source, config, known_poses=source.trajectory)
    written = export_cloud(mapped.tiles, tmp_path / "cloud.ply", tmp_path / "removed.ply")
    assert written.figures["points_removed"] == 0
    assert any("keep_rays=true" in line for line in written.warnings)
