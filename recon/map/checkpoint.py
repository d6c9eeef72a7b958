"""Checkpoints: the state of a run after a frame, written atomically, to resume it from."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from recon.core.errors import FormatError, ReconError
from recon.core.settings import Settings
from recon.io.files import reading
from recon.io.tree_file import read_tree, write_tree

_HEAD_BYTES: Final = 4096
ANEW: Final = "start the run anew, without --resume"


class CheckpointSettings(Settings):
    """How often a run writes a checkpoint; does not change results."""

    every_frames: int = Field(
        50, ge=1, le=1_000_000, description="Number of frames between two checkpoints."
    )


class Checkpoint:
    """The latest state of a run, in one file.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def exists(self) -> bool:
        """Whether there is a state to resume from."""
        return self._path.is_file()

    def save(self, state: Mapping[str, Any]) -> None:
        """Replace the state; if killed at any moment, the old or the new one is intact.

        Raises:
            OutputError: It cannot be written; the old one stays.
        """
        write_tree(self._path, state)

    def restore(self, use: Callable[[dict[str, Any]], None]) -> None:
        """Read the state and pass it to ``use``, which resumes from it.

        Raises:
            FormatError: The file is damaged, or holds something else.
        """
        try:
            with reading(self._path):
                use(read_tree(self._path))
        except ReconError as error:
            raise FormatError(error.what, where=error.where, got=error.got, hint=ANEW) from error


def quick_fingerprint(files: Iterable[Path]) -> dict[str, Any]:
    """Number, total size, and a hash of names and first bytes of files, to tell sources apart.

    Hashing whole files, as at the end of a run, would delay the start of a large drive.
    """
    digest, count, size = hashlib.sha256(), 0, 0
    for path in files:
        length = path.stat().st_size
        digest.update(os.fsencode(path.name) + b"\0" + length.to_bytes(8, "little"))
        with path.open("rb") as content:
            digest.update(content.read(_HEAD_BYTES))
        count, size = count + 1, size + length
    return {"files": count, "bytes": size, "sha256": digest.hexdigest()}
