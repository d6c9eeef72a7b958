"""A run is compared in the axes given in its record."""

import json
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from recon.commands.evaluate import run_evaluate_map, run_evaluate_trajectory
from recon.core.errors import (
    EvaluationError,
    RegistrationError,
    SettingsError,
)
from recon.core.geometry.se3 import exp_so3, invert, make_transform, transform_cloud
from recon.core.values import PointCloud, Trajectory
from recon.evaluation.trajectory import TrajectoryRules
from recon.io.models.ply import read_ply, write_ply
from recon.io.trajectory import read_trajectory, write_kitti_poses, write_tum
from recon.report.map_page import ALIGNED

pytestmark = pytest.mark.usefixtures("blank_figures")
T_MAP_WORLD = make_transform(exp_so3(np.array([0.3, -1.2, 0.8])), np.zeros(3))


@pytest.fixture
def run(tmp_path):
    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.uniform(-5, 5, (2000, 3)).astype(np.float32), frame="map")
    folder = tmp_path / "run"
    write_ply(folder / "map" / "cloud.ply", cloud)
    (folder / "run.json").write_text(json.dumps({"T_map_world": T_MAP_WORLD.tolist()}))
    write_ply(tmp_path / "in_map.ply", cloud)
    in_camera = transform_cloud(cloud, invert(T_MAP_WORLD), frame="camera")
    write_ply(tmp_path / "in_camera.ply", in_camera)
    return folder


@pytest.mark.parametrize("inside", ["", "map/cloud.ply"])
@pytest.mark.parametrize("frame", ["camera", "map"])
def test_a_run_equals_itself_in_either_frame(run, inside, frame):
    reference = run.parent / f"in_{frame}.ply"
    figures = run_evaluate_map(run / inside, reference, frame=frame).to_json()
    assert (figures["f_score"], figures["warnings"]) == (1.0, [])
    # Both clouds are thinned on grids that start elsewhere, after a rotation of float32 points.
    assert 0.0 <= figures["p95_m"] < 0.15


@pytest.mark.parametrize(("right", "wrong"), [("map", "camera"), ("camera", "map")])
def test_the_wrong_frame_does_not_fit_and_the_right_one_is_named(run, right, wrong):
    figures = run_evaluate_map(run, run.parent / f"in_{right}.ply", frame=wrong).to_json()
    assert figures["f_score"] < 0.5
    (doubt,) = figures["warnings"]
    assert f"--reference-frame {right}" in doubt


def test_a_cloud_of_no_run_is_taken_as_it_is_and_clouds_apart_are_said_to_be(run):
    reference, far = run.parent / "in_camera.ply", run.parent / "far.ply"
    assert run_evaluate_map(reference, reference, frame="camera").to_json()["f_score"] == 1.0
    cloud = read_ply(reference)
    write_ply(far, replace(cloud, xyz=cloud.xyz + np.float32(50)))
    (doubt,) = run_evaluate_map(run, far).to_json()["warnings"]
    assert "hardly meet" in doubt


@pytest.fixture
def drifted(tmp_path):
    """A run that walks along two walls and the ground, its path and map turned and moved alike."""
    rng = np.random.default_rng(1)
    along = rng.uniform(0, 40, (9000, 1))
    across = rng.uniform(-4, 4, (9000, 1))
    ground = np.hstack([across, np.full_like(across, 1.6), along])
    walls = np.hstack([np.where(across > 0, 4.0, -4.0), rng.uniform(-1, 1.6, (9000, 1)), along])
    ends = np.hstack([across, rng.uniform(-1, 1.6, (9000, 1)), np.where(along > 20, 40.0, 0.0)])
    truth = np.concatenate([ground, walls, ends[:3000]]).astype(np.float32)
    write_ply(tmp_path / "reference.ply", PointCloud(truth))
    poses = np.tile(np.eye(4), (41, 1, 1))
    poses[:, 2, 3] = np.arange(41)
    write_kitti_poses(tmp_path / "poses.txt", Trajectory(poses, np.arange(41.0)))
    T = make_transform(exp_so3(np.array([0.004, 0.01, -0.01])), np.array([0.4, -0.2, 0.3]))
    write_tum(tmp_path / "drift" / "trajectory_tum.txt", Trajectory(T @ poses, np.arange(41.0)))
    world = transform_cloud(PointCloud(truth), T, frame="world")
    in_map = transform_cloud(world, T_MAP_WORLD, frame="map")
    write_ply(tmp_path / "drift" / "map" / "cloud.ply", in_map)
    record = json.dumps({"T_map_world": T_MAP_WORLD.tolist()})
    (tmp_path / "drift" / "run.json").write_text(record)
    return tmp_path


def test_a_fit_of_the_paths_undoes_what_both_share_and_clouds_are_coloured_by_their_errors(drifted):
    files, out = (drifted / "drift", drifted / "reference.ply"), drifted / "out"
    assert run_evaluate_map(*files).to_json()["f_score"] < 0.7
    found = run_evaluate_map(*files, align_to=drifted / "poses.txt", out=out).to_json()
    assert (found["f_score"], found["alignment"]) == (1.0, "poses")
    # The written path has twelve decimals; the turn made was 0.84 degrees.
    assert found["path_turned_deg"] == pytest.approx(np.degrees(np.sqrt(2.16e-4)), rel=1e-3)
    assert json.loads((out / "summary.json").read_text()) == found
    for cloud in (read_ply(out / "error.ply"), read_ply(out / "missed.ply")):
        assert len(cloud) == 21000
        # All lie on the truth: the blue end of the scale.
        assert (cloud.rgb[:, 2] > cloud.rgb[:, 0]).all()
        assert cloud.confidence.max() < 0.01


def test_icp_lays_the_cloud_onto_the_reference_and_every_threshold_has_its_figures(drifted):
    files = (drifted / "drift", drifted / "reference.ply")
    found = run_evaluate_map(*files, icp=True, thresholds_m=(0.1, 0.2)).to_json()
    assert found["icp_ratio"] > 0.9
    assert 0.1 < found["icp_moved_m"] < 1.5
    first, second = (one["f_score"] for one in found["by_threshold"])
    assert first <= second
    assert second > 0.99
    assert (found["threshold_m"], found["f_score"]) == (0.1, first)


def test_icp_finds_out_in_which_axes_the_reference_is(drifted):
    folder, reference = drifted / "drift", drifted / "reference.ply"
    assert run_evaluate_map(folder, reference, icp=True).to_json()["reference_frame"] == "camera"
    in_map = transform_cloud(read_ply(reference), T_MAP_WORLD, frame="map")
    write_ply(reference, in_map)
    found = run_evaluate_map(folder, reference, icp=True).to_json()
    assert found["reference_frame"] == "map"
    told = run_evaluate_map(folder, reference, icp=True, frame="map").to_json()
    # Open3D adds up in threads, so its last digits differ from run to run.
    for name in ("f_score", "icp_moved_m", "icp_turned_deg", "median_m"):
        assert found[name] == pytest.approx(told[name], rel=1e-6)
    assert found["f_score"] > 0.99
    far = PointCloud(in_map.xyz + np.float32(1e4))
    write_ply(reference, far)
    with pytest.raises(RegistrationError, match="ICP found no corresponding points"):
        run_evaluate_map(folder, reference, icp=True)


def test_what_stands_above_all_of_the_reference_is_not_judged(drifted):
    cloud = read_ply(drifted / "drift" / "map" / "cloud.ply")
    up = T_MAP_WORLD[:3, :3] @ np.array([0.0, -6.0, 0.0])
    crowns = cloud.xyz[9000:18000] + up.astype(np.float32)
    xyz = np.concatenate([cloud.xyz, crowns])
    write_ply(drifted / "drift" / "map" / "cloud.ply", PointCloud(xyz, frame="map"))
    files = (drifted / "drift", drifted / "reference.ply")
    found = run_evaluate_map(*files, align_to=drifted / "poses.txt").to_json()
    assert found["precision"] < 0.8
    assert found["precision_in_reach"] == 1.0
    assert found["beyond_reach"] == pytest.approx(9000 / len(xyz), abs=1e-3)


def test_what_cannot_be_aligned_is_reported(drifted):
    reference, poses = drifted / "reference.ply", drifted / "poses.txt"
    with pytest.raises(EvaluationError, match="has no path to align"):
        run_evaluate_map(reference, reference, align_to=poses)
    with pytest.raises(SettingsError, match="needs a reference in the axes of the poses"):
        run_evaluate_map(drifted / "drift", reference, frame="map", align_to=poses)
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join(lines[:30]) + "\n")
    with pytest.raises(EvaluationError, match="got 30 poses, expected 41"):
        run_evaluate_map(drifted / "drift", reference, align_to=poses)
    with pytest.raises(SettingsError, match="no threshold"):
        run_evaluate_map(reference, reference, thresholds_m=())
    rows = np.loadtxt(lines)
    rows[:, 3::4] *= 1000.0
    np.savetxt(poses, rows)
    with pytest.raises(EvaluationError, match="differ by more than drift and noise explain"):
        run_evaluate_map(drifted / "drift", reference, align_to=poses)


RULES = TrajectoryRules()


@pytest.fixture
def folder(tmp_path):
    """A bend of 120 poses as truth.txt (KITTI) and truth_tum.txt, every second one as half.txt."""
    step = make_transform(exp_so3(np.array([0.0, 0.02, 0.0])), np.array([0.0, 0.0, 1.0]))
    poses = np.stack([np.linalg.matrix_power(step, n) for n in range(120)])
    path = Trajectory(poses, 0.1 * np.arange(120) + 5)
    write_kitti_poses(tmp_path / "truth.txt", path)
    write_tum(tmp_path / "truth_tum.txt", path)
    half = Trajectory(poses[::2], path.timestamps_s[::2] + 0.003)
    write_tum(tmp_path / "half.txt", half)
    write_kitti_poses(tmp_path / "half_kitti.txt", half)
    (tmp_path / "times.txt").write_text("".join(f"{t}\n" for t in half.timestamps_s))
    return tmp_path


def test_paths_are_compared_by_time_where_both_have_times_else_in_order(folder):
    found = run_evaluate_trajectory(folder / "half.txt", folder / "truth_tum.txt", RULES).to_json()
    assert found["associated"] == "by time"
    assert (found["frames"], found["estimate_poses"], found["true_poses"]) == (60, 60, 120)
    assert found["ate_m"] < 1e-6
    assert found["warnings"] == []
    files, times = (folder / "half_kitti.txt", folder / "truth_tum.txt"), folder / "times.txt"
    assert run_evaluate_trajectory(*files, RULES, times=times).to_json()["frames"] == 60
    found = run_evaluate_trajectory(folder / "truth_tum.txt", folder / "truth.txt", RULES).to_json()
    assert (found["associated"], found["frames"]) == ("in order", 120)
    assert found["ate_m"] < 1e-6
    with pytest.raises(EvaluationError, match=r"got 60 poses, expected 120 poses\); without times"):
        run_evaluate_trajectory(folder / "half_kitti.txt", folder / "truth.txt", RULES)
    times = 5 + 0.2 * np.arange(60) + np.where(np.arange(60) < 20, 0.003, 0.05)
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 2, 3] = np.arange(60)
    write_tum(folder / "drifting.txt", Trajectory(poses, times))
    files = (folder / "half.txt", folder / "drifting.txt")
    found = run_evaluate_trajectory(*files, RULES, tolerance_s=0.01).to_json()
    assert found["warnings"] == ["a partner in time for only 20 of 60 poses; see --tolerance"]


def test_the_alignment_is_given_as_a_transform_with_the_offset_of_survey_coordinates(folder):
    turn = exp_so3(np.array([0.3, -0.2, 1.1]))
    T_survey_world = make_transform(turn, np.array([567_890.123, 5_432_109.876, 210.5]))
    path = read_trajectory(folder / "truth_tum.txt")
    poses = path.T_world_camera.copy()
    poses[:, :3, 3] *= 2
    write_tum(folder / "survey.txt", Trajectory(T_survey_world @ poses, path.timestamps_s))
    rules = TrajectoryRules(alignment="sim3")
    files = (folder / "half.txt", folder / "survey.txt")
    found = run_evaluate_trajectory(*files, rules).to_json()
    assert found["scale"] == pytest.approx(2, abs=1e-9)
    # Doubles of 5e6 m are 1e-9 m apart; means and products of a few of them stay below 1e-6 m.
    np.testing.assert_allclose(found["T_truth_estimate"], T_survey_world, rtol=0, atol=1e-6)


def test_a_folder_gets_report_figures_and_aligned_paths(folder):
    out = folder / "out"
    found = run_evaluate_trajectory(
        folder / "half.txt", folder / "truth_tum.txt", RULES, out=out
    ).to_json()
    figures = {"path", "error_along_path", "translation_by_length", "rotation_by_length"}
    assert {path.name for path in out.iterdir()} == {f"{name}.png" for name in figures} | {
        "estimate_aligned_tum.txt", "truth_tum.txt", "report.html", "run.json", "summary.json",
    }  # fmt: skip
    assert json.loads((out / "summary.json").read_text()) == found
    page = (out / "report.html").read_text()
    assert "half.txt against truth_tum.txt" in page
    assert page.count("<img") == 4
    files, rules = (out / "estimate_aligned_tum.txt", out / "truth_tum.txt"), TrajectoryRules
    again = run_evaluate_trajectory(*files, rules(alignment="none")).to_json()
    assert again["ate_m"] == pytest.approx(found["ate_m"], abs=1e-9)


def test_a_report_can_say_of_every_alignment_what_it_did():
    alignments = get_args(TrajectoryRules.model_fields["alignment"].annotation)
    assert set(alignments) == set(ALIGNED)
