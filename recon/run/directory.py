"""The result folder of a run: complete, or not there at all.

Everything is written below ``<folder>/.partial`` and moved up when the run is done. A run that
fails removes its partial files and leaves an earlier run in the same folder untouched. A run that
was killed, interrupted or met a full disk keeps them if it can be resumed.

The folder itself may be a link, such as ``outputs/map/latest``; below it no link is followed, since
a folder that comes from elsewhere could lead anywhere.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, ClassVar, Final

from typing_extensions import Self

from recon.core.errors import ClusterError, FormatError, MemoryLimitError, OutputError
from recon.io.atomic import check_targets, exchange, take_lock
from recon.io.fields import write_json
from recon.io.files import read_text, reading, refuse_links, resolved

RECORD: Final = "run.json"
RECORD_BYTES: Final = 1 << 26  # larger than any record: it lists the files of a run
STARTED: Final = "map.recon"  # state file of a run that can be resumed: the map that it makes
_PARTIAL: Final = ".partial"
_STATE: Final = ".state"
_LOCK: Final = ".lock"
# What an address begins with, such as ``s3:``; of ``s3://`` a path keeps one slash.
_SCHEME: Final = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")
#: Errors that the input did not cause: the run can be resumed later.
_PASSING: Final = (
    ClusterError, OutputError, MemoryLimitError, OSError, MemoryError, KeyboardInterrupt,
)  # fmt: skip


def state_folder(folder: Path) -> Path:
    """Return the folder where an unfinished run keeps the state it resumes from."""
    return folder / _PARTIAL / _STATE


def lock_file(folder: Path) -> Path:
    """Return the file that is locked while a run writes to a folder."""
    return folder / _PARTIAL / _LOCK


def default_folder(command: str) -> Path:
    """Return ``outputs/<command>/<UTC stamp>``."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%S.%fZ")
    return Path("outputs") / command / stamp


class RunDirectory:
    """Context manager: files are written to `path` and appear in `folder` on success."""

    whole: ClassVar[bool] = False  # written beside the folder, and takes its place in one step

    def __init__(self, folder: Path, *, latest: bool = False, resume: bool = False) -> None:
        self.folder = folder
        self.resumes = resume
        # Whether there is a map from which the run can be resumed; who begins one says so.
        self.begun = resume and (state_folder(folder) / STARTED).is_file()
        self._latest = latest
        self._made: list[Path] = []
        self._earlier: list[Path] = []
        self._lock: int | None = None

    def path(self, name: str) -> Path:
        """Return the path to write the file ``name`` to; its parent folder is created."""
        target = self.content / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def state(self, name: str) -> Path:
        """Return the path of the state file ``name``, which is deleted when the run is done."""
        return self.path(f"{_STATE}/{name}")

    def files(self) -> list[str]:
        """Return sorted names of the files written so far, without those of the state."""
        written = (p.relative_to(self.content) for p in self.content.rglob("*") if p.is_file())
        return sorted(p.as_posix() for p in written if p.parts[0] not in (_STATE, _LOCK))

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file; NaN is refused, since it is not valid JSON."""
        write_json(self.path(name), content)

    def __enter__(self) -> Self:
        within = (self.folder, *self.folder.parents)
        if any(_SCHEME.fullmatch(p.name) and not p.is_dir() for p in within):
            raise OutputError(
                "results go into a folder, not to an address",
                where=self.folder,
                hint="give a folder of a shared file system, or copy the finished one there",
            )
        if not self.resumes:
            _refuse_foreign(self.folder)
        refuse_links(self.folder)
        self._earlier = recorded_files(self.folder)
        self._made = [p for p in within if not p.exists()]
        try:
            self._lock = take_lock(
                lock_file(self.folder),
                "another run is writing to this folder",
                where=self.folder,
                hint="wait for it, or choose another folder",
            )
            self._clear()
        except OSError as error:
            self._withdraw()
            raise _unwritable(self.folder, error) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        try:
            if kind is None:
                self._publish()
            elif not (self.begun and (self.resumes or issubclass(kind, _PASSING))):
                self._withdraw()
        except OSError as failure:
            raise _unwritable(self.folder, failure) from failure
        finally:
            if self._lock is not None:
                os.close(self._lock)
                self._lock = None

    def _clear(self) -> None:
        """Remove partial files of an earlier run; a resumed run keeps its state."""
        if self.whole:  # of one that was killed
            if self.content.is_symlink():
                self.content.unlink()
            shutil.rmtree(self.content, ignore_errors=True)
        kept = {_LOCK, _STATE} if self.resumes else {_LOCK}
        for path in self._partial.iterdir():
            if path.name not in kept:
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    def check_targets(self, inputs: Iterable[Path]) -> None:
        """Refuse to replace or remove what this run has read, or what is no regular file."""
        if not self.whole:  # else the folder is replaced, and with it the run that was read
            changed = {*map(Path, self.files()), *self._earlier}
            check_targets((self.folder / name for name in sorted(changed)), inputs)

    @property
    def _partial(self) -> Path:
        return self.folder / _PARTIAL

    @property
    def content(self) -> Path:
        """Where the files of this run are written."""
        if self.whole:
            folder = resolved(self.folder)
            return folder.with_name(f".{folder.name}{_PARTIAL}")
        return self._partial

    def _publish(self) -> None:
        self._swap() if self.whole else self._move()
        link = self.folder.parent / "latest"
        if self._latest and (not link.exists() or link.is_symlink()):
            with suppress(OSError):  # a file system without links: the stamped folder is enough
                link.unlink(missing_ok=True)
                link.symlink_to(self.folder.name)

    def _move(self) -> None:
        files = [Path(name) for name in self.files()]
        for stale in set(self._earlier) - set(files):
            (self.folder / stale).unlink(missing_ok=True)
            with suppress(OSError):  # there are others in it
                os.removedirs((self.folder / stale).parent)
        # The record goes last: a folder with a new run.json has every file it lists.
        for file in sorted(files, key=lambda f: f.name == RECORD):
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            (self._partial / file).replace(self.folder / file)
        # A state that is only half removed must not be resumable.
        (state_folder(self.folder) / STARTED).unlink(missing_ok=True)
        shutil.rmtree(self._partial)

    def _swap(self) -> None:
        """Put the new folder in the place of the old one, with files in it that are of no run."""
        try:
            shutil.rmtree(self.content / _STATE, ignore_errors=True)
            ours = {self.folder / name for name in self._earlier}
            for path in self.folder.rglob("*"):  # files that are of no run
                target = self.content / path.relative_to(self.folder)
                if path.is_file() and path not in ours and self._partial not in path.parents:
                    target.parent.mkdir(parents=True, exist_ok=True)
                    shutil.copy2(path, target, follow_symlinks=False)
            exchange(self.content, resolved(self.folder))
        finally:  # the old folder, or a new one that was interrupted before it took its place
            self._withdraw()

    def _withdraw(self) -> None:
        for partial in {self._partial, self.content}:
            shutil.rmtree(partial, ignore_errors=True)
        for folder in self._made:
            with suppress(OSError):  # not empty: files of others, which stay
                folder.rmdir()


def _refuse_foreign(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise OutputError("output folder is a file", where=folder, hint="choose another --out")
    try:
        occupied = folder.is_dir() and any(p.name != _PARTIAL for p in folder.iterdir())
    except OSError as error:
        raise _unwritable(folder, error) from error
    if occupied and not (folder / RECORD).is_file():
        raise OutputError(
            "output folder contains files that are not of a run",
            where=folder,
            hint="choose another --out or empty it",
        )


def recorded_files(folder: Path) -> list[Path]:
    """Return the files that a folder has of a run, below it; none without a record."""
    path = folder / RECORD
    if not path.is_file():
        return []
    with reading(path):
        names = json.loads(read_text(path, RECORD_BYTES)).get("files", [])
        named = isinstance(names, list) and all(
            isinstance(name, str) and "\0" not in name and os.fsencode(name) != b""
            for name in names
        )
        if not named:
            raise FormatError("record of a run has no valid list of files", where=path)
        inside = (n for n in map(Path, names) if not n.is_absolute() and ".." not in n.parts)
        return [name for name in inside if (folder / name).is_file()]


def _unwritable(folder: Path, error: OSError) -> OutputError:
    return OutputError(
        "output folder cannot be written",
        where=folder,
        got=error.strerror or str(error),
        hint="choose another folder or fix its permissions",
    )
