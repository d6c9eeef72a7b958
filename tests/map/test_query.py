"""A map is asked of places: what is there, what is near, who saw it."""

from dataclasses import FrozenInstanceError

import numpy as np
import pytest

import recon
from recon.core.errors import FormatError, ShapeError
from recon.core.values import FREE, OCCUPIED, UNKNOWN, join_clouds
from recon.map.ground.grid import drop_undecided
from recon.map.sessions.joining import join_sessions
from tests.map import walls

WALL_Y = -walls.WALL_M  # right of the path, which leads along x


@pytest.fixture(scope="module")
def asked():
    with walls.drives(1) as map_:
        yield map_


def test_a_wall_is_occupied_the_space_before_it_free_and_what_is_behind_unknown(asked):
    found = asked.at([[10.0, WALL_Y, 0.0], [10.0, WALL_Y / 2, 0.0], [10.0, WALL_Y - 5.0, 0.0]])
    assert found.state.tolist() == [OCCUPIED, FREE, UNKNOWN]
    assert repr(found) == "MapPlaces(1 occupied, 1 free, 1 unknown)"
    one = asked.at((10.0, WALL_Y, 0.0))
    assert one.state.tolist() == [OCCUPIED]
    with pytest.raises(FrozenInstanceError):
        one.state = found.state
    with pytest.raises(ValueError, match="read-only"):
        one.state[0] = FREE


def test_every_voxel_is_what_the_octomap_says(asked):
    voxels = drop_undecided(walls.voxels_of(asked.tiles()))
    found = asked.at(voxels.centres_m)
    np.testing.assert_array_equal(found.state == OCCUPIED, voxels.log_odds > 0)
    np.testing.assert_array_equal(found.state == FREE, voxels.log_odds <= 0)


def test_the_nearest_points_are_those_of_the_whole_cloud(asked):
    cloud = join_clouds(tile.cloud for tile in asked.tiles()).xyz.astype(np.float64)
    places = np.random.default_rng(0).uniform(-30, 60, (200, 3))
    found, apart = asked.at(places), np.linalg.norm(places[:, None] - cloud, axis=2)
    np.testing.assert_allclose(found.distance_m, apart.min(axis=1), rtol=1e-6)
    off_m = np.linalg.norm(places - found.nearest, axis=1)
    np.testing.assert_allclose(off_m, found.distance_m, rtol=1e-6)


def test_the_frames_that_saw_places_are_those_with_them_in_reach(asked):
    places = [[10.1, WALL_Y, z] for z in np.arange(-0.9, 1.0, 0.2)]
    found = asked.at([*places, [-40.0, WALL_Y, 0.0]])
    # Each frame sees the wall from 1 to 8 m ahead of it.
    within = {(0, frame) for frame in range(3, 10)}
    each = [found.seen_by(number) for number in range(len(places))]
    assert set().union(*each) == within
    assert all(one == sorted(one) for one in each)
    assert found.seen_by(len(places)) == found.seen_by(99) == []
    before = asked.at([10.0, WALL_Y / 2, 0.0])
    assert {*before.sightings[:, 3].tolist()} == {-1}


def test_of_several_drives_each_is_named_once_they_are_linked():
    with walls.drives(2) as map_:
        place = [20.5, WALL_Y, 0.0]
        before = map_.at(place)
        join_sessions(map_, walls.links_between(0, 1, walls.TRUE))
        after = map_.at(place)
    assert {drive for drive, _ in before.seen_by(0)} == {0}
    assert {drive for drive, _ in after.seen_by(0)} == {0, 1}


def test_places_beyond_what_a_voxel_can_be_are_unknown(asked):
    found = asked.at([[1e12, 0.0, 0.0], [0.0, -1e12, 0.0]])
    assert found.state.tolist() == [UNKNOWN, UNKNOWN]
    assert found.seen_by(0) == []
    assert (found.distance_m > 9e11).all()
    assert len(asked.at(np.zeros((0, 3)))) == 0


@pytest.mark.parametrize(
    "wrong", [[1.0, 2.0], "abc", None, [[0, 0, np.nan]], [0, np.inf, 0], [[1, 2, 3], [1]], [[[1]]]]
)
def test_what_is_no_place_is_refused(asked, wrong):
    with pytest.raises(ShapeError, match=r"\(3,\) or \(N, 3\)"):
        asked.at(wrong)


def test_a_map_without_drives_or_that_is_closed_is_refused():
    with recon.Map.temporary() as empty, pytest.raises(FormatError, match="no drive"):
        empty.at([0, 0, 0])
    with pytest.raises(FormatError, match="closed"):
        empty.at([0, 0, 0])


def test_without_rays_points_are_known_and_nobody_knows_who_saw_them():
    config = recon.load_config(walls.CONFIG, {"occupancy.keep_rays": False})
    with recon.Map.temporary() as map_:
        walls.drive(map_, walls.TRUE[0], 0, config=config)
        map_.store.delete("rays")
        found = map_.at([10.0, WALL_Y, 0.0])
    assert found.sightings is None
    assert found.seen_by(0) == []
    assert found.distance_m[0] < 0.3
