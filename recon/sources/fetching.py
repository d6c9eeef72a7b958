"""Fetching of public data sets: each part arrives in its folder whole, or not at all."""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

from recon.core.errors import DownloadError, FormatError, OutputError
from recon.io.archives import FileFacts, unpack
from recon.io.atomic import write_text
from recon.io.download import OnBytes, digest_of, download, fetch_text
from recon.io.files import read_text, reading
from recon.io.lock import take_lock
from recon.run.progress import SILENT, Progress
from recon.sources.datasets import Download, Part

RECORD: Final = "dataset.json"
"""What was fetched, and size and hash of each file."""
_RECORD_BYTES: Final = 1 << 28
_PARTIAL: Final = ".partial"
_MEGABYTE: Final = 1_000_000


@dataclass(frozen=True)
class Megabyte:
    """A megabyte that has arrived; a `Step` of the progress.

    Attributes:
        number: Of how many, from 1.
        seconds: Time since the one before.
    """

    number: int
    seconds: float
    ok: bool = True
    state: str = ""

    @property
    def event(self) -> dict[str, Any]:
        """Its figures for programs."""
        return {"event": "megabyte", "number": self.number, "seconds": round(self.seconds, 3)}


def is_fetched(place: Path) -> bool:
    """Return whether a folder holds a part of a data set that was fetched."""
    return (place / RECORD).is_file()


def fetch_part(
    part: Part, folder: Path, mirror: str | None = None, progress: Progress = SILENT
) -> dict[str, Any]:
    """Fetch one part into its folder, unless it is there.

    Args:
        part: The part.
        folder: Where data sets are kept.
        mirror: A folder on a server that has the archives by their names; None = the owners'.
        progress: Shown each megabyte.

    Returns:
        Its folder, the number of its files, and whether it was fetched now.

    Raises:
        DownloadError: An archive cannot be downloaded, or is not what was promised.
        FormatError: An archive is damaged or hostile.
        OutputError: There is no room, the folder is of something else, or another process is
            fetching it.
    """
    place = folder / part.name
    if is_fetched(place):
        return {"out": str(place), "files": len(_read_record(place)["files"]), "fetched": False}
    if place.exists():
        raise OutputError("folder was not made by recon datasets", where=place, hint="move it away")
    work = folder / _PARTIAL / part.name
    busy = "another process is fetching this data set"
    lock = take_lock(work / ".lock", busy, where=place, hint="wait for it")
    try:
        record = _unpacked(part, work, mirror, progress)
        place.parent.mkdir(parents=True, exist_ok=True)
        (work / "files").replace(place)
        shutil.rmtree(work)
        with suppress(OSError):  # another part is being fetched
            os.removedirs(work.parent)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("the same command goes on from there") from interrupt
    finally:
        os.close(lock)
    return {"out": str(place), "files": len(record["files"]), "fetched": True}


def _unpacked(part: Part, work: Path, mirror: str | None, progress: Progress) -> dict[str, Any]:
    """Download the archives of a part and unpack them; returns the record of its files."""
    received = [_receive(one, work, mirror, progress) for one in part.downloads]
    progress.on_stage("unpack")
    shutil.rmtree(work / "files", ignore_errors=True)
    files: FileFacts = {}
    for one in part.downloads:
        files |= unpack(work / one.file, work / "files", one.choice)
    record = {
        "name": part.name,
        "fetched_utc": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "licence": part.dataset.licence,
        "cite": part.dataset.cite,
        "archives": received,
        "files": dict(sorted(files.items())),
    }
    write_text(work / "files" / RECORD, json.dumps(record, indent=1, ensure_ascii=False))
    return record


def _receive(one: Download, work: Path, mirror: str | None, progress: Progress) -> dict[str, Any]:
    """Download an archive that is not there yet; returns what is known of it."""
    address = one.address if mirror is None else f"{mirror.rstrip('/')}/{one.file}"
    promise = one.promise
    if one.digest_beside:
        promise = replace(promise, digest=_published(f"{address}.{one.digest_beside}", one))
    path = work / one.file
    if not path.is_file():
        with _shown(one.file, promise.size, progress) as on_bytes:
            download(address, path, promise, on_bytes)
    found = digest_of(path, "sha256")
    checked = promise.digest or ("size" if promise.size else "nothing")
    return {"address": address, "bytes": path.stat().st_size, "digest": found, "checked": checked}


@contextmanager
def _shown(name: str, size: int | None, progress: Progress) -> Iterator[OnBytes]:
    """Yield what shows the megabytes of a file, also of those that an earlier call received."""
    shown, last = -1, time.perf_counter()

    def on_bytes(done: int, total: int | None) -> None:
        nonlocal shown, last
        if shown < 0:
            progress.on_start(name, math.ceil((size or total or 0) / _MEGABYTE), "MB")
            shown = 0
        now = time.perf_counter()
        while shown < done // _MEGABYTE:
            shown += 1
            progress.on_step(Megabyte(shown, now - last))
            last = now

    try:
        yield on_bytes
    finally:
        if shown >= 0:
            progress.on_finish()


def _published(address: str, one: Download) -> str:
    """Return the hash in a file of its owners, whose first word it is."""
    words = fetch_text(address).split()
    if not words or not words[0].isalnum() or not words[0].isascii():
        raise DownloadError("no hash is there", where=address)
    return f"{one.digest_beside}:{words[0].lower()}"


def verify_part(place: Path) -> dict[str, Any]:
    """Compare the files of a fetched part with what was unpacked.

    Returns:
        Its folder and the number of its files.

    Raises:
        FormatError: A file is missing or has changed; the first one is named.
    """
    found: dict[str, Any] = {"out": str(place), "files": 0}
    for name, (size, digest) in _read_record(place)["files"].items():
        path = place / name
        wrong = "is missing" if not path.is_file() else ""
        if not wrong and (
            path.stat().st_size != size or digest_of(path, "sha256") != f"sha256:{digest}"
        ):
            wrong = "has changed"
        if wrong:
            hint = f"remove {place} and fetch it again"
            raise FormatError(f"file of the data set {wrong}", where=path, hint=hint)
        found["files"] += 1
    return found


def _read_record(place: Path) -> dict[str, Any]:
    path = place / RECORD
    with reading(path):
        record = json.loads(read_text(path, _RECORD_BYTES))
        record["files"] = {
            str(name): (int(n), str(hash_)) for name, (n, hash_) in record["files"].items()
        }
        return dict(record)
