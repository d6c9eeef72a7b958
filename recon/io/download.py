"""Downloads over HTTP that go on where they broke off, checked against what was promised."""

from __future__ import annotations

import hashlib
import http.client
import json
import re
import shutil
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from recon.core.errors import DownloadError, OutputError
from recon.io.atomic import write_text

PIECE_BYTES: Final = 1_000_000
#: Some servers refuse the name of the library.
_AGENT: Final = "recon-datasets/1"
_TRIES: Final = 5
_PAUSE_S: Final = 1.0
_TIMEOUT_S: Final = 60.0
_SMALL_BYTES: Final = 4096
"""Most that is read of a small text file."""
_RANGE: Final = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)")
#: What a server says that is too busy, or is started again.
_PASSING: Final = frozenset({408, 425, 429, 500, 502, 503, 504})

OnBytes = Callable[[int, int | None], None]
"""Receives the number of bytes that are there and, if it is known, of those to come in all."""


@dataclass(frozen=True)
class Promise:
    """What is known of a file before it is downloaded.

    Attributes:
        size: Its size in bytes; None = not known.
        digest: A hash with its kind, such as ``sha256:…`` or ``md5:…``; None = not known.
    """

    size: int | None = None
    digest: str | None = None


class _BrokenOffError(Exception):
    """The connection ended early, or the server asks to come back later."""


def download(
    address: str, path: Path, promise: Promise, on_bytes: OnBytes = lambda done, total: None
) -> None:
    """Download a file, or the rest of one that an earlier call began.

    What is there of it is kept beside it, with what the server says of its version, and continued
    if the server still has that version. A connection that breaks off is opened again, up to five
    times in a row without a byte.

    Args:
        address: Its address, with http or https.
        path: Where to; it appears when it is complete and is what was promised.
        promise: What it must be.
        on_bytes: Called after each megabyte.

    Raises:
        DownloadError: The server does not have the file or another one, sends more than it said,
            or cannot be reached; or the file is not what was promised.
        OutputError: There is no room for it, or it cannot be written.
    """
    part = path.with_name(path.name + ".part")
    tries = 0
    while True:
        before = _size(part)
        try:
            _transfer(address, part, promise, on_bytes)
            break
        except _BrokenOffError as error:
            tries = 1 if _size(part) > before else tries + 1
            if tries >= _TRIES:
                raise DownloadError(
                    "the download breaks off again and again",
                    where=address,
                    got=f"{error}, {_size(part)} bytes are there",
                    hint="the same command goes on from there",
                ) from error
            time.sleep(_PAUSE_S * 2**tries)
    _check(address, part, promise)
    part.replace(path)
    _note(part).unlink(missing_ok=True)


def fetch_text(address: str) -> str:
    """Read a small text file, such as one with a hash.

    Raises:
        DownloadError: It cannot be read.
    """
    try:
        with _open(address, {}) as response:
            return str(response.read(_SMALL_BYTES).decode("utf-8", "replace"))
    except _BrokenOffError as error:
        raise DownloadError("cannot be downloaded", where=address, got=error) from error


def digest_of(path: Path, kind: str) -> str:
    """Return the hash of a file with its kind, such as ``sha256:…``."""
    digest = hashlib.new(kind, usedforsecurity=False)
    with path.open("rb") as file:
        while piece := file.read(PIECE_BYTES):
            digest.update(piece)
    return f"{kind}:{digest.hexdigest()}"


def _transfer(address: str, part: Path, promise: Promise, on_bytes: OnBytes) -> None:
    """Receive the rest of a file, or all of it where the server cannot go on."""
    version, known = _begun(part)
    if known is not None and _size(part) == known:
        return  # complete: the call before was killed while it was checked
    asked = {"Range": f"bytes={_size(part)}-", "If-Range": version} if version else {}
    with _open(address, asked) as response:
        begin, total = _span(response)
        if begin != (_size(part) if begin else 0):
            _forget(part)
            raise _BrokenOffError("the server sends another part than was asked for")
        _expect(address, total, promise)
        _need_room(part, (total or promise.size or 0) - begin)
        write_text(_note(part), json.dumps([_version(response), total]))
        _receive(address, response, part, (begin, total or promise.size), on_bytes)
        if total is not None and _size(part) < total:
            raise _BrokenOffError(f"{_size(part)} of {total} bytes")


def _receive(
    address: str,
    response: http.client.HTTPResponse,
    part: Path,
    span: tuple[int, int | None],
    on_bytes: OnBytes,
) -> None:
    done, total = span
    try:
        with part.open("r+b" if done else "wb") as out:
            out.seek(done)
            for piece in _pieces(response):
                done += len(piece)
                if total is not None and done > total:
                    _forget(part)
                    raise DownloadError("the server sends more than it said", where=address)
                out.write(piece)
                on_bytes(done, total)
    except OSError as error:
        reason = error.strerror or str(error)
        raise OutputError("cannot write the download", where=part, got=reason) from error


def _pieces(response: http.client.HTTPResponse) -> Iterator[bytes]:
    with _network():
        while piece := response.read(PIECE_BYTES):
            yield piece


@contextmanager
def _open(address: str, headers: dict[str, str]) -> Iterator[http.client.HTTPResponse]:
    """Open an address.

    Raises:
        DownloadError: It is no address, or the server refuses it.
        _BrokenOffError: The server cannot be reached, or is busy.
    """
    try:
        scheme = urlsplit(address).scheme
    except ValueError:  # such as half an IPv6 address
        scheme = ""
    if scheme not in ("http", "https"):
        raise DownloadError(
            "not an address that can be downloaded", where=address, expected="http or https"
        )
    sent = {"User-Agent": _AGENT, "Accept-Encoding": "identity", **headers}
    request = urllib.request.Request(address, headers=sent)  # noqa: S310 - checked above
    with _network(address):
        response = _opener().open(request, timeout=_TIMEOUT_S)
    with response:
        yield response


@contextmanager
def _network(address: str = "") -> Iterator[None]:
    """Tell passing faults of the network from those that stay."""
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
    """Follows redirections, but from https to nothing else."""

    def redirect_request(self, req, fp, code, msg, headers, newurl):  # type: ignore[no-untyped-def]
        if urlsplit(req.full_url).scheme == "https" and urlsplit(newurl).scheme != "https":
            raise DownloadError(
                "the server redirects to an address that is not encrypted",
                where=req.full_url,
                got=newurl,
            )
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _opener() -> urllib.request.OpenerDirector:
    """Return what opens http and https alone: no files, no FTP."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        urllib.request.UnknownHandler,
        _SafeRedirects,
    ):
        opener.add_handler(handler())
    return opener


def _span(response: http.client.HTTPResponse) -> tuple[int, int | None]:
    """Return where the content begins in the file, and the size of the file if it is stated."""
    ranged = _RANGE.fullmatch(response.headers.get("Content-Range", ""))
    if response.status == http.client.PARTIAL_CONTENT and ranged is not None:
        return int(ranged[1]), None if ranged[3] == "*" else int(ranged[3])
    length = response.headers.get("Content-Length", "")
    return 0, int(length) if length.isdigit() else None


def _version(response: http.client.HTTPResponse) -> str:
    """Return what identifies this version of the file at the server; "" = nothing does."""
    tag = response.headers.get("ETag", "")
    return str(
        response.headers.get("Last-Modified", "") if tag.startswith("W/") or not tag else tag
    )


def _expect(address: str, total: int | None, promise: Promise) -> None:
    if None not in (total, promise.size) and total != promise.size:
        raise DownloadError(
            "the server has another file than the list of data sets",
            where=address,
            got=f"{total} bytes",
            expected=f"{promise.size} bytes",
        )


def _need_room(part: Path, size: int) -> None:
    free = shutil.disk_usage(part.parent).free
    if size > free:
        raise OutputError(
            "there is no room for the download",
            where=part.parent,
            got=f"{free / 1e9:.1f} GB free",
            expected=f"{size / 1e9:.1f} GB",
        )


def _check(address: str, part: Path, promise: Promise) -> None:
    """Compare a complete download with the promise; a wrong one is removed."""
    wrong = None
    if promise.size is not None and _size(part) != promise.size:
        wrong = (f"{_size(part)} bytes", f"{promise.size} bytes")
    elif promise.digest is not None:
        found = digest_of(part, promise.digest.partition(":")[0])
        wrong = None if found == promise.digest else (found, promise.digest)
    if wrong is not None:
        _forget(part)
        raise DownloadError(
            "the file is not what was promised",
            where=address,
            got=wrong[0],
            expected=wrong[1],
            hint="it was removed; try again, or another --address",
        )


def _begun(part: Path) -> tuple[str, int | None]:
    """Return the version and size of a download that was begun; "" and None = not known."""
    try:
        version, total = json.loads(_note(part).read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError):
        return "", None
    return str(version), total if isinstance(total, int) else None


def _size(part: Path) -> int:
    return part.stat().st_size if part.is_file() else 0


def _note(part: Path) -> Path:
    """Return the file with the version of a download that was begun."""
    return part.with_name(part.name + ".version")


def _forget(part: Path) -> None:
    part.unlink(missing_ok=True)
    _note(part).unlink(missing_ok=True)
