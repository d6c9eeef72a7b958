"""What newer drives saw again is forgotten; what only an older one saw stays."""

from contextlib import closing
from dataclasses import asdict, replace

import numpy as np
import pytest

from recon.core.dates import Date, date_of_stamp, given_date
from recon.core.errors import FormatError, SettingsError
from recon.core.geometry.se3 import apply
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.map import Map
from recon.map.sessions import joining
from recon.map.sessions.copying import copy_sessions
from recon.map.sessions.keep import Keep
from recon.map.sessions.placed import place_map
from recon.map.sessions.tending import forget, tend
from recon.map.store.session import SESSION, Session
from tests.map.walls import CONFIG, FRAMES, cloud_of, drive, links_between, poses

TWO = Keep(drives=2)
STARTS_M = (0.0, 12.0, 12.0, 12.0)


def street(starts_m: tuple[float, ...] = STARTS_M) -> Map:
    """Drives along a wall, all linked with the first, from different places on."""
    map_, true = Map.temporary(), [poses(start_m) for start_m in starts_m]
    links = []
    for number, path in enumerate(true):
        drive(map_, path, 3 * number)
        links += links_between(0, number, (true[0], path)) if number else []
    joining.join_sessions(map_, links)
    map_.commit()
    return map_


def rays_z(map_: Map, number: int) -> Float64:
    """How far along the wall the rays of a drive end, by where its world lies in the first one."""
    session = map_.session(number)
    T = map_.T_world_session(session) @ session.trajectory.T_world_camera
    ends = [
        apply(T[frame], session.rays(frame)[0].cloud().xyz.astype(float))
        for frame in range(len(session))
    ]
    return np.concatenate(ends)[:, 2]


def voxels_z(map_: Map, number: int) -> Float64:
    session = map_.session(number)
    T = map_.T_world_session(session)
    moves = session.corrections()
    return np.concatenate(
        [
            apply(T if moves is None else T @ moves[n], one.fused.points(CONFIG.fusion.voxel_m))
            for n, one in enumerate(session.submaps)
        ]
    )[:, 2]


def state(map_: Map) -> list[tuple[int, int, int]]:
    return [
        (one.number, len(rays_z(map_, one.number)), len(voxels_z(map_, one.number)))
        for one in map_.sessions
    ]


def world_poses(map_: Map) -> dict[int, Float64]:
    return {number: path.T_world_camera for number, path in map_.paths.items()}


def test_what_newer_drives_confirm_goes_and_what_only_the_first_saw_stays():
    map_ = street()
    before, paths = state(map_), world_poses(map_)
    tended = tend(map_, CONFIG, TWO)
    after = {number: (rays, voxels) for number, rays, voxels in state(map_)}
    # The others begin 12 m farther on: what lies behind that is the first drive's alone.
    for z in (rays_z(map_, 0), voxels_z(map_, 0)):
        assert z.min() < 2.0
        assert np.mean(z > 16.0) < 0.01
    assert np.mean(rays_z(map_, 0) < 12.0) > 0.8
    for number in (2, 3):  # the newest two are whole
        assert after[number] == before[number][1:]
    had, left = sum(row[1] for row in before), sum(rays for rays, _ in after.values())
    share = f"{100 * (1 - left / had):.0f} % of the rays"
    assert tended == f"1 of 4 drives, {share}: newer drives saw the same"
    for number, path in world_poses(map_).items():
        np.testing.assert_array_equal(path, paths[number])


def test_a_drive_of_which_nothing_is_left_leaves_and_its_number_is_not_used_again():
    map_ = street()
    tend(map_, CONFIG, TWO)
    assert [one.number for one in map_.sessions] == [0, 2, 3]
    (gone,) = map_.forgotten
    assert (gone.number, gone.name, gone.frames) == (1, "wall", FRAMES)
    assert gone.length_m == pytest.approx(FRAMES - 1)
    assert {*map_.store.keys(SESSION)} == {0, 2, 3}
    with Map.temporary() as other:
        copy_sessions(map_, other, without=[3])
        assert other.forgotten == map_.forgotten
        assert drive(other, poses(0.0), 50).number == 3
        forget(other, [3])
        assert drive(other, poses(0.0), 50).number == 4


def test_the_first_drive_stays_with_its_poses():
    map_ = street((0.0, 0.0, 0.0, 0.0))
    assert tend(map_, CONFIG, TWO).startswith("1 of 4 drives, ")
    assert [one.number for one in map_.sessions] == [0, 2, 3]
    assert (len(map_.first), len(rays_z(map_, 0)), len(voxels_z(map_, 0))) == (FRAMES, 0, 0)
    assert len(cloud_of(place_map(map_, CONFIG).tiles))


def test_tending_twice_is_tending_once():
    map_ = street((0.0, 6.0, 12.0, 14.0, 15.0))
    tend(map_, CONFIG, TWO)
    once = state(map_)
    assert tend(map_, CONFIG, TWO) == ""
    assert state(map_) == once


def test_products_after_forgetting_have_the_wall_where_it_was():
    map_ = street()
    whole = cloud_of(place_map(map_, CONFIG).tiles)
    tend(map_, CONFIG, TWO)
    thinned = cloud_of(place_map(map_, CONFIG).tiles)
    # Map axes: x forward. What only part of a cell shows may take the rest of it along.
    edge_m = 4 * CONFIG.occupancy.resolution_m
    gaps_m = [np.diff(np.sort(cloud.xyz[:, 0])).max() for cloud in (whole, thinned)]
    assert gaps_m[1] < gaps_m[0] + edge_m
    assert thinned.xyz[:, 0].min() == pytest.approx(whole.xyz[:, 0].min(), abs=0.1)
    assert np.abs(thinned.xyz[:, 1] - np.median(whole.xyz[:, 1])).max() < 0.1


def test_what_too_few_frames_saw_fades_though_no_newer_drive_looked_there():
    map_ = street()
    seldom = CONFIG.model_copy(
        update={"fusion": CONFIG.fusion.model_copy(update={"min_count": FRAMES + 1})}
    )
    tend(map_, seldom, TWO)
    assert not len(voxels_z(map_, 0))
    assert not len(rays_z(map_, 0))


def test_a_map_of_few_drives_is_untouched():
    for starts_m in ((0.0,), (0.0, 0.0)):
        map_ = street(starts_m)
        before = state(map_)
        assert tend(map_, CONFIG, TWO) == ""
        assert state(map_) == before
        assert all(one.thinned is None or one.thinned.rays_ratio == 1.0 for one in map_.sessions)


def test_a_region_keeps_what_lies_in_it_alone():
    map_ = street((0.0, 12.0))
    assert tend(map_, CONFIG, Keep(region=(5.0, -10.0, 20.0, 10.0))).endswith("% of the rays")
    for number in (0, 1):
        for z in (rays_z(map_, number), voxels_z(map_, number)):
            assert z.min() >= 5.0 - 1e-6
            assert z.max() <= 20.0 + 1e-6


@pytest.mark.parametrize(
    "keep", [Keep(region=(500.0, 0.0, 501.0, 1.0)), Keep(1, None, (-9, 90, 0, 99))]
)
def test_a_region_without_anything_is_refused_and_nothing_else_done(keep):
    map_ = street((0.0, 12.0))
    with pytest.raises(SettingsError, match="--keep: the map would keep nothing"):
        tend(map_, CONFIG, keep)
    assert len(map_.sessions) == 2


def dated(session: Session, text: str) -> None:
    session.info = replace(session.info, date=text, date_from="given")
    session._store.put(SESSION, session.number, asdict(session.info))


def test_old_drives_leave_and_the_first_keeps_its_poses_alone():
    map_ = street()
    for number, day in enumerate(("2026-01-01", "2026-03-01", "", "2026-06-01")):
        dated(map_.session(number), day)
    whole = len(rays_z(map_, 3))
    assert "1 of 4 drives" in tend(map_, CONFIG, Keep(days=90.0))
    assert [one.number for one in map_.sessions] == [0, 2, 3]  # without a date, 2 stays
    assert map_.forgotten[0].date == "2026-03-01"
    assert (len(rays_z(map_, 0)), len(map_.first)) == (0, FRAMES)
    assert len(rays_z(map_, 3)) == whole


def test_drives_that_only_one_that_leaves_held_stay_where_they_are():
    true = [poses(start_m) for start_m in (0.0, 6.0, 12.0)]
    for pair in ((0, 1, 2), (0, 2, 1)):  # the link to the last is of the one, and of the other
        map_ = Map.temporary()
        for number, path in enumerate(true):
            drive(map_, path, 3 * number)
        middle, last = pair[1:]
        links = [
            *links_between(0, middle, (true[0], true[middle])),
            *links_between(min(1, 2), 2, (true[1], true[2]), off_m=0.002),
        ]
        joining.join_sessions(map_, links)
        before = world_poses(map_)
        forget(map_, [middle])
        np.testing.assert_array_equal(world_poses(map_)[last], before[last])
        joining.join_new(map_, [])
        assert [one.number for one in map_.linked] == sorted((0, last))
        moved_m = (world_poses(map_)[last] - before[last])[:, :3, 3]
        assert np.abs(moved_m).max() < 1e-3


def test_conditions_are_read_as_people_write_them():
    found = Keep.parse(["3", "90d", "-5,0,10,20.5"], "--keep")
    assert found == Keep(3, 90.0, (-5.0, 0.0, 10.0, 20.5))
    assert Keep.parse(["all"], "--keep") == Keep()


@pytest.mark.parametrize(
    "texts",
    [["0"], ["1.5"], ["-3"], ["nan"], ["infd"], ["d"], [""], ["1,2,3"], ["5,0,1,9"], ["x"],
     ["3", "2"], ["all", "3"], ["3", "all"], ["-1d"], ["1,2,3,4d"], ["1_0"], ["\uff12"]],
)  # fmt: skip
def test_what_is_no_condition_is_refused_in_one_line(texts):
    with pytest.raises(SettingsError, match=r"--keep.*not what a map may keep") as caught:
        Keep.parse(texts, "--keep")
    assert "\n" not in str(caught.value)


def test_dates_are_those_of_stamps_since_1970_or_given():
    assert date_of_stamp(1736150400.25) == Date("2025-01-06T08:00:00Z", "stamps")
    for no_date in (0.0, 12.5, -1.0, 1e12, float("nan"), float("inf")):
        assert date_of_stamp(no_date) == Date()
    assert given_date("2024-11-30", "--date") == Date("2024-11-30", "given")
    assert given_date("2024-11-30T14:05", "--date").text == "2024-11-30T14:05:00Z"
    assert given_date("2024-11-30T14:05+02:00", "--date").text == "2024-11-30T12:05:00Z"
    for bad in ("", "yesterday", "2024-13-01", "1950-01-01", "9000-01-01", "30.11.2024"):
        with pytest.raises(SettingsError, match="--date"):
            given_date(bad, "--date")


def test_a_session_without_a_date_has_that_of_its_stamps():
    with closing(street((0.0,))) as map_:
        session = map_.session(0)
        assert session.date == Date()
        path = session.odometry
        times = Trajectory(path.T_world_camera, path.timestamps_s + 1736150400.0)
        session._times_s = times.timestamps_s.tolist()
        assert session.date == Date("2025-01-06T08:00:00Z", "stamps")
        dated(session, "2024-01-01")
        assert session.date == Date("2024-01-01", "given")


def test_a_damaged_date_is_an_error_of_the_map():
    map_ = street((0.0, 12.0))
    dated(map_.session(1), "some day")
    with pytest.raises(FormatError, match="temporary map"):
        tend(map_, CONFIG, Keep(days=90.0))
