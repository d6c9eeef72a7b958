"""Drives in one map: copied, placed by their links, left apart without, and taken out again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import exp_so3, invert, make_transform, transform_cloud
from recon.core.kernels.voxels import pack_keys
from recon.core.values import PointCloud, RectifiedCamera, join_clouds, join_voxels
from recon.core.values.arrays import Float64
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.occupancy.builder import ray_grain, thin_rays
from recon.map.sessions.copying import check_session, copy_sessions
from recon.map.sessions.joining import join_new, join_sessions, seen_before, shared_frames
from recon.map.sessions.placed import PlacedSubmaps, place_map
from recon.map.store.session import Session, SessionInfo
from recon.map.store.trees import Link
from recon.map.submaps import SubmapBuilder
from recon.odometry.protocol import OdometryHealth
from recon.places.fixes import Fixes
from recon.places.loop import Loop

CONFIG = load_config(None, ["submaps.length_m=8", "fusion.min_count=1"])
CAMERA = RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12)
T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
WALL_M = 3.03
FRAMES = 20


def _poses(start_m: float, turn_rad: float = 0.0) -> Float64:
    """True poses of a drive along a wall, in the world of the first drive."""
    turn = exp_so3(np.array([0.0, turn_rad, 0.0]))
    return np.stack(
        [make_transform(turn, np.array([0.0, 0.0, start_m + n])) for n in range(FRAMES)]
    )


def _wall(T_true: Float64, seed: int) -> PointCloud:
    """What a camera at a true pose sees of the wall, camera axes."""
    rng = np.random.default_rng(seed)
    z = T_true[2, 3] + rng.uniform(1, 8, 600)
    points = np.stack([np.full(600, WALL_M), rng.uniform(-1, 1, 600), z], axis=1)
    cloud = PointCloud(points.astype("f4"), sigma_m=np.full(600, 0.05, "f4"))
    return transform_cloud(replace(cloud, frame="world"), invert(T_true), frame="camera")


def _drive(
    map_: Map,
    true: Float64,
    seed: int,
    name: str = "wall",
    drift: float = 0.0,
    first: int = 0,
    noise: int = 0,
    health: Mapping[int, OdometryHealth] | None = None,
) -> Session:
    """Map a drive whose own world begins with its first camera; ``drift`` stretches its path.

    ``health`` of some frames is not good; where a stretch ends, a submap does.
    Drives of one ``seed`` without other ``noise`` have the same images, from frame ``first`` on.
    """
    session = map_.begin(SessionInfo(name, "of a test", len(true), CONFIG.model_dump(mode="json")))
    session.set_axes(T_MAP_WORLD, CAMERA)
    builder = SubmapBuilder(CONFIG.submaps, CONFIG.fusion, CONFIG.occupancy, T_MAP_WORLD)
    records = [(health or {}).get(frame, OdometryHealth()) for frame in range(len(true))]
    for frame, T_true in enumerate(true):
        T = invert(true[0]) @ T_true
        T[:3, 3] *= 1 + drift
        cloud = _wall(T_true, 1000 * seed + first + frame + 500 * noise)
        if not records[frame].ok:
            cloud = cloud.select(np.zeros(0, np.intp))
        rays = thin_rays(cloud, CONFIG.occupancy)
        builder.integrate(transform_cloud(cloud, T, frame="world"), rays.cloud(), T)
        session.add_frame(T, 0.1 * (first + frame) + seed, records[frame])
        session.add_rays(frame, rays, ray_grain(CONFIG.occupancy))
        if builder.full or frame == len(true) - 1 or not records[frame].ok:
            session.submaps.add(builder.close())
    return session


def _links(one: int, other: int, true: tuple[Float64, Float64], off_m: float = 0.0) -> list[Link]:
    """Places that two drives saw, where their paths are side by side."""
    found = []
    for last in range(0, FRAMES, 3):
        first = int(np.argmin(np.linalg.norm(true[0][:, :3, 3] - true[1][last, :3, 3], axis=1)))
        T = invert(true[0][first]) @ true[1][last]
        T[2, 3] += off_m * (last % 2)
        found.append(Link((one, other), Loop(first, last, T, 1e4 * np.eye(6), 50, 0.9)))
    return found


TRUE = _poses(0.0), _poses(12.0, 0.05), _poses(5.0, -0.04)


def _map(drives: int = 2, drift: float = 0.0) -> Map:
    map_ = Map.temporary()
    for number in range(drives):
        _drive(map_, TRUE[number], number, drift=drift)
    map_.commit()
    return map_


def _path(map_: Map, number: int) -> Float64:
    """Positions of a drive in the world of the map."""
    session = map_.session(number)
    poses = map_.T_world_session(session) @ session.trajectory.T_world_camera
    return np.asarray(poses[:, :3, 3])


def _off_m(map_: Map, number: int) -> float:
    return float(np.linalg.norm(_path(map_, number) - TRUE[number][:, :3, 3], axis=1).max())


def test_a_linked_drive_is_placed_beside_the_first() -> None:
    map_ = _map()
    join_sessions(map_, _links(0, 1, TRUE[:2]))
    assert [session.number for session in map_.linked] == [0, 1]
    assert _off_m(map_, 0) < 1e-6
    assert _off_m(map_, 1) < 0.01
    assert all(link.kept for link in map_.links)


def test_links_correct_what_a_drive_has_drifted() -> None:
    map_ = _map()
    stretched = _drive(map_, TRUE[2], 2, drift=0.01)
    before = np.linalg.norm(stretched.odometry.positions_m[-1])
    join_sessions(map_, [*_links(0, 1, TRUE[:2]), *_links(0, 2, (TRUE[0], TRUE[2]))])
    assert before > 19.15
    assert _off_m(map_, 2) < 0.12


def test_frames_that_both_drives_have_link_them_exactly() -> None:
    map_, behind = Map.temporary(), 12
    later = _poses(float(behind))
    for number, (true, first) in enumerate(((TRUE[0], 0), (later, behind))):
        _drive(map_, true, seed=0, name=str(number), first=first)
    map_.commit()
    one, other = map_.sessions
    shared = shared_frames(one, other)
    assert shared.tolist() == [[frame + behind, frame] for frame in range(FRAMES - behind)]
    join_new(map_, [1])
    assert [link.loop.same_frame for link in map_.links] == [True]
    assert np.abs(_path(map_, 1) - later[:, :3, 3]).max() < 1e-6
    assert seen_before(map_, other) == set(range(FRAMES - behind))
    assert not seen_before(map_, one)
    assert not len(shared_frames(one, _drive(map_, TRUE[0], seed=0, noise=1)))


def test_a_drive_cut_in_two_that_overlap_gives_the_voxels_of_one() -> None:
    whole, halves = Map.temporary(), Map.temporary()
    true = np.concatenate([TRUE[0], _poses(float(FRAMES))])
    _drive(whole, true, seed=0)
    _drive(halves, true[:25], seed=0, name="first")
    _drive(halves, true[15:], seed=0, name="second", first=15)
    for map_ in (whole, halves):
        map_.commit()
    join_new(halves, [1])
    placed = PlacedSubmaps(halves, CONFIG)
    first, second = (placed[number].occupancy for number in (0, placed.drives[0]))
    assert len(first.rows.blocks)
    assert not len(second.rows.blocks)  # all of its frames are the first drive's, too
    seen = [
        join_voxels((tile.voxels for tile in place_map(map_, CONFIG).tiles), 0.2)
        for map_ in (whole, halves)
    ]
    keys = [pack_keys(voxels.keys) for voxels in seen]
    states = [np.sign(v.log_odds[np.argsort(key)]) for v, key in zip(seen, keys, strict=True)]
    assert np.array_equal(*map(np.sort, keys))
    # Not to the last bit: what a later drive sees counts more than what an earlier one has.
    assert (states[0] == states[1]).mean() > 0.99


def test_the_cloud_and_the_voxels_are_those_of_all_linked_drives() -> None:
    map_ = _map(3)
    join_sessions(map_, _links(0, 1, TRUE[:2]))
    assert [session.number for session in map_.linked] == [0, 1]
    placed = place_map(map_, CONFIG)
    cloud = join_clouds(tile.cloud for tile in placed.tiles)
    assert np.abs(-cloud.xyz[:, 1] - WALL_M).max() < 0.1  # one wall, not two
    assert cloud.xyz[:, 0].max() > TRUE[1][-1, 2, 3]
    voxels = join_voxels((tile.voxels for tile in placed.tiles), placed.tiles.resolution_m)
    walls = voxels.select(voxels.log_odds > 1.0)
    assert np.unique(walls.keys[:, 1]).tolist() == [int(np.floor(-WALL_M / 0.2))]
    assert placed.path_m.shape == (2 * FRAMES + 1, 3)
    assert np.isnan(placed.path_m[FRAMES]).all()
    assert not placed.trusted[FRAMES]
    assert placed.tiles.submap_of_frame[FRAMES] == -1


def test_links_that_would_tear_a_drive_are_not_believed() -> None:
    map_ = _map()
    wrong = [*_links(0, 1, TRUE[:2])[:3], *_links(0, 1, TRUE[:2], off_m=9.0)[3:]]
    join_sessions(map_, wrong)
    kept = {link.loop.last for link in map_.links if link.kept}
    assert all(link.kept or link.loop.last % 2 for link in map_.links) or not kept
    assert len(map_.linked) == 1 or _off_m(map_, 1) < 0.1


def test_a_map_in_a_file_is_merged_and_its_drives_get_the_next_numbers(tmp_path: Path) -> None:
    target, source = _map(1), Map.create(tmp_path / "map.recon")
    other = _drive(source, TRUE[1], 1, "friday")
    source.commit()
    assert copy_sessions(source, target) == [1]
    copied = target.session(1)
    assert copied.info.source == "friday"
    np.testing.assert_array_equal(copied.odometry.T_world_camera, other.odometry.T_world_camera)
    rays = [s.rays(3)[0].cloud().xyz for s in (copied, other)]
    np.testing.assert_array_equal(*rays)
    assert copied.submaps.entries == other.submaps.entries
    with pytest.raises(FormatError, match="has this drive already"):
        copy_sessions(source, target)
    for setting in ("fusion.voxel_m=0.2", "occupancy.resolution_m=0.05"):
        with pytest.raises(SettingsError):
            check_session(copied, load_config(None, [setting]))


def test_a_drive_that_is_taken_out_leaves_the_others_where_they_are() -> None:
    map_ = _map(3)
    join_sessions(map_, [*_links(0, 1, TRUE[:2]), *_links(1, 2, TRUE[1:])])
    assert _off_m(map_, 2) < 0.02
    in_map = map_.session(2).T_map_world
    apart = Map.temporary()
    copy_sessions(map_, apart, without=[1])
    join_sessions(apart, apart.links)
    assert [session.number for session in apart.linked] == [0]
    left = Map.temporary()
    assert copy_sessions(map_, left, without=[0]) == [1, 2]
    join_sessions(left, left.links)
    assert [session.number for session in left.linked] == [1, 2]
    np.testing.assert_allclose(left.session(2).T_map_world, in_map, atol=1e-3)


LOST = OdometryHealth(ok=False)
SKIPPED = OdometryHealth(ok=False, skipped=True)
AT = 9


def _torn(health: OdometryHealth, last: int = FRAMES) -> tuple[Map, list[Link]]:
    """A map whose second drive has a bad pose at frame 9, and its links up to a frame."""
    map_ = _map(1)
    _drive(map_, TRUE[1], 1, health={AT: health})
    return map_, [link for link in _links(0, 1, TRUE[:2]) if link.loop.last < last]


def test_what_follows_a_lost_pose_stays_out_of_a_map_of_several_drives() -> None:
    map_, links = _torn(LOST, last=AT)
    join_sessions(map_, links)

    placed = map_.placed
    assert placed[0].all()
    assert np.flatnonzero(placed[1]).tolist() == list(range(AT))
    made = place_map(map_, CONFIG)
    cloud = join_clouds(tile.cloud for tile in made.tiles)
    assert cloud.xyz[:, 0].max() < TRUE[1][AT, 2, 3] + 8.0  # what frame 8 sees ends there
    assert np.abs(-cloud.xyz[:, 1] - WALL_M).max() < 0.1
    voxels = join_voxels((tile.voxels for tile in made.tiles), made.tiles.resolution_m)
    assert (voxels.keys[:, 0] * voxels.resolution_m).max() < TRUE[1][AT, 2, 3] + 8.0
    assert not made.trusted[FRAMES + 1 + AT :].any()
    not_trusted, left_out = map_.doubts
    assert not_trusted.startswith("session 1 (wall): 1 of 20 poses are not to be trusted (frame 9)")
    assert left_out.startswith("session 1 (wall): frames 10-19 follow a lost pose")


@pytest.mark.parametrize(("health", "last"), [(LOST, FRAMES), (SKIPPED, AT)])
def test_what_is_seen_again_or_measured_past_a_bad_pose_is_in_the_map(
    health: OdometryHealth, last: int
) -> None:
    map_, links = _torn(health, last)
    join_sessions(map_, links)
    assert np.flatnonzero(~map_.placed[1]).tolist() == [AT]
    assert len(map_.doubts) == 1


def test_loops_and_measured_positions_hold_what_follows_a_lost_pose() -> None:
    map_, links = _torn(LOST, last=AT)
    join_sessions(map_, links)
    other = map_.session(1)
    loop = asdict(Loop(3, 15, np.eye(4), np.eye(6), 50, 0.9))
    other.set_loops({**other.loops, "closed": [loop]})
    assert map_.placed[1][AT + 1 :].all()
    other.set_loops({**other.loops, "closed": []})
    assert not map_.placed[1][AT + 1 :].any()
    for session, frames in ((map_.session(0), [0, 19]), (other, [12, 17])):
        session.set_fixes(
            Fixes(np.array(frames, np.int32), np.zeros((2, 3)), np.zeros((2, 3)), 0.1)
        )
    assert map_.placed[1][AT + 1 :].all()


def test_a_map_of_one_drive_keeps_what_follows_a_lost_pose_and_says_so() -> None:
    map_ = Map.temporary()
    session = _drive(map_, TRUE[0], 0, health={AT: LOST})
    map_.commit()
    assert np.flatnonzero(~map_.placed[0]).tolist() == [AT]
    np.testing.assert_array_equal(map_.placed[0], session.trusted)
    (line,) = map_.doubts
    assert line.startswith("1 of 20 poses are not to be trusted (frame 9)")


def test_a_first_frame_that_sees_nothing_is_not_where_the_map_begins() -> None:
    map_ = Map.temporary()
    _drive(map_, TRUE[0], 0, health={1: LOST})
    _drive(map_, TRUE[1], 1)
    join_sessions(map_, _links(0, 1, TRUE[:2]))
    assert np.flatnonzero(~map_.placed[0]).tolist() == [0, 1]
    assert map_.placed[1].all()


def test_a_damaged_record_of_links_is_one_clear_line() -> None:
    map_ = _map()
    map_.store.put("links", 0, {"links": [{"sessions": [0, 0]}], "linked": [0]})
    with pytest.raises(FormatError):
        _ = map_.links
    map_.store.put("links", 0, {"linked": 7})
    with pytest.raises(FormatError):
        _ = map_.linked
