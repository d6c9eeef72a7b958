"""What comes back from the jobs of a batch, also of one that is running; what of it is unusual."""

from __future__ import annotations

import json
import math
import os
import statistics
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Final

from recon.core.errors import FormatError, SettingsError
from recon.core.progress import series, stage
from recon.core.summary import Figures, inline, optional
from recon.io.atomic import is_locked
from recon.io.files import read_text, reading, resolved
from recon.run.batch.cluster import BatchOptions, Cluster
from recon.run.batch.job import LOG_S, Job, Outcome, is_done, last_outcome, log_file, progress_of
from recon.run.batch.job_file import PLAN
from recon.run.directory import RECORD, RECORD_BYTES, STARTED, lock_file
from recon.run.run import SUMMARY

ACCURACY: Final = (
    "trajectory.t_rel_percent", "map.f_score", "t_rel_percent", "f_score", "disparity.bad.2.0",
    "bad.2.0", "valid_percent", "points",
)  # fmt: skip
"""What jobs are judged by: of each command the first that its jobs have."""
_LEAST_SPREAD: Final = {
    "t_rel_percent": 0.1, "ate_m": 0.1, "expected_drift_percent": 0.1, "frames_not_trusted": 1.0,
    "valid_percent": -1.0,
}  # fmt: skip
"""What is compared, drift and trust, by the last part of its name: what it differs by at least
from drive to drive; negative where less is worse."""
_DRIFT: Final = ("trajectory.t_rel_percent", "t_rel_percent", "expected_drift_percent")
"""What the drift of a job is: the first of these that it has."""
RUNS: Final = "runs"  # the command of what was run before, in a table of it
_SUMMARY_BYTES: Final = 1 << 26
_LEAST_JOBS: Final = 4  # fewer of one kind have no usual value
#: The spread of a normal distribution from its median absolute deviation.
_SIGMAS: Final = 1.4826
#: Smallest spread, as a fraction of the median.
_LEAST_RATIO: Final = 0.1
_UNUSUAL: Final = 3.5
"""Standard deviations from which a figure is unusual: 0.05 % of normal ones are."""


@dataclass(frozen=True, kw_only=True)
class JobFacts(Figures):
    """How a job ended."""

    name: str
    command: str
    source: str
    state: str
    tries: int
    seconds: float  # of its last try
    worker: str
    bytes: int  # of all files in its folder
    error: str | None = optional()  # why it failed
    swept: Mapping[str, Any] | None = optional()  # its settings of a sweep
    remark: str | None = optional()  # what is unusual about it, and what it was warned of first
    progress: str | None = optional()  # what it does, while it runs
    date: str | None = optional()  # of its drive, the newest of several; UTC


@dataclass(frozen=True, kw_only=True)
class JobSummary(Figures):
    """How a job ended, the numbers of its summary by dotted name, and its warnings."""

    facts: JobFacts = inline()
    figures: Mapping[str, float]
    warnings: Sequence[str]


@dataclass(frozen=True)
class JobResult:
    """A job of a batch that has ended, or was not run; a `Step` of the progress.

    It has the numbers of its summary by dotted name, and their most unusual one of drift or trust.
    """

    job: Job
    last: Outcome = field(default_factory=Outcome)
    figures: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    remark: str = ""
    bytes: int = 0  # of all files in its folder, also where it did not succeed
    progress: str = ""
    date: str = ""

    @property
    def ok(self) -> bool:
        return self.last.state == "succeeded"

    @property
    def failed(self) -> bool:
        """Whether it was run and did not succeed."""
        return self.last.state in ("failed", "broken")

    @property
    def seconds(self) -> float:
        return self.last.seconds

    @property
    def state(self) -> str:
        return self.job.name

    @property
    def event(self) -> dict[str, Any]:
        return {"event": "job", **self.facts.to_json()}

    @property
    def facts(self) -> JobFacts:
        """How it ended."""
        job, last = self.job, self.last
        return JobFacts(
            name=job.name,
            command=job.command,
            source=job.source,
            state="failed" if self.failed else last.state,
            tries=last.tries,
            seconds=last.seconds,
            worker=last.worker,
            bytes=self.bytes,
            error=last.error if self.failed else None,
            swept=dict(job.swept) or None,
            remark=self.remark or None,
            progress=self.progress or None,
            date=self.date or None,
        )

    @property
    def summary(self) -> JobSummary:
        """How it ended, with figures and warnings."""
        return JobSummary(facts=self.facts, figures=self.figures, warnings=self.warnings)


def work_off(
    jobs: Sequence[Job], folder: Path, cluster: Cluster, options: BatchOptions, unit: str = "jobs"
) -> Iterator[JobResult]:
    """Run jobs on workers and show how many are done; yields the result of each that ends."""
    log_file(folder, "").parent.mkdir(parents=True, exist_ok=True)
    stage(f"{len(cluster.workers)} workers, dashboard {cluster.dashboard}")
    with series(folder.name, len(jobs), unit) as shown, _told(jobs, folder):
        for job, outcome in cluster.run(jobs, folder):
            result = result_of(job, outcome, folder)
            shown.on_step(result)
            yield result


@contextmanager
def _told(jobs: Sequence[Job], folder: Path) -> Iterator[None]:
    """Say now and then what jobs are doing."""
    ended = threading.Event()

    def tell() -> None:
        while not ended.wait(LOG_S):
            seen = ((job.name, progress_of(folder, job.name)) for job in jobs)
            if said := "; ".join(f"{name}: {doing}" for name, doing in seen if doing):
                stage(said)

    thread = threading.Thread(target=copy_context().run, args=(tell,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def result_of(job: Job, outcome: Outcome, folder: Path) -> JobResult:
    """Return the result of a job, with the figures of its summary."""
    size, out = 0, Path(os.path.normpath(folder / job.name))
    for place, _, names in os.walk(out):
        for name in names:
            with suppress(OSError):  # others may be writing or removing them
                size += Path(place, name).lstat().st_size
    if outcome.state != "succeeded":
        return JobResult(job, outcome, bytes=size)
    path = out / SUMMARY
    with reading(path):
        summary = json.loads(read_text(path, _SUMMARY_BYTES))
        if not outcome.seconds:  # its worker died before it could say so
            outcome = replace(outcome, seconds=float(summary.get("seconds", 0.0)))
        warnings = tuple(map(str, summary.get("warnings", ())))
        remark = next(iter(warnings), "")
        figures = {**dict(_flat(summary)), "warnings": len(warnings)}
        map_ = out / "map" / STARTED
        if (length_m := figures.get("path_length_m")) and map_.is_file():
            figures.setdefault("map_mb_per_km", map_.stat().st_size / 1e3 / length_m)
        dates = (summary, *summary.get("sessions", ()))
        date = max(_date(one.get("date")) for one in dates)
        return JobResult(job, outcome, figures, warnings, remark, size, date=date)


def _date(text: Any) -> str:
    """Return a date and time as it is written, to the second; "" = it is none."""
    with suppress(ValueError, TypeError):
        datetime.fromisoformat(text[:19])
        return str(text[:19])
    return ""


def runs_by_date(paths: Iterable[Path], folder: Path) -> list[JobResult]:
    """Return finished runs, and those of batches, as jobs that lie beside a folder.

    They are in the order of the dates of their drives; of when they were mapped where these are not
    known.
    """
    found = []
    for path in dict.fromkeys(map(resolved, paths)):
        jobs = sorted(one.parent for one in path.glob(f"*/{RECORD}"))
        for run in jobs if (path / PLAN).is_file() else [path]:
            if not is_done(run):
                raise FormatError("not a finished run", where=run, expected=f"a {SUMMARY}")
            job = Job(os.path.relpath(run, folder), RUNS, str(run), (), writes=True, folder=".")
            one = result_of(job, Outcome("succeeded", tries=1), folder)
            with reading(run / RECORD):
                mapped = json.loads(read_text(run / RECORD, RECORD_BYTES)).get("finished_utc", "")
            mapped = _date(mapped) and f"{_date(mapped)} (mapped)"
            found.append(replace(one, date=one.date or mapped))
    if not found:
        raise SettingsError("there is no run", where="--table", expected="folders of finished runs")
    return sorted(found, key=lambda one: one.date)


def compare(results: Sequence[JobResult]) -> list[JobResult]:
    """Return the results with a remark where drift or trust are much worse than in other jobs.

    Others are those of the same command with the same swept settings. Elsewhere the remark is what
    the job was warned of first.
    """
    groups: dict[str, list[JobResult]] = {}
    for one in results:
        key = json.dumps([one.job.command, dict(one.job.swept)], sort_keys=True, default=str)
        groups.setdefault(key, []).append(one)
    unusual = dict(found for group in groups.values() for found in _remarks(group))
    return [
        replace(one, remark="; ".join(filter(None, (unusual.get(one.job.name), one.remark))))
        for one in results
    ]


def wrong_first(results: Iterable[JobResult]) -> list[JobResult]:
    """Return failed jobs first, then those with the least trust, the most drift, a remark."""
    return sorted(results, key=lambda one: urgency(one.facts, one.figures))


def urgency(facts: JobFacts, figures: Mapping[str, float]) -> tuple[bool, float, float, bool]:
    """Return what `wrong_first` sorts by; jobs that are alike in it keep their order."""
    untrusted = figures.get("frames_not_trusted", 0.0) / max(1.0, figures.get("frames", 1.0))
    drift = next((figures[name] for name in _DRIFT if name in figures), 0.0)
    return facts.state != "failed", -untrusted, -drift, facts.remark is None


def accuracies(figures: Iterable[Mapping[str, float]]) -> list[str]:
    """Return the names in `ACCURACY` of what jobs with these figures are judged by."""
    firsts = {next((name for name in ACCURACY if name in one), "") for one in figures}
    return [name for name in ACCURACY if name in firsts]


def _flat(summary: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, float]]:
    """Yield the finite numbers of a summary by dotted name; those in lists are left out."""
    for key, value in summary.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        elif type(value) in (int, float) and math.isfinite(value):
            yield f"{prefix}{key}", value


def _remarks(group: Sequence[JobResult]) -> Iterator[tuple[str, str]]:
    """Yield the names of jobs with an unusual figure, and which it is."""
    done = [one for one in group if one.figures]
    names = sorted(set.intersection(*(set(one.figures) for one in done))) if done else []
    compared = [name for name in names if name.rpartition(".")[2] in _LEAST_SPREAD]
    if len(done) < _LEAST_JOBS or not compared:
        return
    far: dict[str, list[float]] = {}  # by how many standard deviations worse than their median
    for name in compared:
        values, least = [one.figures[name] for one in done], _LEAST_SPREAD[name.rpartition(".")[2]]
        median = statistics.median(values)
        spread = _SIGMAS * statistics.median(abs(value - median) for value in values)
        spread = math.copysign(max(spread, _LEAST_RATIO * abs(median), abs(least)), least)
        far[name] = [(value - median) / spread for value in values]
    for number, one in enumerate(done):
        most, name = max((far[name][number], name) for name in compared)
        if most >= _UNUSUAL:
            usual = statistics.median(each.figures[name] for each in done)
            yield one.job.name, f"{name} {one.figures[name]:.4g} (usually {usual:.4g})"


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
            doing = progress_of(folder, job.name)
            return replace(result_of(job, last, folder), progress=doing)
        return result_of(job, last, folder)
    except FormatError:
        return JobResult(job, last)
