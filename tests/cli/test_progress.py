"""What is shown of a run: a bar on a terminal, JSON lines for programs, a line per source."""

import io
import json
import re
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from recon.cli.progress import JsonLines, ProgressBar, announce, choose_viewer, warn
from recon.core.progress import Counted, Progress, Silent
from recon.evaluation.middlebury.bench import SceneDone
from recon.map.drive.mapper import FrameResult
from recon.map.localize.localizer import Located, State
from recon.map.localize.sequence import LocalizedFrame
from recon.odometry.protocol import OdometryHealth
from recon.run.batch.job import Outcome
from recon.run.batch.results import JobResult
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings
from tests.run.batch.jobs import job


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def frame(index: int, *, ok: bool = True, valid_ratio: float = 0.7) -> FrameResult:
    health = OdometryHealth(ok=ok, inliers=120, notes=("a [bold] note",))
    return FrameResult(index, 3, 0.25, valid_ratio, 900, np.eye(4), health)


def run(viewer: Progress) -> None:
    viewer.on_start("drive [1]", 3)
    for index in range(3):
        viewer.on_step(frame(index, ok=index != 1))
    viewer.on_finish()
    viewer.on_stage("mesh")


def lines(stream: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in stream.getvalue().splitlines()]


def test_every_event_is_one_json_line_with_null_for_nan():
    stream = io.StringIO()
    run(JsonLines(stream))
    JsonLines(stream).on_step(frame(1, ok=False, valid_ratio=float("nan")))
    *events, last = lines(stream)
    names = [event["event"] for event in events]
    assert names == ["start", "frame", "frame", "frame", "finish", "stage"]
    assert (last["index"], last["measured"], last["valid_ratio"]) == (1, False, None)
    assert (last["position_m"], last["notes"]) == ([0.0, 0.0, 0.0], ["a [bold] note"])
    stream = io.StringIO()
    JsonLines(stream).on_step(SceneDone("Piano", {"sad": {"seconds": 0.25}}, 0.5))
    JsonLines(stream).on_step(SceneDone("Pipes", None, 0.5))
    first, second = lines(stream)
    assert first == {"event": "scene", "name": "Piano", "seconds": {"sad": 0.25}}
    assert second["seconds"] == {}


def test_bar_shows_frames_rate_and_lost_poses_and_may_be_finished_twice():
    stream = Terminal()
    run(ProgressBar(Console(file=stream, force_terminal=True, width=140)))
    shown = stream.getvalue()
    assert "3/3" in shown
    assert "4.0 frames/s" in shown  # 0.25 s each
    assert "1 not trusted" in shown
    assert "70 % valid, 120 inliers" in shown
    assert "drive [1]" in shown  # a name is no markup
    assert "mesh" in shown
    viewer = ProgressBar(Console(file=io.StringIO()))
    viewer.on_step(frame(0))
    viewer.on_finish()
    run(viewer)
    viewer.on_finish()


def test_a_terminal_gets_a_bar_and_a_file_json_lines_if_verbose(capsys):
    assert isinstance(choose_viewer(stream=Terminal()), ProgressBar)
    assert isinstance(choose_viewer(stream=io.StringIO(), verbose=True), JsonLines)
    assert isinstance(choose_viewer(stream=io.StringIO()), Silent)
    run(choose_viewer(quiet=True))
    assert capsys.readouterr() == ("", "")
    run(choose_viewer(verbose=True))
    out, err = capsys.readouterr()
    assert out == ""
    assert err


def located(state: State) -> LocalizedFrame:
    tracked = Located(state, np.eye(4), np.eye(6), 2, 120)
    found = tracked if state is State.TRACKING else Located(state, note="no place is recognised")
    return LocalizedFrame(7, 0.0, 0.25, found)


JOB = JobResult(job("night"), Outcome("failed", "no images", 0.25))


@pytest.mark.parametrize("width", [80, 60])
@pytest.mark.parametrize(
    "name", ["kitti06", "2011_09_26_drive_0013_sync, a drive of very long name"]
)
@pytest.mark.parametrize(
    ("steps", "unit", "bad"),
    [
        pytest.param([frame(1), frame(2, ok=False)], "frames", "not trusted", id="map demo live"),
        pytest.param([located(State.TRACKING), located(State.LOST)], "frames", "", id="localize"),
        pytest.param([SceneDone("Motorcycle", None, 0.25)] * 2, "scenes", "", id="middlebury"),
        pytest.param([Counted(0.25), Counted(0.25)], "MB", "", id="datasets"),
        pytest.param([JOB, JOB], "jobs", "2 failed", id="batch"),
        pytest.param([JOB, JOB], "pieces", "2 failed", id="pieces"),
    ],
)
def test_the_bar_fits_the_terminal_and_what_counts_is_never_cut(steps, unit, bad, name, width):
    stream = Terminal()
    bar = ProgressBar(Console(file=stream, force_terminal=True, width=width, color_system=None))
    bar.on_start(name, 1200, unit)
    for step in steps:
        bar.on_step(step)
    bar.on_finish()
    *_, last = (line for line in stream.getvalue().splitlines() if "2/1200" in line)
    last = last.rpartition("\x1b[2K")[2]
    assert len(last) <= width
    assert last.startswith(name[:8])
    assert f" 4.0 {unit}/s " in f"{last} "
    assert bad in last
    assert re.search(r" \d:\d\d:\d\d ", last) or width < 80
    assert " 70 " not in last or width == 80  # what has no room is left out whole


def test_frames_that_are_searched_are_not_called_untrusted():
    stream = Terminal()
    bar = ProgressBar(Console(file=stream, force_terminal=True, width=140))
    bar.on_start("drive", 3)
    for state in (State.TRACKING, State.SEARCHING, State.SEARCHING):
        bar.on_step(located(state))
    bar.on_finish()
    assert "searching: no place is recognised" in stream.getvalue()
    assert "not trusted" not in stream.getvalue()


SOURCE = SyntheticSource(StreetSettings(frames=3, width_px=64, height_px=32, focal_px=36.0))


def said(stream: io.StringIO, **how: bool) -> list[str]:
    announce(SOURCE, stream=stream, **how)
    warn(["zu dunkel für alles", "too late"], stream=stream, **how)
    return stream.getvalue().splitlines()


def test_a_source_is_a_line_on_a_terminal_and_json_elsewhere_if_verbose():
    first, *rest = said(Terminal())
    assert first == f"{SOURCE.name}: {SOURCE.description}, 3 pairs"
    assert rest == ["warning: zu dunkel für alles", "warning: too late"]
    source, warning, _ = map(json.loads, said(io.StringIO(), verbose=True))
    assert (source["event"], source["frames"]) == ("source", 3)
    assert source["description"] == SOURCE.description
    assert warning == {"event": "warning", "text": "zu dunkel für alles"}
    assert said(io.StringIO()) == said(Terminal(), quiet=True) == []
