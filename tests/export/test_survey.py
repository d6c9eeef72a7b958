"""A map is placed where positions measured along its drive say it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import EvaluationError, FormatError
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.export.survey import georeference
from recon.io.trajectory import write_tum
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.sessions.measured import Survey
from recon.run.finished import FinishedRun

T_MAP_WORLD = make_transform(AXES_MAP_WORLD, np.zeros(3))
T_SURVEY_MAP = make_transform(
    exp_so3(np.array([0.0, 0.0, 2.2])), np.array([456789.25, 5433210.5, 118.75])
)
ANTENNA = (0.4, -0.3, 1.1)
FROM_S = 1.7e9


def bend(times_s: Float64) -> Float64:
    """T_world_camera of a drive that turns left and climbs; 5 m/s."""
    poses = []
    for t in times_s - FROM_S:
        turn = exp_so3(np.array([0.0, -0.05 * t, 0.0]))
        place = [100 * (np.cos(0.05 * t) - 1), -0.1 * t, 100 * np.sin(0.05 * t)]
        poses.append(make_transform(turn, np.array(place)))
    return np.stack(poses)


def write_run(folder: Path, untrusted: tuple[int, ...] = ()) -> FinishedRun:
    times_s = FROM_S + 0.1 * np.arange(200)
    poses = bend(times_s)
    poses[list(untrusted), :3, 3] += 50.0
    write_tum(folder / "trajectory_tum.txt", Trajectory(poses, times_s))
    return FinishedRun(folder, "map", T_MAP_WORLD, untrusted)


def positions(times_s: Float64) -> Float64:
    T_survey_camera = T_SURVEY_MAP @ T_MAP_WORLD @ bend(times_s)
    antenna = AXES_MAP_WORLD.T @ np.array(ANTENNA)
    xyz = np.stack([T[:3, :3] @ antenna + T[:3, 3] for T in T_survey_camera])
    return np.column_stack([times_s, xyz])


def write_positions(folder: Path, rows: Float64) -> Path:
    np.savetxt(folder / "gnss.txt", rows, fmt="%.5f")
    return folder / "gnss.txt"


def test_antenna_and_times_between_frames_count(tmp_path: Path) -> None:
    # Once a second and off the times of the frames; some before and after the drive.
    file = write_positions(tmp_path, positions(FROM_S + 0.037 + np.arange(-3, 25)))
    placed = georeference(write_run(tmp_path), Survey(file, ANTENNA))
    off = invert(T_SURVEY_MAP) @ placed.T_survey_map
    assert np.abs(off[:3, 3]).max() < 0.002
    assert np.degrees(angle_rad(off[None])[0]) < 0.01
    assert placed.figures()["positions"] == 20
    assert placed.rms_m < 0.001
    assert placed.tilt_deg < 0.01
    assert not placed.warnings()


def test_without_the_antenna_the_map_is_off_by_it(tmp_path: Path) -> None:
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)))
    placed = georeference(write_run(tmp_path), Survey(file))
    off = placed.T_survey_map[2, 3] - T_SURVEY_MAP[2, 3]
    assert off == pytest.approx(ANTENNA[2], abs=0.05)


def test_frames_that_are_not_trusted_do_not_count(tmp_path: Path) -> None:
    file = write_positions(tmp_path, positions(FROM_S + 0.05 + np.arange(0, 19.8, 0.1)))
    run = write_run(tmp_path, untrusted=(50, 51, 52))
    assert georeference(run, Survey(file, ANTENNA)).rms_m < 0.01


def test_positions_may_be_a_tum_file_and_in_any_order(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))[::-1]
    tum = np.column_stack([rows, np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1))])
    placed = georeference(write_run(tmp_path), Survey(write_positions(tmp_path, tum), ANTENNA))
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)


def test_the_first_drive_of_a_merged_map_counts(tmp_path: Path) -> None:
    folder = tmp_path / "sessions/0"
    folder.mkdir(parents=True)
    write_run(folder)
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)))
    placed = georeference(FinishedRun(tmp_path, "merge", T_MAP_WORLD), Survey(file, ANTENNA))
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)


def test_positions_on_another_clock_are_warned_of(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[:, 0] += 1.5 * np.sin(np.arange(20))
    placed = georeference(write_run(tmp_path), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert placed.rms_m > 1.0
    assert "another clock" in placed.warnings()[0]


def test_positions_of_another_day_are_refused(tmp_path: Path) -> None:
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)) + np.array([86400, 0, 0, 0]))
    with pytest.raises(EvaluationError, match="no position was measured during the drive"):
        georeference(write_run(tmp_path), Survey(file))


def test_positions_at_one_place_are_refused(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[:, 1:] = rows[0, 1:]
    with pytest.raises(EvaluationError, match="do not say how the map is turned"):
        georeference(write_run(tmp_path), Survey(write_positions(tmp_path, rows)))


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "gnss.txt").write_text("$GPGGA,123519,4807.038,N\n")
    with pytest.raises(FormatError, match=r"gnss\.txt:1"):
        georeference(write_run(tmp_path), Survey(tmp_path / "gnss.txt"))


def test_positions_that_contradict_most_are_left_out_and_named(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[[3, 11], 1:3] += [[30.0, -12.0], [-8.0, 5.0]]
    rows[17, 1:] = 0.0  # no fix
    placed = georeference(write_run(tmp_path), Survey(write_positions(tmp_path, rows), ANTENNA))
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)
    assert placed.figures()["positions"] == 17
    assert placed.figures()["positions_left_out"] == 3
    (warning,) = placed.warnings()
    assert "3 of 20 positions contradict the others" in warning
    assert f"{FROM_S + 3:.3f} s" in warning


def test_noise_alone_leaves_no_position_out(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(0, 19.8, 0.2))
    rows[:, 1:] += np.random.default_rng(4).normal(0, 1.5, (len(rows), 3))
    placed = georeference(write_run(tmp_path), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert placed.figures()["positions_left_out"] == 0


def test_positions_in_feet_are_warned_of_as_another_unit(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[:, 1:] /= 0.3048
    placed = georeference(write_run(tmp_path), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert "3.28 times as far apart" in placed.warnings()[0]


@pytest.mark.parametrize("change", ["swapped", "local", "degrees"])
def test_positions_outside_the_coordinate_system_are_refused(tmp_path: Path, change: str) -> None:
    pytest.importorskip("pyproj")
    rows = positions(FROM_S + np.arange(20))
    if change == "swapped":
        rows[:, 1:3] = rows[:, 2:0:-1]
    elif change == "local":
        rows[:, 1:3] -= rows[0, 1:3]
    else:
        rows[:, 1:3] = [8.5, 49.0]
    survey = Survey(write_positions(tmp_path, rows), ANTENNA, "EPSG:25832")
    with pytest.raises(EvaluationError, match="outside the area of their coordinate system"):
        georeference(write_run(tmp_path), survey)


def test_positions_just_across_the_border_of_a_zone_are_taken(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    rows = positions(FROM_S + np.arange(20))
    rows[:, 1] -= 300000.0  # 1.6 degrees west of zone 33
    survey = Survey(write_positions(tmp_path, rows), ANTENNA, "EPSG:25833")
    assert not georeference(write_run(tmp_path), survey).warnings()


def test_swapped_columns_are_recognised_by_the_bend_of_the_path(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    right = georeference(write_run(tmp_path), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert not right.warnings()
    swapped = write_positions(tmp_path, rows[:, [0, 2, 1, 3]])
    lines = georeference(write_run(tmp_path), Survey(swapped, ANTENNA)).warnings()
    assert [line for line in lines if "with easting and northing swapped" in line]
