"""A run is compared in the axes given in its record."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recon.commands.evaluate_map import run_evaluate_map
from recon.core.errors import EvaluationError, FormatError, RegistrationError, SettingsError
from recon.core.geometry.se3 import exp_so3, invert, make_transform, transform_cloud
from recon.core.values import PointCloud, Trajectory
from recon.io.models.ply import read_ply, write_ply
from recon.io.trajectory import write_kitti_poses, write_tum

T_MAP_WORLD = make_transform(exp_so3(np.array([0.3, -1.2, 0.8])), np.zeros(3))


@pytest.fixture
def run(tmp_path: Path) -> Path:
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
def test_a_run_equals_itself_in_either_frame(run: Path, inside: str, frame: str) -> None:
    reference = run.parent / f"in_{frame}.ply"
    figures = run_evaluate_map(run / inside, reference, frame=frame)
    assert figures["f_score"] == 1.0
    assert figures["warnings"] == []
    # Both clouds are thinned on grids that start elsewhere, after a rotation of float32 points.
    assert 0.0 <= figures["p95_m"] < 0.15


@pytest.mark.parametrize(("right", "wrong"), [("map", "camera"), ("camera", "map")])
def test_the_wrong_frame_does_not_fit_and_the_right_one_is_named(
    run: Path, right: str, wrong: str
) -> None:
    figures = run_evaluate_map(run, run.parent / f"in_{right}.ply", frame=wrong)
    assert figures["f_score"] < 0.5
    (doubt,) = figures["warnings"]
    assert f"--reference-frame {right}" in doubt


def test_clouds_that_do_not_meet_are_said_not_to(run: Path) -> None:
    reference = read_ply(run.parent / "in_camera.ply")
    write_ply(run.parent / "far.ply", replace(reference, xyz=reference.xyz + np.float32(50)))
    (doubt,) = run_evaluate_map(run, run.parent / "far.ply")["warnings"]
    assert "hardly meet" in doubt


def test_a_cloud_of_no_run_is_taken_as_it_is(run: Path) -> None:
    reference = run.parent / "in_camera.ply"
    figures = run_evaluate_map(reference, reference, frame="camera")
    assert figures["f_score"] == 1.0


@pytest.mark.parametrize("record", ["{}", "no json", '{"T_map_world": [[1]]}'])
def test_a_broken_record_is_refused(run: Path, record: str) -> None:
    (run / "run.json").write_text(record)
    with pytest.raises(FormatError, match=r"run\.json|T_map_world"):
        run_evaluate_map(run, run.parent / "in_map.ply", frame="camera")


@pytest.fixture
def drifted(tmp_path: Path) -> Path:
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


def test_a_fit_of_the_paths_undoes_what_both_share(drifted: Path) -> None:
    files = (drifted / "drift", drifted / "reference.ply")
    assert run_evaluate_map(*files)["f_score"] < 0.7
    found = run_evaluate_map(*files, align_to=drifted / "poses.txt")
    assert found["f_score"] == 1.0
    assert found["alignment"] == "poses"
    # The written path has twelve decimals; the turn made was 0.84 degrees.
    assert found["path_turned_deg"] == pytest.approx(np.degrees(np.sqrt(2.16e-4)), rel=1e-3)


def test_icp_lays_the_cloud_onto_the_reference(drifted: Path) -> None:
    found = run_evaluate_map(
        drifted / "drift", drifted / "reference.ply", icp=True, thresholds_m=(0.1, 0.2)
    )
    assert found["by_threshold"][1]["f_score"] > 0.99
    assert found["icp_share"] > 0.9
    assert 0.1 < found["icp_moved_m"] < 1.5


def test_icp_finds_out_in_which_axes_the_reference_is(drifted: Path) -> None:
    folder, reference = drifted / "drift", drifted / "reference.ply"
    assert run_evaluate_map(folder, reference, icp=True)["reference_frame"] == "camera"
    in_map = transform_cloud(read_ply(reference), T_MAP_WORLD, frame="map")
    write_ply(reference, in_map)
    found = run_evaluate_map(folder, reference, icp=True)
    assert found["reference_frame"] == "map"
    told = run_evaluate_map(folder, reference, icp=True, frame="map")
    # Open3D adds up in threads, so its last digits differ from run to run.
    for name in ("f_score", "icp_moved_m", "icp_turned_deg", "median_m"):
        assert found[name] == pytest.approx(told[name], rel=1e-6)
    assert found["f_score"] > 0.99
    far = PointCloud(in_map.xyz + np.float32(1e4))
    write_ply(reference, far)
    with pytest.raises(RegistrationError, match="ICP found no corresponding points"):
        run_evaluate_map(folder, reference, icp=True)


def test_poses_in_another_unit_do_not_move_a_map(drifted: Path) -> None:
    rows = np.loadtxt(drifted / "poses.txt")
    rows[:, 3::4] *= 1000.0
    np.savetxt(drifted / "poses.txt", rows)
    with pytest.raises(EvaluationError, match="neither drift nor noise explains"):
        run_evaluate_map(
            drifted / "drift", drifted / "reference.ply", align_to=drifted / "poses.txt"
        )


def test_every_threshold_has_its_figures_and_the_first_stands_on_top(drifted: Path) -> None:
    found = run_evaluate_map(
        drifted / "drift", drifted / "reference.ply", thresholds_m=(0.1, 0.5, 1.0)
    )
    scores = [one["f_score"] for one in found["by_threshold"]]
    assert scores == sorted(scores)
    assert (found["threshold_m"], found["f_score"]) == (0.1, scores[0])


def test_what_stands_above_all_of_the_reference_is_not_judged(drifted: Path) -> None:
    cloud = read_ply(drifted / "drift" / "map" / "cloud.ply")
    up = T_MAP_WORLD[:3, :3] @ np.array([0.0, -6.0, 0.0])
    crowns = cloud.xyz[9000:18000] + up.astype(np.float32)
    xyz = np.concatenate([cloud.xyz, crowns])
    write_ply(drifted / "drift" / "map" / "cloud.ply", PointCloud(xyz, frame="map"))
    found = run_evaluate_map(
        drifted / "drift", drifted / "reference.ply", align_to=drifted / "poses.txt"
    )
    assert found["precision"] < 0.8
    assert found["precision_in_reach"] == 1.0
    assert found["beyond_reach"] == pytest.approx(9000 / len(xyz), abs=1e-3)


def test_clouds_are_coloured_by_their_errors(drifted: Path) -> None:
    files, poses = (drifted / "drift", drifted / "reference.ply"), drifted / "poses.txt"
    found = run_evaluate_map(*files, align_to=poses, out=drifted / "out")
    assert json.loads((drifted / "out" / "summary.json").read_text()) == found
    for name in ("error", "missed"):
        cloud = read_ply(drifted / "out" / f"{name}.ply")
        assert len(cloud) == 21000
        assert cloud.rgb is not None
        # All lie on the truth: the blue end of the scale.
        assert (cloud.rgb[:, 2] > cloud.rgb[:, 0]).all()
        assert cloud.confidence is not None
        assert cloud.confidence.max() < 0.01


def test_what_cannot_be_aligned_is_reported(drifted: Path) -> None:
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
