"""A mapped drive beside the truth that its source knows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, TypeVar

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
_Errors = TypeVar("_Errors", TrajectoryMetrics, MapMetrics, OccupancyMetrics)
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
    """Compare a mapped drive and its grid with the truth that its source knows.

    Poses that were given are no estimate, and 0 % drift would mislead: the paths are not compared.
    """
    warnings: list[str] = []

    def attempt(what: str, compare: Callable[[], _Errors]) -> _Errors | None:
        try:
            return compare()
        except EvaluationError as error:
            warnings.append(f"not compared with the true {what}: {error}")
            return None

    truth = source.truth or SequenceTruth()
    true_path, true_surface = truth.trajectory, truth.surface
    path = surface = occupancy = None
    if true_path is not None and not poses_given:
        path = attempt("path", lambda: evaluate_trajectory(mapped.trajectory, true_path))
    if true_surface is not None:
        # Loads the whole cloud, but only where the whole true surface is in memory as well.
        surface = attempt(
            "surface", lambda: evaluate_map(mapped.cloud, true_surface, SURFACE_THRESHOLD_M)
        )
    known = source.occupancy_truth(**occupancy_view(mapped.config, mapped.T_map_world))
    if known is not None:
        voxels = drop_undecided(mapped.voxels)
        occupancy = attempt("occupancy", lambda: evaluate_occupancy(voxels, grid, known))
    return DriveErrors(path, surface, occupancy, tuple(warnings), true_path)


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
