from __future__ import annotations

import cv2
import numpy as np
import pytest

from recon.core.values import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, Trajectory
from recon.core.values.arrays import Float64
from recon.odometry.protocol import OdometryHealth
from recon.report import drive_figures as figures
from recon.report.page import timing_figure


def is_png(content: bytes) -> bool:
    picture = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_COLOR)
    return picture is not None and picture.std() > 1


def test_path_is_drawn_with_truth_drift_and_frames_that_are_not_trusted_or_without(
    trajectory: Trajectory, T_map_world: Float64, health: list[OdometryHealth]
) -> None:
    lines: list[list[str]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            figures,
            "top_view",
            lambda drawn, *_: lines.append([look["label"] for _, look in drawn]),
        )
        figures.path_figure(trajectory, trajectory, T_map_world, health, 0.1)
        figures.path_figure(trajectory, None, T_map_world)
    assert lines == [
        ["truth", "estimate", "95 % (expected drift)", "not trusted (1)"],
        ["estimate"],
    ]
    known = figures.path_figure(trajectory, trajectory, T_map_world, health, 0.1)
    assert is_png(known)
    assert known != figures.path_figure(trajectory, trajectory, T_map_world, health)


@pytest.mark.parametrize("frames", [0, 1])
def test_path_of_one_frame_or_none_is_drawn(frames: int, T_map_world: Float64) -> None:
    path = Trajectory(np.tile(np.eye(4), (frames, 1, 1)), np.zeros(frames))
    assert is_png(figures.path_figure(path, path, T_map_world))
    assert is_png(figures.drift_figure(path, path))


def test_error_along_the_path_needs_one_true_pose_per_pose(trajectory: Trajectory) -> None:
    shorter = Trajectory(trajectory.T_world_camera[:-1], trajectory.timestamps_s[:-1])
    assert is_png(figures.drift_figure(trajectory, trajectory))
    assert is_png(figures.drift_figure(trajectory, shorter))


def test_grid_is_drawn_with_and_without_path_and_without_any_known_cell(
    grid: OccupancyGrid, trajectory: Trajectory, T_map_world: Float64
) -> None:
    unknown = OccupancyGrid(np.full((4, 5), -1, dtype=np.int8), 0.1, (0.0, 0.0))
    path = figures.seen_from_above(trajectory, T_map_world)
    np.testing.assert_array_equal(path, np.column_stack([np.arange(11), np.zeros(11)]))
    assert is_png(figures.grid_figure(grid, {"path": path}))
    assert is_png(figures.grid_figure(grid, {}))
    assert is_png(figures.grid_figure(unknown, {}))


@pytest.mark.parametrize(
    "health",
    [[], [OdometryHealth()] * 3, [OdometryHealth(ok=False)], [OdometryHealth(9, 8, 0.2, 0.1)] * 5],
)
def test_health_is_drawn_whatever_was_measured(health: list[OdometryHealth]) -> None:
    assert is_png(figures.health_figure(health))


@pytest.mark.parametrize("stages", [{}, {"match": 0.0}, {"match": 3.2, "mesh": 1.1}])
def test_times_are_drawn(stages: dict[str, float]) -> None:
    assert is_png(timing_figure(stages))


@pytest.mark.parametrize(
    ("target", "length"), [(34.0, 20.0), (0.7, 0.5), (1.0, 1.0), (99.9, 50.0), (5.0, 5.0)]
)
def test_scale_bar_has_a_round_length_that_fits(target: float, length: float) -> None:
    assert figures.nice_length(target) == pytest.approx(length)


def test_a_thinned_grid_keeps_its_obstacles_and_its_place() -> None:
    cells = np.full((7, 10), UNKNOWN, np.int8)
    cells[:3] = FREE
    cells[1, 9] = cells[6, 0] = OCCUPIED
    thinned = figures.thin_grid(OccupancyGrid(cells, 0.2, (-3.0, 4.0)), 4)
    assert (thinned.resolution_m, thinned.origin_m) == (pytest.approx(0.6), (-3.0, 4.0))
    expected = [[FREE, FREE, FREE, OCCUPIED], [UNKNOWN] * 4, [OCCUPIED, *[UNKNOWN] * 3]]
    np.testing.assert_array_equal(thinned.cells, expected)
    small = OccupancyGrid(np.zeros((3, 4), np.int8), 0.2, (0.0, 0.0))
    assert figures.thin_grid(small, 4) is small


def test_a_grid_is_cropped_to_its_known_cells_and_a_margin() -> None:
    cells = np.full((60, 50), UNKNOWN, np.int8)
    cells[20, 30] = cells[25, 33] = FREE
    cropped = figures._crop_to_known(OccupancyGrid(cells, 0.5, (1.0, 2.0)))
    assert cropped.cells.shape == (26, 24)
    assert cropped.origin_m == (1.0 + 20 * 0.5, 2.0 + 10 * 0.5)
