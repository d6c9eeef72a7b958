"""`recon evaluate map`: compare a map with a reference cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from recon.core.errors import SettingsError
from recon.evaluation.map import evaluate_map
from recon.evaluation.map_comparison import (
    MapComparison,
    ReferenceFrame,
    add_within_reach,
    doubt_axes,
    place_by_icp,
    place_cloud,
    possible_frames,
    read_mapped_cloud,
)
from recon.io.files import naming
from recon.io.models.ply import read_ply
from recon.report.map_page import write_map_errors
from recon.run.finished import CLOUD
from recon.run.run import Run
from recon.run.summary import plain


def run_evaluate_map(
    run: Path,
    reference: Path,
    *,
    frame: ReferenceFrame | None = None,
    align_to: Path | None = None,
    icp: bool = False,
    thresholds_m: Sequence[float] = (0.2,),
    out: Path | None = None,
) -> dict[str, Any]:
    """Compare a map with a reference cloud: what `recon evaluate map` does.

    The map is brought into the axes of the reference, and aligned if that is asked for. Precision,
    recall and F-score are those of each threshold; with the path of a run also those of the points
    that the reference could have seen. With a folder, both clouds are coloured by their errors.

    Args:
        run: A run's folder, or a PLY file. A PLY inside a run's folder is in that run's map axes;
            any other PLY is taken to be in the axes of the reference already.
        reference: A PLY file.
        frame: Axes of the reference: those of the first left camera, or the map's; None = those in
            which ICP finds more, without it the camera's.
        align_to: Ground-truth poses of the run's cameras, in the axes of the reference; the run's
            path is aligned rigidly to them, and its map moves with it.
        icp: Whether the cloud is then aligned to the reference by ICP.
        thresholds_m: Distances below which a point counts as correct.
        out: Result folder; None = nothing is written.

    Returns:
        The figures of the first threshold, those of each in ``by_threshold``, and how far the
        alignment moved the cloud.
    """
    if not thresholds_m:
        raise SettingsError("there is no threshold", where="--threshold")
    mapped, truth = read_mapped_cloud(run), read_ply(reference)
    with naming(f"{run}, {reference}"):
        if icp:
            reach_m, frames = max(thresholds_m), possible_frames(mapped, frame, align_to)
            placed, moved, frame = place_by_icp(mapped, truth, frames, align_to, reach_m)
        else:
            frame = frame or "camera"
            placed, moved = place_cloud(mapped, frame, align_to)
        truth = replace(truth, frame=placed.cloud.frame)
        by_threshold = [plain(evaluate_map(placed.cloud, truth, limit)) for limit in thresholds_m]
    beyond = add_within_reach(placed, truth, by_threshold)
    aligned = icp or align_to is not None
    doubts = doubt_axes(placed, truth, by_threshold[0], frame, aligned=aligned)
    summary = {
        **by_threshold[0],
        **moved,
        **beyond,
        "by_threshold": by_threshold,
        "warnings": [*placed.doubts, *doubts],
    }
    if out is not None:
        cloud = run / CLOUD if run.is_dir() else run
        inputs = [path for path in (cloud, reference, align_to) if path is not None]
        result = MapComparison(placed.cloud, truth, tuple(thresholds_m), summary)
        with Run("evaluate map", out) as written:
            with written.report(summary):
                write_map_errors(result, written)
            written.finish(summary, source=str(run), inputs=inputs)
    return summary
