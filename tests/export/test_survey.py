"""A map is placed where positions measured along its drive say it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import EvaluationError, FormatError, ReconError, SettingsError
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import RectifiedCamera
from recon.core.values.arrays import Float64
from recon.export.survey import Georeference, georeference
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.sessions.measured import Survey
from recon.map.store.session import SessionInfo
from recon.map.verbs import Map
from recon.odometry.protocol import OdometryHealth

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


def mapped(untrusted: tuple[int, ...] = (), health: OdometryHealth | None = None) -> Map:
    map_, times_s = Map.temporary(), FROM_S + 0.1 * np.arange(200)
    poses, good = bend(times_s), health or OdometryHealth()
    poses[list(untrusted), :3, 3] += 50.0
    session = map_.begin(SessionInfo())
    session.set_axes(T_MAP_WORLD, RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12))
    for frame, (T, time_s) in enumerate(zip(poses, times_s.tolist(), strict=True)):
        session.add_frame(T, time_s, replace(good, ok=frame not in untrusted))
    return map_


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
    placed = georeference(mapped(), Survey(file, ANTENNA))
    off = invert(T_SURVEY_MAP) @ placed.T_survey_map
    assert np.abs(off[:3, 3]).max() < 0.002
    assert np.degrees(angle_rad(off[None])[0]) < 0.01
    assert placed.figures()["positions"] == 20
    assert placed.rms_m < 0.001
    assert placed.tilt_deg < 0.01
    assert not placed.warnings()


def test_without_the_antenna_the_map_is_off_by_it(tmp_path: Path) -> None:
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)))
    placed = georeference(mapped(), Survey(file))
    off = placed.T_survey_map[2, 3] - T_SURVEY_MAP[2, 3]
    assert off == pytest.approx(ANTENNA[2], abs=0.05)


def test_frames_that_are_not_trusted_do_not_count(tmp_path: Path) -> None:
    file = write_positions(tmp_path, positions(FROM_S + 0.05 + np.arange(0, 19.8, 0.1)))
    map_ = mapped(untrusted=(50, 51, 52))
    assert georeference(map_, Survey(file, ANTENNA)).rms_m < 0.01


def test_positions_may_be_a_tum_file_and_in_any_order(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))[::-1]
    tum = np.column_stack([rows, np.tile([0.0, 0.0, 0.0, 1.0], (len(rows), 1))])
    placed = georeference(mapped(), Survey(write_positions(tmp_path, tum), ANTENNA))
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)


def test_the_first_drive_of_a_merged_map_counts(tmp_path: Path) -> None:
    map_ = mapped()
    other = map_.begin(SessionInfo())
    other.add_frame(np.eye(4), 0.0, OdometryHealth())
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)))
    placed = georeference(map_, Survey(file, ANTENNA))
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)


def test_positions_on_another_clock_are_warned_of(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[:, 0] += 1.5 * np.sin(np.arange(20))
    placed = georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert placed.rms_m > 1.0
    assert "another clock" in placed.warnings()[0]


def test_positions_of_another_day_are_refused(tmp_path: Path) -> None:
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)) + np.array([86400, 0, 0, 0]))
    with pytest.raises(EvaluationError, match="no position was measured during the drive"):
        georeference(mapped(), Survey(file))


def test_positions_at_one_place_are_refused(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[:, 1:] = rows[0, 1:]
    with pytest.raises(EvaluationError, match="do not say how the map is turned"):
        georeference(mapped(), Survey(write_positions(tmp_path, rows)))


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "gnss.txt").write_text("$GPGGA,123519,4807.038,N\n")
    with pytest.raises(FormatError, match=r"gnss\.txt:1"):
        georeference(mapped(), Survey(tmp_path / "gnss.txt"))


def test_positions_that_contradict_most_are_left_out_and_named(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[[3, 11], 1:3] += [[30.0, -12.0], [-8.0, 5.0]]
    rows[17, 1:] = 0.0  # no fix
    placed = georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)
    assert placed.figures()["positions"] == 17
    assert placed.figures()["positions_left_out"] == 3
    (warning,) = placed.warnings()
    assert "3 of 20 positions contradict the others" in warning
    assert f"{FROM_S + 3:.3f} s" in warning


def test_noise_alone_leaves_no_position_out(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(0, 19.8, 0.2))
    rows[:, 1:] += np.random.default_rng(4).normal(0, 1.5, (len(rows), 3))
    placed = georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert placed.figures()["positions_left_out"] == 0


NONSENSE = {
    "feet": lambda xyz: xyz / 0.3048,
    "millimetres": lambda xyz: 1e3 * (xyz - xyz[0]),
    "a million times": lambda xyz: 1e6 * (xyz - xyz[0]),
    "kilometres": lambda xyz: 1e-3 * xyz,
    "random": lambda xyz: xyz + np.random.default_rng(3).uniform(-100, 100, xyz.shape),
    "other shape": lambda xyz: xyz + 150 * np.sin(np.arange(len(xyz)) / 5)[:, None],
    "no place on Earth": lambda xyz: 1e200 * xyz,
    "degrees": lambda xyz: xyz * [1e-5, 1e-5, 1.0] + [8.5, 49.0, 0.0],
}


@pytest.mark.parametrize("nonsense", NONSENSE)
def test_positions_that_nothing_explains_are_refused(tmp_path: Path, nonsense: str) -> None:
    rows = positions(FROM_S + np.arange(0, 19.8, 0.2))
    rows[:, 1:] = NONSENSE[nonsense](rows[:, 1:])
    with pytest.raises(ReconError, match=r"gnss\.txt"):
        georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))


def test_stretched_positions_are_warned_of_as_another_unit(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    rows[:, 1:] *= 1.1
    placed = georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert "1.10 times as far apart" in placed.warnings()[0]


def test_the_noise_of_a_receiver_is_no_reason_to_refuse(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(0, 19.8, 0.2))
    rows[:, 1:] += np.random.default_rng(5).normal(0, 10.0, (len(rows), 3))
    placed = georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert 10.0 < placed.rms_m < 20.0


@pytest.mark.parametrize("columns", [1, 3])
def test_a_file_may_state_how_well_positions_were_measured(tmp_path: Path, columns: int) -> None:
    rows = positions(FROM_S + np.arange(0, 19.8, 0.2))
    rows[:, 1:] += np.random.default_rng(5).normal(0, 10.0, (len(rows), 3))

    def placed(sigma_m: float) -> Georeference:
        stated = np.column_stack([rows, np.full((len(rows), columns), sigma_m)])
        return georeference(mapped(), Survey(write_positions(tmp_path, stated), ANTENNA))

    assert placed(10.0).rms_m > 10.0
    with pytest.raises(EvaluationError, match="neither drift nor noise explains"):
        placed(0.1)
    with pytest.raises(FormatError, match="standard deviation"):
        placed(0.0)


def test_a_drift_that_the_run_states_explains_a_scale(tmp_path: Path) -> None:
    rows = np.column_stack([positions(FROM_S + np.arange(20)), np.full(20, 0.02)])
    rows[:, 1:4] *= 1.2
    file = write_positions(tmp_path, rows)
    with pytest.raises(EvaluationError, match=r"1\.2 times as far"):
        georeference(mapped(), Survey(file, ANTENNA))
    # An error of all disparities by 0.1 px is 8 % of 1.3 px.
    far = mapped(health=OdometryHealth(sigma_m=1e-3, sigma_deg=1e-3, scale_px=1.3))
    assert georeference(far, Survey(file, ANTENNA)).scale == pytest.approx(1.2, abs=0.01)


@pytest.mark.parametrize("far_m", [101.0, 1e5, 1e9, 1e300, float("nan")])
def test_an_antenna_that_is_on_no_vehicle_is_refused(far_m: float) -> None:
    with pytest.raises(SettingsError, match="--antenna"):
        Survey(Path("gnss.txt"), (far_m, 0.0, 0.0))


@pytest.mark.parametrize("crs", ["+proj=noop", "+proj=pipeline +step +proj=noop"])
def test_a_coordinate_system_whose_metres_are_none_is_refused(tmp_path: Path, crs: str) -> None:
    pytest.importorskip("pyproj")
    rows = positions(FROM_S + np.arange(20))
    survey = Survey(write_positions(tmp_path, rows), ANTENNA, crs)
    with pytest.raises(EvaluationError, match="a metre of the coordinate system"):
        georeference(mapped(), survey)


def test_a_coordinate_system_of_ones_own_is_taken(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    file = write_positions(tmp_path, positions(FROM_S + np.arange(20)))
    survey = Survey(file, ANTENNA, "+proj=utm +zone=32 +ellps=GRS80")
    assert not georeference(mapped(), survey).warnings()


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
    with pytest.raises(EvaluationError, match=r"outside the area|not degrees"):
        georeference(mapped(), survey)


def test_positions_just_across_the_border_of_a_zone_are_taken(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    rows = positions(FROM_S + np.arange(20))
    rows[:, 1] -= 300000.0  # 1.6 degrees west of zone 33
    survey = Survey(write_positions(tmp_path, rows), ANTENNA, "EPSG:25833")
    assert not georeference(mapped(), survey).warnings()


def test_swapped_columns_are_recognised_by_the_bend_of_the_path(tmp_path: Path) -> None:
    rows = positions(FROM_S + np.arange(20))
    right = georeference(mapped(), Survey(write_positions(tmp_path, rows), ANTENNA))
    assert not right.warnings()
    swapped = write_positions(tmp_path, rows[:, [0, 2, 1, 3]])
    lines = georeference(mapped(), Survey(swapped, ANTENNA)).warnings()
    assert [line for line in lines if "with easting and northing swapped" in line]
