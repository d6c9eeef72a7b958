"""Checkpoints: the state of a run after a frame, written atomically, to resume it from."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field

from recon.errors import FormatError
from recon.formats.tree_file import read_tree, write_tree
from recon.settings import Settings
from recon.structures.arrays import UInt8

_HEAD_BYTES: Final = 4096
ANEW: Final = "start the run anew, without --resume"
#: Modules that a checkpoint may load: unpickling any other could run foreign code.
_SAFE: Final = ("recon.", "numpy")


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

    def load(self) -> dict[str, Any]:
        """Read the state.

        Raises:
            FormatError: The file is damaged.
        """
        try:
            return read_tree(self._path)
        except FormatError as error:
            raise FormatError(error.what, where=error.where, got=error.got, hint=ANEW) from error

    def restore(self, use: Callable[[dict[str, Any]], None]) -> None:
        """Pass the state to ``use``, which resumes from it.

        Raises:
            FormatError: The file is damaged, or holds something else.
        """
        state = self.load()
        try:
            use(state)
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(
                "the file holds no state of this run", where=self._path, got=error, hint=ANEW
            ) from error


def pack_object(value: object) -> UInt8:
    """uint8 (N,), a stateful object of this project as bytes; `unpack_object` restores it."""
    return np.frombuffer(pickle.dumps(value, protocol=5), np.uint8)


def unpack_object(content: UInt8) -> Any:
    """Restore the object given to `pack_object`.

    Raises:
        FormatError: The bytes are damaged, or contain an object of another package.
    """
    try:
        return _OurUnpickler(io.BytesIO(content.tobytes())).load()
    except (pickle.UnpicklingError, EOFError, AttributeError, ImportError, IndexError) as error:
        raise FormatError("the state of the odometry cannot be read", got=error) from error


class _OurUnpickler(pickle.Unpickler):
    """Unpickles classes of this project and numpy arrays, nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        """The class or function of a name, if it is allowed."""
        found = super().find_class(module, name)
        ours = module.startswith(_SAFE) and (isinstance(found, type) or module.startswith("numpy"))
        if not ours:
            raise pickle.UnpicklingError(f"{module}.{name} is not part of a state")
        return found


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
