"""Progress of an evaluation: a bar on a terminal, JSON lines elsewhere."""

from __future__ import annotations

import io
import json

from rich.console import Console

from recon.cli.show.scenes import QuietScenes, SceneBar, SceneLines, choose_scene_viewer
from recon.commands.evaluate_middlebury import SceneObserver


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


def run(observer: SceneObserver) -> None:
    observer.on_start("trainingQ [1]", 2)
    observer.on_scene("Piano", {"sad": {"seconds": 0.25}})
    observer.on_scene("Pipes", {})
    observer.on_finish()


def test_lines_are_json_with_the_seconds_of_each_matcher() -> None:
    stream = io.StringIO()
    run(SceneLines(stream))
    events = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [event["event"] for event in events] == ["start", "scene", "scene", "finish"]
    assert events[0]["scenes"] == 2
    assert events[1] == {"event": "scene", "name": "Piano", "seconds": {"sad": 0.25}}
    assert events[2]["seconds"] == {}


def test_the_bar_counts_scenes_and_names_one_without_truth() -> None:
    stream = Terminal()
    run(SceneBar(Console(file=stream, force_terminal=True, width=120)))
    assert "trainingQ [1]" in stream.getvalue()
    assert "2/2" in stream.getvalue()
    assert "Pipes: no truth" in stream.getvalue()


def test_the_stream_decides_and_quiet_shows_nothing() -> None:
    assert isinstance(choose_scene_viewer(stream=Terminal()), SceneBar)
    assert isinstance(choose_scene_viewer(stream=io.StringIO(), verbose=True), SceneLines)
    assert isinstance(choose_scene_viewer(stream=io.StringIO()), QuietScenes)
    stream = Terminal()
    viewer = choose_scene_viewer(quiet=True, stream=stream)
    run(viewer)
    assert isinstance(viewer, QuietScenes)
    assert stream.getvalue() == ""
