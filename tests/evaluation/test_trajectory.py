"""Errors of paths: counted by hand, as evo counts them (GPL-3, in development only)."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.core.errors import EvaluationError
from recon.core.geometry.alignment import fit_points, fit_upright
from recon.core.geometry.se3 import (
    angle_rad,
    apply,
    exp_so3,
    invert,
    make_transform,
    quaternion_from_rotation,
)
from recon.core.values import SequenceTruth, Trajectory
from recon.evaluation.trajectory import (
    KITTI_LENGTHS_M,
    TrajectoryRules,
    associate,
    choose_segments,
    compare_paths,
    evaluate_trajectory,
    interpolated_poses,
    interpolation_warnings,
    segments_of,
)
from recon.io.trajectory import write_tum

pytestmark = pytest.mark.portable


def trajectory(poses: np.ndarray) -> Trajectory:
    return Trajectory(poses, 0.1 * np.arange(len(poses), dtype=np.float64))


def straight(frames: int, step_m: float = 1.0) -> np.ndarray:
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = step_m * np.arange(frames)
    return poses


def bend(frames: int, yaw_rad: float, step_m: float = 1.0) -> np.ndarray:
    step = make_transform(exp_so3(np.array([0.0, yaw_rad, 0.0])), np.array([0.0, 0.0, step_m]))
    return np.stack([np.linalg.matrix_power(step, n) for n in range(frames)])


def test_upright_keeps_a_map_upright_where_gnss_leaves_its_roll_open():
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
def test_a_constant_scale_error_is_the_relative_error(scale):
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


def test_a_yaw_drift_is_the_relative_error_of_lengths_and_steps_that_can_be_asked_for():
    drift_rad = math.radians(0.01)
    truth = trajectory(straight(201))
    metrics = evaluate_trajectory(trajectory(bend(201, drift_rad)), truth)
    # 0.01° a metre is 1° in 100 m; segments are up to one frame longer than they are called.
    assert 1.0 < metrics.r_rel_deg_per_100m < 1.021
    assert metrics.rpe_deg == pytest.approx(0.01, rel=1e-6)
    rules = TrajectoryRules(lengths_m=(20.0, 5.0), step_frames=7)
    metrics = evaluate_trajectory(trajectory(straight(50)), trajectory(straight(50)), rules)
    assert [(one.length_m, one.segments) for one in metrics.by_length] == [(5.0, 7), (20.0, 5)]
    with pytest.raises(EvaluationError, match="no room for a segment"):
        compare_paths(*[trajectory(straight(50))] * 2, TrajectoryRules(lengths_m=(60.0,)))


@pytest.mark.parametrize(
    ("alignment", "ate_m", "scale"),
    [("none", 3.0, 1.0), ("origin", 1.0, 1.0), ("se3", 1.0, 1.0), ("sim3", 0.0, 1 / 1.1)],
)
def test_an_alignment_takes_away_what_it_may(alignment, ate_m, scale):
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
def test_segments_are_those_for_which_a_drive_has_room(frames, by_length):
    truth = trajectory(straight(frames))
    metrics = evaluate_trajectory(trajectory(bend(frames, 0.0101)), truth)
    assert {one.length_m: one.segments for one in metrics.by_length} == by_length
    assert metrics.segment_lengths_m == tuple(by_length)
    assert metrics.segments == sum(by_length.values())
    weights = [one.segments for one in metrics.by_length]
    for name in ("t_rel_percent", "r_rel_deg_per_100m"):
        mean = np.average([getattr(one, name) for one in metrics.by_length], weights=weights)
        assert getattr(metrics, name) == pytest.approx(mean, rel=1e-12)


def test_a_path_is_taken_from_a_file_and_from_the_truth_of_a_source(tmp_path):
    path = trajectory(bend(100, 0.01))
    write_tum(tmp_path / "path.txt", path)
    assert evaluate_trajectory(path, SequenceTruth(path)) == evaluate_trajectory(path, path)
    assert evaluate_trajectory(str(tmp_path / "path.txt"), tmp_path / "path.txt").ate_m < 1e-9
    for nothing, got in (
        (SequenceTruth(), "SequenceTruth without a path"),
        (None, "NoneType without a path"),
        (path.T_world_camera, "ndarray"),
    ):
        with pytest.raises(EvaluationError, match=f"truth is no trajectory .got {got}"):
            evaluate_trajectory(path, nothing)  # type: ignore[arg-type]


@pytest.mark.parametrize("unit", [1e-3, 0.3048, 1e3, 1e6])
def test_a_truth_in_another_unit_is_refused_unless_scales_are_aligned(unit):
    estimate = bend(2000, 0.01)
    truth = estimate.copy()
    truth[:, :3, 3] *= unit
    pair = trajectory(estimate), trajectory(truth)
    with pytest.raises(EvaluationError, match="in another unit"):
        evaluate_trajectory(*pair)
    scaled = evaluate_trajectory(*pair, TrajectoryRules(alignment="sim3"))
    assert scaled.scale == pytest.approx(unit)


@given(steps=st.lists(st.floats(0.0, 3.0), min_size=2, max_size=60).filter(lambda s: sum(s) >= 1.0))
def test_every_path_of_a_metre_or_more_has_a_finite_error(steps):
    poses = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    poses[1:, 2, 3] = np.cumsum(steps)
    estimate = poses.copy()
    estimate[:, 0, 3] = 0.1
    metrics = evaluate_trajectory(trajectory(estimate), trajectory(poses))
    assert metrics.segments > 0
    assert math.isfinite(metrics.t_rel_percent)


@pytest.mark.parametrize(
    ("estimate", "truth", "told"),
    [
        (straight(5), straight(6), "differ in length .got 5 poses, expected 6 poses"),
        (straight(1), straight(1), "too few poses"),
        (straight(9), straight(9, 0.0), "too short"),
    ],
)
def test_what_cannot_be_compared_is_reported(estimate, truth, told):
    with pytest.raises(EvaluationError, match=told):
        evaluate_trajectory(trajectory(estimate), trajectory(truth))


@pytest.mark.real
def test_the_two_truths_of_a_real_drive_differ_by_about_one_per_cent(recon_data):
    folder = recon_data / "driven" / "kitti_raw_0013"
    metrics = evaluate_trajectory(folder / "poses_oxts.txt", folder / "poses.txt")
    # The data's README states "about 1 %".
    assert 0.3 < metrics.t_rel_percent < 2.0
    assert metrics.segment_lengths_m == (50.0, 100.0)


def jittered(poses: np.ndarray, sigma_m: float, seed: int = 1) -> np.ndarray:
    """Poses with the true orientations and noise in their positions."""
    moved = poses.copy()
    moved[:, :3, 3] += np.random.default_rng(seed).normal(0, sigma_m, (len(poses), 3))
    return moved


def test_roll_is_no_rotation_error_where_a_path_leaves_it_open_unless_it_changes():
    truth = jittered(straight(60), 0.05, seed=2)
    estimate = make_transform(exp_so3(np.array([0.1, 0.2, 0.8])), np.ones(3)) @ truth
    found = compare_paths(trajectory(jittered(estimate, 0.05)), trajectory(truth))
    np.testing.assert_allclose(np.abs(found.roll_axis), [0, 0, 1], atol=0.01)
    # Pitch and yaw of the line: 0.07 m of noise over 60 m, at 60 poses.
    assert np.degrees(found.rotation_errors_rad).max() < 0.2
    assert found.metrics.ate_m == pytest.approx(0.05 * math.sqrt(3), rel=0.3)
    truth = jittered(straight(60), 0.02, seed=2)
    estimate = jittered(truth, 0.02)
    rolls = [exp_so3(np.array([0.0, 0.0, roll])) for roll in np.linspace(-0.1, 0.1, 60)]
    estimate[:, :3, :3] = np.stack(rolls) @ estimate[:, :3, :3]
    found = compare_paths(trajectory(estimate), trajectory(truth))
    # Evenly from -0.1 to 0.1: an rms of 0.1 / sqrt(3).
    rms = np.sqrt((found.rotation_errors_rad**2).mean())
    assert rms == pytest.approx(0.1 / math.sqrt(3), rel=0.05)


@pytest.mark.parametrize("alignment", ["se3", "none"])
def test_a_bend_fixes_every_rotation_and_so_does_no_alignment(alignment):
    poses = bend(100, 0.02) if alignment == "se3" else straight(100)
    rules = TrajectoryRules(alignment=alignment)  # type: ignore[arg-type]
    found = compare_paths(trajectory(jittered(poses, 0.02)), trajectory(poses), rules)
    assert found.roll_axis is None


TIMES = st.lists(st.floats(0, 100), min_size=1, max_size=30).map(np.sort)


def path(times_s: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    poses[:, 0, 3] = times_s
    return Trajectory(poses, times_s)


@given(times=TIMES, others=TIMES, tolerance=st.floats(0, 5))
def test_partners_are_near_in_order_and_belong_to_one_only(times, others, tolerance):
    times, others = np.unique(times), np.unique(others)
    try:
        first, second = associate(path(times), path(others), tolerance)
    except EvaluationError:
        assert np.abs(times[:, None] - others[None]).min() > tolerance
        return
    assert (np.abs(first.timestamps_s - second.timestamps_s) <= tolerance).all()
    for found in (first, second):
        assert (np.diff(found.timestamps_s) > 0).all()
        np.testing.assert_array_equal(found.positions_m[:, 0], found.timestamps_s)


def test_clocks_that_never_meet_are_reported():
    with pytest.raises(EvaluationError, match=r"times 0\.000 to 4\.000 s and 1000\.000"):
        associate(path(np.arange(5.0)), path(1000 + np.arange(5.0)), 0.01)


def turning_path(turns_deg: np.ndarray) -> Trajectory:
    """A drive of 1.2 m from frame to frame, with a rotation vector (N, 3) for each of them."""
    poses = [np.eye(4)]
    for turn in np.radians(turns_deg):
        poses.append(poses[-1] @ make_transform(exp_so3(turn), np.array([0.0, 0.0, 1.2])))
    # As many digits as a KITTI file has.
    rounded = np.array([float(f"{x:e}") for x in np.stack(poses).ravel()]).reshape(-1, 4, 4)
    return trajectory(rounded)


def measured(frames: int, seed: int = 0) -> np.ndarray:
    """Turns (N, 3) that change by a few hundredths of a degree from frame to frame."""
    return np.random.default_rng(seed).normal(0.0, 0.03, (frames, 3))


def test_an_interpolated_stretch_is_found_and_the_segments_that_rest_on_it_counted():
    turns = measured(50)
    turns[:11] = [0.01, -0.04, -0.04]
    truth = turning_path(turns)
    assert np.flatnonzero(interpolated_poses(truth)).tolist() == list(range(12))
    segments = choose_segments(truth.distances_m)
    assert len(segments.first) == 9
    (warning,) = interpolation_warnings(truth, segments)
    assert warning.startswith("12 true poses (between 0 and 11) turn evenly")
    assert warning.endswith("9 of 9 segments begin or end there")


SHORT_STRETCH = measured(50)
SHORT_STRETCH[10:14] = SHORT_STRETCH[10]


@pytest.mark.parametrize(
    "turns",
    [
        *(measured(200, seed) for seed in range(5)),
        SHORT_STRETCH,  # may be chance
        *(np.full((60, 3), turn_deg) for turn_deg in (0.0, 0.5)),  # even throughout
        *(measured(steps) for steps in (0, 1, 5)),
    ],
)
def test_no_other_path_has_interpolated_poses(turns):
    assert not interpolated_poses(turning_path(turns)).any()
    assert interpolation_warnings(turning_path(turns), segments_of(np.arange(9.0), (3.0,), 1)) == []


def drive(frames: int, seed: int) -> tuple[Trajectory, Trajectory]:
    """An estimate of another start and scale that drifts and shakes, of a winding path."""
    rng, step = np.random.default_rng(seed), np.array([0.02, 0.01, 0.9])
    paths = [make_transform(exp_so3(np.array([0.2, -0.7, 0.4])), np.ones(3))[None], np.eye(4)[None]]
    for n in range(frames - 1):
        turn = np.array([0.01 * np.sin(n / 9), 0.03 * np.cos(n / 25), 0.004])
        shaken = exp_so3(turn + rng.normal(0, 2e-3, 3))
        moved = make_transform(shaken, 1.07 * step + rng.normal(0, 0.02, 3))
        for k, motion in enumerate((moved, make_transform(exp_so3(turn), step))):
            paths[k] = np.concatenate([paths[k], paths[k][-1:] @ motion])
    return trajectory(paths[0]), trajectory(paths[1])


@pytest.fixture
def evo():
    """The metrics of evo, whose relations and units are in the same module."""
    return pytest.importorskip("evo.core.metrics", reason="evo needs Python 3.11")


def of_evo(path: Trajectory) -> Any:
    from evo.core.trajectory import PoseTrajectory3D

    turns = [quaternion_from_rotation(pose[:3, :3]) for pose in path.T_world_camera]
    wxyz = np.stack(turns)[:, [3, 0, 1, 2]]
    return PoseTrajectory3D(path.positions_m, wxyz, path.timestamps_s)


def evo_statistics(pair: Any, metric: Any) -> dict[str, float]:
    metric.process_data(pair)
    return dict(metric.get_all_statistics())


@pytest.mark.parametrize("alignment", ["none", "origin", "se3", "sim3"])
@pytest.mark.parametrize("rpe_frames", [1, 7])
def test_ate_and_rpe_agree_with_evo(alignment, rpe_frames, evo):
    estimate, truth = drive(300, seed=3)
    rules = TrajectoryRules(alignment=alignment, rpe_frames=rpe_frames)
    found = compare_paths(estimate, truth, rules)
    reference, moved = of_evo(truth), of_evo(estimate)
    if alignment == "origin":
        moved.align_origin(reference)
    elif alignment != "none":
        rotation, translation, scale = moved.align(reference, correct_scale=alignment == "sim3")
        assert found.motion.scale == pytest.approx(scale, rel=1e-9)
        np.testing.assert_allclose(found.motion.T_to_from[:3, :3], rotation, atol=1e-9)
        np.testing.assert_allclose(found.motion.T_to_from[:3, 3], translation, atol=1e-6)
    pair, ours = (reference, moved), found.metrics
    absolute = evo_statistics(pair, evo.APE(evo.PoseRelation.translation_part))
    # Both are float64; evo goes by quaternions, which cost it some digits.
    for name, value in (
        ("rmse", ours.ate_m), ("median", ours.ate_median_m), ("max", ours.ate_max_m)
    ):  # fmt: skip
        assert value == pytest.approx(absolute[name], rel=1e-7)
    for relation, value, rel in (
        (evo.PoseRelation.translation_part, ours.rpe_m, 1e-7),
        (evo.PoseRelation.rotation_angle_deg, ours.rpe_deg, 1e-6),
    ):
        steps = evo.RPE(relation, rpe_frames, evo.Unit.frames, all_pairs=True)
        assert value == pytest.approx(evo_statistics(pair, steps)["rmse"], rel=rel)
