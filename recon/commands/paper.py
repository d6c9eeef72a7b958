"""`recon paper`: the seed paper's experiments, repeated and corrected."""

from __future__ import annotations

from pathlib import Path

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.evaluation.paper import (
    CORRECTED,
    TITLES,
    Experiment,
    ExperimentFigures,
    MethodResult,
    PaperSummary,
    apply_method,
    read_experiments,
    table_1_row,
    try_patches,
)
from recon.io.images.disparity import write_pfm
from recon.io.images.image import write_image
from recon.io.models.mesh import write_mlp
from recon.io.models.ply import write_ply
from recon.report.paper_page import write_paper_page
from recon.report.style import colour_disparity
from recon.run.run import Run


def run_paper(
    folder: Path | None = None,
    config: ReconConfig | None = None,
    *,
    out: Path | None = None,
    threads: int | None = None,
    as_printed: bool = False,
) -> PaperSummary:
    """Repeat experiments 2 to 4 of the seed paper: what `recon paper` does.

    Each method is applied to each scene, alone and with all patch sizes, and compared with the
    truth where there is one. Maps, clouds and a report go to the result folder.

    ``folder`` holds the scenes ArtL, Jadeplant and Pipes; None = MiddEval3's trainingQ in the
    folder that ``RECON_DATA`` names. ``as_printed`` adds the method as the paper has it.
    """
    config = config or load_config(defaults=PAIR_DEFAULTS)
    experiments = read_experiments(folder)
    methods = tuple(TITLES) if as_printed else (CORRECTED,)
    source = experiments[0].files[0].parents[1]
    with Run("paper", out, config, threads=threads) as run:
        figures, done = {}, []
        for one in experiments:
            with run.stage("methods"):
                results = [apply_method(name, one, config, run.threads) for name in methods]
            with run.stage("patches"):
                tried = {name: try_patches(name, one, config, run.threads) for name in methods}
            with run.stage("write"):
                _write_experiment(one, results, run)
            done.append((one, results))
            figures[str(one.number)] = ExperimentFigures(
                scene=one.scene,
                width_px=one.camera.width_px,
                height_px=one.camera.height_px,
                methods={result.method: result.figures for result in results},
                patches=tried,
            )
        summary = PaperSummary(
            as_printed=as_printed,
            table_1=[table_1_row(one) for one in experiments],
            experiments=figures,
            warnings=[
                f"{one.scene} has no true disparity: nothing is compared with the truth"
                for one in experiments
                if one.truth is None
            ],
        )
        with run.report(summary) as summary:
            write_paper_page(source, done, summary.to_json(), run)
        inputs = [file for one in experiments for file in one.files]
        return run.finish(summary, source=str(source), inputs=inputs)


def _write_experiment(one: Experiment, results: list[MethodResult], run: Run) -> None:
    """Write disparity, depth and cloud of each method, and a MeshLab project."""
    experiment = f"experiment_{one.number}_{one.scene}"
    for result in results:
        folder = f"{experiment}/{result.method}"
        write_pfm(run.path(f"{folder}/disparity.pfm"), result.disparity.values)
        colours = colour_disparity(result.disparity.values)
        write_image(run.path(f"{folder}/disparity_colour.png"), colours)
        write_pfm(run.path(f"{folder}/depth.pfm"), result.depth_m)
        write_ply(run.path(f"{folder}/cloud.ply"), result.cloud)
        write_ply(run.path(f"{folder}/cloud_ascii.ply"), result.cloud, ascii=True)
    layers = {each.method: run.path(f"{experiment}/{each.method}/cloud.ply") for each in results}
    write_mlp(run.path(f"{experiment}/clouds.mlp"), layers, "camera")
