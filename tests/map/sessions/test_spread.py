"""Tiles that several processes make through files are those that one makes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import MappingError
from recon.map.map import Map
from recon.map.sessions.joining import join_sessions
from recon.map.sessions.placed import PlacedMap, place_map, place_map_on
from tests.map.sessions.test_map_of_several_drives import TRUE, _drive, _links, _map

SETTINGS = ["submaps.length_m=8", "submaps.tile_m=12.8", "fusion.min_count=1"]


def shuffled(function: Callable[[Any], None], items: Sequence[Any]) -> None:
    """Stand in for processes, which end in any order."""
    for number in np.random.default_rng(0).permutation(len(items)):
        function(items[number])


@pytest.fixture(scope="module", params=["one drive", "one drive, bent", "two drives"])
def file(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.recon"
    with Map.create(path) as map_:
        for number in range(2 if request.param == "two drives" else 1):
            _drive(map_, TRUE[number], number, drift=0.01)
        if request.param == "two drives":
            join_sessions(map_, _links(0, 1, TRUE[:2]))
        if "bent" in request.param:
            bent = TRUE[0].copy()
            bent[10:, 0, 3] += 0.33
            map_.session().set_loops({"closed": [], "refused": [], "T_world_camera": bent})
        map_.commit()
    return path


def assert_same(made: PlacedMap, expected: PlacedMap) -> None:
    tiles, others = made.tiles, expected.tiles
    assert [tile.key for tile in tiles] == [tile.key for tile in others]
    assert (tiles.extent, tiles.edge_cells) == (others.extent, others.edge_cells)
    np.testing.assert_array_equal(tiles.submap_of_frame, others.submap_of_frame)
    np.testing.assert_array_equal(made.path_m, expected.path_m)
    np.testing.assert_array_equal(made.trusted, expected.trusted)
    for tile in tiles:
        for one, other in (
            (tiles.wide_voxels(tile.key), others.wide_voxels(tile.key)),
            (tile.voxels, others.voxels(tile.key)),
        ):
            np.testing.assert_array_equal(one.keys, other.keys)
            np.testing.assert_array_equal(one.log_odds, other.log_odds)
        np.testing.assert_array_equal(tile.cloud.xyz, others.cloud(tile.key).xyz)
        bounds = tiles.bounds(tile.key)
        np.testing.assert_array_equal(tiles.floors_in(bounds), others.floors_in(bounds))


@pytest.mark.parametrize("workers", [1, 3])
def test_tiles_are_the_same_however_many_processes_make_them(
    file: Path, tmp_path: Path, workers: int
) -> None:
    config = load_config(None, SETTINGS)
    with Map.open(file) as map_:
        made = place_map_on(map_, config, tmp_path / "tiles", shuffled, workers)
        assert_same(made, place_map(map_, config))


def test_tiles_are_halved_for_all_where_one_is_too_large(file: Path, tmp_path: Path) -> None:
    config: ReconConfig = load_config(None, [*SETTINGS, "submaps.tile_m=51.2"])
    memory = config.memory.model_copy(update={"limit_mb": 8.0})
    tight = config.model_copy(update={"memory": memory})
    with Map.open(file) as map_, pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(memory), "check", lambda self, where: None)
        made = place_map_on(map_, tight, tmp_path / "tiles", shuffled, 2)
        assert made.tiles.edge_cells < place_map(map_, config).tiles.edge_cells
        assert_same(made, place_map(map_, tight))


def test_a_temporary_map_is_refused(tmp_path: Path) -> None:
    with _map(1) as map_, pytest.raises(MappingError, match="temporary"):
        place_map_on(map_, load_config(None, SETTINGS), tmp_path, shuffled, 2)
