"""`recon batch`: many commands as jobs, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from recon.core.errors import ClusterError, OutputError
from recon.core.summary import Rows, RunSummary, shown_path
from recon.core.text import counted
from recon.io.files import resolved
from recon.report.batch_page import write_batch_page
from recon.run.batch.cluster import BatchOptions
from recon.run.batch.job import Job, is_done, last_outcome
from recon.run.batch.job_file import PLAN, JobList
from recon.run.batch.results import (
    JobResult,
    JobSummary,
    compare,
    result_of,
    runs_by_date,
    urgency,
    work_off,
)
from recon.run.directory import default_folder
from recon.run.finished import refuse_as_target
from recon.run.run import Run


def run_batch(
    jobs: Sequence[Job], options: BatchOptions, listed: JobList | None = None
) -> BatchSummary:
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
        with run.report(summary) as summary:
            write_batch_page(results, summary.to_json(), run)
        return run.finish(summary, source=f"{len(jobs)} jobs", inputs=[folder / PLAN])


def run_table(runs: Sequence[Path], out: Path | None = None) -> BatchSummary:
    """Make the tables and the report of a batch of runs that are there: `recon batch --table`."""
    folder = resolved(out or default_folder("batch"))
    for run_ in runs:
        refuse_as_target(run_, folder)
    results = compare(runs_by_date(runs, folder))
    with Run("batch", folder) as run:
        with run.report(_summary(results, 0, 0.0)) as summary:
            write_batch_page(results, summary.to_json(), run)
        return run.finish(summary, source=counted(len(results), "run"), inputs=())


@dataclass(frozen=True, kw_only=True)
class BatchSummary(RunSummary):
    """How the jobs of a batch ended; its warnings are those of the jobs."""

    jobs: Sequence[JobSummary]
    succeeded: int
    failed: int
    not_run: int
    bytes: int
    jobs_per_hour: float | None  # of those that were run now; None = none was

    def rows(self) -> Rows:
        left = f", {self.not_run} not run" if self.not_run else ""
        ended = f"{self.succeeded} succeeded, {self.failed} failed{left}"
        rate = () if self.jobs_per_hour is None else (f"{self.jobs_per_hour:.0f} jobs in an hour",)
        first = min(self.jobs, key=lambda one: urgency(one.facts, one.figures), default=None)
        rows: Rows = [
            (f"{counted(len(self.jobs), 'job')}: {ended}",),
            *self.folder_row(),
            ("tables", "table.csv, table.md, table.tex", f"{self.bytes / 1e9:.3g} GB in all"),
        ]
        if first is not None and first.facts.remark is not None:
            rows.append(("look at", first.facts.name, first.facts.remark))
        resume = f"recon batch --resume {shown_path(self.out or '')}"
        done = not (self.failed or self.not_run)
        return [*rows, *self.cost_row(*rate), ("next", self.open_report() if done else resume)]


def _summary(results: Sequence[JobResult], run_now: int, seconds: float) -> BatchSummary:
    return BatchSummary(
        jobs=[one.summary for one in results],
        succeeded=sum(one.ok for one in results),
        failed=sum(one.failed for one in results),
        not_run=sum(not one.ok and not one.failed for one in results),
        bytes=sum(one.bytes for one in results),
        jobs_per_hour=3600.0 * run_now / seconds if run_now else None,
        warnings=[f"{one.job.name}: {text}" for one in results for text in one.warnings],
    )


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
