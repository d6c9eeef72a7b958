"""The work of a batch: jobs go to workers, results come back, and both are shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from recon.run.batch.cluster import Cluster
from recon.run.batch.figures import JobResult, result_of
from recon.run.batch.job import Job
from recon.run.batch.plan import Limits
from recon.run.machine import available_cores
from recon.run.progress import SILENT, Progress


@dataclass(frozen=True)
class BatchOptions:
    """How the jobs of a batch are run.

    Attributes:
        out: Folder of the batch; None = a new one below ``outputs/``.
        scheduler: Address of Dask's scheduler; None = workers on this machine.
        workers: How many of these; None = one per core.
        fail_fast: Whether the first job that fails ends the batch.
        progress: Shown each job that ends.
        tell: Told events of running jobs, from another thread.
    """

    out: Path | None = None
    scheduler: str | None = None
    workers: int | None = None
    fail_fast: bool = False
    progress: Progress = SILENT
    tell: Callable[[Mapping[str, Any]], None] = lambda event: None

    @property
    def workers_here(self) -> int:
        """Workers on this machine."""
        return self.workers or available_cores()

    def share_cores(self, limits: Limits) -> Limits:
        """Return limits by which the workers of this machine share its cores, unless given."""
        if limits.threads is not None or self.scheduler is not None:
            return limits
        return replace(limits, threads=max(1, available_cores() // self.workers_here))


@dataclass(frozen=True)
class JobStep:
    """A job that has ended; a `Step` of the progress."""

    result: JobResult
    number: int
    total: int

    @property
    def seconds(self) -> float:
        """Time of the job."""
        return self.result.seconds

    @property
    def ok(self) -> bool:
        """Whether it succeeded."""
        return self.result.state == "succeeded"

    @property
    def event(self) -> Mapping[str, Any]:
        """How it ended; its figures are in the summary."""
        left_out = ("figures", "warnings")
        ended = {key: value for key, value in self.result.plain().items() if key not in left_out}
        return {"event": "job", "number": self.number, "total": self.total, **ended}

    @property
    def state(self) -> str:
        """Its name, and why it failed."""
        return f"{self.result.job.name} {self.result.error}".strip()


def work_off(
    jobs: Sequence[Job], folder: Path, cluster: Cluster, options: BatchOptions
) -> dict[str, JobResult]:
    """Run jobs on workers and show how far they are.

    Args:
        jobs: The jobs.
        folder: Folder of the batch.
        cluster: The workers.
        options: How the batch is run.

    Returns:
        The results by name, of all jobs or up to the first that failed.

    Raises:
        ClusterError: The scheduler is gone.
    """
    progress, ended = options.progress, dict[str, JobResult]()
    workers, dashboard = len(cluster.workers), cluster.dashboard
    options.tell({"event": "cluster", "workers": workers, "dashboard": dashboard})
    progress.on_start(folder.name, len(jobs), "jobs")
    try:
        for one, outcome in cluster.run(jobs, folder, options.tell):
            result = result_of(one.job, one.number + 1, outcome, folder)
            ended[one.job.name] = result
            progress.on_step(JobStep(result, len(ended), len(jobs)))
            if options.fail_fast and result.state == "failed":
                break
    finally:
        progress.on_finish()
    return ended
