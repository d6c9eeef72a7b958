"""The folder that a run leaves behind: whole, or not at all.

Everything is written below ``<folder>/.partial`` and moved up when the run is done. A run that
fails takes its partial files away again; an earlier run in the same folder stays as it was.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from typing_extensions import Self

from recon.errors import OutputError

RECORD: Final = "run.json"
_PARTIAL: Final = ".partial"
_STATE: Final = ".state"


def default_folder(command: str, base: Path = Path("outputs")) -> Path:
    """``outputs/<command>/<UTC stamp>``."""
    stamp = datetime.now(timezone.utc).strftime("%Y%m%dT%H%M%S.%fZ")
    return base / command / stamp


class RunDirectory:
    """Use as a context: files go to `path`, and appear in `folder` when the context ends well.

    Args:
        folder: Where the results are to be; made if missing.
        latest: Keep a link ``latest`` beside the folder (for the default folders).

    Raises:
        OutputError: The folder cannot be written, or holds something that is no run of ours.
    """

    def __init__(self, folder: Path, *, latest: bool = False) -> None:
        self.folder = folder
        self._latest = latest
        self._made: list[Path] = []

    @classmethod
    def for_command(cls, command: str, out: Path | None) -> Self:
        """The folder that the user asked for, or a new one under ``outputs/``."""
        return cls(default_folder(command), latest=True) if out is None else cls(out)

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

    def files(self) -> list[str]:
        """Names of the files written so far, sorted; what is of the state is not among them."""
        written = (p.relative_to(self._partial) for p in self._partial.rglob("*") if p.is_file())
        return sorted(p.as_posix() for p in written if p.parts[0] != _STATE)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a JSON file, NaN refused: it would not load elsewhere."""
        text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
        self.path(name).write_text(text + "\n", encoding="utf-8")

    def __enter__(self) -> Self:
        _refuse_foreign(self.folder)
        self._made = [p for p in (self.folder, *self.folder.parents) if not p.exists()]
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            shutil.rmtree(self._partial, ignore_errors=True)
            self._partial.mkdir()
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
        if kind is not None:
            self._withdraw()
            return
        try:
            self._publish()
        except OSError as failure:
            raise _unwritable(self.folder, failure) from failure

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
            "output folder holds files that are not of a run",
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
        hint="choose another --out or mend its permissions",
    )
