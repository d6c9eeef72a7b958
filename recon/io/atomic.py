"""Atomic file writes: temporary file, fsync, rename. Locks on files."""

from __future__ import annotations

import ctypes
import fcntl
import os
import secrets
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path
from typing import Final

from recon.core.errors import OutputError, SettingsError
from recon.io.files import special_kind

_RENAME_EXCHANGE: Final = 2  # flag of Linux's renameat2, here with absolute paths


@contextmanager
def atomic_path(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a temporary path to write to, which is renamed to ``path`` if the block succeeds.

    It is in the same folder, created if missing, and has the same suffix, by which a library may
    choose the format. If the block raises, a file at ``path`` stays as it was.
    """
    target = Path(path)
    check_targets([target])
    temporary = target.with_name(f".{secrets.token_hex(6)}-{target.name}")
    try:
        with writing_to(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            _sync(temporary)
            temporary.replace(target)
            _sync(target.parent)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


@contextmanager
def writing_to(target: Path) -> Iterator[None]:
    """Name a file, and what to do, where the system cannot write it."""
    try:
        yield
    except OSError as error:
        got = error.strerror or str(error) or type(error).__name__
        hint = "check that the folder is writable and the disk is not full"
        raise OutputError("cannot write the file", where=target, got=got, hint=hint) from error


def check_targets(targets: Iterable[Path], inputs: Iterable[Path] = ()) -> None:
    """Refuse to write to what is no regular file, or is read by the same command under any name."""
    read = {file for path in inputs if (file := _file_of(path)) is not None}
    for target in targets:
        if (kind := special_kind(target)) is not None:
            expected = "a regular file, or none yet"
            raise OutputError("cannot write the file", where=target, got=kind, expected=expected)
        if read and _file_of(target) in read:
            what, hint = "the result would replace an input", "choose another file or folder"
            raise SettingsError(what, where=target, hint=hint)


def _file_of(path: Path) -> tuple[int, int] | None:
    """Return what identifies the file that a path leads to; None = it leads to none."""
    try:
        state = path.stat()
    except (OSError, ValueError):
        return None
    return state.st_dev, state.st_ino


def exchange(new: Path, old: Path) -> None:
    """Exchange two folders in one step; where the system cannot, the old one is moved aside."""
    rename = None
    if sys.platform == "linux":
        rename = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    ends = os.fsencode(new.absolute()), os.fsencode(old.absolute())
    if rename is None or rename(0, ends[0], 0, ends[1], _RENAME_EXCHANGE) != 0:
        aside = old.with_name(f".{secrets.token_hex(6)}-{old.name}")
        old.replace(aside)
        try:
            new.replace(old)
        except BaseException:
            aside.replace(old)
            raise
        aside.replace(new)
    _sync(old.parent)


def write_text(path: str | PathLike[str], text: str) -> None:
    """Write UTF-8 text atomically, without converting line endings."""
    # A name of a file that is not UTF-8 is written as \\udcXX, which JSON and YAML read back.
    write_bytes(path, text.encode(errors="backslashreplace"))


def write_bytes(path: str | PathLike[str], content: bytes) -> None:
    """Write bytes atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _sync(path: Path) -> None:
    """Flush a file, or the directory entries of a folder, to disk."""
    if os.name == "nt" and path.is_dir():  # Windows cannot open a folder, nor needs to sync it
        return
    handle = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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
    """Lock a file, made with its folders, until the handle closes; ``what`` is who else has it."""
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
