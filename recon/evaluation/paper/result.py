"""The results of the seed paper's experiments: their figures and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recon.core.geometry.projection import depth_from_disparity
from recon.evaluation.paper.methods import (
    MethodResult,
    PatchFigure,
    apply_method,
    compare_depth,
    methods_of,
    try_patches,
)
from recon.evaluation.paper.scenes import Experiment, camera_of_table_1
from recon.evaluation.paper.settings import PaperConfig
from recon.io.images.pfm import write_pfm
from recon.io.models.mlp import write_mlp
from recon.io.models.ply import write_ply
from recon.run.directory import RunDirectory
from recon.run.stopwatch import Stopwatch
from recon.run.summary import plain


@dataclass(frozen=True, eq=False)
class ExperimentResult:
    """Results of one experiment.

    Attributes:
        experiment: Its input.
        methods: One result for each method.
        patches: Method -> one result for each patch size.
        table_1_depth_error_percent: Median depth error caused by Table 1's focal length alone,
            given true disparities; None = no ground truth, or doffs is not positive.
    """

    experiment: Experiment
    methods: tuple[MethodResult, ...]
    patches: dict[str, list[PatchFigure]]
    table_1_depth_error_percent: float | None


@dataclass(frozen=True, eq=False)
class PaperRun:
    """Results of a run, from which its report is made.

    Attributes:
        folder: Folder of the scenes.
        config: The configuration.
        experiments: One result for each experiment.
        summary: The figures of ``summary.json``.
        warnings: Problems that did not stop the run.
    """

    folder: Path
    config: PaperConfig
    experiments: tuple[ExperimentResult, ...]
    summary: dict[str, Any]
    warnings: tuple[str, ...]


def run_experiment(
    experiment: Experiment, config: PaperConfig, threads: int, watch: Stopwatch
) -> ExperimentResult:
    """Apply each method to an experiment, and each with all patch sizes."""
    methods = methods_of(config)
    with watch.stage("methods"):
        results = tuple(apply_method(name, experiment, config, threads) for name in methods)
    with watch.stage("patches"):
        patches = {name: try_patches(name, experiment, config, threads) for name in methods}
    return ExperimentResult(
        experiment=experiment,
        methods=results,
        patches=patches,
        table_1_depth_error_percent=_table_1_depth_error(experiment),
    )


def _table_1_depth_error(experiment: Experiment) -> float | None:
    if experiment.truth is None or experiment.camera.doffs_px <= 0:
        return None
    believed = camera_of_table_1(experiment.camera)
    depth_m = depth_from_disparity(experiment.truth.values, believed)
    figures = compare_depth(depth_m, experiment.truth, experiment.camera)
    return None if figures is None else figures.median_error_percent


def paper_figures(results: Sequence[ExperimentResult], config: PaperConfig) -> dict[str, Any]:
    """Return the figures of ``summary.json``: Table 1, then each experiment."""
    return {
        "as_printed": config.paper.as_printed,
        "table_1": [_table_1_summary(result) for result in results],
        "experiments": {str(r.experiment.number): _experiment_summary(r) for r in results},
    }


def _table_1_summary(result: ExperimentResult) -> dict[str, Any]:
    """Return a row of Table 1 as printed, and the corrected values."""
    experiment, camera = result.experiment, result.experiment.camera
    both = {"baseline_mm": round(1000 * camera.baseline_m, 6), "ndisp": camera.ndisp}
    return {
        "experiment": experiment.number,
        "scene": experiment.scene,
        "printed": {"focal_length": experiment.doffs_px, **both},
        "corrected": {"focal_px": camera.focal_px, "doffs_px": experiment.doffs_px, **both},
        "depth_error_of_printed_percent": result.table_1_depth_error_percent,
    }


def _experiment_summary(result: ExperimentResult) -> dict[str, Any]:
    camera = result.experiment.camera
    patches = {
        name: [asdict(figure) for figure in figures] for name, figures in result.patches.items()
    }
    summary: dict[str, Any] = {
        "scene": result.experiment.scene,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "methods": {one.method: _method_summary(one) for one in result.methods},
        "patches": plain(patches),
    }
    return summary


def _method_summary(result: MethodResult) -> dict[str, Any]:
    depth_m = result.depth_m[np.isfinite(result.depth_m)]
    return {
        "valid_percent": 100.0 * float(result.disparity.valid.mean()),
        "points": len(result.cloud),
        "depth_median_m": float(np.median(depth_m)) if len(depth_m) else None,
        "disparity": plain(result.metrics),
        "depth": plain(result.depth),
    }


def write_experiments(results: Sequence[ExperimentResult], run: RunDirectory) -> None:
    """Write disparity, depth and cloud of each method, and a MeshLab project per experiment."""
    for result in results:
        folder = result.experiment.folder
        layers = {}
        for one in result.methods:
            _write_method(one, f"{folder}/{one.method}", run)
            layers[one.method] = run.path(f"{folder}/{one.method}/cloud.ply")
        write_mlp(run.path(f"{folder}/clouds.mlp"), layers, "camera")


def _write_method(result: MethodResult, folder: str, run: RunDirectory) -> None:
    write_pfm(run.path(f"{folder}/disparity.pfm"), result.disparity.values)
    write_pfm(run.path(f"{folder}/depth.pfm"), result.depth_m)
    write_ply(run.path(f"{folder}/cloud.ply"), result.cloud)
    write_ply(run.path(f"{folder}/cloud_ascii.ply"), result.cloud, ascii=True)
