"""`recon batch`: many commands as jobs, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from recon.core.errors import ClusterError, OutputError
from recon.io.files import resolved
from recon.report.batch_page import write_batch_page
from recon.run.batch.cluster import BatchOptions
from recon.run.batch.job import Job, is_done, last_outcome
from recon.run.batch.job_file import PLAN, JobList
from recon.run.batch.results import JobResult, compare, result_of, work_off
from recon.run.directory import default_folder
from recon.run.run import Run


def run_batch(
    jobs: Sequence[Job], options: BatchOptions, listed: JobList | None = None
) -> dict[str, Any]:
    """Run many commands, all checked: what `recon batch` does; returns the summary.

    Each job is a process of its own on its worker and writes a folder of its own, all or nothing;
    a job that fails leaves the others alone, and one that breaks is tried again and goes on where
    it was. What the jobs come from is kept, so that the batch can be resumed; None = it is resumed:
    jobs without a result are run, also those that had failed, and the summary is that of all.
    """
    folder = resolved(options.out or default_folder("batch"))
    if listed is not None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        begun = "--resume goes on with it" if (folder / PLAN).is_file() else "choose another --out"
        raise OutputError("output folder is not empty", where=folder, hint=begun)
    with _hint(folder), Run("batch", folder, resume=True) as run:
        done = [job for job in jobs if is_done(folder / job.name)]
        ended = {job.name: result_of(job, last_outcome(folder, job.name), folder) for job in done}
        missing = [job for job in jobs if job.name not in ended]
        with run.stage("jobs"):
            if missing:
                with options.connect() as cluster:
                    if listed is not None:
                        listed.write(folder)
                    for result in work_off(missing, folder, cluster, options):
                        ended[result.job.name] = result
                        if options.fail_fast and result.failed:
                            break
        results = compare([ended.get(job.name) or JobResult(job) for job in jobs])
        summary = _summary(results, len(ended) - len(done), run.watch.seconds["jobs"])
        with run.report(summary):
            write_batch_page(results, summary, run)
        run.finish(summary, source=f"{len(jobs)} jobs", inputs=[folder / PLAN])
    return summary


def _summary(results: Sequence[JobResult], run_now: int, seconds: float) -> dict[str, Any]:
    return {
        "jobs": [
            {**one.facts, "figures": dict(one.figures), "warnings": list(one.warnings)}
            for one in results
        ],
        "succeeded": sum(one.ok for one in results),
        "failed": sum(one.failed for one in results),
        "not_run": sum(not one.ok and not one.failed for one in results),
        "bytes": sum(one.bytes for one in results),
        "jobs_per_hour": 3600.0 * run_now / seconds if run_now else None,
        "warnings": [f"{one.job.name}: {text}" for one in results for text in one.warnings],
    }


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
        raise error.copy_with(hint=hint) from error
