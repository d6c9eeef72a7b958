"""Public data sets that can be mapped: where they come from and how they are laid out.

The list is ``datasets.toml`` beside this file; its first lines explain it.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timezone
from functools import cache
from pathlib import Path
from typing import Any, Final

from pydantic import Field

from recon.core.errors import DownloadError, FormatError, OutputError, SettingsError
from recon.core.progress import Counted, series, stage
from recon.core.settings import Settings
from recon.io.atomic import take_lock, write_text
from recon.io.download import OnBytes, download, unpack
from recon.io.fields import read_toml
from recon.io.files import digest_of, read_text, reading, refuse_links

_LIST: Final = Path(__file__).with_suffix(".toml")
RECORD: Final = "dataset.json"  # what was fetched, and size and hash of each file
_RECORD_BYTES: Final = 1 << 28
_HASH: Final = "hash"
_HASH_BYTES: Final = 4096
_PARTIAL: Final = ".partial"
_MEGABYTE: Final = 1_000_000


class Facts(Settings):
    """What is known of a file beforehand; the digest begins with its kind, such as ``md5:``."""

    bytes: int | None = None
    digest: str | None = None
    id: str = ""


class Archive(Facts):
    """One archive of a data set: its address, its name here, and what of it is unpacked."""

    path: str
    file: str = ""
    below: str = ""
    without: tuple[str, ...] = ()
    zips: bool = False

    def of_part(self, part: str, base: str, files: dict[str, Facts]) -> Archive:
        """Return the archive of one part, with its whole address and what is known of it."""
        file = (self.file or self.path.rpartition("/")[2]).format(part=part)
        facts = files.get(file, Facts())
        path = base + self.path.format(part=part, id=facts.id)
        below = self.below.format(part=part)
        return self.model_copy(update={**dict(facts), "path": path, "file": file, "below": below})


class Dataset(Settings):
    """One entry of the list; ``digest_beside`` is the kind of the hash beside each archive."""

    name: str
    about: str
    page: str
    licence: str
    cite: str
    layout: str
    use: str
    unchecked: str = ""
    digest_beside: str = ""
    base: str
    parts: tuple[str, ...] = ("",)
    archives: tuple[Archive, ...]
    files: dict[str, Facts] = Field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """What is fetched at once, into one folder: ``kitti-raw/2011_09_26_drive_0013``."""

    dataset: Dataset
    name: str
    archives: tuple[Archive, ...]

    @property
    def size(self) -> int | None:
        """Bytes to download; None = not known beforehand."""
        sizes = [one.bytes for one in self.archives]
        return None if None in sizes else sum(size or 0 for size in sizes)


@cache
def datasets() -> dict[str, Dataset]:
    """Return the list, by name."""
    entries = [Dataset.parse(one, where=str(_LIST)) for one in read_toml(_LIST)["dataset"]]
    return {one.name: one for one in entries}


def parts_of(dataset: Dataset) -> list[Part]:
    """Return the parts of a data set, in the order of the list; at least one."""
    parts = []
    for part in dataset.parts:
        archives = (one.of_part(part, dataset.base, dataset.files) for one in dataset.archives)
        parts.append(Part(dataset, f"{dataset.name}/{part}".rstrip("/"), tuple(archives)))
    return parts


def find_parts(name: str) -> list[Part]:
    """Return the parts that a name means: those of a data set, or one."""
    whole = name.rstrip("/").partition("/")[0]
    every = [part for one in datasets().values() for part in parts_of(one)]
    parts = [part for part in every if part.dataset.name == whole]
    found = [part for part in parts if name.rstrip("/") in (whole, part.name)]
    if not found:
        names = [part.name for part in parts] or list(datasets())
        near = difflib.get_close_matches(name, names, n=3) or ([] if parts else names)
        hint = f"`recon datasets list{' ' + whole if parts else ''}` lists them"
        expected = ", ".join(near) or None
        raise SettingsError("unknown data set or part", got=name, expected=expected, hint=hint)
    return found


def is_fetched(place: Path) -> bool:
    """Return whether a folder holds a part of a data set that was fetched."""
    return (place / RECORD).is_file()


def fetch_part(part: Part, folder: Path, mirror: str | None) -> dict[str, Any]:
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
        received = [_receive(one, part, work, mirror) for one in part.archives]
        stage("unpack")
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


def _receive(one: Archive, part: Part, work: Path, mirror: str | None) -> dict[str, Any]:
    """Download an archive that is not there yet, and check it; returns what is known of it."""
    address = one.path if mirror is None else f"{mirror.rstrip('/')}/{one.file}"
    path, promised = work / one.file, one.digest
    if kind := part.dataset.digest_beside:
        download(f"{address}.{kind}", work / _HASH)
        word, *_ = read_text(work / _HASH, _HASH_BYTES).split() or [""]
        if not (word.isalnum() and word.isascii()):
            raise DownloadError("no hash is there", where=f"{address}.{kind}")
        promised = f"{kind}:{word.lower()}"
    if not path.is_file():
        with _shown(one) as on_bytes:
            download(address, path, one.bytes, on_bytes)
    kind = promised.partition(":")[0] if promised else ""
    found = f"{kind}:{digest_of(path, kind)}" if kind else None
    if found != promised:
        path.unlink()
        what, hint = "the file is not what was promised", "try again, or another --address"
        raise DownloadError(what, where=address, got=found, expected=promised, hint=hint)
    return {
        "address": address,
        "bytes": path.stat().st_size,
        "digest": f"sha256:{digest_of(path)}",
        "checked": promised or ("size" if one.bytes else "nothing"),
    }


@contextmanager
def _shown(one: Archive) -> Iterator[OnBytes]:
    """Yield what shows the megabytes of a file, also of those that an earlier call received."""
    shown, last = 0, time.perf_counter()
    with series(one.file, math.ceil((one.bytes or 0) / _MEGABYTE), "MB") as progress:

        def on_bytes(received: int) -> None:
            nonlocal shown, last
            now = time.perf_counter()
            while shown < received // _MEGABYTE:
                shown += 1
                progress.on_step(Counted(now - last))
                last = now

        yield on_bytes


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
    return [path.stat().st_size, digest_of(path)]


def _recorded_files(place: Path) -> dict[str, list[Any]]:
    with reading(place / RECORD):
        files = json.loads(read_text(place / RECORD, _RECORD_BYTES))["files"]
        return {str(name): list(facts) for name, facts in files.items()}
