"""How a batch stands that another process runs: what its folder says of each job."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from recon.core.errors import FormatError
from recon.io.atomic import is_locked
from recon.run.batch.job import Job, Outcome, last_outcome
from recon.run.batch.job_file import PLAN
from recon.run.batch.results import JobResult, compare, result_of
from recon.run.directory import lock_file


def watch_jobs(
    folder: Path, jobs: Sequence[Job], every_s: float = 1.0
) -> Iterator[list[JobResult]]:
    """Yield how all jobs stand, every second until nobody runs the batch any more.

    Raises:
        FormatError: The folder is removed meanwhile.
    """
    done: dict[str, JobResult] = {}
    running = True
    while running:
        running = is_locked(lock_file(folder))  # before the jobs, whose last state it then is
        if not (folder / PLAN).is_file():
            raise FormatError("the folder of the batch was removed", where=folder)
        seen = [done.get(job.name) or _seen(job, folder, running=running) for job in jobs]
        done.update((one.job.name, one) for one in seen if one.figures)
        yield compare(seen)
        if running:
            time.sleep(every_s)


def _seen(job: Job, folder: Path, *, running: bool) -> JobResult:
    """Return how a job stands; what is half written is as if it were not there yet."""
    last = Outcome()
    try:
        last = last_outcome(folder, job.name)
        # A try that has not ended is written as one that broke.
        if running and last.state == "broken" and not last.seconds:
            last = replace(last, state="running", error="")
        return result_of(job, last, folder)
    except FormatError:
        return JobResult(job, last)
