"""Positions measured along drives are kept with them, bend their paths and place them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import EvaluationError, ReconError, RegistrationError
from recon.core.geometry.alignment import interpolate_poses
from recon.core.geometry.se3 import exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.map import Map
from recon.map.sessions.copying import copy_sessions
from recon.map.sessions.joining import join_new, times_as_long
from recon.map.sessions.measured import Survey, doubts_of_positions, hold, misfit_rms_m
from recon.places.loop import Loop
from tests.map import walls
from tests.map.walls import TRUE, off_m

T_SURVEY_WORLD = make_transform(
    exp_so3(np.array([0.0, 0.0, 0.7])), np.array([456789.0, 5433210.0, 118.0])
) @ make_transform(AXES_MAP_WORLD, np.zeros(3))
ANTENNA = (0.4, -0.3, 1.1)
DAY_S = 100


def drives(count: int = 1) -> Map:
    """Drives of different days that no link holds, whose paths are stretched by drift."""
    return walls.drives(count, drift=0.01, apart=DAY_S)


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
    """Positions that leave the true path to either side."""
    rows = rows_of(numbers, every_s)
    rows[1:, 1:3] += off * np.sin(3.0 * rows[1:, 0])[:, None]
    return rows


def test_a_drive_is_bent_to_measured_positions(tmp_path: Path) -> None:
    map_ = drives()
    assert off_m(map_, 0) > 0.15
    assert hold(map_, survey(tmp_path, rows_of())) == []
    join_new(map_, [])
    assert off_m(map_, 0) < 0.03
    assert misfit_rms_m(map_) == pytest.approx(0.0, abs=0.02)
    assert doubts_of_positions(map_) == []
    other = Map.temporary()
    copy_sessions(map_, other)
    join_new(other, [])
    assert off_m(other, 0) < 0.03
    with pytest.raises(EvaluationError, match="no position was measured during the drive"):
        hold(map_, survey(tmp_path, rows_of(())))


def test_drives_that_share_no_place_are_placed_by_measured_positions(tmp_path: Path) -> None:
    map_ = drives(2)
    for measured, linked in (((), [0]), ((0,), [0]), ((0, 1), [0, 1])):
        if measured:
            hold(map_, survey(tmp_path, rows_of(measured)))
        join_new(map_, [])
        assert [session.number for session in map_.linked] == linked
    assert off_m(map_, 0) < 0.03
    assert off_m(map_, 1) < 0.1


@pytest.mark.parametrize("scale", [1e3, 1e-3, 1e6])
def test_positions_in_another_unit_leave_the_map_as_it_is(tmp_path: Path, scale: float) -> None:
    map_, rows = drives(), rows_of(every_s=0.05)
    rows[:, 1:] = scale * (rows[:, 1:] - rows[1, 1:])
    with pytest.raises(ReconError, match=r"gnss\.txt"):
        hold(map_, survey(tmp_path, rows, fmt="%.9f"))
    assert not len(map_.first.fixes)


def test_a_few_jumps_are_left_out(tmp_path: Path) -> None:
    map_, rows = drives(), rows_of(every_s=0.05)
    rows[[4, 17], 1:3] += 800.0
    (line,) = hold(map_, survey(tmp_path, rows))
    assert "2 of 38 positions contradict the others" in line
    join_new(map_, [])
    assert off_m(map_, 0) < 0.03


def test_positions_count_as_much_as_the_file_says(tmp_path: Path) -> None:
    map_ = drives()
    hold(map_, survey(tmp_path, rows_of(), sigma_m=5.0))
    join_new(map_, [])
    assert map_.first.fixes.sigma_m == pytest.approx(5.0)
    assert off_m(map_, 0) > 0.1


def test_positions_that_jump_more_than_the_file_states_are_refused(tmp_path: Path) -> None:
    rows = rows_of(every_s=0.05)
    rows[1:, 1:] += np.random.default_rng(3).normal(0.0, 0.15, rows[1:, 1:].shape)
    assert hold(drives(), survey(tmp_path, rows)) == []
    with pytest.raises(EvaluationError, match=r"jump.*expected 0\.02 m, as the file states"):
        hold(drives(), survey(tmp_path, rows, sigma_m=0.02))


def test_positions_far_from_the_path_are_warned_of(tmp_path: Path) -> None:
    map_ = drives()
    hold(map_, survey(tmp_path, winding(3.0, 0.25)))
    join_new(map_, [])
    assert "from the measured positions" in doubts_of_positions(map_)[0]


@pytest.mark.parametrize("numbers", [(0,), (0, 1)])
def test_positions_that_no_drift_explains_are_refused(
    tmp_path: Path, numbers: tuple[int, ...]
) -> None:
    map_ = drives(len(numbers))
    hold(map_, survey(tmp_path, winding(8.0, 0.02, numbers)))
    with pytest.raises(RegistrationError, match="bend a path more than its drift explains"):
        join_new(map_, [])


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
def test_the_ratio_of_two_rigs_is_found_within_its_deviation(longer: float) -> None:
    other = bend(longer)
    moved = Trajectory(T_THERE @ other.T_world_camera, other.timestamps_s)
    scale, sigma = times_as_long(bend(1.0), moved, links_of(3))
    assert 0.0002 < sigma < 0.002
    assert abs(scale - 1.0 / longer) < 4 * sigma


def test_noisy_links_say_little_and_few_or_those_at_one_place_nothing() -> None:
    scale, sigma = times_as_long(bend(1.0), bend(1.0), links_of(3, noise_m=0.5))
    assert 0.01 < sigma < 0.05
    assert abs(scale - 1.0) < 4 * sigma
    still = Trajectory(np.tile(np.eye(4), (40, 1, 1)), 0.1 * np.arange(40))
    assert times_as_long(bend(1.0), bend(1.03), links_of(10)) is None
    assert times_as_long(bend(1.0), still, links_of(3)) is None
