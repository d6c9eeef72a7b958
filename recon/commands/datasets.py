"""`recon datasets`: list, fetch and verify public data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from recon.core.errors import FormatError
from recon.run.progress import SILENT, Progress
from recon.sources.datasets import Part, datasets, find_parts, parts_of
from recon.sources.fetching import fetch_part, is_fetched, verify_part

FOLDER: Final = Path("datasets")


def run_list(name: str | None = None, folder: Path = FOLDER) -> dict[str, Any]:
    """List data sets, or the parts of one: what `recon datasets list` does.

    Args:
        name: A data set; None = all of them.
        folder: Where data sets are kept.

    Raises:
        SettingsError: There is no such data set.
    """
    if name is None:
        listed = [_described(list(parts_of(one)), folder) for one in datasets().values()]
        return {"datasets": listed}
    parts = find_parts(name)
    shown = [
        {"name": part.name, "bytes": part.size, "fetched": is_fetched(folder / part.name)}
        for part in parts
    ]
    return {**_described(parts, folder), "parts": shown}


def run_fetch(
    names: Sequence[str],
    folder: Path = FOLDER,
    *,
    address: str | None = None,
    progress: Progress = SILENT,
) -> dict[str, Any]:
    """Download, check and unpack data sets: what `recon datasets fetch` does.

    A part appears in its folder when all of it is there. What is there already is not fetched
    again, and a download that broke off goes on where it was.

    Args:
        names: Data sets, or parts of them.
        folder: Where to.
        address: A mirror: a folder on a server that has the archives by their names.
        progress: Shown each megabyte.

    Raises:
        SettingsError: There is no such data set.
        DownloadError: An archive cannot be downloaded, or is not what was promised.
        FormatError: An archive is damaged or hostile.
        OutputError: There is no room, or another process is fetching it.
    """
    parts = {part.name: part for name in names for part in find_parts(name)}
    fetched = {name: fetch_part(part, folder, address, progress) for name, part in parts.items()}
    return {"datasets": [{"name": name, **found} for name, found in fetched.items()]}


def run_verify(names: Sequence[str], folder: Path = FOLDER) -> dict[str, Any]:
    """Compare fetched files with what was unpacked: what `recon datasets verify` does.

    Args:
        names: Data sets, or parts of them; of a data set, the parts that were fetched.
        folder: Where they are.

    Raises:
        SettingsError: There is no such data set.
        FormatError: It was not fetched, or a file is missing or changed.
    """
    parts = {part.name: folder / part.name for name in names for part in find_parts(name)}
    there = {name: place for name, place in parts.items() if is_fetched(place)}
    for name in names:
        if not any(part == name or part.startswith(f"{name.rstrip('/')}/") for part in there):
            hint = f"recon datasets fetch {name}"
            raise FormatError("this data set was not fetched", where=folder / name, hint=hint)
    return {"datasets": [{"name": name, **verify_part(place)} for name, place in there.items()]}


def _described(parts: Sequence[Part], folder: Path) -> dict[str, Any]:
    entry, sizes = parts[0].dataset, [part.size for part in parts]
    facts = entry.model_dump(include={"name", "about", "page", "licence", "cite", "layout", "use"})
    fetched = sum(is_fetched(folder / part.name) for part in parts)
    known = None if None in sizes else sum(size or 0 for size in sizes)
    return {
        **facts,
        "unchecked": entry.unchecked,
        "bytes": known,
        "parts": len(parts),
        "fetched": fetched,
    }
