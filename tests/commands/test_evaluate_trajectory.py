"""Trajectory files are compared by time if they have timestamps, with a report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from recon.commands.evaluate_trajectory import run_evaluate_trajectory
from recon.core.errors import EvaluationError, FormatError, SourceError
from recon.core.geometry.se3 import exp_so3, make_transform
from recon.core.values import Trajectory
from recon.evaluation.trajectory import TrajectoryRules
from recon.io.trajectory import read_trajectory, write_kitti_poses, write_tum
from recon.report.trajectory_page import widest_axes

RULES = TrajectoryRules()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
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


def test_files_with_times_are_compared_by_time(folder: Path) -> None:
    files = (folder / "half.txt", folder / "truth_tum.txt")
    found = run_evaluate_trajectory(*files, RULES)
    assert found["associated"] == "by time"
    assert (found["frames"], found["estimate_poses"], found["true_poses"]) == (60, 60, 120)
    assert found["ate_m"] < 1e-6
    assert found["warnings"] == []


def test_a_kitti_file_gets_its_times_from_a_file(folder: Path) -> None:
    files = (folder / "half_kitti.txt", folder / "truth_tum.txt")
    found = run_evaluate_trajectory(*files, RULES, times=folder / "times.txt")
    assert found["frames"] == 60


def test_kitti_and_tum_are_compared_in_order(folder: Path) -> None:
    files = (folder / "truth_tum.txt", folder / "truth.txt")
    found = run_evaluate_trajectory(*files, RULES)
    assert (found["associated"], found["frames"]) == ("in order", 120)
    assert found["ate_m"] < 1e-6


def test_the_alignment_is_given_as_a_transform_with_the_offset_of_survey_coordinates(
    folder: Path,
) -> None:
    turn = exp_so3(np.array([0.3, -0.2, 1.1]))
    T_survey_world = make_transform(turn, np.array([567_890.123, 5_432_109.876, 210.5]))
    path = read_trajectory(folder / "truth_tum.txt")
    poses = path.T_world_camera.copy()
    poses[:, :3, 3] *= 2
    write_tum(folder / "survey.txt", Trajectory(T_survey_world @ poses, path.timestamps_s))
    rules = TrajectoryRules(alignment="sim3")
    files = (folder / "half.txt", folder / "survey.txt")
    found = run_evaluate_trajectory(*files, rules)
    assert found["scale"] == pytest.approx(2, abs=1e-9)
    # Doubles of 5e6 m are 1e-9 m apart; means and products of a few of them stay below 1e-6 m.
    np.testing.assert_allclose(found["T_truth_estimate"], T_survey_world, rtol=0, atol=1e-6)


def test_without_times_the_numbers_of_poses_must_agree(folder: Path) -> None:
    with pytest.raises(EvaluationError, match=r"got 60 poses, expected 120 poses\); without times"):
        run_evaluate_trajectory(folder / "half_kitti.txt", folder / "truth.txt", RULES)


def test_few_partners_are_warned_of(folder: Path) -> None:
    files = (folder / "half.txt", folder / "drifting.txt")
    times = 5 + 0.2 * np.arange(60) + np.where(np.arange(60) < 20, 0.003, 0.05)
    path = Trajectory(np.tile(np.eye(4), (60, 1, 1)), times)
    poses = path.T_world_camera.copy()
    poses[:, 2, 3] = np.arange(60)
    write_tum(folder / "drifting.txt", Trajectory(poses, times))
    found = run_evaluate_trajectory(*files, RULES, tolerance_s=0.01)
    assert found["warnings"] == ["a partner in time for only 20 of 60 poses; see --tolerance"]


def test_a_folder_gets_report_figures_and_aligned_paths(folder: Path) -> None:
    files = (folder / "half.txt", folder / "truth_tum.txt")
    found = run_evaluate_trajectory(*files, RULES, out=folder / "out")
    written = {path.name for path in (folder / "out").iterdir()}
    figures = {"path", "error_along_path", "translation_by_length", "rotation_by_length"}
    assert written == {f"{name}.png" for name in figures} | {
        "estimate_aligned_tum.txt", "truth_tum.txt", "report.html", "run.json", "summary.json",
    }  # fmt: skip
    assert json.loads((folder / "out" / "summary.json").read_text()) == found
    page = (folder / "out" / "report.html").read_text()
    assert "half.txt against truth_tum.txt" in page
    assert page.count("<img") == 4
    assert run_evaluate_trajectory(
        folder / "out" / "estimate_aligned_tum.txt",
        folder / "out/truth_tum.txt",
        TrajectoryRules(alignment="none"),
    )["ate_m"] == pytest.approx(found["ate_m"], abs=1e-9)


def test_what_cannot_be_compared_leaves_no_folder(folder: Path) -> None:
    for estimate, truth, times, kind in (
        ("half.txt", "none.txt", None, FormatError),
        ("truth.txt", "truth_tum.txt", folder / "times.txt", SourceError),
    ):
        files = (folder / estimate, folder / truth)
        with pytest.raises(kind):
            run_evaluate_trajectory(*files, RULES, times=times, out=folder / "out")
        assert not (folder / "out").exists()


def test_a_path_is_drawn_in_the_axes_in_which_it_goes_farthest() -> None:
    rng = np.random.default_rng(0)
    assert widest_axes(rng.normal(0, (9, 1, 30), (50, 3))) == (0, 2)
    assert widest_axes(rng.normal(0, (9, 12, 1), (50, 3))) == (0, 1)
