from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.core.values import OccupancyGrid, Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.protocol import OdometryHealth
from recon.report.drive_figures import (
    drift_figure,
    grid_figure,
    health_figure,
    nice_length,
    path_figure,
    seen_from_above,
)
from recon.report.page import timing_figure


def is_png(content: bytes) -> bool:
    picture = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    return picture is not None and picture.std() > 1


@pytest.mark.parametrize("with_truth", [True, False])
def test_path_is_drawn_with_and_without_truth(
    with_truth: bool, trajectory: Trajectory, T_map_world: Float64, health: list[OdometryHealth]
) -> None:
    truth = trajectory if with_truth else None
    assert is_png(path_figure(trajectory, truth, T_map_world, health))


def test_the_expected_drift_is_drawn_around_the_path(
    trajectory: Trajectory, T_map_world: Float64
) -> None:
    known = path_figure(trajectory, None, T_map_world, (), 0.1)
    assert is_png(known)
    assert known != path_figure(trajectory, None, T_map_world)


@pytest.mark.parametrize("frames", [0, 1])
def test_path_of_one_frame_or_none_is_drawn(frames: int, T_map_world: Float64) -> None:
    path = Trajectory(np.tile(np.eye(4), (frames, 1, 1)), np.zeros(frames))
    assert is_png(path_figure(path, path, T_map_world))
    assert is_png(drift_figure(path, path))


def test_error_along_the_path_needs_one_true_pose_per_pose(trajectory: Trajectory) -> None:
    shorter = Trajectory(trajectory.T_world_camera[:-1], trajectory.timestamps_s[:-1])
    assert is_png(drift_figure(trajectory, trajectory))
    assert is_png(drift_figure(trajectory, shorter))


def test_grid_is_drawn_with_and_without_path_and_without_any_known_cell(
    grid: OccupancyGrid, trajectory: Trajectory, T_map_world: Float64
) -> None:
    unknown = OccupancyGrid(np.full((4, 5), -1, dtype=np.int8), 0.1, (0.0, 0.0))
    assert is_png(grid_figure(grid, {"path": seen_from_above(trajectory, T_map_world)}))
    assert is_png(grid_figure(grid, {}))
    assert is_png(grid_figure(unknown, {}))


@pytest.mark.parametrize(
    "health", [[], [OdometryHealth()] * 3, [OdometryHealth(ok=False)]], ids=["none", "nan", "lost"]
)
def test_health_that_was_not_measured_is_drawn(health: list[OdometryHealth]) -> None:
    assert is_png(health_figure(health))


def test_health_is_drawn(health: list[OdometryHealth]) -> None:
    assert is_png(health_figure(health))


@pytest.mark.parametrize("stages", [{}, {"match": 0.0}, {"match": 3.2, "mesh": 1.1}])
def test_times_are_drawn(stages: dict[str, float]) -> None:
    assert is_png(timing_figure(stages))


@pytest.mark.parametrize(
    ("target", "length"), [(34.0, 20.0), (0.7, 0.5), (1.0, 1.0), (99.9, 50.0), (5.0, 5.0)]
)
def test_scale_bar_has_a_round_length_that_fits(target: float, length: float) -> None:
    assert nice_length(target) == pytest.approx(length)
