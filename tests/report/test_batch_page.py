"""Table, plot and report of a batch."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from recon.report import style
from recon.report.batch_page import batch_tables, sweep_figure, write_batch_page
from recon.run.batch.job import Outcome
from recon.run.batch.results import JobResult, compare
from recon.run.directory import RunDirectory
from tests.run.batch.jobs import job

DONE = Outcome("succeeded", seconds=10.0, worker="host", tries=1)


def results() -> list[JobResult]:
    def one(n: int, w: int) -> JobResult:
        drift = 0.5 + 0.01 * n + 0.1 * w
        figures = {"frames": 40, "trajectory.t_rel_percent": drift, "seconds": 10.0 + w}
        return JobResult(job(f"drive{n}_w={w}", swept={"window": w}), DONE, figures)

    done = [one(n, w) for n in range(5) for w in (9, 11)]
    odd = {"frames": 40, "trajectory.t_rel_percent": 99.0, "seconds": 10.0}
    done[6] = replace(done[6], figures=odd)
    failed = JobResult(job("bad"), Outcome("failed", "<b>no images</b> | none", 1.0, tries=3))
    return compare([*done, failed, JobResult(job("later"))])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("batch") / "out"
    summary = {
        "jobs": [{}] * 12, "succeeded": 10, "failed": 1, "seconds": 60.0, "workers": 2,
        "jobs_per_hour": 600.0, "warnings": ["drive0_w=9: the lens is dirty"],
    }  # fmt: skip
    (out / "drive3_w=9").mkdir(parents=True)
    (out / "drive3_w=9" / "report.html").touch()
    with RunDirectory(out, resume=True) as directory:
        write_batch_page(results(), summary, directory)
    return out


def test_the_report_shows_outliers_first_and_links_to_the_runs(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    rows = re.findall(r'<tr><th scope="row">(.*?)</th>', page)
    names = [re.sub("<[^>]+>", "", row) for row in rows][:3]
    assert names[:2] == ["bad", "drive3_w=9"]
    assert 'href="drive3_w%3D9/report.html"' in page
    assert 'href="drive4_w%3D9/summary.json"' in page
    assert 'href="logs/bad.log"' in page
    assert 'href="later' not in page
    assert "trajectory.t_rel_percent 99 (usually" in page
    assert "&lt;b&gt;no images" in page
    assert "drive0_w=9: the lens is dirty" in page


def test_the_csv_has_every_figure_and_swept_setting(folder: Path) -> None:
    rows = list(csv.DictReader((folder / "table.csv").open()))
    assert len(rows) == 12
    assert rows[0]["window"] == "9"
    assert float(rows[6]["trajectory.t_rel_percent"]) == 99.0
    assert rows[10]["error"] == "<b>no images</b> | none"


def test_the_table_for_people_leaves_out_what_no_job_has_and_keeps_its_columns(
    folder: Path,
) -> None:
    lines = [line for line in (folder / "table.md").read_text().splitlines() if line]
    assert "trajectory.t_rel_percent" in lines[1]
    assert "map.f_score" not in lines[1]
    # A bar in an error is no column.
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines if line[0] == "|"}) == 1


def test_a_sweep_is_drawn_with_a_point_per_job_and_medians(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert np.asarray(Image.open(folder / "sweep.png").convert("L")).std() > 5
    figures: list[Figure] = []
    monkeypatch.setattr(style, "to_png", lambda figure: figures.append(figure) or b"")
    jobs = [replace(one, figures={"seconds": float(n)}) for n, one in enumerate(results()[:6])]
    sweep_figure([*jobs[:5], replace(jobs[5], figures={"frames": 40})])
    (_, axes) = figures[0].axes
    *points, medians = axes.lines
    assert [list(line.get_ydata()) for line in points] == [[0.0, 2.0, 4.0], [1.0, 3.0]]
    np.testing.assert_array_equal(medians.get_xydata(), [[0, 2], [1, 2]])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["9", "11"]


def test_jobs_of_each_command_have_a_table_and_panels_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn: list[tuple[str, list[float]]] = []
    monkeypatch.setattr(
        "recon.report.batch_page._draw",
        lambda axes, jobs, setting, name: drawn.append((name, [one.figures[name] for one in jobs])),
    )
    drive = JobResult(job("drive", swept={"w": 9}), DONE, {"points": 7.0, "seconds": 400.0})
    pair = replace(drive.job, name="pair", command="pair")
    both = [drive, JobResult(pair, DONE, {"valid_percent": 80.0, "seconds": 9.0})]
    sweep_figure(both)
    assert drawn == [
        ("points", [7.0]), ("seconds", [400.0]), ("valid_percent", [80.0]), ("seconds", [9.0]),
    ]  # fmt: skip
    assert [table.title for table in batch_tables(both)] == ["map", "pair"]
    assert "valid_percent" not in batch_tables(both)[0].head
