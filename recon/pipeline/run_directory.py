"""The folder that a run leaves behind: whole, or not at all.

Everything is written below ``<folder>/.partial`` and moved up when the run is done. A run that
fails takes its partial files away again; an earlier run in the same folder stays as it was. One
that was killed, interrupted or met a full disk leaves them where it can be resumed from them.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from typing_extensions import Self

from recon.errors import MemoryLimitError, OutputError

RECORD: Final = "run.json"
STARTED: Final = "started.json"
"""Name in the state of what a run that can be resumed was started with."""
_PARTIAL: Final = ".partial"
_STATE: Final = ".state"
_LOCK: Final = ".lock"
#: What is no fault of the input: the run can go on later.
_PASSING: Final = (OutputError, MemoryLimitError, OSError, MemoryError, KeyboardInterrupt)


def state_folder(folder: Path) -> Path:
    """Where an unfinished run in a folder keeps what it goes on from."""
    return folder / _PARTIAL / _STATE


def default_folder(command: str, base: Path = Path("outputs")) -> Path:
    """``outputs/<command>/<UTC stamp>``."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%S.%fZ")
    return base / command / stamp


class RunDirectory:
    """Use as a context: files go to `path`, and appear in `folder` when the context ends well.

    Args:
        folder: Where the results are to be; made if missing.
        latest: Keep a link ``latest`` beside the folder (for the default folders).
        resume: Go on with the unfinished run in the folder.

    Raises:
        OutputError: The folder cannot be written, holds something that is no run of ours, or
            another run is writing to it.
    """

    def __init__(self, folder: Path, *, latest: bool = False, resume: bool = False) -> None:
        self.folder = folder
        self.resumes = resume
        self._latest = latest
        self._made: list[Path] = []
        self._lock: int | None = None

    @classmethod
    def for_command(cls, command: str, out: Path | None, *, resume: bool = False) -> Self:
        """The folder that the user asked for, or a new one under ``outputs/``."""
        if out is None:
            return cls(default_folder(command), latest=True)
        # A run in a default folder keeps its link when it is resumed.
        stamped = out.parent.resolve() == default_folder(command).parent.resolve()
        return cls(out, latest=resume and stamped, resume=resume)

    def path(self, name: str) -> Path:
        """Where to write the file ``name``; its parent folder exists."""
        target = self._partial / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def state(self, name: str) -> Path:
        """Where to keep under ``name`` what the run needs until it is done, and not after."""
        target = self._partial / _STATE / name
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def keep(self, state: str, name: str) -> None:
        """Make a file of the state a result too, without another copy where links are known."""
        source, target = self.state(state), self.path(name)
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)

    def files(self) -> list[str]:
        """Names of the files written so far, sorted; what is of the state is not among them."""
        written = (p.relative_to(self._partial) for p in self._partial.rglob("*") if p.is_file())
        return sorted(p.as_posix() for p in written if p.parts[0] not in (_STATE, _LOCK))

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file, NaN refused: it would not load elsewhere."""
        text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
        self.path(name).write_text(text + "\n", encoding="utf-8")

    def __enter__(self) -> Self:
        if not self.resumes:
            _refuse_foreign(self.folder)
        self._made = [p for p in (self.folder, *self.folder.parents) if not p.exists()]
        try:
            self._lock = self._take_lock()
            self._clear()
        except OSError as error:
            self._withdraw()
            raise _unwritable(self.folder, error) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            if kind is None:
                self._publish()
            elif not (self.resumable and (self.resumes or issubclass(kind, _PASSING))):
                self._withdraw()
        except OSError as failure:
            raise _unwritable(self.folder, failure) from failure
        finally:
            self._release()

    @property
    def resumable(self) -> bool:
        """Whether the run has written down what it was started with."""
        return (state_folder(self.folder) / STARTED).is_file()

    def _take_lock(self) -> int:
        """Be the only run that writes to the folder, until `_release` or the process ends."""
        while True:
            self._partial.mkdir(parents=True, exist_ok=True)
            path = self._partial / _LOCK
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                # A run that ended meanwhile has removed the file that was opened here.
                if path.exists() and os.fstat(handle).st_ino == path.stat().st_ino:
                    return handle
            except BlockingIOError as error:
                os.close(handle)
                raise OutputError(
                    "another run is writing to this folder",
                    where=self.folder,
                    hint="wait for it, or choose another --out",
                ) from error
            os.close(handle)

    def _release(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _clear(self) -> None:
        """Take away what another run left half-written; a resumed one needs its state."""
        kept = {_LOCK, _STATE} if self.resumes else {_LOCK}
        for path in self._partial.iterdir():
            if path.name in kept:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()

    @property
    def _partial(self) -> Path:
        return self.folder / _PARTIAL

    def _publish(self) -> None:
        files = [Path(name) for name in self.files()]
        for stale in set(_earlier_files(self.folder)) - set(files):
            (self.folder / stale).unlink(missing_ok=True)
        # The record goes last: a folder with a new run.json has all that it lists.
        for file in sorted(files, key=lambda f: f.name == RECORD):
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            (self._partial / file).replace(self.folder / file)
        # Nothing can be resumed from a state that is half removed.
        (state_folder(self.folder) / STARTED).unlink(missing_ok=True)
        shutil.rmtree(self._partial)
        if self._latest:
            _link_latest(self.folder)

    def _withdraw(self) -> None:
        shutil.rmtree(self._partial, ignore_errors=True)
        for folder in self._made:
            with suppress(OSError):  # not empty: somebody else's files, which stay
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


def _earlier_files(folder: Path) -> list[Path]:
    try:
        record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
        names = [Path(name) for name in record.get("files", [])]
    except (OSError, ValueError, AttributeError):
        return []  # no earlier run, or one whose record is broken: nothing is known to be stale
    return [name for name in names if not name.is_absolute() and ".." not in name.parts]


def _link_latest(folder: Path) -> None:
    link = folder.parent / "latest"
    with suppress(OSError):  # a file system without links: the stamped folder is enough
        link.unlink(missing_ok=True)
        link.symlink_to(folder.name)


def _unwritable(folder: Path, error: OSError) -> OutputError:
    return OutputError(
        "output folder cannot be written",
        where=folder,
        got=error.strerror or str(error),
        hint="choose another --out or fix its permissions",
    )
