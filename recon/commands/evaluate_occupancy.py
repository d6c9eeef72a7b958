"""`recon evaluate occupancy`: compare the occupancy maps of a run with ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from recon.commands.config import ReconConfig, run_settings
from recon.commands.demo import demo_source
from recon.core.errors import EvaluationError
from recon.core.values import OccupancyGrid, OccupancyMetrics, OccupancyTruth
from recon.evaluation.doubts import doubts_of
from recon.evaluation.drive_errors import LEAST_FRAMES, known_occupancy
from recon.evaluation.occupancy import evaluate_occupancy
from recon.io.atomic import check_targets
from recon.io.images.image import write_image
from recon.io.models.nav2 import read_nav2
from recon.io.models.octomap import read_octomap
from recon.report.style import colour_grid_errors
from recon.run.directory import recorded_files
from recon.run.finished import GRID, OCTOMAP, FinishedRun, open_run
from recon.sources.source import KnowsOccupancy


@dataclass(frozen=True, eq=False)
class OccupancyComparison:
    """The occupancy of a run and its ground truth.

    Attributes:
        metrics: The figures.
        grid: The 2-D grid of the run.
        truth: Ground truth, in the cells of the run.
        doubts: What is not to be trusted in the map of the run.
    """

    metrics: OccupancyMetrics
    grid: OccupancyGrid
    truth: OccupancyTruth
    doubts: list[str]


def run_evaluate_occupancy(
    folder: Path, least_frames: int = LEAST_FRAMES, *, image: Path | None = None
) -> OccupancyComparison:
    """Compare ``map/octomap.ot`` and ``map/grid.*`` of a run: `recon evaluate occupancy`.

    The street is rendered again, and what its cameras can have known of each cell is the truth.

    Args:
        folder: A run of a rendered street: of ``recon demo``, or of ``recon occupancy`` on one.
        least_frames: Number of frames that must have seen a cell for it to be compared.
        image: PNG for the grid with its errors in colour; None = none is drawn.
    """
    if image is not None:
        check_targets([image], (folder / name for name in recorded_files(folder)))
    run, config = open_run(folder), run_settings(folder)
    source = _source_that_knows(run, config)
    voxels, grid = read_octomap(folder / OCTOMAP), read_nav2(folder / GRID)
    truth = known_occupancy(source, config, run.T_map_world, least_frames)
    if image is not None:
        write_image(image, colour_grid_errors(grid, truth))
    metrics = evaluate_occupancy(voxels, grid, truth)
    return OccupancyComparison(metrics, grid, truth, doubts_of(run))


def _source_that_knows(run: FinishedRun, config: ReconConfig) -> KnowsOccupancy:
    if run.mapped_by != "demo":
        raise EvaluationError(
            "the true occupancy of this run is not known",
            where=run.folder,
            got=f"a run of recon {run.mapped_by}",
            expected="a run of recon demo, whose street can be rendered again",
            hint="recon evaluate map compares a run with a reference cloud",
        )
    return demo_source(config)
