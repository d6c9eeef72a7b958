"""Announces the recognised source and its warnings before a run starts."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from typing import TextIO

from recon.sources import StereoSource


def announce(source: StereoSource, *, quiet: bool = False, stream: TextIO | None = None) -> None:
    """Write one line: text on a terminal, else a JSON object.

    Args:
        source: The source.
        quiet: Whether to write nothing.
        stream: Output stream; None = standard error, as standard output is for results.
    """
    event = {
        "event": "source",
        "name": source.name,
        "description": source.description,
        "frames": len(source),
    }
    _tell(f"{source.name}: {source.description}, {len(source)} pairs", event, quiet, stream)


def warn(lines: Iterable[str], *, quiet: bool = False, stream: TextIO | None = None) -> None:
    """Write warnings before the run starts, each in the form of `announce`."""
    for line in lines:
        _tell(f"warning: {line}", {"event": "warning", "text": line}, quiet, stream)


def _tell(text: str, event: dict[str, object], quiet: bool, stream: TextIO | None) -> None:
    if quiet:
        return
    out = sys.stderr if stream is None else stream
    out.write((text if out.isatty() else json.dumps(event, ensure_ascii=False)) + "\n")
    out.flush()
