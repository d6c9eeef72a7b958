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
from tests.map.sessions.test_map_of_several_drives import TRUE, _drive, _off_m

T_SURVEY_WORLD = make_transform(
    exp_so3(np.array([0.0, 0.0, 0.7])), np.array([456789.0, 5433210.0, 118.0])
) @ make_transform(AXES_MAP_WORLD, np.zeros(3))
ANTENNA = (0.4, -0.3, 1.1)
DAY_S = 100


def drives(count: int = 1, drift: float = 0.01) -> Map:
    """Drives of different days that no link holds; ``drift`` stretches their paths."""
    map_ = Map.temporary()
    for number in range(count):
        _drive(map_, TRUE[number], DAY_S * number, drift=drift)
    map_.commit()
    return map_


def positions(folder: Path, numbers: tuple[int, ...] = (0,), every_s: float = 0.25) -> Path:
    """Several while each of these drives lasts, and one when nobody drove."""
    rows = [np.array([[DAY_S * 50.0, 1.0, 2.0, 3.0]])]
    for number in numbers:
        times_s = DAY_S * number + np.arange(0.03, 1.9, every_s)
        path = Trajectory(TRUE[number], DAY_S * number + 0.1 * np.arange(len(TRUE[number])))
        rows.append(np.column_stack([times_s, antenna(interpolate_poses(path, times_s))]))
    np.savetxt(folder / "gnss.txt", np.concatenate(rows), fmt="%.4f")
    return folder / "gnss.txt"


def antenna(T_world_camera: Float64) -> Float64:
    offset_m = AXES_MAP_WORLD.T @ np.array(ANTENNA)
    T = T_SURVEY_WORLD @ T_world_camera
    return np.asarray(T[:, :3, :3] @ offset_m + T[:, :3, 3])


def test_a_drive_is_bent_to_measured_positions(tmp_path: Path) -> None:
    map_ = drives()
    assert _off_m(map_, 0) > 0.15
    assert hold(map_, Survey(positions(tmp_path), ANTENNA)) == []
    join_new(map_, [])
    assert _off_m(map_, 0) < 0.03
    assert misfit_rms_m(map_) == pytest.approx(0.0, abs=0.02)
    assert doubts_of_positions(map_) == []
    other = Map.temporary()
    copy_sessions(map_, other)
    join_new(other, [])
    assert _off_m(other, 0) < 0.03
    with pytest.raises(EvaluationError, match="no position was measured during the drive"):
        hold(map_, Survey(positions(tmp_path, ())))


def test_drives_that_share_no_place_are_placed_by_measured_positions(tmp_path: Path) -> None:
    map_ = drives(2)
    for only_first in ((), (0,)):
        if only_first:
            hold(map_, Survey(positions(tmp_path, only_first), ANTENNA))
        join_new(map_, [])
        assert [session.number for session in map_.linked] == [0]
    hold(map_, Survey(positions(tmp_path, (0, 1)), ANTENNA))
    join_new(map_, [])
    assert [session.number for session in map_.linked] == [0, 1]
    assert _off_m(map_, 0) < 0.03
    assert _off_m(map_, 1) < 0.1


def winding(folder: Path, off_m: float, every_s: float, numbers: tuple[int, ...] = (0,)) -> Path:
    """Positions that leave the true path to either side."""
    rows = np.loadtxt(positions(folder, numbers, every_s))
    rows[1:, 1:3] += off_m * np.sin(3.0 * rows[1:, 0])[:, None]
    np.savetxt(folder / "gnss.txt", rows, fmt="%.4f")
    return folder / "gnss.txt"


@pytest.mark.parametrize("scale", [1e3, 1e-3, 1e6])
def test_positions_in_another_unit_leave_the_map_as_it_is(tmp_path: Path, scale: float) -> None:
    map_ = drives()
    rows = np.loadtxt(positions(tmp_path, every_s=0.05))
    rows[:, 1:] = scale * (rows[:, 1:] - rows[1, 1:])
    np.savetxt(tmp_path / "gnss.txt", rows, fmt="%.9f")
    with pytest.raises(ReconError, match=r"gnss\.txt"):
        hold(map_, Survey(tmp_path / "gnss.txt", ANTENNA))
    assert not len(map_.first.fixes)


def test_a_few_jumps_are_left_out(tmp_path: Path) -> None:
    map_ = drives()
    rows = np.loadtxt(positions(tmp_path, every_s=0.05))
    rows[[4, 17], 1:3] += 800.0
    np.savetxt(tmp_path / "gnss.txt", rows, fmt="%.4f")
    (line,) = hold(map_, Survey(tmp_path / "gnss.txt", ANTENNA))
    assert "2 of 38 positions contradict the others" in line
    join_new(map_, [])
    assert _off_m(map_, 0) < 0.03


def test_positions_count_as_much_as_the_file_says(tmp_path: Path) -> None:
    rows = np.loadtxt(positions(tmp_path))
    np.savetxt(tmp_path / "gnss.txt", np.column_stack([rows, np.full(len(rows), 5.0)]), fmt="%.4f")
    map_ = drives()
    hold(map_, Survey(tmp_path / "gnss.txt", ANTENNA))
    join_new(map_, [])
    assert map_.first.fixes.sigma_m == pytest.approx(5.0)
    assert _off_m(map_, 0) > 0.1


def test_positions_that_jump_more_than_the_file_states_are_refused(tmp_path: Path) -> None:
    rows = np.loadtxt(positions(tmp_path, every_s=0.05))
    rows[1:, 1:] += np.random.default_rng(3).normal(0.0, 0.15, rows[1:, 1:].shape)
    np.savetxt(tmp_path / "plain.txt", rows, fmt="%.4f")
    np.savetxt(tmp_path / "sure.txt", np.column_stack([rows, np.full(len(rows), 0.02)]), fmt="%.4f")
    assert hold(drives(), Survey(tmp_path / "plain.txt", ANTENNA)) == []
    with pytest.raises(EvaluationError, match=r"jump.*expected 0\.02 m, as the file states"):
        hold(drives(), Survey(tmp_path / "sure.txt", ANTENNA))


def test_positions_far_from_the_path_are_warned_of(tmp_path: Path) -> None:
    map_ = drives()
    hold(map_, Survey(winding(tmp_path, 3.0, 0.25), ANTENNA))
    join_new(map_, [])
    assert "from the measured positions" in doubts_of_positions(map_)[0]


@pytest.mark.parametrize("numbers", [(0,), (0, 1)])
def test_positions_that_no_drift_explains_are_refused(
    tmp_path: Path, numbers: tuple[int, ...]
) -> None:
    map_ = drives(len(numbers))
    hold(map_, Survey(winding(tmp_path, 8.0, 0.02, numbers), ANTENNA))
    with pytest.raises(RegistrationError, match="bend a path more than its drift explains"):
        join_new(map_, [])


T_THERE = make_transform(exp_so3(np.array([0.0, 2.5, 0.0])), np.array([30.0, 1.0, -80.0]))


def bend(longer: float) -> Trajectory:
    """A drive of 40 frames around a bend, as long as a rig measures it."""
    turns = 0.04 * np.arange(40)
    poses = [
        make_transform(
            exp_so3(np.array([0.0, turn, 0.0])),
            longer * 20.0 * np.array([1.0 - np.cos(turn), 0.0, np.sin(turn)]),
        )
        for turn in turns
    ]
    return Trajectory(np.stack(poses), 0.1 * np.arange(40))


def links_of(frames: range, noise_m: float = 0.02) -> list[Loop]:
    """Places that both saw, a frame apart: the link is measured by the first rig."""
    path, random = bend(1.0).T_world_camera, np.random.default_rng(5)
    found = []
    for frame in frames:
        T = invert(path[frame]) @ path[frame + 1]
        T[:3, 3] += random.normal(0.0, noise_m, 3)
        found.append(Loop(frame, frame + 1, T, np.eye(6), 100, 0.9))
    return found


@pytest.mark.parametrize("longer", [0.9, 1.0, 1.03])
def test_the_ratio_of_two_rigs_is_found_within_its_deviation(longer: float) -> None:
    other = bend(longer)
    moved = Trajectory(T_THERE @ other.T_world_camera, other.timestamps_s)
    found = times_as_long(bend(1.0), moved, links_of(range(0, 39, 3)))
    scale, sigma = found
    assert 0.0002 < sigma < 0.002
    assert abs(scale - 1.0 / longer) < 4 * sigma


def test_noisy_links_say_little_and_how_little() -> None:
    found = times_as_long(bend(1.0), bend(1.0), links_of(range(0, 39, 3), noise_m=0.5))
    assert 0.01 < found[1] < 0.05
    assert abs(found[0] - 1.0) < 4 * found[1]


def test_few_links_or_links_at_one_place_say_nothing() -> None:
    still = Trajectory(np.tile(np.eye(4), (40, 1, 1)), 0.1 * np.arange(40))
    assert times_as_long(bend(1.0), bend(1.03), links_of(range(0, 39, 10))) is None
    assert times_as_long(bend(1.0), still, links_of(range(0, 39, 3))) is None
