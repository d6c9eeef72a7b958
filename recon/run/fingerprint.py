"""Hashes of what a run has read, for its record."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

_PIECE_BYTES: Final = 1 << 20


def fingerprint(files: Iterable[Path], *, head_bytes: int | None = None) -> dict[str, Any]:
    """Return the number, size and one SHA-256 of a list of files, in that order.

    The hash covers each file's name and bytes, so a renamed frame changes it too.

    Args:
        files: The files.
        head_bytes: Hash only the first bytes of each, to tell sources apart without the delay of
            reading a large drive; None = all.
    """
    digest, count, size = hashlib.sha256(), 0, 0
    for path in files:
        length = path.stat().st_size
        digest.update(os.fsencode(path.name) + b"\0" + length.to_bytes(8, "little"))
        # In pieces: a recording may be larger than memory.
        with path.open("rb") as content:
            while head_bytes is None and (piece := content.read(_PIECE_BYTES)):
                digest.update(piece)
            digest.update(content.read(head_bytes or 0))
        count, size = count + 1, size + length
    return {"files": count, "bytes": size, "sha256": digest.hexdigest()}
