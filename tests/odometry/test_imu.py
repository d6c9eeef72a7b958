"""An inertial unit: what a drive shows of it, and what it does for visual odometry."""

import re
from dataclasses import replace

import numpy as np
import pytest

from recon.core.geometry.se3 import Motion, angle_rad, exp_so3, invert, log_so3, make_transform
from recon.core.values import ImuRecord, Trajectory
from recon.odometry.checked import CheckedOdometry
from recon.odometry.guide import Guided
from recon.odometry.imu import Gyro, ImuGuide, ImuSpan, up_of_drive
from recon.odometry.imu_fit import fit_imu
from recon.odometry.visual import VisualOdometry
from tests.odometry.conftest import CAMERA

FRAMES_S = 0.1 * np.arange(150)
T_CAMERA_IMU = make_transform(exp_so3(np.array([0.2, -1.4, 0.7])), np.array([0.05, 0.1, -0.02]))
BIAS = np.array([0.05, -0.01, 0.02])
UP = np.array([0.1, -0.95, -0.3]) / np.linalg.norm([0.1, -0.95, -0.3])


def pose(t: float) -> np.ndarray:
    """A hand that sways, and turns about all axes; the first pose is the identity."""
    turn = exp_so3(np.array([0.3, 0.5, 0.2]) * np.sin(np.array([1.1, 0.7, 1.7]) * t))
    return make_transform(turn, np.array([0.4, 0.2, 0.5]) * np.sin(np.array([0.9, 1.3, 0.5]) * t))


def measured(rate_hz: float = 200.0) -> ImuRecord:
    """What a unit with a bias measures on that path, exactly."""
    times_s, h = np.arange(-1.0, 16.0, 1.0 / rate_hz), 1e-3
    R, t = T_CAMERA_IMU[:3, :3], T_CAMERA_IMU[:3, 3]
    gyro, accel = [], []
    for now_s in times_s:
        before, here, after = (pose(now_s + k * h) for k in (-1, 0, 1))
        gyro.append(R.T @ log_so3(before[:3, :3].T @ after[:3, :3]) / (2 * h) + BIAS)
        at = [T[:3, :3] @ t + T[:3, 3] for T in (before, here, after)]
        force = (at[0] - 2 * at[1] + at[2]) / h**2 + 9.81 * UP
        accel.append(R.T @ here[:3, :3].T @ force)
    return ImuRecord(times_s, np.array(gyro), np.array(accel), T_CAMERA_IMU, "imu")


def seen() -> list[ImuSpan]:
    """What cameras see of it: turns to 0.03 degrees."""
    rng, poses = np.random.default_rng(1), np.stack([pose(t) for t in FRAMES_S])
    for T in poses[1:]:
        T[:3, :3] = T[:3, :3] @ exp_so3(rng.normal(scale=5e-4, size=3))
    motions = len(poses) - 1
    path = Trajectory(poses, FRAMES_S)
    return [ImuSpan(path, np.full(motions, 2e-3), np.full(motions, 7e-4))]


@pytest.fixture(scope="module")
def record() -> ImuRecord:
    return measured()


def turned(record: ImuRecord, matrix: np.ndarray) -> ImuRecord:
    return replace(record, gyro=record.gyro @ matrix.T, accel=record.accel @ matrix.T)


CYCLE, SWAP = np.eye(3)[[2, 0, 1]], np.eye(3)[[1, 0, 2]]
FAULTS = {
    "none": (lambda r: r, ""),
    "late": (
        lambda r: replace(r, timestamps_s=r.timestamps_s + 0.05),
        r"stamps are 50 ± \d ms lat",
    ),
    "early": (lambda r: replace(r, timestamps_s=r.timestamps_s - 0.05), r"50 ± \d ms earlier"),
    "cycled axes": (lambda r: turned(r, CYCLE), r"axes are turned by 120 ± 0\.\d° from those st"),
    "swapped axes": (lambda r: turned(r, SWAP), "axes are left-handed; used as found"),
}


def test_up_is_found_all_along_a_path_whose_frames_are_partly_lost(record):
    fitted, run = fit_imu(record, FRAMES_S, seen, T_CAMERA_IMU), seen()[0]
    up, sigma_deg = up_of_drive(fitted.guide, run.path, run.sigma_m)
    assert np.rad2deg(np.arccos(up @ UP)) < sigma_deg < 1.0
    lost = np.where(np.arange(len(run.sigma_m)) == 3, np.nan, run.sigma_m)
    up, _ = up_of_drive(fitted.guide, run.path, lost)
    assert np.rad2deg(np.arccos(up @ UP)) < 1.0
    assert up_of_drive(fitted.guide, run.path, np.full_like(lost, np.nan))[0] is None


@pytest.mark.parametrize("fault", FAULTS)
def test_bias_and_up_are_found_and_a_wrong_delay_or_axes_too_and_said(record, fault):
    spoil, said = FAULTS[fault]
    fitted = fit_imu(spoil(record), FRAMES_S, seen, T_CAMERA_IMU)
    guide = fitted.guide
    matrix = {"cycled axes": CYCLE, "swapped axes": -SWAP}.get(fault, np.eye(3))
    # Turns of 0.04° at 149 motions of 0.1 s leave 0.04° / s / √149.
    np.testing.assert_allclose(guide.gyro.bias, matrix @ BIAS, atol=5e-4)
    time_offset_s = {"late": 0.05, "early": -0.05}.get(fault, 0.0)
    assert guide.gyro.time_offset_s == pytest.approx(time_offset_s, abs=2e-3)
    assert np.degrees(np.arccos(guide.up @ UP)) < 0.5
    # A sway of 0.5 m at 0.5 rad/s to 0.2 m at 1.3 rad/s: 0.13 to 0.34 m/s² at most.
    assert 0.1 < guide.unsteady < 0.3
    T, _ = guide.gyro.turned(3.0, 5.0)
    assert np.degrees(angle_rad(T.T @ (invert(pose(3.0)) @ pose(5.0))[:3, :3])) < 0.15
    assert len(fitted.lines) == bool(said)
    assert re.search(said, " ".join(fitted.lines))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda r: replace(r, gyro=r.gyro[::-1].copy()), "does not turn as the cameras do"),
        (lambda r: replace(r, timestamps_s=r.timestamps_s + 1e9), "must use the same clock"),
        (lambda r: replace(r, gyro=r.gyro * [1, 0, 0], accel=r.accel), "not used"),
    ],
    ids=["of another drive", "another clock", "one axis"],
)
def test_a_unit_that_does_not_fit_is_not_used_and_that_is_said(record, spoil, said):
    fitted = fit_imu(spoil(record), FRAMES_S, seen, T_CAMERA_IMU)
    assert fitted.guide is None
    assert said in fitted.lines[-1]


UNITS = {
    "degrees": (lambda r: replace(r, gyro=np.degrees(r.gyro)), True, "its rates are in degrees"),
    "g": (lambda r: replace(r, accel=r.accel / 9.81), False, r"1 m/s² .* gravity .* in g\?"),
    "no forces": (lambda r: replace(r, accel=0.0 * r.accel), False, "0 m/s² .* gravity"),
}


@pytest.mark.parametrize("unit", UNITS)
def test_units_that_are_not_those_of_the_file_are_said(record, unit):
    spoil, forces, said = UNITS[unit]
    fitted = fit_imu(spoil(record), FRAMES_S, seen, T_CAMERA_IMU)
    guide = fitted.guide
    assert re.search(said, " ".join(fitted.lines))
    np.testing.assert_allclose(guide.gyro.bias, BIAS, atol=5e-4)
    # Without forces nothing says how steadily it moves: the camera may be anywhere.
    assert (guide.up is not None) is forces
    last = Motion(np.eye(4), 3.0, np.eye(4), 0.1)
    guided = guide.guide(last, last, 3.1)
    assert (guided.sigma_m < 1.0) is forces
    assert np.isfinite(guided.covariance).all()


def test_axes_that_nothing_states_are_found_and_gaps_are_counted(record):
    half = ImuRecord(record.timestamps_s[:2200], record.gyro[:2200], record.accel[:2200])
    fitted = fit_imu(half, FRAMES_S, seen, None)
    off = fitted.guide.gyro.R_camera_imu @ T_CAMERA_IMU[:3, :3].T
    assert np.degrees(angle_rad(off)) < 0.3
    assert "50 of 149 motions between frames are not covered" in fitted.lines[0]
    assert fitted.guide.gyro.knows(9.8, 9.9)
    assert not fitted.guide.gyro.knows(9.9, 10.1)


def test_derivatives_of_a_turn_are_those_of_differences(record):
    gyro = Gyro(record, T_CAMERA_IMU[:3, :3], BIAS + 0.01, 0.003)
    R, J = gyro.turned(2.0, 2.7)
    for k, step in enumerate(1e-5 * np.eye(7)):
        by_difference = log_so3(R.T @ gyro.stepped(step).turned(2.0, 2.7)[0]) / 1e-5
        np.testing.assert_allclose(J[:, k], by_difference, atol=2e-4)


def test_a_few_matches_among_many_wrong_ones_place_a_camera_whose_turn_is_known():
    rng = np.random.default_rng(3)
    xyz = rng.uniform([-3, -1, 4], [3, 1, 20], (80, 3))
    T = make_transform(exp_so3(np.array([0.0, 0.4, 0.1])), np.array([0.5, 0.1, 0.3]))
    place = (xyz - T[:3, 3]) @ T[:3, :3]
    uv = CAMERA.focal_px * place[:, :2] / place[:, 2:] + [CAMERA.cx_px, CAMERA.cy_px]
    uv[14:] = rng.uniform([0, 0], [400, 160], (66, 2))
    known = make_transform(T[:3, :3] @ exp_so3(np.full(3, 5e-4)), np.array([9.0, 9.0, 9.0]))
    guided = Guided(known, np.diag([1e6] * 3 + [1e-6] * 3), holds=True)
    found = guided.locate(xyz, uv, CAMERA)
    assert found.agree[:14].sum() >= 12
    assert np.linalg.norm(found.T_world_camera[:3, 3] - T[:3, 3]) < 0.05
    assert guided.locate(xyz[14:], uv[14:], CAMERA) is None


def spun(n: int) -> np.ndarray:
    """From frame 4 on the camera rolls by 45 degrees in six frames, and goes on as before."""
    turn = 0.13 * np.clip(n - 3, 0, 6)
    return make_transform(exp_so3(np.array([0.0, 0.0, turn])), np.array([0.0, 0.0, 0.1 * n]))


def spinning(unsteady: float) -> ImuGuide:
    times_s = np.arange(-0.1, 2.0, 0.01)
    gyro = np.zeros((len(times_s), 3))
    gyro[(times_s > 0.295) & (times_s < 0.895), 2] = 1.3
    record = ImuRecord(times_s, gyro, np.zeros_like(gyro))
    return ImuGuide(Gyro(record, np.eye(3), np.zeros(3)), 1e-8 * np.eye(7), 1e-3, unsteady, 1e-3)


def test_the_turn_is_carried_over_frames_without_sight_and_places_are_not_believed(see, blind):
    frames = [blind(index=n) if 4 <= n <= 8 else see(spun(n), n) for n in range(13)]
    alone, led, sure = (
        [odometry.register(frame) for frame in frames]
        for odometry in map(
            CheckedOdometry, map(VisualOdometry, (None, spinning(1.0), spinning(0.05)))
        )
    )
    truth = np.stack([spun(n) for n in range(13)])
    off_deg = [
        np.degrees(angle_rad(invert(result[8].T_world_camera) @ truth[8]))
        for result in (alone, led, sure)
    ]
    assert off_deg[0] > 30
    assert max(off_deg[1:]) < 1.0
    # 1 m/s² are 6 cm in 0.3 s, half of it before the last frame; 0.05 m/s² are 1 cm in 0.5 s.
    assert [n for n, one in enumerate(led) if not one.health.ok] == [6, 7, 8]
    assert all(led[n].health.skipped for n in (6, 7, 8))
    assert "carried by the IMU" in led[4].health.notes[0]
    assert all(one.health.ok for one in sure[:9])
    # A street that is seen anew begins a path, turned as it is.
    last = led[-1].T_world_camera
    assert np.degrees(angle_rad(invert(last) @ truth[-1])) < 1.0
