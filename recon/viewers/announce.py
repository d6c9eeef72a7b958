"""Says what a source was taken for, before anything is done with it."""

from __future__ import annotations

import json
import sys
from typing import TextIO

from recon.sources import StereoSource


def announce(source: StereoSource, *, quiet: bool = False, stream: TextIO | None = None) -> None:
    """Write one line: text on a terminal, a JSON object anywhere else, nothing where ``quiet``.

    Args:
        source: The source.
        quiet: Whether to write nothing.
        stream: Where to; None = standard error, so that standard output stays for results.
    """
    out = sys.stderr if stream is None else stream
    if quiet:
        return
    if out.isatty():
        out.write(f"{source.name}: {source.description}, {len(source)} pairs\n")
        out.flush()
        return
    event = {
        "event": "source",
        "name": source.name,
        "description": source.description,
        "frames": len(source),
    }
    out.write(json.dumps(event, ensure_ascii=False) + "\n")
    out.flush()
