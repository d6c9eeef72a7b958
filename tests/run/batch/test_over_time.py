"""What runs are doing, and what became of them from one to the next."""

import csv
import json
import re

import pytest
from typer.testing import CliRunner

from recon.cli import app
from recon.core.errors import ReconError
from recon.core.progress import Progress, showing
from recon.report.batch_page import time_figure
from recon.run.batch import job as jobs
from recon.run.batch import results
from recon.run.batch.job import Outcome, log_file, progress_of
from recon.run.batch.results import compare, runs_by_date
from tests.run.batch.jobs import job

TRY = Outcome("broken", "its worker died", tries=1).line()


@pytest.mark.parametrize(
    ("lines", "shown"),
    [
        ([], ""),
        ([b'{"event": "stage", "name": "read"}\n'], "read"),
        (
            [b'{"event": "stage", "name": "map"}\n', b"progress: frames 3/9, 7.9/s\n"],
            "map, frames 3",
        ),
        ([b'{"event": "start", "name": "a", "frames": 9}\n', b"progress: frames 3/9\n", TRY], ""),
        ([b"progress: frames 3/9\n", b'{"event": "finish"}\n'], ""),
        ([b'{"event": "stage", "name": "a"}\n', b'{"event": "start", "name": "b"}\n'], "a"),
        ([b'{"event": "stage", "na'], ""),
        ([b"progress: frames \xff\n"], "frames"),
    ],
)
def test_what_a_job_does_is_at_the_end_of_its_log(tmp_path, lines, shown):
    assert progress_of(tmp_path, "a") == ""
    log_file(tmp_path, "a").parent.mkdir()
    log_file(tmp_path, "a").write_bytes(TRY + b"x" * 100_000 + b"\n" + b"".join(lines))
    assert progress_of(tmp_path, "a").startswith(shown)
    assert bool(progress_of(tmp_path, "a")) == bool(shown)


def test_a_log_counts_frames_now_and_then(tmp_path, monkeypatch):
    class Log:
        text = b""

        def write(self, line):
            self.text += line

    monkeypatch.setattr(jobs, "LOG_S", 0.0)
    log, frame = Log(), b'{"event": "frame", "index": 5}\n'
    lines = [b'{"event": "start", "name": "x", "frames": 3}\n', frame, frame]
    jobs._listen(iter(lines), log, [""])
    assert re.findall(rb"progress: (.*)", log.text)[0] == b"frames 1/3"
    assert re.search(rb"\nprogress: frames 2/3, [\d.]+/s\n", log.text)


def test_the_batch_says_what_its_jobs_do(tmp_path, monkeypatch):
    said = []

    class Told(Progress):
        def on_stage(self, name):
            said.append(name)

    monkeypatch.setattr(results, "LOG_S", 0.0)
    log_file(tmp_path, "a").parent.mkdir()
    log_file(tmp_path, "a").write_bytes(TRY + b"progress: frames 3/9\n")
    with showing(Told()), results._told([job("a"), job("b")], tmp_path):
        while not said:
            pass
    assert said[0] == "a: frames 3/9"


def run(folder, name, **summary):
    out = folder / name
    (out / "map").mkdir(parents=True)
    (out / "summary.json").write_text(json.dumps({"seconds": 1.0, "warnings": [], **summary}))
    (out / "run.json").write_text(json.dumps({"finished_utc": "2026-11-30T10:00:00+00:00"}))
    return out


@pytest.fixture
def weeks(tmp_path):
    (tmp_path / "weeks").mkdir()
    drift = {"path_length_m": 500.0, "frames_not_trusted": 1}
    for week in (2, 0, 1, 3):
        summary = drift | {"date": f"2026-01-{1 + 7 * week:02d}T10:00:00", "map_mb_per_km": week}
        summary |= {"expected_drift_percent": 9.0 if week == 3 else 0.5}
        run(tmp_path / "weeks", f"w{3 - week}", **summary, warnings=["dark"] * week)
    return [*(tmp_path / "weeks").iterdir()]


def test_runs_are_in_the_order_of_their_dates(weeks, tmp_path):
    (tmp_path / "weeks" / "jobs.json").write_text("{}")
    for given in (weeks, [tmp_path / "weeks"], [*weeks, *weeks]):
        found = runs_by_date(given, tmp_path / "out")
        assert [one.job.name for one in found] == [f"../weeks/w{n}" for n in (3, 2, 1, 0)]
    assert compare(found)[3].remark == "expected_drift_percent 9 (usually 0.5); dark"
    assert time_figure(found)
    assert not time_figure(found[:1])


def test_storage_of_runs_that_do_not_say_it_and_dates_of_several_drives(tmp_path):
    sessions = [{"date": "2026-02-01"}, {"date": "2026-03-01"}, {"date": ""}, {}]
    out = run(tmp_path, "a", path_length_m=500.0, sessions=sessions)
    (out / "map" / "map.recon").write_bytes(b"x" * 1_000_000)
    late = run(tmp_path, "late", path_length_m=0.0)
    one, other = runs_by_date([late, out], tmp_path)
    assert (one.date, one.figures["map_mb_per_km"]) == ("2026-03-01", 2.0)
    assert other.date == "2026-11-30T10:00:00 (mapped)"
    (late / "run.json").write_text('{"finished_utc": "in autumn"}')
    assert runs_by_date([late], tmp_path)[0].date == ""
    assert not time_figure([*runs_by_date([late], tmp_path), one])
    assert "map_mb_per_km" not in other.figures


def test_the_table_of_runs(weeks, tmp_path):
    out = tmp_path / "out"
    words = ["batch", "--table", *map(str, weeks), "--out", str(out), "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["succeeded"] == 4
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert [row["date"][:10] for row in rows] == [f"2026-01-{n:02d}" for n in (1, 8, 15, 22)]
    assert [row["warnings"] for row in rows] == ["0", "1", "2", "3"]
    head, _, first, *_ = (out / "table.md").read_text().splitlines()[1:]
    assert head.startswith("| job | date | remark | state |")
    assert "map_mb_per_km" in head
    assert first.startswith("| ../weeks/w3 | 2026-01-01T10:00:00 |")
    page = (out / "report.html").read_text()
    assert "warnings of 3 jobs are below" in page
    assert 'href="../weeks/w3/summary.json"' in page
    assert page.index("../weeks/w3") < page.index("../weeks/w0")
    assert (out / "time.png").stat().st_size > 1000


def test_a_run_of_1_0_0_which_has_some_figures_under_two_names_is_read(tmp_path):
    twice = {
        "rig": {"epipolar_error_px": 0.1, "rows_px": 0.1},
        "segments": [],
        "drive_sessions": [],
    }
    (one,) = runs_by_date([run(tmp_path, "a", **twice)], tmp_path)
    assert one.figures["rig.epipolar_error_px"] == 0.1


@pytest.mark.parametrize("text", ["[]", "{", '{"sessions": 5}', '{"warnings": 5}'])
def test_what_is_no_run_is_one_line(tmp_path, text):
    with pytest.raises(ReconError, match="there is no run"):
        runs_by_date([], tmp_path)
    with pytest.raises(ReconError, match="not a finished run"):
        runs_by_date([tmp_path], tmp_path)
    out = run(tmp_path, "a")
    (out / "summary.json").write_text(text)
    with pytest.raises(ReconError, match=r"a/summary\.json"):
        runs_by_date([out], tmp_path)


def test_a_table_never_takes_the_place_of_a_run_that_it_is_of(weeks, tmp_path):
    before = {path: path.read_bytes() for path in weeks[0].rglob("*") if path.is_file()}
    words = ["batch", "--table", *map(str, weeks), "--out", str(weeks[0])]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 1
    assert "w0: the results would replace the run; another --out" in " ".join(done.output.split())
    assert before == {path: path.read_bytes() for path in weeks[0].rglob("*") if path.is_file()}
