"""A map is placed where positions measured along its drive say it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import EvaluationError, FormatError, ReconError, SettingsError
from recon.core.geometry.se3 import angle_rad, exp_so3, invert, make_transform
from recon.core.values import PointCloud, RectifiedCamera
from recon.core.values.arrays import Float64
from recon.export.cloud import ground_points
from recon.map.ground.axes import AXES_MAP_WORLD
from recon.map.ground.surface import GroundSurface
from recon.map.map import Map
from recon.map.sessions.georeference import georeference
from recon.map.sessions.measured import Survey
from recon.map.store.session import SessionInfo
from recon.odometry.protocol import OdometryHealth
from tests.scenery import receivers

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


@pytest.fixture
def place(tmp_path):
    """Places a map by rows of positions."""

    def placed(rows, map_=None, antenna=ANTENNA, crs=None):
        np.savetxt(tmp_path / "gnss.txt", rows, fmt="%.5f")
        return georeference(map_ or mapped(), Survey(tmp_path / "gnss.txt", antenna, crs))

    return placed


def each_second() -> Float64:
    return positions(FROM_S + np.arange(20))


def often() -> Float64:
    return positions(FROM_S + np.arange(0, 19.8, 0.2))


def noisy(sigma_m: float, seed: int = 5) -> Float64:
    rows = often()
    rows[:, 1:] += np.random.default_rng(seed).normal(0, sigma_m, (len(rows), 3))
    return rows


def test_antenna_and_times_between_frames_count(place):
    # Once a second and off the times of the frames; some before and after the drive.
    placed = place(positions(FROM_S + 0.037 + np.arange(-3, 25)))
    off = invert(T_SURVEY_MAP) @ placed.T_survey_map
    assert np.abs(off[:3, 3]).max() < 0.002
    assert np.degrees(angle_rad(off[None])[0]) < 0.01
    assert placed.figures().to_json()["positions"] == 20
    assert placed.rms_m < 0.001
    assert placed.tilt_deg < 0.01
    assert not placed.warnings()
    without = place(each_second(), antenna=(0.0, 0.0, 0.0)).T_survey_map - T_SURVEY_MAP
    assert without[2, 3] == pytest.approx(ANTENNA[2], abs=0.05)


def test_frames_that_are_not_trusted_and_the_order_of_positions_do_not_count(place):
    rows = positions(FROM_S + 0.05 + np.arange(0, 19.8, 0.1))
    assert place(rows, mapped(untrusted=(50, 51, 52))).rms_m < 0.01
    # A TUM file; and a merged map, of which the first drive counts.
    rows, map_ = each_second()[::-1], mapped()
    map_.begin(SessionInfo()).add_frame(np.eye(4), 0.0, OdometryHealth())
    placed = place(np.column_stack([rows, np.tile([0.0, 0.0, 0.0, 1.0], (20, 1))]), map_)
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)


def test_positions_that_contradict_most_are_left_out_and_named(place):
    rows = each_second()
    rows[[3, 11], 1:3] += [[30.0, -12.0], [-8.0, 5.0]]
    rows[17, 1:] = 0.0  # no fix
    placed = place(rows)
    np.testing.assert_allclose(placed.T_survey_map, T_SURVEY_MAP, atol=0.002)
    assert (
        placed.figures().to_json()["positions"],
        placed.figures().to_json()["positions_left_out"],
    ) == (17, 3)
    (warning,) = placed.warnings()
    assert "3 of 20 positions contradict the others" in warning
    assert f"{FROM_S + 3:.3f} s" in warning


def test_what_may_be_wrong_with_the_positions_is_warned_of(place):
    rows = each_second()
    rows[:, 0] += 1.5 * np.sin(np.arange(20))
    placed = place(rows)
    assert placed.rms_m > 1.0
    assert "another clock" in placed.warnings()[0]
    assert "1.10 times as far apart" in place(each_second() * [1, 1.1, 1.1, 1.1]).warnings()[0]
    lines = place(each_second()[:, [0, 2, 1, 3]]).warnings()
    assert [line for line in lines if "with easting and northing swapped" in line]


NONSENSE = {
    "feet": lambda xyz: xyz / 0.3048,
    "kilometres": lambda xyz: 1e-3 * xyz,
    "random": lambda xyz: xyz + np.random.default_rng(3).uniform(-100, 100, xyz.shape),
    "other shape": lambda xyz: xyz + 150 * np.sin(np.arange(len(xyz)) / 5)[:, None],
    "no place on Earth": lambda xyz: 1e200 * xyz,
    "degrees": lambda xyz: xyz * [1e-5, 1e-5, 1.0] + [8.5, 49.0, 0.0],
}


@pytest.mark.parametrize("nonsense", NONSENSE)
def test_positions_that_nothing_explains_are_refused(place, nonsense):
    rows = often()
    rows[:, 1:] = NONSENSE[nonsense](rows[:, 1:])
    with pytest.raises(ReconError, match=r"gnss\.txt"):
        place(rows)


def test_positions_of_another_day_or_at_one_place_or_none_are_refused(place, tmp_path):
    rows = each_second()
    with pytest.raises(EvaluationError, match="no position was measured during the drive"):
        place(rows + np.array([86400, 0, 0, 0]))
    rows[:, 1:] = rows[0, 1:]
    with pytest.raises(EvaluationError, match="do not say how the map is turned"):
        place(rows)
    (tmp_path / "gnss.txt").write_text("12:35:19 4807.038 N E\n")
    with pytest.raises(FormatError, match=r"gnss\.txt:1"):
        georeference(mapped(), Survey(tmp_path / "gnss.txt"))


def standing(sigma_m: float) -> Float64:
    rows = positions(FROM_S + 0.02 * np.arange(10))
    rows[:, 1:] = rows[0, 1:] + np.random.default_rng(2).normal(0.0, sigma_m, (10, 3))
    return rows


NO_DIRECTION = {
    "two within a tenth of a second": positions(FROM_S + np.array([3.0, 3.1])),
    "three within a fifth": positions(FROM_S + np.array([3.0, 3.1, 3.2])),
    "standing with noise": standing(3.0),
    "stated to be worse than their span": np.column_stack([
        positions(FROM_S + np.arange(3, 6)), np.full(3, 4.0)
    ]),
}  # fmt: skip


@pytest.mark.parametrize("rows", NO_DIRECTION.values(), ids=NO_DIRECTION)
def test_positions_that_fix_no_direction_are_refused(place, rows):
    with pytest.raises(
        EvaluationError, match=r"gnss\.txt: the positions do not say how the map is"
    ):
        place(rows)


def test_a_roll_about_a_straight_path_moves_no_frame_of_it(place):
    times_s = FROM_S + 0.1 * np.arange(50)
    map_ = Map.temporary()
    session = map_.begin(SessionInfo())
    session.set_axes(T_MAP_WORLD, RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12))
    for way_m, time_s in enumerate(times_s.tolist()):
        T = make_transform(np.eye(3), np.array([0.0, 0.0, float(way_m)]))
        session.add_frame(T, time_s, OdometryHealth())
    there_m = np.column_stack([np.zeros(50), np.arange(50.0), np.full(50, 1000.0)])
    rows = np.column_stack([times_s, there_m, np.full(50, 0.02)])
    figures = place(rows, map_, antenna=(0.0, 0.0, 0.0)).figures().to_json()
    assert figures["rotation_sigma_deg"] == pytest.approx(3.0, rel=0.01)
    assert figures["edge_sigma_m"] < 0.02


def test_a_direction_that_is_known_badly_is_warned_of(place):
    rows = np.column_stack([each_second()[:3], np.full(3, 1.0)])
    (said,) = [line for line in place(rows).warnings() if "known to" in line]
    assert "turned by an angle known to 8." in said
    assert "m at its farthest frame" in said


def test_the_stated_yaw_is_what_noise_makes_of_it(place):
    turned = []
    for seed in range(60):
        rows = each_second()[:8]
        rows[:, 1:] += np.random.default_rng(seed).normal(0.0, 0.3, (8, 3))
        placed = place(np.column_stack([rows, np.full(8, 0.3)]))
        off = (invert(T_SURVEY_MAP) @ placed.T_survey_map)[:3, :3]
        turned.append(np.degrees(np.arctan2(off[1, 0], off[0, 0])))
    # Of 60 samples, a standard deviation is known to 9 %: three of those.
    assert np.std(turned) == pytest.approx(placed.figures().to_json()["yaw_sigma_deg"], rel=0.3)


@pytest.mark.parametrize("columns", [1, 3])
def test_a_file_may_state_how_well_positions_were_measured(place, columns):
    def stated(sigma_m: float) -> Float64:
        rows = noisy(10.0)
        return np.column_stack([rows, np.full((len(rows), columns), sigma_m)])

    assert place(noisy(1.5, seed=4)).figures().to_json()["positions_left_out"] == 0
    assert 10.0 < place(noisy(10.0)).rms_m < 20.0
    assert place(stated(10.0)).rms_m > 10.0
    with pytest.raises(EvaluationError, match="differ by more than drift and noise explain"):
        place(stated(0.1))
    with pytest.raises(FormatError, match="standard deviation"):
        place(stated(0.0))


def test_a_drift_that_is_stated_explains_a_scale_and_no_antenna_is_off_the_vehicle(place):
    rows = np.column_stack([each_second() * [1, 1.2, 1.2, 1.2], np.full(20, 0.02)])
    with pytest.raises(EvaluationError, match=r"1\.2 times as far"):
        place(rows)
    # An error of all disparities by 0.1 px is 8 % of 1.3 px.
    far = mapped(health=OdometryHealth(sigma_m=1e-3, sigma_deg=1e-3, scale_px=1.3))
    assert place(rows, far).scale == pytest.approx(1.2, abs=0.01)
    for far_m in (101.0, 1e300, float("nan")):
        with pytest.raises(SettingsError, match="--antenna"):
            Survey(Path("gnss.txt"), (far_m, 0.0, 0.0))


def test_coordinate_systems_of_ones_own_are_taken_if_their_metres_are_metres(place):
    pytest.importorskip("pyproj")
    for crs in ("+proj=noop", "+proj=pipeline +step +proj=noop"):
        with pytest.raises(EvaluationError, match="the coordinate system distorts lengths"):
            place(each_second(), crs=crs)
    assert not place(each_second(), crs="+proj=utm +zone=32 +ellps=GRS80").warnings()
    # 1.6 degrees west of zone 33.
    assert not place(each_second() - [0, 300000.0, 0, 0], crs="EPSG:25833").warnings()


# A drive whose speed and curvature change: only such a one shows a clock.
def winding(times_s: Float64) -> Float64:
    s = times_s - FROM_S
    return np.column_stack([times_s, 60 * np.sin(0.3 * s), 4 * s + 8 * np.sin(0.7 * s), 0.1 * s])


@pytest.fixture
def winding_map():
    map_, times_s = Map.temporary(), FROM_S + 0.1 * np.arange(200)
    session = map_.begin(SessionInfo())
    session.set_axes(T_MAP_WORLD, RectifiedCamera(100.0, 9.0, 5.0, 9.0, 0.5, 20, 12))
    for T, time_s in zip(winding(times_s)[:, 1:] @ AXES_MAP_WORLD, times_s.tolist(), strict=True):
        session.add_frame(make_transform(np.eye(3), T), time_s, OdometryHealth())
    return map_


@pytest.mark.parametrize("off_s", [0.0, 0.5, -1.3, 1.3e9])
@pytest.mark.parametrize("jumps", [False, True])
def test_a_clock_that_is_off_is_found_said_and_taken_as_that(winding_map, place, off_s, jumps):
    rng, rows = np.random.default_rng(3), winding(FROM_S + np.arange(0.5, 19.5, 0.2))
    rows[:, 1:] += rng.normal(0, 0.02, (len(rows), 3)) + np.array([4e5, 5e6, 100])
    rows[:, 0] += off_s
    if jumps:
        rows[rng.choice(len(rows), len(rows) // 10, replace=False), 1:3] += [3.0, 4.0]
    placed = place(rows, winding_map, antenna=(0.0, 0.0, 0.0))
    assert placed.rms_m < 0.06
    assert placed.left_out == (len(rows) // 10 if jumps else 0)
    said = [line for line in placed.warnings() if "clock" in line]
    assert len(said) == (off_s != 0)
    if off_s:
        late = "late" if off_s > 0 else "early"
        (found_s,) = [float(line.split(" is ")[1].split(" s ")[0]) for line in said]
        assert f" s {late}" in said[0]
        assert found_s == pytest.approx(abs(off_s), abs=0.02)


def test_swapped_latitude_and_longitude_are_refused(winding_map, tmp_path):
    pytest.importorskip("pyproj")
    rows = winding(FROM_S + np.arange(0.5, 19.5, 0.2)) + np.array([0, 4e5, 5e6, 100])
    degrees = receivers.degrees_of(rows[:, 1:], "EPSG:32632")
    survey = Survey(receivers.write_degrees(tmp_path / "gnss.csv", rows[:, 0], degrees))
    assert georeference(winding_map, survey).rms_m < 0.01
    swapped = degrees[:, [1, 0, 2]]
    survey = Survey(receivers.write_degrees(tmp_path / "swapped.csv", rows[:, 0], swapped))
    with pytest.raises(EvaluationError, match="latitude and longitude are swapped"):
        georeference(winding_map, survey)


def test_ground_is_as_thick_as_it_is_seen_too_low_and_what_stands_on_it_is_none():
    rng = np.random.default_rng(2)
    surface = GroundSurface(np.tile(0.1 * np.arange(8.0), (8, 1)), 1.0, (0.0, 0.0))
    xy = rng.uniform(0.5, 7.5, (4000, 2))
    z = surface.height_at(xy) + rng.normal(0.0, 0.02, 4000)
    z[3000:] += rng.uniform(0.2, 2.0, 1000)  # a hedge
    normals = np.tile(np.float32((0, 0, 1)), (4000, 1))
    normals[:100] = 0, 1, 0  # the foot of a wall
    cloud = PointCloud(np.column_stack([xy, z]).astype(np.float32), normals=normals, frame="map")
    ground = ground_points(cloud, surface)
    assert not ground[:100].any()
    assert ground[100:3000].mean() > 0.9
    assert not ground[3000:].any()
    far = replace(cloud, xyz=cloud.xyz + np.float32((100, 0, 0)))  # where no ground is known
    assert not ground_points(far, surface).any()
    assert not ground_points(cloud.select(np.zeros(4000, np.bool_)), surface).size
