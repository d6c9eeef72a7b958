"""Unpacking of zip and tar archives from outside, which may be hostile."""

from __future__ import annotations

import posixpath
import shutil
import stat
import tarfile
import zipfile
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Final

from recon.core.errors import FormatError, OutputError
from recon.io.files import naming, reading

#: Images and clouds hardly shrink in an archive; what grows by more than this fills the disk.
_MOST_GROWTH: Final = 50
_SMALL_BYTES: Final = 100_000_000
_LEAST_BYTES: Final = 4096
"""What an entry takes of a disk, however small it is."""
_RESOURCE_FORKS: Final = "__MACOSX"
_LONGEST_TARGET: Final = 4096


@dataclass(frozen=True)
class _Entry:
    """One entry: name, size, the path a link leads to ("" = no link), how a file is opened."""

    name: str
    size: int
    is_file: bool
    leads: str
    open: Callable[[], IO[bytes] | None]


def unpack(
    archive: Path,
    folder: Path,
    *,
    below: str = "",
    without: Collection[str] = (),
    zips: bool = False,
) -> None:
    """Unpack a zip or tar archive into a folder.

    Nothing is written outside of the folder, and no link at all: a link that stays in the archive
    is left out, any other refuses the archive. A later archive may replace files of an earlier
    one in the same folder.

    Args:
        archive: The archive; tar archives may be compressed.
        folder: Where to; created if missing.
        below: Folder of the archive whose content is unpacked; "" = everything.
        without: Suffixes of files that are left out.
        zips: Whether archives in the archive are unpacked beside themselves, and left out.
    """
    most_bytes = _SMALL_BYTES + _MOST_GROWTH * archive.stat().st_size
    with naming(archive):
        _unpack(archive, folder, most_bytes, below, without, zips=zips)


def _unpack(
    archive: Path, folder: Path, left: int, below: str, without: Collection[str], *, zips: bool
) -> int:
    """Unpack what takes at most ``left`` bytes; returns what is left of them."""
    seen = set[PurePosixPath]()
    for entry in _entries(archive):
        left -= max(entry.size, _LEAST_BYTES)
        if left < 0:
            raise FormatError("archive unpacks to far more than its own size")
        if ".." in entry.name.split("/") or not (
            _is_inside(entry.name) and _is_inside(entry.leads)
        ):
            raise FormatError("archive holds a path outside of itself", got=entry.name)
        path = PurePosixPath(entry.name)
        hidden = path.suffix in without or path.parts[:1] == (_RESOURCE_FORKS,)
        if not entry.is_file or hidden or not path.is_relative_to(below):
            continue
        if path in seen:
            raise FormatError("two entries of the archive have one name", got=entry.name)
        seen.add(path)
        target = folder / path.relative_to(below)
        _write(entry, archive, target)
        if zips and target.suffix == ".zip":
            left = _unpack(target, target.parent, left, "", without, zips=False)
            target.unlink()
    if not seen:
        raise FormatError("archive is empty", expected=f"files below {below}" if below else "files")
    return left


def _entries(archive: Path) -> Iterator[_Entry]:
    """Yield the entries; what the libraries raise on damaged archives becomes a `FormatError`."""
    with reading(archive):
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as from_zip:
                yield from (_zip_entry(from_zip, info) for info in from_zip.infolist())
        elif tarfile.is_tarfile(archive):
            with tarfile.open(archive) as from_tar:
                yield from (_tar_entry(from_tar, info) for info in from_tar)
        else:
            raise FormatError("not an archive", expected="zip or tar")


def _zip_entry(file: zipfile.ZipFile, info: zipfile.ZipInfo) -> _Entry:
    if info.flag_bits & 1:
        raise FormatError("archive is encrypted", got=info.filename)
    link = stat.S_ISLNK(info.external_attr >> 16)
    target = file.open(info).read(_LONGEST_TARGET).decode() if link else ""
    leads = posixpath.join(posixpath.dirname(info.filename), target) if link else ""
    is_file = not (link or info.is_dir())
    return _Entry(info.orig_filename, info.file_size, is_file, leads, partial(file.open, info))


def _tar_entry(file: tarfile.TarFile, info: tarfile.TarInfo) -> _Entry:
    if not (info.isfile() or info.isdir() or info.issym() or info.islnk()):
        raise FormatError("archive holds a device", got=info.name)
    # The target of a hard link is a path from the root of the archive.
    folder = posixpath.dirname(info.name) if info.issym() else ""
    leads = posixpath.join(folder, info.linkname)
    return _Entry(info.name, info.size, info.isfile(), leads, partial(file.extractfile, info))


def _is_inside(name: str) -> bool:
    """Return whether a path stays where it begins, on every system."""
    plain = name.isprintable() and not {"\\", ":"} & set(name)
    return plain and not (posixpath.normpath(name) + "/").startswith(("/", "../"))


def _write(entry: _Entry, archive: Path, target: Path) -> None:
    with reading(archive):
        content = entry.open()
        if content is None:
            raise FormatError("entry of the archive has no content", got=entry.name)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            with content, target.open("wb") as out:
                shutil.copyfileobj(content, out)
        except OSError as error:
            if error.errno is None:  # of a decompressor, not of the system
                raise
            got = error.strerror
            raise OutputError("cannot unpack", where=target, got=got, hint="make room") from error
