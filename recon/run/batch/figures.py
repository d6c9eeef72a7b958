"""The figures of a batch: one row for each job, and how unusual each is among jobs of its kind."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from recon.io.files import read_text, reading
from recon.run.batch.job import Job, Outcome
from recon.run.run import SUMMARY

_SUMMARY_BYTES: Final = 1 << 26
_LEAST_JOBS: Final = 4
"""Fewer of one kind have no usual value."""
#: The spread of a normal distribution from its median absolute deviation.
_SIGMAS: Final = 1.4826
#: Smallest spread, as a share of the median: figures that are all equal have none.
_LEAST_SPREAD: Final = 0.01
_UNUSUAL: Final = 3.5
"""Standard deviations from which a figure is unusual: 0.05 % of normal ones are."""
#: Last parts of the names of what is compared: drift and trust. Drives differ in all else.
_COMPARED: Final = (
    "t_rel_percent", "ate_m", "expected_drift_percent", "frames_not_trusted", "valid_percent",
)  # fmt: skip


@dataclass(frozen=True)
class JobResult:
    """A job that has ended for good.

    Attributes:
        job: The job.
        state: ``succeeded`` or ``failed``.
        tries: How often it was begun.
        error: Why it failed; "" if it did not.
        seconds: Time of the last try.
        worker: Where that ran.
        figures: Numbers of its summary by dotted name; none if it failed.
        warnings: Warnings of its summary.
        unusual: How far its most unusual figure is from the others', in standard deviations; 0 =
            none is unusual.
        remark: That figure with its usual value; "" = there is none.
    """

    job: Job
    state: str
    tries: int
    error: str
    seconds: float
    worker: str
    figures: Mapping[str, float] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    unusual: float = 0.0
    remark: str = ""

    def plain(self) -> dict[str, Any]:
        """Return it as the summary of the batch has it."""
        return {
            "name": self.job.name,
            "command": self.job.command,
            "source": self.job.source,
            "state": self.state,
            "tries": self.tries,
            "seconds": self.seconds,
            "worker": self.worker,
            **({"error": self.error} if self.error else {}),
            **({"swept": dict(self.job.swept)} if self.job.swept else {}),
            **({"remark": self.remark} if self.remark else {}),
            "figures": dict(self.figures),
            "warnings": list(self.warnings),
        }


def result_of(job: Job, tries: int, outcome: Outcome, folder: Path) -> JobResult:
    """Return the result of a job, with the figures of its summary.

    Raises:
        FormatError: Its summary cannot be read.
    """
    if outcome.state != "succeeded":
        return JobResult(job, "failed", tries, outcome.error, outcome.seconds, outcome.worker)
    path = folder / job.name / SUMMARY
    with reading(path):
        summary = json.loads(read_text(path, _SUMMARY_BYTES))
        figures = dict(flat(summary))
        warnings = tuple(map(str, summary.get("warnings", ())))
    seconds = outcome.seconds or float(summary.get("seconds", 0.0))
    return JobResult(job, "succeeded", tries, "", seconds, outcome.worker, figures, warnings)


def flat(summary: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, float]]:
    """Yield the finite numbers of a summary by dotted name; those in lists are left out."""
    for key, value in summary.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        elif (
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        ):
            yield f"{prefix}{key}", value


def compare(results: Sequence[JobResult]) -> list[JobResult]:
    """Return the results with a remark on the most unusual figure of each.

    A figure is compared with that of the other jobs of the same command, and with the same swept
    settings, by its distance from their median in (robust) standard deviations.
    """
    groups: dict[str, list[JobResult]] = {}
    for one in results:
        key = json.dumps([one.job.command, dict(one.job.swept)], sort_keys=True, default=str)
        groups.setdefault(key, []).append(one)
    remarks = {name: found for group in groups.values() for name, found in _remarks(group).items()}
    return [
        JobResult(**{**vars(one), "unusual": score, "remark": remark})
        for one in results
        for score, remark in [remarks.get(one.job.name, (0.0, ""))]
    ]


def outliers_first(results: Iterable[JobResult]) -> list[JobResult]:
    """Return failed jobs first, then the most unusual ones."""
    return sorted(results, key=lambda one: (one.state != "failed", -one.unusual, one.job.name))


def _remarks(group: Sequence[JobResult]) -> dict[str, tuple[float, str]]:
    """Return the distance of the most unusual figure and what it is, by the name of the job."""
    done = [one for one in group if one.figures]
    shared = set.intersection(*(set(one.figures) for one in done)) if done else set()
    usual = {
        name: _usual([one.figures[name] for one in done])
        for name in sorted(shared)
        if len(done) >= _LEAST_JOBS and name.rpartition(".")[2] in _COMPARED
    }
    most = {
        one.job.name: max(
            (abs(one.figures[name] - median) / spread, _remark(name, one.figures[name], median))
            for name, (median, spread) in usual.items()
        )
        for one in done
        if usual
    }
    return {name: found for name, found in most.items() if found[0] >= _UNUSUAL}


def _usual(values: Sequence[float]) -> tuple[float, float]:
    """Return median and spread of a figure."""
    median = statistics.median(values)
    spread = _SIGMAS * statistics.median(abs(value - median) for value in values)
    return median, max(spread, _LEAST_SPREAD * abs(median), 1e-12)


def _remark(name: str, value: float, median: float) -> str:
    return f"{name} {value:.4g} (usually {median:.4g})"
