"""`recon batch`: many commands as jobs, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from recon.commands.config import load_config
from recon.core.errors import ClusterError, OutputError
from recon.io.files import naming
from recon.report.batch_page import write_batch_page
from recon.run.batch.cluster import connect
from recon.run.batch.figures import JobResult, compare, result_of
from recon.run.batch.job import Job, Outcome, is_done
from recon.run.batch.job_file import Entry
from recon.run.batch.plan import PLAN, Limits, Program, plan_jobs, read_plan, write_plan
from recon.run.batch.work import BatchOptions, work_off
from recon.run.directory import default_folder
from recon.run.run import Run

COMMANDS: Final = (
    "map", "localize", "merge", "pair", "disparity", "export", "mesh", "occupancy", "rectify",
    "audit", "demo", "paper", "evaluate trajectory", "evaluate map", "evaluate occupancy",
    "evaluate disparity", "evaluate middlebury",
)  # fmt: skip
"""What a job can be."""


def run_batch(
    entries: Sequence[Entry], program: Program, limits: Limits, options: BatchOptions, place: Path
) -> dict[str, Any]:
    """Run many commands: what `recon batch JOBS` does.

    Every command line is checked first. Each job is a process of its own on its worker and writes
    a folder of its own, whole or not at all; a job that fails leaves the others alone, and one
    that breaks is tried again and goes on where it was.

    Args:
        entries: The jobs.
        program: What jobs can run.
        limits: What holds for jobs that do not say otherwise.
        options: How they are run.
        place: Where relative paths begin.

    Returns:
        The summary: ``jobs`` with the figures of each, ``succeeded``, ``failed`` and more.

    Raises:
        SettingsError: A job is none, or the scheduler cannot be reached.
        OutputError: The folder is not empty or cannot be written.
        MissingDependencyError: Dask is not installed.
        ClusterError: The scheduler or all workers are gone.
    """
    jobs = plan_jobs(entries, program, options.share_cores(limits), place)
    _check_settings(entries)
    folder = (options.out or default_folder("batch")).resolve()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        begun = "--resume goes on with it" if (folder / PLAN).is_file() else "choose another --out"
        raise OutputError("output folder is not empty", where=folder, hint=begun)
    return _run(jobs, folder, options)


def resume_batch(folder: Path, options: BatchOptions) -> dict[str, Any]:
    """Do what is missing of a batch: what `recon batch --resume` does.

    Jobs without a result are run, also those that had failed; the summary is that of all.

    Raises:
        FormatError: The folder is not one of a batch.
        OutputError: The folder cannot be written, or another batch is writing to it.
        SettingsError: The scheduler cannot be reached.
        ClusterError: The scheduler or all workers are gone.
    """
    folder = folder.resolve()
    return _run(read_plan(folder), folder, options)


def _run(jobs: Sequence[Job], folder: Path, options: BatchOptions) -> dict[str, Any]:
    """Run the jobs that are not done; write table, report and summary of all."""
    with _hint(folder), Run("batch", folder, progress=options.progress, resume=True) as run:
        done = [job for job in jobs if is_done(folder / job.name)]
        ended = {job.name: result_of(job, 0, Outcome("succeeded"), folder) for job in done}
        missing = [job for job in jobs if job.name not in ended]
        with run.stage("jobs"):
            if missing:
                with connect(options.scheduler, options.workers_here) as cluster:
                    write_plan(jobs, folder)
                    ended |= work_off(missing, folder, cluster, options)
        results = compare([ended.get(job.name) or _not_run(job) for job in jobs])
        summary = _summary(results, len(ended) - len(done), run.watch.seconds["jobs"])
        with run.report(summary):
            write_batch_page(results, summary, run)
        run.finish(summary, source=f"{len(jobs)} jobs", inputs=[folder / PLAN])
    return summary


def _summary(results: Sequence[JobResult], run_now: int, seconds: float) -> dict[str, Any]:
    states = [one.state for one in results]
    return {
        "jobs": [one.plain() for one in results],
        "succeeded": states.count("succeeded"),
        "failed": states.count("failed"),
        "not_run": states.count("not run"),
        "jobs_per_hour": 3600.0 * run_now / seconds if run_now else None,
        "warnings": [f"{one.job.name}: {text}" for one in results for text in one.warnings],
    }


def _not_run(job: Job) -> JobResult:
    return JobResult(job, "not run", 0, "", 0.0, "")


@contextmanager
def _hint(folder: Path) -> Iterator[None]:
    """Say how to go on after what ends a batch early."""
    hint = f"recon batch --resume {folder} does what is missing"
    try:
        yield
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt(hint) from interrupt
    except ClusterError as error:
        if not (folder / PLAN).is_file():
            raise
        raise error.but(hint=hint) from error


def _check_settings(entries: Sequence[Entry]) -> None:
    """Refuse settings that no command knows, before any job runs."""
    first = {entry.set: entry.name for entry in reversed(entries)}
    for texts, name in first.items():
        with naming(f"job {name}"):
            load_config(None, texts)
