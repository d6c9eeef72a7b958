"""A lock on a file, held by one process at a time and released by its end, however it ends."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

from recon.core.errors import OutputError


def is_locked(path: Path) -> bool:
    """Return whether a process holds the lock on a file, which need not exist."""
    try:
        handle = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(handle)
    return False


def take_lock(path: Path, what: str, *, where: Path, hint: str) -> int:
    """Lock a file, which is created with its folders; closing the handle releases it.

    Args:
        path: The file. It may be removed while it is locked.
        what: Who else holds the lock, for the error message.
        where: What is locked, for the error message.
        hint: What to do then.

    Returns:
        The handle of the file.
    """
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Who held it meanwhile may have removed the file that was opened here.
            if path.exists() and os.fstat(handle).st_ino == path.stat().st_ino:
                return handle
        except BlockingIOError as error:
            os.close(handle)
            raise OutputError(what, where=where, hint=hint) from error
        os.close(handle)
