"""Downloads over HTTP that go on where they broke off, and archives, which may be hostile."""

from __future__ import annotations

import http.client
import posixpath
import shutil
import stat
import tarfile
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, Any, Final
from urllib.parse import urlsplit

from recon.core.errors import DownloadError, FormatError, OutputError
from recon.core.text import counted
from recon.io.atomic import write_text
from recon.io.files import naming, reading

_PIECE_BYTES: Final = 1_000_000
_AGENT: Final = "recon-datasets/1"  # some servers refuse the name of the library
_TRIES: Final = 5
_PAUSE_S: Final = 1.0
_TIMEOUT_S: Final = 60.0
_PASSING: Final = frozenset({408, 425, 429, 500, 502, 503, 504})  # busy, or starting again

OnBytes = Callable[[int], None]
"""Receives the number of bytes that are there and, if it is known, of those to come in all."""


class _BrokenOffError(Exception):
    """The connection ended early, or the server asks to come back later."""


def download(
    address: str, path: Path, size: int | None = None, on_bytes: OnBytes = lambda *_: None
) -> None:
    """Download a file, or the rest of one that an earlier call began; reopen what breaks off."""
    part, tries = path.with_name(path.name + ".part"), 0
    while True:
        before = _size(part)
        try:
            _receive(address, part, size, on_bytes)
            break
        except _BrokenOffError as error:
            tries = 1 if _size(part) > before else tries + 1
            if tries >= _TRIES:
                got = f"{error}, {counted(_size(part), 'byte')} arrived"
                what = "the download breaks off again and again"
                hint = "the same command goes on from there"
                raise DownloadError(what, where=address, got=got, hint=hint) from error
            time.sleep(_PAUSE_S * 2**tries)
    part.replace(path)
    _version_file(part).unlink()


def _receive(address: str, part: Path, size: int | None, on_bytes: OnBytes) -> None:
    """Receive the rest of a file, or all of it where the server cannot go on."""
    # One byte is asked for again: a file that is complete has no rest that could be sent.
    begin, known = max(_size(part) - 1, 0), _version_file(part)
    version = known.read_text(errors="replace") if known.is_file() else ""
    safe = version.isascii() and version.isprintable()
    asked = {"Range": f"bytes={begin}-", "If-Range": version} if version and safe else {}
    with _open(address, asked) as response:
        if response.status != http.client.PARTIAL_CONTENT:
            begin = 0
        elif not response.headers.get("Content-Range", "").startswith(f"bytes {begin}-"):
            _forget(part)
            raise _BrokenOffError("the server sends another part than was asked for")
        total = size if response.length is None else begin + response.length
        if size is not None and total is not None and total != size:
            what = "the server has another file than the list of data sets"
            got = counted(total, "byte")
            raise DownloadError(what, where=address, got=got, expected=counted(size, "byte"))
        free, needed = shutil.disk_usage(part.parent).free, (total or 0) - begin
        if needed > free:
            what = "not enough disk space for the download"
            got, expected = f"{free / 1e9:.1f} GB free", f"{needed / 1e9:.1f} GB"
            raise OutputError(what, where=part.parent, got=got, expected=expected)
        if begin == 0:
            _forget(part)
        version = response.headers.get("Last-Modified") or response.headers.get("ETag", "")
        write_text(_version_file(part), version)
        for done in _written(part, begin, response):
            if total is not None and done > total:
                _forget(part)
                raise DownloadError("the server sends more than it said", where=address)
            on_bytes(done)
    if total is not None and _size(part) < total:
        raise _BrokenOffError(f"{_size(part)} of {counted(total, 'byte')}")


def _written(part: Path, begin: int, response: http.client.HTTPResponse) -> Iterator[int]:
    """Write what arrives; yields the size of the file after each piece."""
    try:
        with part.open("r+b" if begin else "wb") as out:
            out.seek(begin)
            while True:
                with _network():
                    piece = response.read(_PIECE_BYTES)
                if not piece:
                    break
                out.write(piece)
                yield out.tell()
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError("cannot write the download", where=part, got=reason) from error


def _open(address: str, asked: Mapping[str, str]) -> Any:
    try:
        scheme = urlsplit(address).scheme
    except ValueError:  # such as half an IPv6 address
        scheme = ""
    if scheme not in ("http", "https"):
        what = "not an address that can be downloaded"
        raise DownloadError(what, where=address, expected="http or https")
    sent = {"User-Agent": _AGENT, "Accept-Encoding": "identity", **asked}
    request = urllib.request.Request(address, headers=sent)  # noqa: S310 - checked above
    with _network(address):
        return urllib.request.build_opener(_SafeRedirects).open(request, timeout=_TIMEOUT_S)


@contextmanager
def _network(address: str = "") -> Iterator[None]:
    try:
        yield
    except urllib.error.HTTPError as error:
        got = f"{error.code} {error.reason}"
        if error.code in _PASSING:
            raise _BrokenOffError(got) from error
        raise DownloadError("the server refuses the file", where=address, got=got) from error
    except (http.client.HTTPException, OSError) as error:
        reason = error.reason if isinstance(error, urllib.error.URLError) else error
        raise _BrokenOffError(str(reason) or type(reason).__name__) from error


class _SafeRedirects(urllib.request.HTTPRedirectHandler):
    """Follows redirections to http and https, and from https to nothing else."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        if urlsplit(newurl).scheme not in ("https", urlsplit(req.full_url).scheme):
            what = "the server redirects to an address that is not encrypted"
            raise DownloadError(what, where=req.full_url, got=newurl)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _version_file(part: Path) -> Path:
    return part.with_name(part.name + ".version")


def _size(part: Path) -> int:
    return part.stat().st_size if part.is_file() else 0


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _version_file(part).unlink(missing_ok=True)


_MOST_GROWTH: Final = 50  # images and clouds hardly shrink; what grows by more fills the disk
_SMALL_BYTES: Final = 100_000_000
_LEAST_BYTES: Final = 4096  # what an entry takes of a disk, however small it is
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
    """Unpack a zip or tar archive, of which only what is ``below`` a folder, into a folder.

    Nothing is written outside of it, and no link: one that leads out refuses the archive. Files
    with a suffix in ``without`` are left out; with ``zips``, archives in it are unpacked in their
    place.
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
