"""Tables of evaluations and batches agree with their figures; a batch's plot and report."""

import csv
import io
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from recon.report import style
from recon.report.batch_page import batch_tables, sweep_figure, write_batch_page
from recon.report.middlebury_page import csv_table, middlebury_tables
from recon.report.sections import Table, join, known
from recon.run.batch.job import Outcome
from recon.run.batch.results import JobResult, compare
from recon.run.directory import RunDirectory
from tests.run.batch.jobs import job


def masked(error: float | None, *, depth: bool) -> dict[str, Any]:
    one: dict[str, Any] = dict.fromkeys(("avgerr", "rms", "a50", "a90", "a95", "a99"), error)
    one["bad"] = {"0.5": 40.0, "1": 30.0, "2": 20.0, "4": 10.0}
    if depth:
        names = ("mean_m", "median_m", "rms_m", "median_percent", "over_5_percent", "infinite")
        one["depth"] = dict.fromkeys(names, 0.5)
    return {"dense": one, "sparse": one, "invalid": 12.5}


def summary(error: float | None = 3.25, *, depth: bool = True) -> dict[str, Any]:
    """Two scenes and two matchers, of which only the first has a confidence."""
    figures = {mask: masked(error, depth=depth) for mask in ("nonocc", "all")}
    scenes = {name: {**figures, "seconds": 0.5} for name in ("Piano", "Teddy")}
    weighted = {**figures, "seconds": 0.5}
    found = {"scenes": scenes, "weighted": weighted}
    rated = dict.fromkeys(("ece", "ause", "within_1_sigma", "within_2_sigma"), 0.125)
    sure = {name: {**one, "confidence": rated} for name, one in scenes.items()}
    sad = {"scenes": sure, "weighted": {**weighted, "confidence": rated}}
    return {"matchers": {"sad": sad, "opencv-bm": found}, "mean_over": list(scenes)}


def tables(found: dict[str, Any], form: Callable[[Table], str] = Table.text) -> dict[str, list]:
    parts = join(map(form, middlebury_tables(found))).strip("\n").split("\n\n")
    return {
        title.lstrip("#% ").partition(" (bad")[0]: lines
        for title, *lines in map(str.splitlines, parts)
    }


def csv_rows(found: dict[str, Any]) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(csv_table(found))))


def test_a_table_has_a_row_per_matcher_and_the_csv_every_scene_mask_and_filling():
    first = tables(summary())["Weighted mean, nonocc, dense"]
    assert " ".join(first[1].split()[:8]) == "sad 40.00 30.00 20.00 10.00 12.50 3.25 3.25"
    assert (first[0].split()[-1], first[1].split()[-1]) == ("seconds", "0.500")
    assert len({line[-4:] for line in first[1:]}) == 1
    for lines in tables(summary(), Table.markdown).values():
        assert len({line.count("|") for line in lines}) == 1
    rows = csv_rows(summary())
    assert len(rows) == 2 * 3 * 4
    first = [rows[0][name] for name in ("scene", "depth_median_m", "bad0.5")]
    assert first == ["Piano", "0.5", "40"]
    counted = [(row["matcher"], row["mask"], row["holes"]) for row in rows if row["ece"]]
    assert counted == 3 * [("sad", "all", "sparse")]


def test_what_is_not_known_is_a_dash_and_means_over_some_scenes_say_so():
    found = tables(summary())
    rows = found["Confidence, weighted mean, all, sparse"]
    assert rows[1].split() == ["sad", "0.125", "0.125", "0.125", "0.125"]
    assert rows[2].split() == ["opencv-bm", "–", "–", "–", "–"]
    assert found["ece of each scene"][1].split() == ["Piano", "0.125", "–"]
    given = summary(None, depth=False)
    assert "–" in tables(given)["Weighted mean, nonocc, dense"][1]
    assert csv_rows(given)[0]["avgerr"] == csv_rows(given)[0]["depth_mean_m"] == ""
    given = summary() | {"mean_over": ["Piano"]}
    del given["matchers"]["opencv-bm"]["scenes"]["Teddy"]
    found = tables(given)
    assert "Weighted mean of 1 of 2 scenes, nonocc, dense" in found
    assert found["seconds of each scene, matching alone"][2].split() == ["Teddy", "0.500", "–"]


def test_what_rounds_to_nothing_has_no_sign():
    assert [known("{:.3f}", one) for one in (-0.0004, 0.0004, -0.0006)] == [
        "0.000",
        "0.000",
        "-0.001",
    ]
    assert [known("{:.0%}", -0.001), known("{:.1f} m", -0.04)] == ["0%", "0.0 m"]
    assert known("{:.3f}", None, "-") == "-"


def test_the_best_of_several_is_bold_in_latex_whose_signs_are_escaped():
    given = summary()
    given["matchers"]["sad"]["weighted"]["seconds"] = 0.25
    better = masked(2.5, depth=True)
    given["matchers"]["opencv-bm"]["scenes"]["Teddy"] = {"nonocc": better, "seconds": 0.125}
    found = tables(given, Table.latex)
    begin, *_, sad, other, _, end = found["Weighted mean, nonocc, dense"]
    assert (begin, end) == (r"\begin{tabular}{lrrrrrrrrrrrrr}", r"\end{tabular}")
    assert sad.endswith(r"\textbf{0.250} \\")
    assert other.endswith(r" & 0.500 \\")
    # Equal values are all the best.
    assert sad.count("textbf") == other.count("textbf") + 1
    errors = found["avgerr (px) of each scene, nonocc, dense"]
    assert errors[5] == r"Teddy & 3.25 & \textbf{2.50} \\"
    assert "textbf" not in "".join(found["Confidence, weighted mean, all, sparse"])
    table = Table("t", ("my_method", "50 %"), [("a&b–c", "{x}~^#$\\")]).latex()
    assert r"my\_method & 50 \% \\" in table
    assert r"a\&b--c & \{x\}\textasciitilde{}\textasciicircum{}\#\$\textbackslash{} \\" in table


DONE = Outcome("succeeded", seconds=10.0, worker="host", tries=1)


def results() -> list[JobResult]:
    def one(n: int, w: int) -> JobResult:
        drift = 0.5 + 0.01 * n + 0.1 * w
        figures = {"frames": 40, "trajectory.t_rel_percent": drift, "seconds": 10.0 + w}
        warned = ("the lens is dirty",) if (n, w) == (0, 9) else ()
        return JobResult(job(f"drive{n}_w={w}", swept={"window": w}), DONE, figures, warned)

    done = [one(n, w) for n in range(5) for w in (9, 11)]
    odd = {"frames": 40, "trajectory.t_rel_percent": 99.0, "seconds": 10.0}
    done[6] = replace(done[6], figures=odd)
    failed = JobResult(job("bad"), Outcome("failed", "<b>no images</b> | none", 1.0, tries=3))
    return compare([*done, failed, JobResult(job("later"))])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("batch") / "out"
    summary = {
        "jobs": [{}] * 12, "succeeded": 10, "failed": 1, "seconds": 60.0, "workers": 2,
        "bytes": 7e8, "jobs_per_hour": 600.0, "warnings": ["drive0_w=9: the lens is dirty"],
    }  # fmt: skip
    (out / "drive3_w=9").mkdir(parents=True)
    (out / "drive3_w=9" / "report.html").touch()
    with RunDirectory(out, resume=True) as directory:
        write_batch_page(results(), summary, directory)
    return out


def test_the_report_shows_outliers_first_and_links_to_the_runs(folder):
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
    assert "warnings of 1 job are below" in page
    assert re.search(r"drive0_<wbr>w=9</th><td>the lens is dirty", page)


def test_the_csv_has_every_figure_and_the_table_for_people_what_any_job_has(folder):
    rows = list(csv.DictReader((folder / "table.csv").open()))
    assert (len(rows), rows[0]["window"]) == (12, "9")
    assert float(rows[6]["trajectory.t_rel_percent"]) == 99.0
    assert rows[10]["error"] == "<b>no images</b> | none"
    lines = [line for line in (folder / "table.md").read_text().splitlines() if line]
    assert "trajectory.t_rel_percent" in lines[1]
    assert "map.f_score" not in lines[1]
    # A bar in an error is no column.
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines if line[0] == "|"}) == 1


def test_a_sweep_is_drawn_with_a_point_per_job_and_medians(folder, monkeypatch):
    assert (folder / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert sweep_figure([JobResult(job("later", swept={"window": 9}))]) == b""
    figures: list[Figure] = []
    monkeypatch.setattr(style, "to_png", lambda figure: figures.append(figure) or b"")
    jobs = [replace(one, figures={"seconds": float(n)}) for n, one in enumerate(results()[:6])]
    sweep_figure([*jobs[:5], replace(jobs[5], figures={"frames": 40})])
    (_, axes) = figures[0].axes
    *points, medians = axes.lines
    assert [list(line.get_ydata()) for line in points] == [[0.0, 2.0, 4.0], [1.0, 3.0]]
    np.testing.assert_array_equal(medians.get_xydata(), [[0, 2], [1, 2]])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["9", "11"]


def test_jobs_of_each_command_have_a_table_and_panels_of_their_own(monkeypatch):
    drawn: list[tuple[str, list[float]]] = []
    monkeypatch.setattr(
        "recon.report.batch_page._draw",
        lambda _, jobs, __, name: drawn.append((name, [one.figures[name] for one in jobs])),
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
