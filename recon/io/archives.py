"""Unpacking of zip and tar archives from outside, which may be hostile."""

from __future__ import annotations

import hashlib
import posixpath
import stat
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Final, Literal

from recon.core.errors import FormatError, OutputError
from recon.io.files import naming, reading

_PIECE_BYTES: Final = 1 << 20
_MOST_ENTRIES: Final = 2_000_000
#: Images and clouds hardly shrink in an archive; what grows by more than this fills the disk.
_MOST_GROWTH: Final = 50
_SMALL_BYTES: Final = 100_000_000
#: What macOS adds to an archive.
_RESOURCE_FORKS: Final = "__MACOSX"

_LONGEST_TARGET: Final = 4096

_Kind = Literal["file", "folder", "link", "device"]

FileFacts = dict[str, tuple[int, str]]
"""Size in bytes and SHA-256 of each file, by its path below the folder."""


@dataclass(frozen=True)
class Choice:
    """What of an archive is unpacked.

    Attributes:
        below: Folder of the archive whose content is unpacked; "" = everything.
        without: Suffixes of files that are left out.
        zips: Whether archives in the archive are unpacked beside themselves, and left out.
    """

    below: str = ""
    without: tuple[str, ...] = ()
    zips: bool = False


@dataclass(frozen=True)
class _Entry:
    """One entry: its name, kind, the path a link leads to, and how its content is opened."""

    name: str
    kind: _Kind
    leads: str
    open: Callable[[], IO[bytes] | None]


@dataclass
class _Budget:
    """What may still be written of an archive and of those in it."""

    bytes_left: int
    entries_left: int = _MOST_ENTRIES
    written: FileFacts = field(default_factory=dict)

    def spend(self, size: int = 0) -> None:
        """Count an entry, or bytes of one."""
        self.bytes_left -= size
        self.entries_left -= not size
        if self.bytes_left < 0 or self.entries_left < 0:
            raise FormatError("archive unpacks to far more than its own size")


def unpack(archive: Path, folder: Path, choice: Choice | None = None) -> FileFacts:
    """Unpack a zip or tar archive into a folder.

    Nothing is written outside of the folder, and no link at all: a link that stays in the archive
    is left out, any other refuses the archive. A later archive may replace files of an earlier
    one in the same folder.

    Args:
        archive: The archive; tar archives may be compressed.
        folder: Where to; created if missing.
        choice: What to unpack; None = everything.

    Returns:
        Size and hash of every file written.

    Raises:
        FormatError: The archive is damaged, is none, names a path outside of itself, has two
            entries of one name, devices or encrypted files, unpacks to more than 50 times its
            size, or holds nothing of what was chosen.
        OutputError: A file cannot be written.
    """
    budget = _Budget(_SMALL_BYTES + _MOST_GROWTH * archive.stat().st_size)
    with naming(archive):
        _unpack(archive, folder, choice or Choice(), PurePosixPath(), budget)
    if not budget.written:
        expected = f"files below {choice.below}" if choice and choice.below else "files"
        raise FormatError("archive is empty", where=archive, expected=expected)
    return budget.written


def _unpack(
    archive: Path, folder: Path, choice: Choice, into: PurePosixPath, budget: _Budget
) -> None:
    seen = set[PurePosixPath]()
    for entry in _entries(archive):
        budget.spend()
        path = _checked(entry)
        if entry.kind != "file" or not _chosen(path, choice):
            continue
        if path in seen:
            raise FormatError("two entries of the archive have one name", got=entry.name)
        seen.add(path)
        place = into / path.relative_to(choice.below)
        facts = _write(entry, archive, folder / place, budget)
        if choice.zips and place.suffix == ".zip":
            _unpack(folder / place, folder, Choice(without=choice.without), place.parent, budget)
            (folder / place).unlink()
        else:
            budget.written[place.as_posix()] = facts


def _entries(archive: Path) -> Iterator[_Entry]:
    """Yield the entries; what the libraries raise on damaged archives becomes a `FormatError`."""
    with reading(archive):
        if zipfile.is_zipfile(archive):
            yield from _zip_entries(archive)
        elif tarfile.is_tarfile(archive):
            yield from _tar_entries(archive)
        else:
            raise FormatError("not an archive", expected="zip or tar")


def _zip_entries(archive: Path) -> Iterator[_Entry]:
    with zipfile.ZipFile(archive) as file:
        for info in file.infolist():
            link = stat.S_ISLNK(info.external_attr >> 16)
            if info.flag_bits & 1:
                raise FormatError("archive is encrypted", got=info.filename)
            kind: _Kind = "link" if link else "folder" if info.is_dir() else "file"
            target = file.open(info).read(_LONGEST_TARGET).decode() if link else ""
            leads = _beside(info.filename, target)
            yield _Entry(info.orig_filename, kind, leads, partial(file.open, info))


def _tar_entries(archive: Path) -> Iterator[_Entry]:
    with tarfile.open(archive) as file:
        for info in file:
            kind: _Kind = "file" if info.isfile() else "folder" if info.isdir() else "device"
            kind = "link" if info.issym() or info.islnk() else kind
            # The target of a hard link is a path from the root of the archive.
            leads = info.linkname if info.islnk() else _beside(info.name, info.linkname)
            yield _Entry(info.name, kind, leads, partial(file.extractfile, info))


def _beside(name: str, target: str) -> str:
    """Return the path that a symbolic link leads to."""
    return posixpath.join(posixpath.dirname(name), target)


def _checked(entry: _Entry) -> PurePosixPath:
    """Return the path of an entry.

    Raises:
        FormatError: It, or where a link leads to, is outside of the archive; or it is a device.
    """
    inside = _inside(entry.name) and ".." not in entry.name.split("/")
    if not inside or (entry.kind == "link" and not _inside(entry.leads)):
        raise FormatError("archive holds a path outside of itself", got=entry.name)
    if entry.kind == "device":
        raise FormatError("archive holds a device", got=entry.name)
    return PurePosixPath(entry.name)


def _inside(name: str) -> bool:
    """Return whether a path stays where it begins, on every system."""
    plain = name.isprintable() and not {"\\", ":"} & set(name)
    return plain and not (posixpath.normpath(name) + "/").startswith(("/", "../"))


def _chosen(path: PurePosixPath, choice: Choice) -> bool:
    return (
        path.is_relative_to(choice.below)
        and path.suffix not in choice.without
        and path.parts[:1] != (_RESOURCE_FORKS,)
    )


def _write(entry: _Entry, archive: Path, target: Path, budget: _Budget) -> tuple[int, str]:
    digest, size = hashlib.sha256(), 0
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("wb") as out:
            for piece in _pieces(entry, archive):
                budget.spend(len(piece))
                out.write(piece)
                digest.update(piece)
                size += len(piece)
    except OSError as error:
        raise OutputError(
            "cannot unpack", where=target, got=error.strerror or str(error), hint="make room"
        ) from error
    return size, digest.hexdigest()


def _pieces(entry: _Entry, archive: Path) -> Iterator[bytes]:
    """Yield the content of a file; a checksum of the archive that does not fit is an error."""
    with reading(archive):
        content = entry.open()
        if content is None:
            raise FormatError("entry of the archive has no content", got=entry.name)
        with content:
            while piece := content.read(_PIECE_BYTES):
                yield piece
