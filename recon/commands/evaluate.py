"""`recon evaluate`: compare trajectories, maps, disparities and occupancy with the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from recon.commands.config import run_settings
from recon.commands.demo import demo_source
from recon.core.errors import EvaluationError, SettingsError
from recon.core.progress import stage
from recon.core.text import counted
from recon.core.values import (
    Disparity,
    DisparityTruth,
    OccupancyGrid,
    OccupancyMetrics,
    OccupancyTruth,
    Trajectory,
)
from recon.core.values.arrays import Float32
from recon.evaluation.disparity import evaluate_disparity
from recon.evaluation.map import (
    LEAST_FRAMES,
    MapComparison,
    doubt_axes,
    doubts_of_file,
    evaluate_map,
    map_of_run,
    occupancy_view,
    place_by_icp,
    place_cloud,
    possible_frames,
    read_mapped_cloud,
    within_reach_too,
)
from recon.evaluation.middlebury.bench import unrated
from recon.evaluation.middlebury.score import curve_figures, dense_map, named_figures
from recon.evaluation.occupancy import evaluate_occupancy
from recon.evaluation.summary import (
    DisparityEvaluation,
    MapEvaluation,
    OccupancyEvaluation,
    ReferenceFrame,
    TrajectoryEvaluation,
)
from recon.evaluation.trajectory import (
    TOLERANCE_S,
    TrajectoryRules,
    associate,
    compare_paths,
    interpolation_warnings,
)
from recon.io.atomic import check_targets
from recon.io.files import naming
from recon.io.images.disparity import read_disparity, read_pfm
from recon.io.images.image import read_grey_levels, write_image
from recon.io.models.octomap import read_octomap
from recon.io.models.ply import read_ply
from recon.io.models.rasters import read_grid
from recon.io.trajectory import holds_times, read_trajectory, write_tum
from recon.report.map_page import write_map_errors, write_trajectory_page
from recon.report.style import colour_grid_errors
from recon.run.directory import recorded_files
from recon.run.finished import CLOUD, GRID, OCTOMAP, command_of_map
from recon.run.run import Run
from recon.sources.times import read_times


def run_evaluate_trajectory(
    estimate: Path,
    truth: Path,
    rules: TrajectoryRules,
    *,
    times: Path | None = None,
    tolerance_s: float = TOLERANCE_S,
    out: Path | None = None,
) -> TrajectoryEvaluation:
    """Compare two trajectory files: what `recon evaluate trajectory` does.

    Poses are associated by time if both files have timestamps, else in order; the paths are
    aligned as the rules say. With a folder, the aligned paths and a report go there.

    ``times`` has the timestamps of the poses of a KITTI file (s, one per line), ``tolerance_s`` is
    the largest time difference of two associated poses.
    """
    stage("compare")
    ours, true, by_time = _read_paths(estimate, truth, times)
    poses = (len(ours), len(true))
    fewer = min(poses)
    if by_time:
        ours, true = associate(ours, true, tolerance_s)
    comparison = compare_paths(ours, true, rules)
    few = f"a partner in time for only {len(true)} of {counted(fewer, 'pose')}; see --tolerance"
    summary = TrajectoryEvaluation(
        metrics=comparison.metrics,
        T_truth_estimate=comparison.motion.T_to_from,
        rotation_deg=float(np.degrees(np.sqrt((comparison.rotation_errors_rad**2).mean()))),
        roll="fixed" if comparison.roll_axis is None else "not observable on a straight path",
        associated="by time" if by_time else "in order",
        estimate_poses=poses[0],
        true_poses=poses[1],
        warnings=[
            *doubts_of_file(estimate),
            *([few] if 2 * len(true) < fewer else ()),
            *interpolation_warnings(comparison.truth, comparison.segments),
        ],
    )
    if out is None:
        return summary
    with Run("evaluate trajectory", out) as run:
        write_tum(run.path("estimate_aligned_tum.txt"), comparison.estimate)
        write_tum(run.path("truth_tum.txt"), comparison.truth)
        with run.report(summary) as summary:
            names = (estimate.name, truth.name)
            write_trajectory_page(comparison, names, summary.to_json(), run)
        inputs = [path for path in (estimate, truth, times) if path is not None]
        return run.finish(summary, source=str(estimate), inputs=inputs)


def _read_paths(
    estimate: Path, truth: Path, times: Path | None
) -> tuple[Trajectory, Trajectory, bool]:
    """Return estimate and truth, and whether the times of both are known."""
    stamped = [holds_times(path) for path in (estimate, truth)]
    paths = [read_trajectory(path) for path in (estimate, truth)]
    if times is not None:
        for n, path in enumerate(paths):
            if not stamped[n]:
                paths[n] = Trajectory(path.T_world_camera, read_times(times, len(path)))
        stamped = [True, True]
    return paths[0], paths[1], all(stamped)


def run_evaluate_map(
    run: Path,
    reference: Path,
    *,
    frame: ReferenceFrame | None = None,
    align_to: Path | None = None,
    icp: bool = False,
    thresholds_m: Sequence[float] = (0.2,),
    out: Path | None = None,
) -> MapEvaluation:
    """Compare a map with a reference cloud: what `recon evaluate map` does.

    Precision, recall and F-score are those of each threshold; with the path of a run also those of
    the points that the reference could have seen. With a folder, both clouds are coloured by error.

    Args:
        run: A run's folder, or a PLY file. A PLY inside a run's folder is in that run's map axes;
            any other PLY is taken to be in the axes of the reference already.
        reference: A PLY file.
        frame: Axes of the reference: those of the first left camera, or the map's; None = those in
            which ICP finds more, without it the camera's.
        align_to: True poses in the axes of the reference: the path is aligned rigidly to them, and
            its map moves with it.
        icp: Whether the cloud is then aligned to the reference by ICP.
        thresholds_m: Distances below which a point counts as correct: figures are those of the
            first, with those of each in ``by_threshold``.
        out: Result folder; None = nothing is written.
    """
    if not thresholds_m:
        raise SettingsError("there is no threshold", where="--threshold")
    stage("compare")
    mapped, truth = read_mapped_cloud(run), read_ply(reference)
    with naming(f"{run}, {reference}"):
        if icp:
            reach_m, frames = max(thresholds_m), possible_frames(mapped, frame, align_to)
            placed, moved = place_by_icp(mapped, truth, frames, align_to, reach_m)
        else:
            placed, moved = place_cloud(mapped, frame or "camera", align_to)
        truth = replace(truth, frame=placed.cloud.frame)
        found = [evaluate_map(placed.cloud, truth, limit) for limit in thresholds_m]
    by_threshold, beyond_reach = within_reach_too(placed, truth, found)
    aligned = icp or align_to is not None
    doubts = doubt_axes(
        placed, truth, found[0], moved.reference_frame or frame or "camera", aligned=aligned
    )
    summary = MapEvaluation(
        first=by_threshold[0],
        placement=moved,
        beyond_reach=beyond_reach,
        by_threshold=by_threshold,
        warnings=[*placed.doubts, *doubts],
    )
    if out is None:
        return summary
    cloud = run / CLOUD if run.is_dir() else run
    inputs = [path for path in (cloud, reference, align_to) if path is not None]
    with Run("evaluate map", out) as written:
        with written.report(summary) as summary:
            write_map_errors(MapComparison(placed.cloud, truth, tuple(thresholds_m)), written)
        return written.finish(summary, source=str(run), inputs=inputs)


def run_evaluate_disparity(
    estimate: Path,
    truth: Path,
    mask: Path | None = None,
    *,
    scale: float = 1.0,
    confidence: Path | None = None,
) -> DisparityEvaluation:
    """Compare one disparity map file (PFM or 16-bit PNG) with another: `recon evaluate disparity`.

    Args:
        estimate: The map; holes are filled for the dense figures, KITTI's ``d1`` among them.
        truth: Ground truth of the same size.
        mask: An image that is 255 where pixels are compared; None = all with ground truth.
        scale: Pixels of the size that figures are given in per pixel here.
        confidence: PFM of the map's confidence, in [0, 1]; a pixel is correct if its error is at
            most one pixel of the map.
    """
    stage("compare")
    values, true = read_disparity(estimate), read_disparity(truth)
    counted = np.isfinite(true) if mask is None else read_grey_levels(mask) == 255
    if counted.shape != true.shape:
        what, got = "mask and truth differ in size", counted.shape
        raise EvaluationError(what, where=mask, got=got, expected=true.shape)
    known = DisparityTruth(true, counted)
    found = evaluate_disparity(values, known, scale=scale)
    dense = evaluate_disparity(dense_map(values), known, scale=scale)
    rated = None
    if confidence is not None:
        compared = np.where(counted, true, np.float32(np.nan))
        measured = DisparityTruth(compared, np.isfinite(compared))
        rated = curve_figures(_rated(values, confidence), measured, limit_px=1.0)
    return DisparityEvaluation(
        pixels=found.pixels,
        invalid=found.invalid,
        sparse={**named_figures(found), "d1": found.d1},
        dense={**named_figures(dense), "d1": dense.d1},
        confidence=rated,
    )


def _rated(values: Float32, path: Path) -> Disparity:
    confidence, known = read_pfm(path), np.isfinite(values)
    if confidence.shape != values.shape:
        what, got = "confidence and map differ in size", confidence.shape
        raise EvaluationError(what, where=path, got=got, expected=values.shape)
    if not ((confidence[known] >= 0) & (confidence[known] <= 1)).all():
        raise EvaluationError("confidence is not between 0 and 1", where=path)
    return replace(unrated(values), confidence=np.where(known, confidence, np.float32(0)))


@dataclass(frozen=True, eq=False)
class OccupancyComparison:
    """The occupancy of a run, its ground truth in the same cells, and what is not to be trusted."""

    metrics: OccupancyMetrics
    grid: OccupancyGrid
    truth: OccupancyTruth
    doubts: list[str]

    @property
    def summary(self) -> OccupancyEvaluation:
        """What `recon evaluate occupancy` prints."""
        return OccupancyEvaluation(metrics=self.metrics, warnings=self.doubts)


def run_evaluate_occupancy(
    folder: Path, least_frames: int = LEAST_FRAMES, *, image: Path | None = None
) -> OccupancyComparison:
    """Compare ``map/octomap.ot`` and ``map/grid.*`` of a run: `recon evaluate occupancy`.

    ``folder`` is a run of ``recon demo``, or of ``recon occupancy`` on one: the street is rendered
    again, and what its cameras can have known of each cell is the truth, if ``least_frames`` saw
    it. The grid is drawn with its errors in colour into the PNG ``image``.
    """
    if image is not None:
        check_targets([image], (folder / name for name in recorded_files(folder)))
    config, command = run_settings(folder), command_of_map(folder)
    if command != "demo":
        what, got = "the true occupancy of this run is not known", f"a run of recon {command}"
        expected = "a run of recon demo, whose street can be rendered again"
        hint = "recon evaluate map compares a run with a reference cloud"
        raise EvaluationError(what, where=folder, got=got, expected=expected, hint=hint)
    stage("compare")
    source, map_ = demo_source(config), map_of_run(folder)
    voxels, grid = read_octomap(folder / OCTOMAP), read_grid(folder / GRID)
    truth = source.occupancy_truth(**occupancy_view(config, map_.T_map_world, least_frames))
    metrics = evaluate_occupancy(voxels, grid, truth)
    if image is not None:
        write_image(image, colour_grid_errors(grid, truth))
    return OccupancyComparison(metrics, grid, truth, list(map_.doubts))
