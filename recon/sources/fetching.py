"""Fetching of public data sets: each part arrives in its folder whole, or not at all."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Final

from recon.core.errors import DownloadError, FormatError, OutputError
from recon.io.archives import unpack
from recon.io.atomic import write_text
from recon.io.download import OnBytes, download
from recon.io.files import read_text, reading
from recon.io.lock import take_lock
from recon.run.directory import refuse_links
from recon.run.progress import Progress
from recon.sources.datasets import Archive, Part

RECORD: Final = "dataset.json"
"""What was fetched, and size and hash of each file."""
_RECORD_BYTES: Final = 1 << 28
_HASH: Final = "hash"
_HASH_BYTES: Final = 4096
_PARTIAL: Final = ".partial"
_MEGABYTE: Final = 1_000_000


@dataclass(frozen=True)
class _Megabyte:
    """A megabyte that has arrived, in so many seconds; a `Step` of the progress."""

    number: int
    seconds: float
    ok: bool = True
    state: str = ""

    @property
    def event(self) -> dict[str, Any]:
        return {"event": "megabyte", "number": self.number, "seconds": round(self.seconds, 3)}


def is_fetched(place: Path) -> bool:
    """Return whether a folder holds a part of a data set that was fetched."""
    return (place / RECORD).is_file()


def fetch_part(part: Part, folder: Path, mirror: str | None, progress: Progress) -> dict[str, Any]:
    """Fetch one part into its folder, unless it is there."""
    place, work = folder / part.name, folder / _PARTIAL / part.name
    found = {"name": part.name, "out": str(place)}
    for ours in (place, work):
        refuse_links(ours, below=folder)
    if is_fetched(place):
        return {**found, "files": len(_recorded_files(place)), "fetched": False}
    if place.exists():
        raise OutputError("folder was not made by recon datasets", where=place, hint="move it away")
    busy = "another process is fetching this data set"
    try:
        lock = take_lock(work / ".lock", busy, where=place, hint="wait for it")
    except OSError as error:
        raise OutputError("cannot be written", where=folder, got=error.strerror) from error
    try:
        received = [_receive(one, part, work, mirror, progress) for one in part.archives]
        progress.on_stage("unpack")
        count = _unpack(part, work, received)
        place.parent.mkdir(parents=True, exist_ok=True)
        (work / "files").replace(place)
        shutil.rmtree(work)
        with suppress(OSError):  # another part is being fetched
            os.removedirs(work.parent)
    except KeyboardInterrupt as interrupt:
        raise KeyboardInterrupt("the same command goes on from there") from interrupt
    finally:
        os.close(lock)
    return {**found, "files": count, "fetched": True}


def _receive(
    one: Archive, part: Part, work: Path, mirror: str | None, progress: Progress
) -> dict[str, Any]:
    """Download an archive that is not there yet, and check it; returns what is known of it."""
    address = one.path if mirror is None else f"{mirror.rstrip('/')}/{one.file}"
    path, promised = work / one.file, one.digest
    if kind := part.dataset.digest_beside:
        promised = _published(f"{address}.{kind}", kind, work)
    if not path.is_file():
        with _shown(one, progress) as on_bytes:
            download(address, path, one.bytes, on_bytes)
    found = _digest(path, promised.partition(":")[0]) if promised else None
    if found != promised:
        path.unlink()
        what, hint = "the file is not what was promised", "try again, or another --address"
        raise DownloadError(what, where=address, got=found, expected=promised, hint=hint)
    return {
        "address": address,
        "bytes": path.stat().st_size,
        "digest": _digest(path, "sha256"),
        "checked": promised or ("size" if one.bytes else "nothing"),
    }


def _published(address: str, kind: str, work: Path) -> str:
    """Return the hash in a file of the owners, whose first word it is."""
    download(address, work / _HASH)
    word, *_ = read_text(work / _HASH, _HASH_BYTES).split() or [""]
    if not (word.isalnum() and word.isascii()):
        raise DownloadError("no hash is there", where=address)
    return f"{kind}:{word.lower()}"


@contextmanager
def _shown(one: Archive, progress: Progress) -> Iterator[OnBytes]:
    """Yield what shows the megabytes of a file, also of those that an earlier call received."""
    shown, last = -1, time.perf_counter()

    def on_bytes(done: int, total: int | None) -> None:
        nonlocal shown, last
        if shown < 0:
            progress.on_start(one.file, math.ceil((total or 0) / _MEGABYTE), "MB")
            shown = 0
        now = time.perf_counter()
        while shown < done // _MEGABYTE:
            shown += 1
            progress.on_step(_Megabyte(shown, now - last))
            last = now

    try:
        yield on_bytes
    finally:
        if shown >= 0:
            progress.on_finish()


def _unpack(part: Part, work: Path, received: Sequence[Mapping[str, Any]]) -> int:
    """Unpack the archives of a part, with a record of its files; returns their number."""
    files = work / "files"
    shutil.rmtree(files, ignore_errors=True)
    for one in part.archives:
        unpack(work / one.file, files, below=one.below, without=one.without, zips=one.zips)
    names = sorted(path.relative_to(files).as_posix() for path in files.rglob("*"))
    facts = {name: _facts(files / name) for name in names if (files / name).is_file()}
    record = {
        "name": part.name,
        "fetched_utc": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "licence": part.dataset.licence,
        "cite": part.dataset.cite,
        "archives": received,
        "files": facts,
    }
    write_text(files / RECORD, json.dumps(record, indent=1, ensure_ascii=False))
    return len(facts)


def verify_part(name: str, folder: Path) -> dict[str, Any]:
    """Compare the files of a fetched part with what was unpacked; the first other one is named."""
    place = folder / name
    refuse_links(place, below=folder)
    files = _recorded_files(place)
    for file, facts in files.items():
        path = place / file
        if not path.is_file() or _facts(path) != facts:
            wrong = "has changed" if path.is_file() else "is missing"
            hint = f"remove {place} and fetch it again"
            raise FormatError(f"file of the data set {wrong}", where=path, hint=hint)
    return {"name": name, "out": str(place), "files": len(files)}


def _facts(path: Path) -> list[Any]:
    """Return the size in bytes and the SHA-256 of a file."""
    return [path.stat().st_size, _digest(path, "sha256").partition(":")[2]]


def _digest(path: Path, kind: str) -> str:
    """Return the hash of a file with its kind, such as ``sha256:…``."""
    digest = hashlib.new(kind, usedforsecurity=False)
    with path.open("rb") as file:
        while piece := file.read(_MEGABYTE):
            digest.update(piece)
    return f"{kind}:{digest.hexdigest()}"


def _recorded_files(place: Path) -> dict[str, list[Any]]:
    """Return the facts of each file of a fetched part, by its path."""
    with reading(place / RECORD):
        files = json.loads(read_text(place / RECORD, _RECORD_BYTES))["files"]
        return {str(name): list(facts) for name, facts in files.items()}
