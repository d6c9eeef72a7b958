"""What is unusual stands out."""

from dataclasses import replace

import pytest

from recon.core.errors import FormatError
from recon.run.batch.job import Outcome
from recon.run.batch.results import JobResult, accuracies, compare, result_of, wrong_first
from tests.run.batch.jobs import job

DONE = Outcome("succeeded", seconds=1.0, worker="w", tries=1)
TEXT = """{"a": 1, "b": {"c": 2.5, "d": null, "e": "x"}, "f": true, "g": [1], "h": Infinity,
"seconds": 4, "warnings": ["dark"]}"""


def result(name: str, **figures: float) -> JobResult:
    return JobResult(job(name), DONE, figures)


def test_only_finite_numbers_of_a_summary_are_figures(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "summary.json").write_text(TEXT)
    found = result_of(job("a"), replace(DONE, seconds=0.0), tmp_path)
    assert found.figures == {"a": 1, "b.c": 2.5, "seconds": 4, "warnings": 1}
    assert (found.seconds, found.warnings) == (4.0, ("dark",))
    assert found.remark == "dark"  # a job that succeeded, and yet is not to be used as it is
    assert [one.remark for one in compare([found])] == ["dark"]
    assert result_of(job("a"), DONE, tmp_path).seconds == 1.0
    (tmp_path / "a" / "summary.json").write_text("{")
    with pytest.raises(FormatError, match=r"summary\.json"):
        result_of(job("a"), DONE, tmp_path)
    assert result_of(job("a"), Outcome("failed", "why"), tmp_path).figures == {}


def test_the_job_with_the_unusual_figure_comes_after_the_failed_ones():
    drift = [0.50, 0.55, 0.45, 0.52, 5.0, 0.48]
    results = [result(f"j{n}", t_rel_percent=value, frames=n) for n, value in enumerate(drift)]
    failed = JobResult(job("bad"), Outcome("failed", "no images"))
    ranked = wrong_first(compare([*results, failed, JobResult(job("later"))]))
    assert [one.job.name for one in ranked[:2]] == ["bad", "j4"]
    assert ranked[1].remark == "t_rel_percent 5 (usually 0.51)"
    assert [one.remark for one in ranked[2:]] == [""] * 6


@pytest.mark.parametrize(
    ("name", "values", "remarks"),
    [
        ("t_rel_percent", (5.0, 5.1, 4.9, 5.2, 0.1), {}),  # better than usual
        ("valid_percent", (50, 51, 49, 52, 99), {}),
        ("valid_percent", (90, 91, 89, 92, 9), {4: "valid_percent 9 (usually 90)"}),
        ("frames_not_trusted", (*[0] * 6, 1, 2, 1, 3, 2), {}),  # a few among none
        ("frames_not_trusted", (*[0] * 7, 40), {7: "frames_not_trusted 40 (usually 0)"}),
        ("trajectory.ate_m", (1, 1, 1, 9), {3: "trajectory.ate_m 9 (usually 1)"}),
        ("ate_m", (1, 1, 9), {}),  # too few have no usual value
        ("points", [10.0**n for n in range(11)], {}),  # drives differ in length
    ],
)
def test_what_is_much_worse_than_usual_is_remarked(name, values, remarks):
    results = compare([result(f"j{n}", **{name: value}) for n, value in enumerate(values)])
    assert {n: one.remark for n, one in enumerate(results) if one.remark} == remarks


def test_jobs_of_each_command_are_judged_by_their_first_accuracy_and_among_themselves():
    for changes in ("swept", "command"):
        results = [
            JobResult(replace(job(f"j{n}"), **{changes: {"w": w}}), DONE, {"ate_m": 10.0**w})
            for n, w in enumerate([0, 0, 0, 0, 1, 1, 1, 1])
        ]
        assert [one.remark for one in compare(results)] == [""] * 8
    drive = {"trajectory.t_rel_percent": 0.5, "points": 7.0}
    pair = {"disparity.bad.2.0": 9.0, "valid_percent": 80.0, "points": 7.0}
    assert accuracies([pair, drive, {}]) == ["trajectory.t_rel_percent", "disparity.bad.2.0"]
