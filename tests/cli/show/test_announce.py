"""A source and its warnings are announced in one line each."""

from __future__ import annotations

import io
import json

import pytest

from recon.cli.show.announce import announce, warn
from recon.sources.synthetic import SyntheticSource
from recon.street.settings import StreetSettings

SOURCE = SyntheticSource(StreetSettings(frames=3, width_px=64, height_px=32, focal_px=36.0))


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("stream", [Terminal(), io.StringIO()])
def test_nothing_is_said_where_quiet(stream: io.StringIO) -> None:
    announce(SOURCE, quiet=True, stream=stream)
    warn(["too dark"], quiet=True, stream=stream)
    assert stream.getvalue() == ""


def test_a_terminal_gets_text() -> None:
    stream = Terminal()
    announce(SOURCE, stream=stream)
    warn(["too dark", "too late"], stream=stream)
    first, *rest = stream.getvalue().splitlines()
    assert first == f"{SOURCE.name}: {SOURCE.description}, 3 pairs"
    assert rest == ["warning: too dark", "warning: too late"]


def test_anything_else_gets_one_json_object_a_line_if_verbose() -> None:
    stream = io.StringIO()
    announce(SOURCE, verbose=True, stream=stream)
    warn(["zu dunkel für alles"], verbose=True, stream=stream)
    source, warning = (json.loads(line) for line in stream.getvalue().splitlines())
    assert (source["event"], source["frames"]) == ("source", 3)
    assert source["description"] == SOURCE.description
    assert warning == {"event": "warning", "text": "zu dunkel für alles"}


def test_anything_else_gets_nothing_unless_verbose() -> None:
    stream = io.StringIO()
    announce(SOURCE, stream=stream)
    warn(["too dark"], stream=stream)
    assert stream.getvalue() == ""
