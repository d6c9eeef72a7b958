"""What people and programs see of a batch while it runs."""

from __future__ import annotations

import io
import json

from rich.console import Console

from recon.cli.show.jobs import JobEvents, JobLines, NoJobs, choose_job_viewer
from recon.run.batch.figures import JobResult
from recon.run.batch.work import JobStep
from tests.run.batch.jobs import job

CLUSTER = {"event": "cluster", "workers": 2, "dashboard": "http://127.0.0.1:1/status"}


def running(name: str, frames: int | None = None) -> dict[str, object]:
    event: dict[str, object] = {"event": "job", "name": name, "state": "running"}
    return event if frames is None else {**event, "frames": frames, "of": 40}


def ended(name: str, error: str = "") -> JobStep:
    state = "failed" if error else "succeeded"
    return JobStep(JobResult(job(name), state, 1, error, 2.0, "w"), 1, 2)


def test_programs_get_one_object_per_event() -> None:
    out = io.StringIO()
    viewer = JobEvents(out)
    viewer.on_job(CLUSTER)
    viewer.on_start("week", 2, "jobs")
    viewer.on_job(running("a", 7))
    viewer.on_step(ended("a", "no images"))
    viewer.on_finish()
    events = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [event["event"] for event in events] == ["cluster", "start", "job", "job", "finish"]
    assert events[1]["jobs"] == 2
    assert (events[2]["frames"], events[3]["state"]) == (7, "failed")
    assert events[3]["error"] == "no images"


def test_people_see_a_line_for_each_running_job_and_why_one_failed() -> None:
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=100, color_system=None)
    viewer = JobLines(console)
    viewer.on_job(CLUSTER)
    viewer.on_start("week", 2, "jobs")
    viewer.on_job(running("a", 7))
    viewer.on_job(running("b"))
    viewer.on_step(ended("b", "no images"))
    viewer.on_job(running("b"))  # said before it ended
    viewer.on_finish()
    shown = out.getvalue()
    assert "2 workers, dashboard: http://127.0.0.1:1/status" in shown
    assert "b: no images" in shown
    last = shown.rpartition("b: no images")[2]
    assert "7/40" in last
    assert "1/2" in last
    assert "1 failed" in last


def test_nothing_is_shown_where_nobody_looks() -> None:
    assert isinstance(choose_job_viewer(stream=io.StringIO()), NoJobs)
    assert isinstance(choose_job_viewer(quiet=True, verbose=True), NoJobs)
    assert isinstance(choose_job_viewer(verbose=True, stream=io.StringIO()), JobEvents)
