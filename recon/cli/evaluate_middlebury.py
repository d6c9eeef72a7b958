"""`recon evaluate middlebury`: compare matchers on benchmark scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_json

_NONE = "none"
Matchers = Annotated[
    str | None,
    typer.Option(
        "--matcher",
        help="Matchers, separated by commas: sad, sgm, opencv-bm, opencv-sgbm, onnx, or those of "
        "installed plug-ins; none for --results alone.",
        show_default="matching.matcher, sad unless changed",
    ),
]


def middlebury(
    folder: Annotated[
        Path,
        typer.Argument(
            help="A Middlebury scene, or a folder with scenes of any year at any depth."
        ),
    ],
    matcher: Matchers = None,
    results: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder with results of another program: SCENE.pfm or SCENE/disp0*.pfm, for a "
            "column of its own. May be repeated."
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Folder with the same scenes at another size, for those without ground truth."
        ),
    ] = None,
    parallel: Annotated[
        int, typer.Option(min=1, help="Scenes to process at once. Above 1, the times mean nothing.")
    ] = 1,
    range_: Annotated[
        Literal["scene", "auto"],
        typer.Option(
            "--range",
            help="Disparity range: published with the scene (before 2014: from its ground "
            "truth), or estimated from each pair.",
        ),
    ] = "scene",
    out: opt.Out = None,
    config: opt.Config = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    latex: Annotated[
        bool, typer.Option("--latex", help="Print the tables in LaTeX, the best value in bold.")
    ] = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
    threads: opt.Threads = None,
) -> None:
    """Score matchers on Middlebury scenes with the measures of the benchmark.

    Several matchers, separated by commas, are compared in one run, and with
    --results those of other programs beside them.

    Examples:
      recon evaluate middlebury MiddEval3/trainingQ --matcher sad,sgm,opencv-sgbm
      recon evaluate middlebury MiddEval3/trainingH --truth MiddEval3/trainingQ
      recon evaluate middlebury MiddEval3/trainingQ --results results/mine --latex
    """
    if json and latex:
        raise typer.BadParameter("--json and --latex exclude each other")
    with one_line_errors(quiet=quiet):
        from recon.cli.show.progress import choose_viewer
        from recon.commands.config import load_config
        from recon.commands.evaluate_middlebury import run_middlebury
        from recon.report.middlebury_page import middlebury_tables
        from recon.report.table import Table, join

        summary = run_middlebury(
            folder,
            load_config(config, set_ or ()),
            matchers=_names(matcher),
            results=results or (),
            truth=truth,
            out=out,
            threads=threads,
            parallel=parallel,
            auto_range=range_ == "auto",
            progress=choose_viewer(quiet=quiet, verbose=verbose),
        )
        form = Table.latex if latex else Table.text
        tables = join(map(form, middlebury_tables(summary)))
    for warning in summary["warnings"]:
        typer.echo(f"warning: {warning}", err=True)
    if json:
        print_json(summary)
        return
    typer.echo(tables)
    typer.echo(f"results: {summary['out']}", err=latex)


def _names(matcher: str | None) -> list[str] | None:
    """Return the matchers of the option; None = the configured one."""
    if matcher is None:
        return None
    return [] if matcher == _NONE else [name.strip() for name in matcher.split(",")]
