"""Drives in one map: placed by links or by measured positions, left apart, taken out again."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import (
    FormatError,
    MappingError,
    ReconError,
    RegistrationError,
    SettingsError,
)
from recon.core.geometry.alignment import interpolate_poses
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.sessions import joining
from recon.map.sessions.copying import check_session, copy_sessions
from recon.map.sessions.measured import Survey, doubts_of_positions, hold, misfit_rms_m
from recon.map.sessions.placed import PlacedMap, PlacedSubmaps, place_map, place_map_on
from recon.odometry.protocol import OdometryHealth
from recon.places.places import Loop
from recon.places.pose_graph import Fixes
from tests.map.walls import (
    CONFIG,
    FRAMES,
    TRUE,
    WALL_M,
    cloud_of,
    drive,
    drives,
    links_between,
    off_m,
    poses,
    voxels_of,
)


def _linked(map_: Map) -> list[int]:
    return [session.number for session in map_.linked]


def test_links_place_a_drive_beside_the_first_and_correct_what_one_has_drifted():
    map_ = drives(2)
    joining.join_sessions(map_, links_between(0, 1, TRUE[:2]))
    assert _linked(map_) == [0, 1]
    assert off_m(map_, 0) < 1e-6
    assert off_m(map_, 1) < 0.01
    assert all(link.kept for link in map_.links)
    stretched = drive(map_, TRUE[2], 2, drift=0.01)
    assert np.linalg.norm(stretched.odometry.positions_m[-1]) > 19.15
    joining.join_sessions(map_, [*map_.links, *links_between(0, 2, (TRUE[0], TRUE[2]))])
    assert off_m(map_, 2) < 0.12


def test_frames_that_both_drives_have_link_them_exactly():
    map_, behind = Map.temporary(), 12
    for number, first in enumerate((0, behind)):
        drive(map_, poses(float(first)), seed=0, name=str(number), first=first)
    map_.commit()
    one, other = map_.sessions
    shared = joining.shared_frames(one, other)
    assert shared.tolist() == [[frame + behind, frame] for frame in range(FRAMES - behind)]
    joining.join_new(map_, [1])
    assert [link.loop.same_frame for link in map_.links] == [True]
    T = map_.T_world_session(other) @ other.trajectory.T_world_camera
    assert np.abs((T - poses(float(behind)))[:, :3, 3]).max() < 1e-6
    assert joining.seen_before(map_, other) == set(range(FRAMES - behind))
    assert not joining.seen_before(map_, one)
    assert not len(joining.shared_frames(one, drive(map_, TRUE[0], seed=0, noise=1)))


def test_a_drive_cut_in_two_that_overlap_gives_the_voxels_of_one():
    whole, halves = Map.temporary(), Map.temporary()
    true = np.concatenate([TRUE[0], poses(float(FRAMES))])
    drive(whole, true, seed=0)
    drive(halves, true[:25], seed=0, name="first")
    drive(halves, true[15:], seed=0, name="second", first=15)
    for map_ in (whole, halves):
        map_.commit()
    joining.join_new(halves, [1])
    placed = PlacedSubmaps(halves, CONFIG)
    first, second = (placed[number].occupancy for number in (0, placed.drives[0]))
    assert len(first.rows.blocks)
    assert not len(second.rows.blocks)  # all of its frames are the first drive's, too
    ours, theirs = (voxels_of(place_map(map_, CONFIG).tiles) for map_ in (whole, halves))
    np.testing.assert_array_equal(ours.keys, theirs.keys)
    # Not to the last bit: what a later drive sees counts more than what an earlier one has.
    assert (np.sign(ours.log_odds) == np.sign(theirs.log_odds)).mean() > 0.99


def test_the_cloud_and_the_voxels_are_those_of_all_linked_drives():
    map_ = drives(3)
    joining.join_sessions(map_, links_between(0, 1, TRUE[:2]))
    assert _linked(map_) == [0, 1]
    placed = place_map(map_, CONFIG)
    cloud, voxels = cloud_of(placed.tiles), voxels_of(placed.tiles)
    assert np.abs(-cloud.xyz[:, 1] - WALL_M).max() < 0.1  # one wall, not two
    assert cloud.xyz[:, 0].max() > TRUE[1][-1, 2, 3]
    walls = voxels.select(voxels.log_odds > 1.0)
    assert np.unique(walls.keys[:, 1]).tolist() == [int(np.floor(-WALL_M / 0.2))]
    assert placed.path_m.shape == (2 * FRAMES + 1, 3)
    assert np.isnan(placed.path_m[FRAMES]).all()
    assert not placed.trusted[FRAMES]
    assert placed.tiles.submap_of_frame[FRAMES] == -1


def test_links_that_would_tear_a_drive_are_not_believed():
    map_, right = drives(2), links_between(0, 1, TRUE[:2])
    joining.join_sessions(map_, [*right[:3], *links_between(0, 1, TRUE[:2], off_m=9.0)[3:]])
    kept = {link.loop.last for link in map_.links if link.kept}
    assert all(link.kept or link.loop.last % 2 for link in map_.links) or not kept
    assert len(map_.linked) == 1 or off_m(map_, 1) < 0.1


def test_a_map_in_a_file_is_merged_and_its_drives_get_the_next_numbers(tmp_path):
    target, source = drives(1), Map.create(tmp_path / "map.recon")
    other = drive(source, TRUE[1], 1, "friday")
    source.commit()
    assert copy_sessions(source, target) == [1]
    copied = target.session(1)
    assert copied.info.source == "friday"
    np.testing.assert_array_equal(copied.odometry.T_world_camera, other.odometry.T_world_camera)
    np.testing.assert_array_equal(*(s.rays(3)[0].cloud().xyz for s in (copied, other)))
    assert copied.submaps.entries == other.submaps.entries
    with pytest.raises(FormatError, match="has this drive already"):
        copy_sessions(source, target)
    for setting in ("fusion.voxel_m=0.2", "occupancy.resolution_m=0.05"):
        with pytest.raises(SettingsError):
            check_session(copied, load_config(None, [setting]))


def test_a_drive_that_is_taken_out_leaves_the_others_where_they_are():
    map_ = drives(3)
    joining.join_sessions(map_, [*links_between(0, 1, TRUE[:2]), *links_between(1, 2, TRUE[1:])])
    assert off_m(map_, 2) < 0.02
    for without, numbers, linked in ((1, [0, 2], [0]), (0, [1, 2], [1, 2])):
        left = Map.temporary()
        assert copy_sessions(map_, left, without=[without]) == numbers
        joining.join_sessions(left, left.links)
        assert _linked(left) == linked
    in_map = map_.session(2).T_map_world
    np.testing.assert_allclose(left.session(2).T_map_world, in_map, atol=1e-3)


LOST = OdometryHealth(ok=False)
SKIPPED = OdometryHealth(ok=False, skipped=True)
AT = 9


def _torn(health: OdometryHealth, last: int = FRAMES) -> Map:
    """A map whose second drive has a bad pose at frame 9, joined by its links up to a frame."""
    map_ = drives(1)
    drive(map_, TRUE[1], 1, health={AT: health})
    joining.join_sessions(
        map_, [one for one in links_between(0, 1, TRUE[:2]) if one.loop.last < last]
    )
    return map_


def test_what_follows_a_lost_pose_stays_out_of_the_map():
    map_ = _torn(LOST, last=AT)
    placed = map_.placed
    assert placed[0].all()
    assert np.flatnonzero(placed[1]).tolist() == list(range(AT))
    made = place_map(map_, CONFIG)
    cloud, voxels = cloud_of(made.tiles), voxels_of(made.tiles)
    assert cloud.xyz[:, 0].max() < TRUE[1][AT, 2, 3] + 8.0  # what frame 8 sees ends there
    assert np.abs(-cloud.xyz[:, 1] - WALL_M).max() < 0.1
    assert (voxels.keys[:, 0] * voxels.resolution_m).max() < TRUE[1][AT, 2, 3] + 8.0
    assert not made.trusted[FRAMES + 1 + AT :].any()
    not_trusted, left_out = map_.doubts
    assert not_trusted.startswith("session 1 (wall): 1 of 20 poses are not to be trusted (frame 9)")
    assert left_out.startswith("session 1 (wall): frames 10-19 lie beyond a break")


@pytest.mark.parametrize(("health", "last"), [(LOST, FRAMES), (SKIPPED, AT)])
def test_what_is_seen_past_a_bad_pose_is_in_the_map(health, last):
    map_ = _torn(health, last)
    assert np.flatnonzero(~map_.placed[1]).tolist() == [AT]
    assert len(map_.doubts) == 1


def test_loops_and_measured_positions_hold_what_follows_a_lost_pose():
    map_ = _torn(LOST, last=AT)
    other = map_.session(1)
    loop = asdict(Loop(3, 15, np.eye(4), np.eye(6), 50, 0.9))
    other.set_loops({**other.loops, "closed": [loop]})
    assert map_.placed[1][AT + 1 :].all()
    other.set_loops({**other.loops, "closed": []})
    assert not map_.placed[1][AT + 1 :].any()
    for session, at in ((map_.session(0), [0, 19]), (other, [12, 17])):
        session.set_fixes(Fixes(np.int32(at), np.zeros((2, 3)), np.zeros((2, 3)), 0.1))
    assert map_.placed[1][AT + 1 :].all()


def test_a_first_frame_that_sees_nothing_is_not_where_the_map_begins():
    map_ = Map.temporary()
    session = drive(map_, TRUE[0], 0, health={1: LOST})
    not_trusted, left_out = map_.doubts
    assert not_trusted.startswith("1 of 20 poses are not to be trusted (frame 1)")
    assert left_out.startswith("frame 0 lie")
    assert np.flatnonzero(~map_.joined(session)).tolist() == [0, 1]
    drive(map_, TRUE[1], 1)
    joining.join_sessions(map_, links_between(0, 1, TRUE[:2]))
    assert np.flatnonzero(~map_.placed[0]).tolist() == [0, 1]
    assert map_.placed[1].all()


def test_of_a_drive_without_any_trusted_pose_nothing_is_in_the_map():
    map_ = Map.temporary()
    session = drive(map_, TRUE[0], 0, health=dict.fromkeys(range(FRAMES), LOST))
    assert not map_.placed[0].any()
    assert map_.joined(session).all()  # the path is all that there is to look at


SMALL_TILES = load_config(None, ["submaps.length_m=8", "submaps.tile_m=12.8", "fusion.min_count=1"])


def _shuffled(function: Callable[[Any], None], items: Sequence[Any]) -> None:
    """Stand in for processes, which end in any order."""
    for number in np.random.default_rng(0).permutation(len(items)):
        function(items[number])


@pytest.fixture(scope="module", params=["one drive", "one drive, bent", "two drives"])
def file(request, tmp_path_factory):
    path, several = tmp_path_factory.mktemp("map") / "map.recon", request.param == "two drives"
    with Map.create(path) as map_:
        for number in range(2 if several else 1):
            drive(map_, TRUE[number], number, drift=0.01)
        if several:
            joining.join_sessions(map_, links_between(0, 1, TRUE[:2]))
        if "bent" in request.param:
            bent = TRUE[0].copy()
            bent[10:, 0, 3] += 0.33
            map_.session().set_loops({"closed": [], "refused": [], "T_world_camera": bent})
        map_.commit()
    return path


def _assert_same(made: PlacedMap, expected: PlacedMap) -> None:
    tiles, others = made.tiles, expected.tiles
    assert [tile.key for tile in tiles] == [tile.key for tile in others]
    assert (tiles.extent, tiles.edge_cells) == (others.extent, others.edge_cells)
    np.testing.assert_array_equal(tiles.submap_of_frame, others.submap_of_frame)
    np.testing.assert_array_equal(made.path_m, expected.path_m)
    np.testing.assert_array_equal(made.trusted, expected.trusted)
    for tile, other in zip(tiles, others, strict=True):
        ours, theirs = (
            (wide.keys, wide.log_odds, one.voxels.keys, one.cloud.xyz, floors)
            for one in (tile, other)
            for wide in [one.tiles.wide_voxels(tile.key)]
            for floors in [one.tiles.floors_in(tiles.bounds(tile.key))]
        )
        np.testing.assert_equal(ours, theirs)


@pytest.mark.parametrize("workers", [1, 3])
def test_tiles_are_the_same_by_many_processes(file, tmp_path, workers):
    with Map.open(file) as map_:
        made = place_map_on(map_, SMALL_TILES, tmp_path / "tiles", _shuffled, workers)
        _assert_same(made, place_map(map_, SMALL_TILES))


def test_tiles_are_halved_for_all_where_one_is_too_large(file, tmp_path):
    config = load_config(None, ["submaps.length_m=8", "submaps.tile_m=51.2", "fusion.min_count=1"])
    memory = config.memory.model_copy(update={"limit_mb": 8.0})
    tight = config.model_copy(update={"memory": memory})
    with Map.open(file) as map_, pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(memory), "check", lambda self, where: None)
        made = place_map_on(map_, tight, tmp_path / "tiles", _shuffled, 2)
        assert made.tiles.edge_cells < place_map(map_, config).tiles.edge_cells
        _assert_same(made, place_map(map_, tight))
    with drives(1) as temporary, pytest.raises(MappingError, match="temporary"):
        place_map_on(temporary, SMALL_TILES, tmp_path, _shuffled, 2)


T_SURVEY_WORLD = make_transform(
    exp_so3(np.array([0.0, 0.0, 0.7])), np.array([456789.0, 5433210.0, 118.0])
) @ make_transform(AXES_MAP_WORLD, np.zeros(3))
ANTENNA = (0.4, -0.3, 1.1)
DAY_S = 100


def strayed(count: int = 1) -> Map:
    """Drives of different days that no link holds, whose paths are stretched by drift."""
    return drives(count, drift=0.01, apart=DAY_S)


def rows_of(numbers: tuple[int, ...] = (0,), every_s: float = 0.25) -> Float64:
    """Several while each of these drives lasts, and the first one when nobody drove."""
    rows = [np.array([[DAY_S * 50.0, 1.0, 2.0, 3.0]])]
    for number in numbers:
        times_s = DAY_S * number + np.arange(0.03, 1.9, every_s)
        path = Trajectory(TRUE[number], DAY_S * number + 0.1 * np.arange(len(TRUE[number])))
        T = T_SURVEY_WORLD @ interpolate_poses(path, times_s)
        antenna_m = T[:, :3, :3] @ AXES_MAP_WORLD.T @ np.array(ANTENNA) + T[:, :3, 3]
        rows.append(np.column_stack([times_s, antenna_m]))
    return np.concatenate(rows)


def survey(folder: Path, rows: Float64, fmt: str = "%.4f", sigma_m: float | None = None) -> Survey:
    if sigma_m is not None:
        rows = np.column_stack([rows, np.full(len(rows), sigma_m)])
    np.savetxt(folder / "gnss.txt", rows, fmt=fmt)
    return Survey(folder / "gnss.txt", ANTENNA)


def winding(off: float, every_s: float, numbers: tuple[int, ...] = (0,)) -> Float64:
    rows = rows_of(numbers, every_s)
    rows[1:, 1:3] += off * np.sin(3.0 * rows[1:, 0])[:, None]
    return rows


def test_a_drive_is_bent_to_measured_positions(tmp_path):
    map_ = strayed()
    assert off_m(map_, 0) > 0.15
    assert hold(map_, survey(tmp_path, rows_of())) == []
    joining.join_new(map_, [])
    assert off_m(map_, 0) < 0.03
    assert (misfit_rms_m(map_), doubts_of_positions(map_)) == (pytest.approx(0.0, abs=0.02), [])
    other = Map.temporary()
    copy_sessions(map_, other)
    joining.join_new(other, [])
    assert off_m(other, 0) < 0.03
    with pytest.raises(ReconError, match="no position was measured during the drive"):
        hold(map_, survey(tmp_path, rows_of(())))


def test_drives_that_share_no_place_are_placed_by_measured_positions(tmp_path):
    map_ = strayed(2)
    for measured, linked in (((), [0]), ((0,), [0]), ((0, 1), [0, 1])):
        if measured:
            hold(map_, survey(tmp_path, rows_of(measured)))
        joining.join_new(map_, [])
        assert [session.number for session in map_.linked] == linked
    assert off_m(map_, 0) < 0.03
    assert off_m(map_, 1) < 0.1


@pytest.mark.parametrize("scale", [1e3, 1e-3, 1e6])
def test_positions_in_another_unit_leave_the_map_as_it_is(tmp_path, scale):
    map_, rows = strayed(), rows_of(every_s=0.05)
    rows[:, 1:] = scale * (rows[:, 1:] - rows[1, 1:])
    with pytest.raises(ReconError, match=r"gnss\.txt"):
        hold(map_, survey(tmp_path, rows, fmt="%.9f"))
    assert not len(map_.first.fixes)


def test_a_few_jumps_are_left_out(tmp_path):
    map_, rows = strayed(), rows_of(every_s=0.05)
    rows[[4, 17], 1:3] += 800.0
    (line,) = hold(map_, survey(tmp_path, rows))
    assert "2 of 38 positions contradict the others" in line
    joining.join_new(map_, [])
    assert off_m(map_, 0) < 0.03


def test_positions_count_as_much_as_the_file_says(tmp_path):
    map_ = strayed()
    hold(map_, survey(tmp_path, rows_of(), sigma_m=5.0))
    joining.join_new(map_, [])
    assert map_.first.fixes.sigma_m == pytest.approx(5.0)
    assert off_m(map_, 0) > 0.1


def test_positions_that_jump_more_than_the_file_states_are_refused(tmp_path):
    rows = rows_of(every_s=0.05)
    rows[1:, 1:] += np.random.default_rng(3).normal(0.0, 0.15, rows[1:, 1:].shape)
    assert hold(strayed(), survey(tmp_path, rows)) == []
    with pytest.raises(ReconError, match=r"jump.*expected 0\.02 m, as the file states"):
        hold(strayed(), survey(tmp_path, rows, sigma_m=0.02))


def test_positions_far_from_the_path_are_warned_of(tmp_path):
    map_ = strayed()
    hold(map_, survey(tmp_path, winding(3.0, 0.25)))
    joining.join_new(map_, [])
    assert "from the measured positions" in doubts_of_positions(map_)[0]


@pytest.mark.parametrize("numbers", [(0,), (0, 1)])
def test_positions_beyond_any_drift_are_refused(tmp_path, numbers):
    map_ = strayed(len(numbers))
    hold(map_, survey(tmp_path, winding(8.0, 0.02, numbers)))
    with pytest.raises(RegistrationError, match="deform a path more than its drift explains"):
        joining.join_new(map_, [])


T_THERE = make_transform(exp_so3(np.array([0.0, 2.5, 0.0])), np.array([30.0, 1.0, -80.0]))


def bend(longer: float) -> Trajectory:
    """A drive of 40 frames around a bend, as long as a rig measures it."""
    turns = 0.04 * np.arange(40)
    ways = np.stack([1.0 - np.cos(turns), 0.0 * turns, np.sin(turns)], axis=1)
    turned = [exp_so3(np.array([0.0, turn, 0.0])) for turn in turns]
    poses = [make_transform(R, longer * 20.0 * way) for R, way in zip(turned, ways, strict=True)]
    return Trajectory(np.stack(poses), 0.1 * np.arange(40))


def links_of(every: int, noise_m: float = 0.02) -> list[Loop]:
    """Places that both saw, a frame apart: the link is measured by the first rig."""
    path, random = bend(1.0).T_world_camera, np.random.default_rng(5)
    found = []
    for frame in range(0, 39, every):
        T = invert(path[frame]) @ path[frame + 1]
        T[:3, 3] += random.normal(0.0, noise_m, 3)
        found.append(Loop(frame, frame + 1, T, np.eye(6), 100, 0.9))
    return found


@pytest.mark.parametrize("longer", [0.9, 1.0, 1.03])
def test_the_ratio_of_two_rigs_is_found_within_its_deviation(longer):
    other = bend(longer)
    moved = Trajectory(T_THERE @ other.T_world_camera, other.timestamps_s)
    scale, sigma = joining.times_as_long(bend(1.0), moved, links_of(3))
    assert 0.0002 < sigma < 0.002
    assert abs(scale - 1.0 / longer) < 4 * sigma


def test_noisy_links_say_little_and_few_or_those_at_one_place_nothing():
    scale, sigma = joining.times_as_long(bend(1.0), bend(1.0), links_of(3, noise_m=0.5))
    assert 0.01 < sigma < 0.05
    assert abs(scale - 1.0) < 4 * sigma
    still = Trajectory(np.tile(np.eye(4), (40, 1, 1)), 0.1 * np.arange(40))
    assert joining.times_as_long(bend(1.0), bend(1.03), links_of(10)) is None
    assert joining.times_as_long(bend(1.0), still, links_of(3)) is None
