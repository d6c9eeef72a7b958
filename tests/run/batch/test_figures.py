"""What is unusual stands out."""

from __future__ import annotations

from pathlib import Path

import pytest

from recon.core.errors import FormatError
from recon.run.batch.figures import JobResult, compare, flat, outliers_first, result_of
from recon.run.batch.job import Outcome
from tests.run.batch.jobs import job


def result(name: str, **figures: float) -> JobResult:
    return JobResult(job(name), "succeeded", 1, "", 1.0, "w", figures)


def test_only_finite_numbers_of_a_summary_are_figures() -> None:
    summary = {"a": 1, "b": {"c": 2.5, "d": None, "e": "x"}, "f": True, "g": [1], "h": float("inf")}
    assert dict(flat(summary)) == {"a": 1, "b.c": 2.5}


def test_the_job_with_the_unusual_figure_comes_after_the_failed_ones() -> None:
    drift = [0.50, 0.55, 0.45, 0.52, 5.0, 0.48]
    results = [result(f"j{n}", t_rel_percent=value, frames=n) for n, value in enumerate(drift)]
    failed = JobResult(job("bad"), "failed", 1, "no images", 1.0, "w")
    ranked = outliers_first(compare([*results, failed]))
    assert [one.job.name for one in ranked[:2]] == ["bad", "j4"]
    assert ranked[1].remark == "t_rel_percent 5 (usually 0.51)"
    assert [one.remark for one in ranked[2:]] == [""] * 5


def test_jobs_of_other_commands_or_settings_are_not_compared() -> None:
    results = [
        JobResult(job(f"j{n}", swept={"w": w}), "succeeded", 1, "", 1.0, "w", {"ate_m": 10.0**w})
        for n, w in enumerate([0, 0, 0, 0, 1, 1, 1, 1])
    ]
    assert [one.unusual for one in compare(results)] == [0.0] * 8


def test_of_drives_that_differ_in_length_alone_none_is_unusual() -> None:
    results = [result(f"j{n}", frames=10.0**n, points=7.0**n, ate_m=0.1) for n in range(11)]
    assert [one.remark for one in compare(results)] == [""] * 11


def test_too_few_jobs_have_no_usual_value() -> None:
    assert [one.remark for one in compare([result("a", ate_m=1), result("b", ate_m=9)])] == ["", ""]


def test_a_summary_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "summary.json").write_text("{")
    with pytest.raises(FormatError, match=r"summary\.json"):
        result_of(job("a"), 1, Outcome("succeeded"), tmp_path)
