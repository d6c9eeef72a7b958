from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import fit_points, fit_upright
from recon.core.geometry.se3 import angle_rad, apply, exp_so3, invert, make_transform
from recon.core.values import SequenceTruth, Trajectory
from recon.evaluation.trajectory import (
    KITTI_LENGTHS_M,
    TrajectoryRules,
    compare_paths,
    evaluate_trajectory,
    segments_of,
)
from recon.io.trajectory import write_tum


def trajectory(poses: np.ndarray) -> Trajectory:
    return Trajectory(poses, 0.1 * np.arange(len(poses), dtype=np.float64))


def straight(frames: int, step_m: float = 1.0) -> np.ndarray:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step_m * np.arange(frames)
    return poses


def bend(frames: int, yaw_rad: float, step_m: float = 1.0) -> np.ndarray:
    step = make_transform(exp_so3(np.array([0.0, yaw_rad, 0.0])), np.array([0.0, 0.0, step_m]))
    return np.stack([np.linalg.matrix_power(step, n) for n in range(frames)])


def test_a_perfect_estimate_has_no_error() -> None:
    truth = trajectory(bend(300, 0.005))
    metrics = evaluate_trajectory(truth, truth)
    # 1e-6: the sums of 300 products of float64 matrices.
    assert metrics.t_rel_percent < 1e-6
    assert metrics.r_rel_deg_per_100m < 1e-6
    assert metrics.ate_m < 1e-6
    assert metrics.rpe_m < 1e-9
    assert metrics.frames == 300


def test_upright_keeps_a_map_upright_where_gnss_leaves_its_roll_open() -> None:
    along = np.arange(60)[:, None] * np.array([0.8, 0.6, 0.02])
    noise = np.random.default_rng(4).normal(0, 0.3, along.shape)
    found, loose = (fit(along, along + noise + 5e6).T_to_from for fit in (fit_upright, fit_points))
    # The pitch by 0.3 m of noise in 60 points over 60 m: 0.3 / 17 / sqrt(60), 0.13 degrees.
    assert np.degrees(np.arccos(found[2, 2])) < 0.5
    assert np.degrees(np.arccos(loose[2, 2])) > 20
    path = trajectory(bend(200, 0.03)).positions_m[:, [2, 0, 1]]  # a circle in the plane z = 0
    T_survey_map = make_transform(exp_so3(np.array([0.02, -0.03, 1.2])), np.array([4e5, 5e6, 90.0]))
    tilted = fit_upright(path, apply(T_survey_map, path)).T_to_from
    # Three metres upwards count 9 m² beside half of the squared radius of 33 m: of 0.036 rad.
    assert angle_rad(tilted @ invert(T_survey_map)) < 0.036 * 9 / (33**2 / 2)


@given(scale=st.floats(0.5, 1.5))
def test_a_constant_scale_error_is_the_relative_error(scale: float) -> None:
    truth = straight(201)
    estimate = truth.copy()
    estimate[:, :3, 3] *= scale
    metrics = evaluate_trajectory(trajectory(estimate), trajectory(truth))
    # A segment ends at the first frame beyond its length, here one frame: 51/50 and 101/100.
    count_50, count_100 = 150, 100
    ends = (count_50 * 51 / 50 + count_100 * 101 / 100) / (count_50 + count_100)
    assert metrics.t_rel_percent == pytest.approx(100 * abs(scale - 1) * ends, abs=1e-9)
    assert metrics.r_rel_deg_per_100m == pytest.approx(0.0, abs=1e-9)
    assert metrics.rpe_m == pytest.approx(abs(scale - 1), abs=1e-9)


def test_a_yaw_drift_is_the_relative_rotation_error() -> None:
    drift_rad = math.radians(0.01)
    truth = trajectory(straight(201))
    metrics = evaluate_trajectory(trajectory(bend(201, drift_rad)), truth)
    # 0.01° a metre is 1° in 100 m; segments are up to one frame longer than they are called.
    assert 1.0 < metrics.r_rel_deg_per_100m < 1.021
    assert metrics.rpe_deg == pytest.approx(0.01, rel=1e-6)


@pytest.mark.parametrize(
    ("alignment", "ate_m", "scale"),
    [("none", 3.0, 1.0), ("origin", 1.0, 1.0), ("se3", 1.0, 1.0), ("sim3", 0.0, 1 / 1.1)],
)
def test_an_alignment_takes_away_what_it_may(alignment: str, ate_m: float, scale: float) -> None:
    """An estimate of another scale that begins elsewhere; what remains is at least ``ate_m``."""
    poses = bend(201, 0.01)
    moved = make_transform(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([5.0, -3.0, 2.0])) @ poses
    rules = TrajectoryRules(alignment=alignment)
    same = evaluate_trajectory(trajectory(moved), trajectory(poses), rules)
    assert (same.ate_m < 1e-9) == (alignment != "none")
    assert same.t_rel_percent < 1e-9
    moved[:, :3, 3] *= 1.1
    found = evaluate_trajectory(trajectory(moved), trajectory(poses), rules)
    assert found.scale == pytest.approx(scale)
    assert found.ate_m > ate_m if ate_m else found.ate_m < 1e-9
    poses[:, 1, 3] += 9 * np.sin(np.arange(201))  # no plane, in which a mirror is a rotation
    mirrored = poses.copy()
    mirrored[:, 0, 3] *= -1
    assert evaluate_trajectory(trajectory(mirrored), trajectory(poses), rules).ate_m > 0.5


def test_the_absolute_error_of_a_scale_is_that_of_centred_positions() -> None:
    estimate = straight(101)
    estimate[:, :3, 3] *= 1.1
    metrics = evaluate_trajectory(trajectory(estimate), trajectory(straight(101)))
    # Centred, position s is off by 0.1·s, s evenly in ±50 m: rms = 0.1·sqrt(50·51/3).
    assert metrics.ate_m == pytest.approx(0.1 * math.sqrt(50 * 51 / 3), rel=1e-9)
    assert metrics.ate_max_m == pytest.approx(5.0)
    assert metrics.ate_median_m == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("frames", "by_length"),
    [
        # From every tenth frame; a segment ends one frame beyond its length.
        (331, {100.0: 23, 200.0: 13, 300.0: 3}),
        (1000, {n: 99 - int(n) // 10 + (1 if n < 900 else 0) for n in KITTI_LENGTHS_M}),
        (171, {50.0: 120, 100.0: 70}),
        (31, {15.0: 15}),
    ],
)
def test_segments_are_those_for_which_a_drive_has_room(
    frames: int, by_length: dict[float, int]
) -> None:
    truth = trajectory(bend(frames, 0.01))
    metrics = evaluate_trajectory(trajectory(bend(frames, 0.0101)), trajectory(straight(frames)))
    assert {one.length_m: one.segments for one in metrics.by_length} == by_length
    assert metrics.segment_lengths_m == tuple(by_length)
    assert metrics.segments == sum(by_length.values())
    metrics = evaluate_trajectory(trajectory(bend(frames, 0.0101)), truth)
    weights = [one.segments for one in metrics.by_length]
    for name in ("t_rel_percent", "r_rel_deg_per_100m"):
        mean = np.average([getattr(one, name) for one in metrics.by_length], weights=weights)
        assert getattr(metrics, name) == pytest.approx(mean, rel=1e-12)


def test_lengths_and_steps_can_be_asked_for() -> None:
    rules = TrajectoryRules(lengths_m=(20.0, 5.0), step_frames=7)
    metrics = evaluate_trajectory(trajectory(straight(50)), trajectory(straight(50)), rules)
    assert [(one.length_m, one.segments) for one in metrics.by_length] == [(5.0, 7), (20.0, 5)]
    with pytest.raises(EvaluationError, match="no room for a segment"):
        evaluate_trajectory(
            trajectory(straight(50)), trajectory(straight(50)), TrajectoryRules(lengths_m=(60.0,))
        )


def test_a_path_is_taken_from_a_file_and_from_the_truth_of_a_source(tmp_path: Path) -> None:
    path = trajectory(bend(100, 0.01))
    found = evaluate_trajectory(path, path)
    write_tum(tmp_path / "path.txt", path)
    assert evaluate_trajectory(path, SequenceTruth(path)) == found
    assert evaluate_trajectory(str(tmp_path / "path.txt"), tmp_path / "path.txt").ate_m < 1e-9
    for nothing, got in (
        (SequenceTruth(), "SequenceTruth without a path"),
        (None, "NoneType without a path"),
        (path.T_world_camera, "ndarray"),
    ):
        with pytest.raises(EvaluationError, match=f"truth is no trajectory .got {got}"):
            evaluate_trajectory(path, nothing)  # type: ignore[arg-type]


@pytest.mark.parametrize("unit", [1e-3, 0.3048, 1e3, 1e6])
def test_a_truth_in_another_unit_is_refused_unless_scales_are_aligned(unit: float) -> None:
    estimate = bend(2000, 0.01)
    truth = estimate.copy()
    truth[:, :3, 3] *= unit
    pair = trajectory(estimate), trajectory(truth)
    with pytest.raises(EvaluationError, match="in another unit"):
        evaluate_trajectory(*pair)
    scaled = evaluate_trajectory(*pair, TrajectoryRules(alignment="sim3"))
    assert scaled.scale == pytest.approx(unit)


@given(steps=st.lists(st.floats(0.0, 3.0), min_size=2, max_size=60).filter(lambda s: sum(s) >= 1.0))
def test_every_path_of_a_metre_or_more_has_a_finite_error(steps: list[float]) -> None:
    poses = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    poses[1:, 2, 3] = np.cumsum(steps)
    estimate = poses.copy()
    estimate[:, 0, 3] = 0.1
    metrics = evaluate_trajectory(trajectory(estimate), trajectory(poses))
    assert metrics.segments > 0
    assert math.isfinite(metrics.t_rel_percent)


def test_a_segment_ends_at_the_first_frame_beyond_its_length() -> None:
    # As lastFrameFromSegmentLength of the development kit: strictly farther.
    segments = segments_of(np.array([0.0, 40.0, 50.0, 60.0]), (50.0,), 1)
    assert segments.first.tolist() == [0]
    assert segments.last.tolist() == [3]


@pytest.mark.parametrize(
    ("estimate", "truth", "told"),
    [
        (straight(5), straight(6), "differ in length (got 5 poses, expected 6 poses)"),
        (straight(1), straight(1), "too few poses"),
        (straight(9), straight(9, 0.0), "too short"),
    ],
)
def test_what_cannot_be_compared_is_reported(
    estimate: np.ndarray, truth: np.ndarray, told: str
) -> None:
    with pytest.raises(EvaluationError) as error:
        evaluate_trajectory(trajectory(estimate), trajectory(truth))
    assert told in str(error.value)


@pytest.mark.real
def test_the_two_truths_of_a_real_drive_differ_by_about_one_per_cent(recon_data: Path) -> None:
    folder = recon_data / "driven" / "kitti_raw_0013"
    if not (folder / "poses_oxts.txt").exists():
        pytest.skip("real data: no second truth of kitti_raw_0013")
    lidar, gps = (_read(folder / name) for name in ("poses.txt", "poses_oxts.txt"))
    metrics = evaluate_trajectory(gps, lidar)
    # The data's README states "about 1 %".
    assert 0.3 < metrics.t_rel_percent < 2.0
    assert metrics.segment_lengths_m == (50.0, 100.0)


def _read(path: Path) -> Trajectory:
    poses = np.tile(np.eye(4), (len(path.read_text().splitlines()), 1, 1))
    poses[:, :3] = np.loadtxt(path).reshape(-1, 3, 4)
    return trajectory(poses)


def jittered(poses: np.ndarray, sigma_m: float, seed: int = 1) -> np.ndarray:
    """Poses with the true orientations and noise in their positions."""
    moved = poses.copy()
    moved[:, :3, 3] += np.random.default_rng(seed).normal(0, sigma_m, (len(poses), 3))
    return moved


def test_the_roll_that_a_straight_path_does_not_fix_is_no_rotation_error() -> None:
    truth = jittered(straight(60), 0.05, seed=2)
    estimate = make_transform(exp_so3(np.array([0.1, 0.2, 0.8])), np.ones(3)) @ truth
    found = compare_paths(trajectory(jittered(estimate, 0.05)), trajectory(truth))
    assert found.roll_axis is not None
    np.testing.assert_allclose(np.abs(found.roll_axis), [0, 0, 1], atol=0.01)
    # Pitch and yaw of the line: 0.07 m of noise over 60 m, at 60 poses.
    assert np.degrees(found.rotation_errors_rad).max() < 0.2
    assert found.metrics.ate_m == pytest.approx(0.05 * math.sqrt(3), rel=0.3)


def test_a_roll_that_changes_along_a_straight_path_stays_a_rotation_error() -> None:
    truth = jittered(straight(60), 0.02, seed=2)
    estimate = jittered(truth, 0.02)
    rolls = [exp_so3(np.array([0.0, 0.0, roll])) for roll in np.linspace(-0.1, 0.1, 60)]
    estimate[:, :3, :3] = np.stack(rolls) @ estimate[:, :3, :3]
    found = compare_paths(trajectory(estimate), trajectory(truth))
    # Evenly from -0.1 to 0.1: an rms of 0.1 / sqrt(3).
    rms = np.sqrt((found.rotation_errors_rad**2).mean())
    assert rms == pytest.approx(0.1 / math.sqrt(3), rel=0.05)


@pytest.mark.parametrize("alignment", ["se3", "none"])
def test_a_bend_fixes_every_rotation_and_so_does_no_alignment(alignment: str) -> None:
    poses = bend(100, 0.02) if alignment == "se3" else straight(100)
    rules = TrajectoryRules(alignment=alignment)  # type: ignore[arg-type]
    found = compare_paths(trajectory(jittered(poses, 0.02)), trajectory(poses), rules)
    assert found.roll_axis is None
