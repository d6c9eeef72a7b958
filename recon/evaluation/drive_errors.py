"""A mapped drive beside the truth that its source knows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from recon.core.errors import EvaluationError
from recon.core.values import (
    MapMetrics,
    OccupancyGrid,
    OccupancyMetrics,
    SequenceTruth,
    Trajectory,
    TrajectoryMetrics,
)
from recon.core.values.arrays import Float64
from recon.evaluation.map import evaluate_map
from recon.evaluation.occupancy import evaluate_occupancy
from recon.evaluation.trajectory import evaluate_trajectory
from recon.map.drive.sequence import MappedSequence
from recon.map.ground.grid import drop_undecided
from recon.map.settings import DriveSettings
from recon.sources.source import StereoSource

# Distance to the true surface below which a map point counts as correct.
SURFACE_THRESHOLD_M: Final = 0.2
LEAST_FRAMES: Final = 3  # number of frames that must have seen a cell for it to be compared


@dataclass(frozen=True)
class DriveErrors:
    """Errors of a drive; None = the truth is not known, or cannot be compared with."""

    path: TrajectoryMetrics | None  # errors against the true path
    surface: MapMetrics | None  # errors against the true surface
    occupancy: OccupancyMetrics | None  # errors against the true occupancy
    warnings: tuple[str, ...] = ()  # what could not be compared
    true_path: Trajectory | None = None  # to be drawn


def compare_with_truth(
    source: StereoSource, mapped: MappedSequence, grid: OccupancyGrid, *, poses_given: bool
) -> DriveErrors:
    """Compare a drive with the truth that its source knows.

    Args:
        source: The source.
        mapped: The mapped drive.
        grid: Its grid.
        poses_given: Whether its poses were given: they are no estimate, and 0 % drift would
            mislead.
    """
    warnings: list[str] = []
    truth = source.truth
    path = None if poses_given else _compare_paths(mapped.trajectory, truth, warnings)
    surface = _compare_surfaces(mapped, truth, warnings)
    occupancy = _compare_occupancy(source, mapped, grid, warnings)
    true_path = None if truth is None else truth.trajectory
    return DriveErrors(path, surface, occupancy, tuple(warnings), true_path)


def _compare_paths(
    trajectory: Trajectory, truth: SequenceTruth | None, warnings: list[str]
) -> TrajectoryMetrics | None:
    if truth is None or truth.trajectory is None:
        return None
    try:
        return evaluate_trajectory(trajectory, truth.trajectory)
    except EvaluationError as error:
        warnings.append(f"not compared with the true path: {error}")
        return None


def _compare_surfaces(
    mapped: MappedSequence, truth: SequenceTruth | None, warnings: list[str]
) -> MapMetrics | None:
    if truth is None or truth.surface is None:
        return None
    try:
        # Loads the whole cloud, but only where the whole true surface is in memory as well.
        return evaluate_map(mapped.cloud, truth.surface, SURFACE_THRESHOLD_M)
    except EvaluationError as error:
        warnings.append(f"not compared with the true surface: {error}")
        return None


def _compare_occupancy(
    source: StereoSource, mapped: MappedSequence, grid: OccupancyGrid, warnings: list[str]
) -> OccupancyMetrics | None:
    truth = source.occupancy_truth(**occupancy_view(mapped.config, mapped.T_map_world))
    if truth is None:
        return None
    try:
        return evaluate_occupancy(drop_undecided(mapped.voxels, mapped.config.grid), grid, truth)
    except EvaluationError as error:
        warnings.append(f"not compared with the true occupancy: {error}")
        return None


def occupancy_view(
    config: DriveSettings, T_map_world: Float64, least_frames: int = LEAST_FRAMES
) -> dict[str, Any]:
    """Return the cells, axes and height band of a map, for `StereoSource.occupancy_truth`."""
    return {
        "resolution_m": config.occupancy.resolution_m,
        "band_m": (config.grid.min_height_m, config.grid.max_height_m),
        "range_m": config.occupancy.max_range_m,
        "least_frames": least_frames,
        "T_map_world": T_map_world,
    }
