"""The pipeline behind `recon paper`: the seed paper's experiments, repeated and corrected."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recon.commands.config import ReconConfig, dump_config
from recon.core.geometry.triangulation import depth_from_disparity
from recon.evaluation.paper.methods import (
    MethodResult,
    PatchFigure,
    apply_method,
    compare_depth,
    methods_of,
    try_patches,
)
from recon.evaluation.paper.scenes import (
    Experiment,
    camera_of_table_1,
    read_experiments,
)
from recon.io.atomic import write_text
from recon.io.images.pfm import write_pfm
from recon.io.models.mlp import write_mlp
from recon.io.models.ply import write_ply
from recon.run.directory import RunDirectory
from recon.run.machine import use_threads
from recon.run.record import fingerprint, write_record
from recon.run.stopwatch import Stopwatch
from recon.run.summary import cost, plain


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
    config: ReconConfig
    experiments: tuple[ExperimentResult, ...]
    summary: dict[str, Any]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class PaperOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        present: Writes figures and the report into the result folder.
    """

    out: Path | None = None
    threads: int | None = None
    present: Callable[[PaperRun, RunDirectory], None] | None = None


def run_paper(folder: Path, config: ReconConfig, options: PaperOptions) -> PaperRun:
    """Repeat experiments 2 to 4 of the seed paper and write the results.

    Args:
        folder: Holds the scenes ArtL, Jadeplant and Pipes, such as MiddEval3's trainingQ.
        config: Settings; ``paper`` selects methods and patch sizes.
        options: Result folder, threads and report.

    Raises:
        ReconError: A scene is missing or damaged, or the folder cannot be written; nothing is left
            behind.
    """
    start = time.perf_counter()
    threads, watch = use_threads(options.threads), Stopwatch()
    experiments = read_experiments(folder)
    with RunDirectory.for_command("paper", options.out) as directory:
        results = tuple(_run_experiment(one, config, threads, watch) for one in experiments)
        run = PaperRun(folder, config, results, _summary(results, config), _warnings(results))
        with watch.stage("write"):
            _write(run, directory)
        run.summary.update(cost(watch, time.perf_counter() - start))
        if options.present is not None:
            with watch.stage("report"):
                options.present(run, directory)
        run.summary["warnings"] = list(run.warnings)
        run.summary.update(cost(watch, time.perf_counter() - start))
        run.summary["out"] = str(directory.folder)
        directory.write_json("summary.json", run.summary)
        record = {
            "source": str(folder),
            "inputs": fingerprint(path for one in experiments for path in one.files),
            "timings": watch.seconds,
            "peak_memory_mb": run.summary["peak_memory_mb"],
            "warnings": list(run.warnings),
        }
        write_record(directory, "paper", record)
    return run


def headline(summary: dict[str, Any]) -> dict[str, str]:
    """One line for each experiment and method, for the command's table."""
    lines = {}
    for number, experiment in summary["experiments"].items():
        for method, figures in experiment["methods"].items():
            name = f"{number} {experiment['scene']}, {method}"
            lines[name] = _headline(figures)
    return lines


def _headline(figures: dict[str, Any]) -> str:
    parts = [f"{figures['valid_percent']:.1f} % of the pixels have a value"]
    if figures["disparity"] is not None:
        parts.append(f"{figures['disparity']['bad']['1.0']:.1f} % off by more than 1 px")
    if figures["depth"] is not None:
        parts.append(f"median depth error {figures['depth']['median_error_percent']:.2f} %")
    return ", ".join(parts)


def _run_experiment(
    experiment: Experiment, config: ReconConfig, threads: int, watch: Stopwatch
) -> ExperimentResult:
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


def _summary(results: tuple[ExperimentResult, ...], config: ReconConfig) -> dict[str, Any]:
    return {
        "as_printed": config.paper.as_printed,
        "table_1": [_table_1_summary(result) for result in results],
        "experiments": {str(r.experiment.number): _experiment_summary(r) for r in results},
    }


def _table_1_summary(result: ExperimentResult) -> dict[str, Any]:
    """A row of Table 1 as printed, and the corrected values."""
    row = result.experiment.table_1
    return {
        "experiment": row.experiment,
        "scene": row.scene,
        "printed": {
            "focal_length": row.doffs_px,
            "baseline_mm": row.baseline_mm,
            "ndisp": row.ndisp,
        },
        "corrected": {
            "focal_px": row.focal_px,
            "doffs_px": row.doffs_px,
            "baseline_mm": row.baseline_mm,
            "ndisp": row.ndisp,
        },
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


def _warnings(results: tuple[ExperimentResult, ...]) -> tuple[str, ...]:
    return tuple(
        f"{result.experiment.scene} has no true disparity: nothing is compared with the truth"
        for result in results
        if result.experiment.truth is None
    )


def _write(run: PaperRun, directory: RunDirectory) -> None:
    write_text(directory.path("config.yaml"), dump_config(run.config, "paper"))
    for result in run.experiments:
        folder = result.experiment.folder
        layers = {}
        for one in result.methods:
            _write_method(one, f"{folder}/{one.method}", directory)
            layers[one.method] = directory.path(f"{folder}/{one.method}/cloud.ply")
        write_mlp(directory.path(f"{folder}/clouds.mlp"), layers, "camera")


def _write_method(result: MethodResult, folder: str, directory: RunDirectory) -> None:
    write_pfm(directory.path(f"{folder}/disparity.pfm"), result.disparity.values)
    write_pfm(directory.path(f"{folder}/depth.pfm"), result.depth_m)
    write_ply(directory.path(f"{folder}/cloud.ply"), result.cloud)
    write_ply(directory.path(f"{folder}/cloud_ascii.ply"), result.cloud, ascii=True)
