"""An inertial unit and wheels whose measurements arrive while the drive goes on."""

import numpy as np
import pytest

from recon.commands.config import load_config
from recon.core.geometry.se3 import Motion, angle_rad, exp_so3, invert, make_transform
from recon.core.values import ImuRecord, Trajectory
from recon.odometry.arriving import ArrivingGyro, ArrivingPath
from recon.odometry.guide import MAX_SIGMAS
from recon.odometry.protocol import OdometryFrame
from recon.odometry.registry import make_odometry
from recon.odometry.settings import PriorSettings
from recon.sources.registry import open_source
from recon.stereo.frame import FrameReconstructor
from recon.stereo.rectify.rectifier import turns_of

FOCAL_PX = 700.0
FRAME_S = 0.1
BIAS = np.array([0.01, -0.02, 0.015])
R_CAMERA_IMU = exp_so3(np.array([0.3, -1.2, 0.4]))
T0_S = 1_795_000_000.0
STILL = np.eye(3)
ROOM = 0.05  # its size against a road


def pose_at(time_s):
    """A camera that turns to and fro about all axes, and goes on."""
    t = time_s - T0_S
    turn = exp_so3(np.array([0.1 * np.sin(2 * t), 0.4 * np.sin(t), 0.05 * np.cos(3 * t)]))
    return make_transform(turn, np.array([np.sin(t), 0.1 * t, 3.0 * t]))


def record_until(time_s, stated=R_CAMERA_IMU, *, rate_hz=200.0, scale=1.0, seed=0):
    """What a gyro with a bias and noise measured in the last ten seconds."""
    first = max(T0_S, time_s - 10.0)
    times_s = first + np.arange(int((time_s - first) * rate_hz) + 2) / rate_hz
    step_s, random = 1e-4, np.random.default_rng(seed)
    rates = []
    for t in times_s:
        before, after = pose_at(t - step_s)[:3, :3], pose_at(t + step_s)[:3, :3]
        skew = (before.T @ after - after.T @ before) / (4 * step_s)
        rates.append([skew[2, 1], skew[0, 2], skew[1, 0]])
    gyro = scale * (np.array(rates) @ R_CAMERA_IMU + BIAS)
    gyro += random.normal(scale=2e-4, size=gyro.shape)
    accel = np.tile([0.0, 0.0, 9.8], (len(times_s), 1))
    T_camera_imu = None if stated is None else make_transform(stated, np.zeros(3))
    return ImuRecord(times_s, gyro, accel, T_camera_imu, "imu")


def drive(guide_at, frames):
    """Yield of each frame what the guide says, and the truth; features see the true poses."""
    before = Motion(pose_at(T0_S), T0_S)
    for number in range(1, frames):
        to_s = T0_S + number * FRAME_S
        yield guide_at(to_s).guide(before, before, to_s), pose_at(to_s)
        before = before.moved(pose_at(to_s), to_s)


def test_the_bias_of_a_gyro_is_learnt_within_seconds():
    now = [T0_S]
    stated = exp_so3(np.array([0.005, 0.0, -0.005])) @ R_CAMERA_IMU
    guide = ArrivingGyro(lambda: record_until(now[0], stated), STILL, FOCAL_PX)

    def at(to_s):
        now[0] = to_s + 0.01
        return guide

    found = list(drive(at, 60))
    assert np.abs(guide.bias - BIAS).max() < 2e-3
    told = [(one, truth) for one, truth in found if one is not None]
    assert len(told) > 40
    off = [angle_rad(one.T_world_camera[:3, :3].T @ truth[:3, :3]) for one, truth in told]
    assert np.percentile(off, 95) < 1.0 / FOCAL_PX  # a pixel
    sigma = [np.deg2rad(one.sigma_deg) for one, _ in told]
    assert np.mean(np.array(off) < 3.5 * np.array(sigma)) > 0.95  # as sure as it says


def test_a_guide_says_nothing_before_it_knows():
    guide = ArrivingGyro(lambda: None, STILL, FOCAL_PX)
    assert all(one is None for one, _ in drive(lambda _: guide, 5))
    early = ArrivingGyro(lambda: record_until(T0_S + 0.2), STILL, FOCAL_PX)
    assert all(one is None for one, _ in drive(lambda _: early, 20))  # it stopped at 0.2 s


def test_a_unit_that_is_nowhere_on_the_robot_is_said_once_and_used_once_it_is_placed(caplog):
    now, where = [T0_S], [None]
    guide = ArrivingGyro(lambda: record_until(now[0], where[0]), STILL, FOCAL_PX)

    def at(to_s):
        now[0] = to_s + 0.01
        if to_s > T0_S + 1.0:
            where[0] = R_CAMERA_IMU
        return guide

    found = [one for one, _ in drive(at, 60)]
    assert all(one is None for one in found[:9])
    assert sum(one is not None for one in found) > 30
    [line] = [one.getMessage() for one in caplog.records]
    assert line.startswith("IMU not used: no static transform")


@pytest.mark.parametrize("fault", ["degrees", "axes"])
def test_a_gyro_that_contradicts_the_cameras_is_not_used(fault, caplog):
    now, scale = [T0_S], float(np.rad2deg(1.0)) if fault == "degrees" else 1.0
    stated = R_CAMERA_IMU if fault == "degrees" else exp_so3(np.array([0.0, 0.0, 2.0]))
    guide = ArrivingGyro(lambda: record_until(now[0], stated, scale=scale), STILL, FOCAL_PX)

    def at(to_s):
        now[0] = to_s + 0.01
        return guide

    list(drive(at, 60))
    assert not guide.used
    [line] = [one.getMessage() for one in caplog.records]
    assert line.startswith("IMU not used: it does not turn as the cameras do")


def follow(guide, now, frames, wrong=None):
    """Let a guide see frames, one of them wrongly; returns the last motion."""
    before = Motion(pose_at(T0_S), T0_S)
    for number in range(1, frames):
        to_s = T0_S + number * FRAME_S
        now[0] = to_s + 0.01
        guide.guide(before, before, to_s)
        seen = pose_at(to_s)
        if number == wrong:  # another thing that fills the image
            seen = seen @ make_transform(exp_so3(np.array([0.0, 0.3, 0.0])), np.zeros(3))
        before = before.moved(seen, to_s)
    return before


def test_one_wrong_turn_does_not_spoil_what_was_learnt():
    now = [T0_S]
    guide = ArrivingGyro(lambda: record_until(now[0]), STILL, FOCAL_PX)
    follow(guide, now, 60, wrong=40)
    assert guide.used
    assert np.abs(guide.bias - BIAS).max() < 3e-3


def test_where_the_camera_goes_is_the_less_sure_the_longer_it_was_not_seen():
    now = [T0_S]
    guide = ArrivingGyro(lambda: record_until(now[0]), STILL, FOCAL_PX)
    before, sigmas = follow(guide, now, 60), []
    for gap_s in (0.1, 0.4, 1.0):
        now[0] = before.timestamp_s + gap_s + 0.01
        found = guide.guide(before, before, before.timestamp_s + gap_s)
        assert found is not None
        off = invert(found.T_world_camera) @ pose_at(before.timestamp_s + gap_s)
        assert np.linalg.norm(off[:3, 3]) < MAX_SIGMAS * np.sqrt(3) * found.sigma_m
        sigmas.append(found.sigma_m)
    assert sigmas[2] > 4 * sigmas[1] > 16 * sigmas[0]  # as the square of the time


@pytest.mark.slow
def test_a_room_is_lost_less_often_with_its_unit(recon_data):
    """By frames up to seconds apart; the unit as it arrives, and for comparison none."""
    source, config = open_source(recon_data / "rooms/euroc_v1_sparse"), load_config()
    matcher = FrameReconstructor(source.calibration, config, threads=1)
    R_left = turns_of(source.calibration, config.rectification).R_left
    record, now = source.read_imu(), [0.0]

    def recent():
        near = np.abs(record.timestamps_s - now[0] + 5.0) < 5.01
        return ImuRecord(
            record.timestamps_s[near], record.gyro[near], record.accel[near],
            record.T_camera_imu, record.origin,
        )  # fmt: skip

    frames = [OdometryFrame(*matcher.match_roughly(p), rough=True) for p in source.frames()]
    lost = []
    for guide in (None, ArrivingGyro(recent, R_left, matcher.camera.focal_px, ROOM)):
        odometry = make_odometry("visual", config.odometry, None, ROOM, guide)
        lost.append(0)
        for frame in frames:
            now[0] = frame.pair.timestamp_s
            lost[-1] += not odometry.register(frame).health.ok
    assert lost[1] <= 0.4 * lost[0]


def test_wheels_guide_as_far_as_they_have_arrived():
    times_s = T0_S + np.arange(0, 1.01, 0.02)
    path = Trajectory(np.stack([pose_at(t) for t in times_s]), times_s)
    arrived = [None, path.select(slice(0, 1)), path]
    guides = [ArrivingPath(lambda one=one: one, PriorSettings(axes="camera")) for one in arrived]
    last = Motion(pose_at(T0_S + 0.5), T0_S + 0.5)
    first, second, third = (guide.guide(last, last, T0_S + 0.6) for guide in guides)
    assert first is None
    assert second is None
    assert third is not None
    off = invert(third.T_world_camera) @ pose_at(T0_S + 0.6)
    assert np.linalg.norm(off[:3, 3]) < 1e-3
    assert guides[2].guide(last, last, T0_S + 1.1) is None  # not there yet
