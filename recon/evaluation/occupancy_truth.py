"""Comparing the occupancy of a run with that of a source that knows the truth."""

from __future__ import annotations

from typing import Final

from recon.core.errors import EvaluationError
from recon.core.values import OccupancyGrid, OccupancyMetrics, OccupancyTruth, OccupancyVoxels
from recon.core.values.arrays import Float64
from recon.evaluation.occupancy import evaluate_occupancy
from recon.map.drive.sequence import MappedSequence
from recon.map.ground.grid import drop_undecided
from recon.map.settings import DriveSettings
from recon.sources.protocol import KnowsOccupancy, StereoSource

LEAST_FRAMES: Final = 3
"""Number of frames that must have seen a cell for it to be compared."""


def compare_with_source(
    source: StereoSource,
    config: DriveSettings,
    mapped: MappedSequence,
    grid: OccupancyGrid,
    warnings: list[str],
) -> OccupancyMetrics | None:
    """Return metrics of a run if its source knows the true occupancy, else None."""
    if not isinstance(source, KnowsOccupancy):
        return None
    truth = known_occupancy(source, config, mapped.T_map_world)
    return compare(drop_undecided(mapped.voxels, config.grid), grid, truth, warnings)


def known_occupancy(
    source: KnowsOccupancy,
    config: DriveSettings,
    T_map_world: Float64,
    least_frames: int = LEAST_FRAMES,
) -> OccupancyTruth:
    """Return True occupancy of a source, in the cells, axes and height band of a map."""
    return source.occupancy_truth(
        resolution_m=config.occupancy.resolution_m,
        band_m=(config.grid.min_height_m, config.grid.max_height_m),
        range_m=config.occupancy.max_range_m,
        least_frames=least_frames,
        T_map_world=T_map_world,
    )


def compare(
    voxels: OccupancyVoxels, grid: OccupancyGrid, truth: OccupancyTruth, warnings: list[str]
) -> OccupancyMetrics | None:
    """Return the metrics, or None and a warning that says why."""
    try:
        return evaluate_occupancy(voxels, grid, truth)
    except EvaluationError as error:
        warnings.append(f"not compared with the true occupancy: {error}")
        return None
