"""Absolute and relative errors are those of evo (GPL-3, in development only)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.core.geometry.se3 import exp_so3, make_transform, quaternion_from_rotation
from recon.core.values import Trajectory
from recon.evaluation.trajectory import (
    TrajectoryRules,
    align,
    associate,
    compare_paths,
    evaluate_trajectory,
)

pytest.importorskip("evo", reason="evo needs Python 3.11")


def drive(frames: int, seed: int) -> tuple[Trajectory, Trajectory]:
    """A winding path, and an estimate of another start and scale that drifts and shakes."""
    rng = np.random.default_rng(seed)
    truth, estimate = np.eye(4), make_transform(exp_so3(np.array([0.2, -0.7, 0.4])), np.ones(3))
    paths: tuple[list[np.ndarray], list[np.ndarray]] = ([truth], [estimate])
    for n in range(frames - 1):
        turn = np.array([0.01 * np.sin(n / 9), 0.03 * np.cos(n / 25), 0.004])
        step = np.array([0.02, 0.01, 0.9])
        truth = truth @ make_transform(exp_so3(turn), step)
        shaken = exp_so3(turn + rng.normal(0, 2e-3, 3))
        estimate = estimate @ make_transform(shaken, 1.07 * step + rng.normal(0, 0.02, 3))
        paths[0].append(truth)
        paths[1].append(estimate)
    times = 0.1 * np.arange(frames)
    return Trajectory(np.stack(paths[1]), times), Trajectory(np.stack(paths[0]), times)


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
def test_ate_and_rpe_agree_with_evo(alignment: str, rpe_frames: int) -> None:
    from evo.core.metrics import APE, RPE, PoseRelation, Unit

    estimate, truth = drive(300, seed=3)
    found = evaluate_trajectory(
        estimate, truth, TrajectoryRules(alignment=alignment, rpe_frames=rpe_frames)
    )
    reference, moved = of_evo(truth), of_evo(estimate)
    if alignment == "origin":
        moved.align_origin(reference)
    elif alignment != "none":
        rotation, translation, scale = moved.align(reference, correct_scale=alignment == "sim3")
        motion = align(estimate, truth, alignment)
        assert motion.scale == pytest.approx(scale, rel=1e-9)
        np.testing.assert_allclose(motion.T_to_from[:3, :3], rotation, atol=1e-9)
        np.testing.assert_allclose(motion.T_to_from[:3, 3], translation, atol=1e-6)
    pair = (reference, moved)
    absolute = evo_statistics(pair, APE(PoseRelation.translation_part))
    steps = {
        relation: evo_statistics(pair, RPE(relation, rpe_frames, Unit.frames, all_pairs=True))
        for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_deg)
    }
    # Both are float64; evo goes by quaternions, which cost it some digits.
    ours = (found.ate_m, found.ate_median_m, found.ate_max_m)
    assert ours == pytest.approx([absolute[name] for name in ("rmse", "median", "max")], rel=1e-7)
    assert found.rpe_m == pytest.approx(steps[PoseRelation.translation_part]["rmse"], rel=1e-7)
    assert found.rpe_deg == pytest.approx(steps[PoseRelation.rotation_angle_deg]["rmse"], rel=1e-6)


def test_association_agrees_with_evo() -> None:
    from evo.core import sync

    estimate, truth = drive(300, seed=7)
    rng = np.random.default_rng(0)
    kept = np.flatnonzero(rng.random(300) < 0.6)
    jitter = rng.uniform(-0.012, 0.012, len(kept))
    sparse = Trajectory(estimate.T_world_camera[kept], estimate.timestamps_s[kept] + jitter)
    ours = associate(sparse, truth, 0.01)
    theirs = sync.associate_trajectories(of_evo(sparse), of_evo(truth), max_diff=0.01)
    np.testing.assert_array_equal(ours[0].timestamps_s, theirs[0].timestamps)
    np.testing.assert_array_equal(ours[1].timestamps_s, theirs[1].timestamps)
    assert 0 < len(ours[0]) < len(kept)


def test_segments_agree_with_evo_where_its_rules_are_kittis() -> None:
    """Over one length, from every frame, and measured along the true path."""
    from evo.core.metrics import RPE, PoseRelation, Unit

    estimate, truth = drive(400, seed=9)
    found = compare_paths(estimate, truth, TrajectoryRules(lengths_m=(100.0,), step_frames=1))
    metric = RPE(PoseRelation.translation_part, 100.0, Unit.meters, 0.01, True, True)
    mean_m = evo_statistics((of_evo(truth), of_evo(estimate)), metric)["mean"]
    # evo ends at the frame nearest to 100 m, KITTI at the first beyond: steps are 0.9 m.
    assert found.metrics.t_rel_percent == pytest.approx(mean_m, rel=0.01)
