"""`recon batch`: many commands as jobs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.show.tables import print_batch, print_json

_HELP = "Job file (TOML, YAML), or a command and the sources to run it on."
What = Annotated[list[str] | None, typer.Argument(metavar="JOBS|COMMAND SOURCE...", help=_HELP)]


def batch(
    what: What = None,
    out: opt.Out = None,
    resume: Annotated[
        Path | None, typer.Option(help="Do what is missing of the batch in this folder.")
    ] = None,
    scheduler: opt.Scheduler = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Workers on this machine.", show_default="one per core"),
    ] = None,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Threads of each job.",
            show_default="cores divided by workers; on a scheduler, all cores of the machine",
        ),
    ] = None,
    memory_limit: Annotated[
        str | None,
        typer.Option(help="Memory limit of each job that maps, e.g. 2G.", show_default="none"),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(min=1e-3, help="Longest time of one try, in seconds.", show_default="none"),
    ] = None,
    retries: Annotated[
        int, typer.Option(min=0, help="Tries after one that was killed or late.")
    ] = 2,
    fail_fast: Annotated[
        bool, typer.Option("--fail-fast", help="End the batch with the first job that fails.")
    ] = False,
    option: Annotated[
        list[str] | None,
        typer.Option(help="Word for each command line, e.g. --option=--no-mesh. May be repeated."),
    ] = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    r"""Run many commands, side by side, on this machine or a cluster.

    Each job is a process of its own with a folder of its own below --out. One
    that fails leaves the others alone; one whose worker dies goes on elsewhere.
    The folder gets summary.json, a table and a report with outliers first. The
    exit code is 1 if any job failed. It needs: pip install 'recon\[cluster]'

    Examples:
      recon batch jobs.toml --out outputs/week
      recon batch map drives/* --out outputs/week --option=--no-mesh
      recon batch jobs.toml --scheduler tcp://head:8786 --timeout 7200
      recon batch --resume outputs/week
    """
    if (resume is None) == (not what):
        raise typer.BadParameter("give JOBS, or COMMAND and SOURCES, or --resume FOLDER")
    with one_line_errors(quiet=quiet):
        from recon.cli.program import known_program
        from recon.cli.show.jobs import choose_job_viewer
        from recon.commands.batch import resume_batch, run_batch
        from recon.run.batch.job_file import SUFFIXES, jobs_of_sources, read_jobs
        from recon.run.batch.plan import Limits
        from recon.run.batch.work import BatchOptions

        viewer = choose_job_viewer(quiet=quiet, verbose=verbose)
        options = BatchOptions(out, scheduler, workers, fail_fast, viewer, viewer.on_job)
        first, *sources = what or [""]
        if resume is not None:
            summary = resume_batch(resume, options)
        else:
            listed = Path(first).suffix.lower() in SUFFIXES and not sources
            place = Path(first).parent if listed else Path()
            entries = (
                read_jobs(Path(first), settings=set_ or (), options=option or ())
                if listed
                else jobs_of_sources(first, sources, option or (), set_ or ())
            )
            limits = Limits(threads, memory_limit, timeout, retries)
            summary = run_batch(entries, known_program(), limits, options, place)
    print_json(summary) if json else print_batch(summary)
    if summary["failed"]:
        raise typer.Exit(1)
