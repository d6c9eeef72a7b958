"""The record of a run: versions, inputs and their hashes, command, timings."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

from recon.run.directory import RECORD, RunDirectory
from recon.run.machine import versions

_PIECE_BYTES: Final = 1 << 20


def fingerprint(files: Iterable[Path]) -> dict[str, Any]:
    """Return the number, size and one SHA-256 of a list of files, in that order.

    The hash covers each file's name and bytes, so a renamed frame changes it too.
    """
    digest, count, size = hashlib.sha256(), 0, 0
    for path in files:
        length = path.stat().st_size
        digest.update(os.fsencode(path.name) + b"\0" + length.to_bytes(8, "little"))
        # In pieces: a recording may be larger than memory.
        with path.open("rb") as content:
            while piece := content.read(_PIECE_BYTES):
                digest.update(piece)
        count, size = count + 1, size + length
    return {"files": count, "bytes": size, "sha256": digest.hexdigest()}


def write_record(run: RunDirectory, command: str, content: Mapping[str, Any]) -> None:
    """Write ``run.json``, last, since it lists all other files of the run."""
    record = {
        "command": command,
        "finished_utc": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "versions": versions(),
        **content,
        "files": [*run.files(), RECORD],
    }
    run.write_json(RECORD, record)
