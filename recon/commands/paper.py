"""`recon paper`: the seed paper's experiments, repeated and corrected."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.evaluation.paper.result import (
    PaperRun,
    paper_figures,
    run_experiment,
    write_experiments,
)
from recon.evaluation.paper.scenes import default_scenes_folder, read_experiments
from recon.report.paper_page import write_paper_page
from recon.run.run import Run


def run_paper(
    folder: Path | None = None,
    config: ReconConfig | None = None,
    *,
    out: Path | None = None,
    threads: int | None = None,
) -> PaperRun:
    """Repeat experiments 2 to 4 of the seed paper: what `recon paper` does.

    Each method is applied to each scene, alone and with all patch sizes, and compared with the
    truth where there is one. Maps, clouds and a report go to the result folder.

    Args:
        folder: Holds the scenes ArtL, Jadeplant and Pipes; None = MiddEval3's trainingQ in the
            folder that ``RECON_DATA`` names.
        config: Settings; ``paper`` selects methods and patch sizes. None = those of `recon paper`.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.

    Raises:
        ReconError: A scene is missing or damaged, or the folder cannot be written; nothing is left
            behind.
    """
    config = config or load_config(defaults=PAIR_DEFAULTS)
    folder = folder or default_scenes_folder()
    experiments = read_experiments(folder)
    with Run("paper", out, config, threads=threads) as run:
        results = tuple(run_experiment(one, config, run.threads, run.watch) for one in experiments)
        with run.stage("write"):
            write_experiments(results, run)
        warnings = tuple(
            f"{one.scene} has no true disparity: nothing is compared with the truth"
            for one in experiments
            if one.truth is None
        )
        summary = {**paper_figures(results, config), "warnings": list(warnings)}
        result = PaperRun(folder, config, results, summary, warnings)
        with run.report(summary):
            write_paper_page(result, run)
        inputs = [path for one in experiments for path in one.files]
        run.finish(summary, source=str(folder), inputs=inputs)
    return result


def headline(summary: dict[str, Any]) -> dict[str, str]:
    """Return one line for each experiment and method, for the command's table."""
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
