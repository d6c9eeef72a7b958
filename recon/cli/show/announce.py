"""Announces the recognised source and its warnings before a run starts."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from typing import TextIO

from recon.core.text import counted
from recon.sources.source import StereoSource


def announce(
    source: StereoSource,
    *,
    quiet: bool = False,
    verbose: bool = False,
    stream: TextIO | None = None,
) -> None:
    """Write one line: text on a terminal, else a JSON object if verbose.

    Args:
        source: The source.
        quiet: Whether to write nothing.
        verbose: Whether to write JSON where the stream is no terminal.
        stream: Output stream; None = standard error, as standard output is for results.
    """
    event = {
        "event": "source",
        "name": source.name,
        "description": source.description,
        "frames": len(source),
    }
    if not quiet:
        many = f", {counted(len(source), 'pair')}" if len(source) else ""
        _write(f"{source.name}: {source.description}{many}", event, verbose, stream)


def warn(
    lines: Iterable[str],
    *,
    quiet: bool = False,
    verbose: bool = False,
    stream: TextIO | None = None,
) -> None:
    """Write warnings before the run starts, each in the form of `announce`."""
    for line in lines:
        if not quiet:
            _write(f"warning: {line}", {"event": "warning", "text": line}, verbose, stream)


def _write(text: str, event: dict[str, object], verbose: bool, stream: TextIO | None) -> None:
    out = sys.stderr if stream is None else stream
    if out.isatty() or verbose:
        out.write((text if out.isatty() else json.dumps(event, ensure_ascii=False)) + "\n")
        out.flush()
