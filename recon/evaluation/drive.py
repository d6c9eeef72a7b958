"""A mapped drive beside the truth that its source knows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from recon.core.errors import EvaluationError
from recon.core.values import (
    MapMetrics,
    OccupancyGrid,
    OccupancyMetrics,
    SequenceTruth,
    Trajectory,
    TrajectoryMetrics,
)
from recon.evaluation.map import evaluate_map
from recon.evaluation.occupancy_truth import compare_with_source
from recon.evaluation.trajectory import evaluate_trajectory
from recon.map.drive.sequence import MappedSequence
from recon.sources.protocol import StereoSource

SURFACE_THRESHOLD_M: Final = 0.2
"""Distance to the true surface below which a map point counts as correct."""


@dataclass(frozen=True)
class DriveErrors:
    """Errors of a drive; None = the truth is not known, or cannot be compared with.

    Attributes:
        path: Errors against the true path.
        surface: Errors against the true surface.
        occupancy: Errors against the true occupancy.
        warnings: What could not be compared.
    """

    path: TrajectoryMetrics | None
    surface: MapMetrics | None
    occupancy: OccupancyMetrics | None
    warnings: tuple[str, ...]


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
    occupancy = compare_with_source(source, mapped.config, mapped, grid, warnings)
    return DriveErrors(path, surface, occupancy, tuple(warnings))


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
