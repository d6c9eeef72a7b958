"""Odometries by name, what they say of their poses, and how far they are off on real drives."""

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from recon.core.errors import RegistrationError
from recon.core.geometry.se3 import as_transform, invert
from recon.core.values import RectifiedPair, Trajectory, TrajectoryMetrics
from recon.evaluation.trajectory import evaluate_trajectory
from recon.map.store.records import Store
from recon.odometry.health import (
    doubt_about,
    expected_drift,
    health_warnings,
    name_frames,
    segment_numbers,
)
from recon.odometry.protocol import OdometryFrame, OdometryHealth
from recon.odometry.registry import ODOMETRIES, KnownPoses, make_odometry
from recon.sources.registry import open_source
from recon.stereo.match.registry import make_matcher


@pytest.mark.parametrize("name", ODOMETRIES)
def test_a_saved_odometry_goes_on_to_the_bit(name, street, tmp_path):
    unbroken = make_odometry(name)
    for frame in street[:6]:
        unbroken.register(frame)
    saved = make_odometry(name)
    with Store.create(tmp_path / "map.recon") as store:
        store.put("state", 0, unbroken.state())
        saved.restore(store.read("state", 0))
    for frame in street[6:]:
        ours, theirs = saved.register(frame), unbroken.register(frame)
        np.testing.assert_array_equal(ours.T_world_camera, theirs.T_world_camera)
        assert repr(ours.health) == repr(theirs.health)


def test_known_poses_begin_at_the_identity_and_are_picked_by_the_number_of_the_frame(
    blind, street_poses
):
    odometry = KnownPoses(Trajectory(street_poses, np.arange(12.0)))
    for index in (3, 4, 5, 9):
        result = odometry.register(blind(index=index))
        expected = invert(street_poses[3]) @ street_poses[index]
        np.testing.assert_allclose(result.T_world_camera, expected, atol=1e-12)
        assert result.health.ok
        assert result.health.known
    with pytest.raises(RegistrationError, match=r"frame 12: no known pose .* \(got 12 poses"):
        odometry.register(blind(index=12))


GOOD = OdometryHealth(scale_px=30.0, sigma_m=0.01, sigma_deg=0.02)


def path(frames: int = 101, step_m: float = 1.0) -> Trajectory:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step_m * np.arange(frames)
    return Trajectory(poses, np.arange(frames, dtype=np.float64))


def test_an_error_of_all_disparities_is_as_much_of_the_length_and_warned_of_if_large(camera):
    near = expected_drift(path(), [GOOD] * 101, camera)
    far = expected_drift(path(), [replace(GOOD, scale_px=3.0)] * 101, camera)
    # 0.1 px, and 0.02° at 260 px: 0.135 px together, beside 0.2 % of the baseline.
    assert near.rig_percent == pytest.approx(100 * np.hypot(0.1351 / 30.0, 0.002), rel=1e-3)
    assert far.rig_percent == pytest.approx(100 * np.hypot(0.1351 / 3.0, 0.002), rel=1e-3)
    assert far.rests_on_m == pytest.approx(260.0 * 0.5 / 3.0)
    assert near.warnings() == []
    assert far.warnings() == [
        "scale rests on points about 43.3 m away: the length of the path is certain to ± 9 % only"
    ]


def test_random_errors_scatter_as_stated(camera):
    """Paths with errors of the stated size in each step, against the stated drift."""
    rng = np.random.default_rng(4)
    sigmas = np.repeat([GOOD.sigma_m, np.deg2rad(GOOD.sigma_deg)], 3) / np.sqrt(3)
    offs = []
    for _ in range(200):
        T = np.eye(4)
        for _ in range(100):
            step = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]) + sigmas * rng.normal(size=6)
            T = T @ as_transform(step)
        offs.append(T[:3, 3] - [0.0, 0.0, 100.0])
    found = expected_drift(path(), [GOOD] * 101, camera)
    random = np.sqrt(found.percent**2 - found.rig_percent**2)
    scattered = float(np.sqrt(np.square(offs).sum(axis=1).mean()))
    # Of a turn about the direction of travel nothing is seen: a third less. 200 trials: ±5 %.
    assert 0.8 * random < scattered < 1.1 * random


def test_poses_that_were_not_measured_say_nothing(camera):
    assert expected_drift(path(), [OdometryHealth()] * 101, camera) is None
    assert expected_drift(path(1), [GOOD], camera) is None
    lost = replace(GOOD, ok=False, scale_px=1.0)
    some = expected_drift(path(), [GOOD, lost] + [GOOD] * 99, camera)
    assert some.rig_percent < 1.0


LOST = OdometryHealth(ok=False, notes=("dark",))
SKIPPED = replace(LOST, skipped=True)
FINE = OdometryHealth()
BEGINS = replace(FINE, begins=True)


def test_what_is_lost_is_named_by_stretches_and_said_of_a_drive():
    assert name_frames([4]) == "frame 4"
    assert name_frames([1, 2, 5, 7, 8, 9]) == "frames 1-2, frame 5, frames 7-9"
    assert name_frames([1, 3, 5, 7]) == "frame 1, frame 3, frame 5, …"
    assert health_warnings([FINE] * 3) == []
    lines = health_warnings([FINE, LOST, LOST, FINE, LOST, *[FINE] * 30])
    assert [line.split(":")[0] for line in lines] == ["frames 1-2", "frame 4"]
    assert all("dark" in line for line in lines)
    first, *others = health_warnings([FINE, *[LOST] * 3, *[FINE] * 16])
    assert first.startswith("PATH AND MAP ARE NOT TO BE TRUSTED")
    assert "3 of 20 frames" in first
    assert len(others) == 1
    warned = replace(FINE, warnings=("rows are off",))
    assert health_warnings([warned, FINE, warned, FINE]) == ["frames 0-2: rows are off"]
    assert segment_numbers([FINE, SKIPPED, FINE, LOST, FINE, FINE]).tolist() == [0, -1, 0, -1, 1, 1]
    assert segment_numbers([FINE, LOST, SKIPPED, FINE]).tolist() == [0, -1, -1, 1]
    assert segment_numbers([LOST, BEGINS, FINE, BEGINS, FINE]).tolist() == [-1, 0, 0, 1, 1]
    assert segment_numbers([]).tolist() == []
    assert doubt_about([FINE] * 3) == []
    (line,) = doubt_about([*[FINE] * 20, LOST, *[FINE] * 20])
    assert line == "1 of 41 poses are not to be trusted (frame 20): nothing of them is in the map"
    (line,) = doubt_about([FINE, LOST, FINE])
    assert line.startswith("PATH AND MAP ARE NOT TO BE TRUSTED: the poses of 1 of 3 frames")


def drive(folder: Path, stride: int) -> tuple[TrajectoryMetrics, list[OdometryHealth]]:
    if not folder.is_dir():
        pytest.skip(f"real data: no folder {folder.name}")
    source, matcher, odometry = open_source(folder), make_matcher("sad"), make_odometry("visual")
    results = []
    for index, pair in enumerate(islice(source, 0, None, stride)):
        rectified = RectifiedPair(pair.left, pair.right, source.calibration, index=index)
        results.append(odometry.register(OdometryFrame(rectified, matcher.match(rectified))))
    truth = np.tile(np.eye(4), (len(results), 1, 1))
    truth[:, :3] = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)[::stride]
    times = np.arange(len(truth), dtype=np.float64)
    path = Trajectory(np.stack([result.T_world_camera for result in results]), times)
    return evaluate_trajectory(path, Trajectory(truth, times)), [r.health for r in results]


@pytest.mark.real
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "stride", "t_bound", "r_bound"),
    [
        ("kitti_raw_0013", 1, 0.35, 0.65),
        ("kitti_raw_0013", 3, 0.40, 0.65),
        ("kitti_06_51", 1, 0.80, 1.5),
        ("kitti_06_51", 3, 0.95, 1.8),
    ],
)
def test_real_drives_drift_as_little_as_promised_and_raise_no_alarm(
    name, stride, t_bound, r_bound, recon_data
):
    found, health = drive(recon_data / "driven" / name, stride)
    assert 0.0 < found.t_rel_percent < t_bound
    assert 0.0 < found.r_rel_deg_per_100m < r_bound
    assert all(record.ok for record in health)
