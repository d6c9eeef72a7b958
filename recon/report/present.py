"""Writes the report and the colour pictures of a run into its folder."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from recon.commands.config import dump_config
from recon.commands.map import MapRun
from recon.commands.paper import PaperRun
from recon.io.atomic import write_text
from recon.io.images.image import write_image
from recon.report.colour import colour_confidence, colour_disparity, colour_reasons
from recon.report.html import render_html
from recon.report.map_report import MapReportInputs, map_report
from recon.report.pair_report import PairReportInputs, pair_report
from recon.report.paper_report import paper_report
from recon.run.directory import RunDirectory
from recon.run.machine import versions
from recon.stereo.pair_run import PairRun


def present_map(run: MapRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of a drive.

    Raises:
        OutputError: The file cannot be written.
    """
    mapped = run.mapped
    content = map_report(
        MapReportInputs(
            source=_short(run.name),
            trajectory=mapped.trajectory,
            T_map_world=mapped.T_map_world,
            samples=[(mapped.sample.pair, mapped.sample.disparity)],
            health=mapped.health,
            truth=None if run.truth is None else run.truth.trajectory,
            metrics=run.metrics,
            grid=run.grid,
            cloud=run.cloud,
            mesh=run.mesh,
            summary=run.summary,
            loops=mapped.loops,
            command=command_line(),
            config=dump_config(run.config, "map"),
            warnings=run.warnings,
            versions=versions(),
        )
    )
    write_text(directory.path("report.html"), render_html(content))


def present_pair(run: PairRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of a pair, and its disparity and reasons in colour.

    Raises:
        OutputError: A file cannot be written.
    """
    present_disparity(run, directory)
    content = pair_report(
        PairReportInputs(
            source=_short(run.name),
            pair=run.pair,
            disparity=run.disparity,
            truth=run.truth,
            metrics=run.metrics,
            cloud=run.cloud,
            mesh=run.mesh,
            summary=run.summary,
            command=command_line(),
            config=dump_config(run.config, "pair"),
            warnings=run.warnings,
            versions=versions(),
        )
    )
    write_text(directory.path("report.html"), render_html(content))


def present_disparity(run: PairRun, directory: RunDirectory) -> None:
    """Write disparity, confidence and reasons of a pair as colour images.

    Raises:
        OutputError: A file cannot be written.
    """
    pictures = {
        "disparity_colour.png": colour_disparity(run.disparity.values),
        "confidence_colour.png": colour_confidence(run.disparity.confidence),
        "reason_colour.png": colour_reasons(run.disparity.reason),
    }
    for name, picture in pictures.items():
        write_image(directory.path(f"disparity/{name}"), picture)


def present_paper(run: PaperRun, directory: RunDirectory) -> None:
    """Write ``report.html`` of the seed paper's experiments, and each disparity in colour.

    Raises:
        OutputError: A file cannot be written.
    """
    for result in run.experiments:
        for one in result.methods:
            path = directory.path(f"{result.experiment.folder}/{one.method}/disparity_colour.png")
            write_image(path, colour_disparity(one.disparity.values))
    write_text(directory.path("report.html"), render_html(paper_report(run, command_line())))


def command_line() -> str:
    """The command line of this process, or "" if it is not one of recon."""
    program = Path(sys.argv[0] if sys.argv else "")
    started = program.name in {"recon", "recon.exe"} or program.parts[-2:] == (
        "recon",
        "__main__.py",
    )
    return shlex.join(["recon", *sys.argv[1:]]) if started else ""


def _short(name: str) -> str:
    """The last part of a path; any other name unchanged."""
    return Path(name).name or name
