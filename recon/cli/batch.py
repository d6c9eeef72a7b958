"""`recon batch`: many commands as jobs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from recon.cli import options as opt
from recon.cli.errors import one_line_errors
from recon.cli.tables import print_batch

_HELP = "Job file (TOML, YAML), or a command and the sources to run it on."
What = Annotated[list[str] | None, typer.Argument(metavar="JOBS|COMMAND SOURCE...", help=_HELP)]


def batch(
    what: What = None,
    out: opt.Out = None,
    resume: Annotated[
        Path | None, opt.option("Do what is missing of the batch in this folder.")
    ] = None,
    watch: Annotated[
        Path | None,
        opt.option("Show how the batch in this folder stands, until it ends; from any terminal."),
    ] = None,
    table: Annotated[
        bool, opt.option("Make the tables of finished runs or batches, by date.", "--table")
    ] = False,
    scheduler: opt.Scheduler = None,
    workers: Annotated[
        int | None, opt.option("Workers on this machine.", default="one per core", min=1)
    ] = None,
    threads: Annotated[
        int | None,
        opt.option(
            "Threads of each job.", default="a fraction of the cores; on a scheduler, all", min=1
        ),
    ] = None,
    memory_limit: Annotated[
        str | None, opt.option("Memory limit of each job that maps, e.g. 2G.", default="none")
    ] = None,
    timeout: Annotated[
        float | None, opt.option("Longest time of one try, in seconds.", default="none", min=1e-3)
    ] = None,
    retries: Annotated[int, opt.option("Tries after one that was killed or late.", min=0)] = 2,
    fail_fast: Annotated[
        bool, opt.option("End the batch with the first job that fails.", "--fail-fast")
    ] = False,
    option: Annotated[
        list[str] | None,
        opt.option("Word for each command line, e.g. --option=--no-mesh. May be repeated."),
    ] = None,
    set_: opt.Set = None,
    json: opt.Json = False,
    quiet: opt.Quiet = False,
    verbose: opt.Verbose = False,
) -> None:
    r"""Run many commands, side by side, on this machine or a cluster.

    Each job is a process of its own with a folder of its own below --out. One
    that fails leaves the others alone; one whose worker dies goes on elsewhere.
    The folder gets summary.json, tables and a report, what is wrong first. The
    exit code is 1 if any job failed. It needs the extra cluster:
    pip install 'recon-stereo\[cluster]'

    Examples:
      recon batch jobs.toml --out outputs/week
      recon batch map drives/* --out outputs/week --option=--no-mesh
      recon batch jobs.toml --scheduler tcp://head:8786 --timeout 7200
      recon batch --resume outputs/week
      recon batch --watch outputs/week
      recon batch --table outputs/monday outputs/friday --out outputs/table
    """
    if [bool(what), resume is not None, watch is not None].count(True) != 1:
        one = "JOBS, COMMAND and SOURCES, --table RUNS"
        raise typer.BadParameter(f"give {one}, --resume or --watch FOLDER")
    with one_line_errors(quiet=quiet, verbose=verbose):
        if watch is not None:
            from recon.cli.watch import show_batch

            show_batch(watch)
            return
        from recon.cli.program import plan_jobs
        from recon.commands.batch import run_batch, run_table
        from recon.core.progress import stage

        if table:
            found = run_table([Path(run) for run in what or ()], out)
            print_batch(found, as_json=json, verbose=verbose)
            return
        from recon.run.batch.cluster import BatchOptions
        from recon.run.batch.job_file import SUFFIXES, jobs_of_sources, read_jobs, read_plan

        options = BatchOptions(resume or out, scheduler, workers, fail_fast)
        first, *sources = what or [""]
        if resume is not None:
            listed = read_plan(resume)
        else:
            is_file = Path(first).suffix.lower() in SUFFIXES and not sources
            asked = read_jobs(Path(first)) if is_file else jobs_of_sources(first, sources)
            listed = asked.with_limits(
                set_ or (),
                option or (),
                threads=options.threads_of(threads),
                memory=memory_limit,
                timeout_s=timeout,
                retries=retries,
            )
        stage("check the jobs")
        jobs = plan_jobs(listed)
        summary = run_batch(jobs, options, listed if resume is None else None)
    print_batch(summary, as_json=json, verbose=verbose)
    if summary.failed:
        raise typer.Exit(1)
