"""`recon datasets`: list, fetch and verify public data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from recon.core.errors import FormatError
from recon.sources.datasets import (
    Part,
    datasets,
    fetch_part,
    find_parts,
    is_fetched,
    parts_of,
    verify_part,
)

FOLDER: Final = Path("datasets")


def run_list(name: str | None = None, folder: Path = FOLDER) -> dict[str, Any]:
    """List all data sets, or one with its parts."""
    if name is None:
        return {"datasets": [_described(parts_of(one), folder) for one in datasets().values()]}
    shown = [
        {"name": part.name, "bytes": part.size, "fetched": is_fetched(folder / part.name)}
        for part in find_parts(name)
    ]
    return {**_described(find_parts(name), folder), "parts": shown}


def run_fetch(
    names: Sequence[str],
    folder: Path = FOLDER,
    *,
    address: str | None = None,
) -> dict[str, Any]:
    """Download, check and unpack data sets, or parts of them, that are not there yet.

    ``address`` is a mirror: a folder on a server that has the archives by their names.
    """
    parts = {part.name: part for name in names for part in find_parts(name)}
    return {"datasets": [fetch_part(one, folder, address) for one in parts.values()]}


def run_verify(names: Sequence[str], folder: Path = FOLDER) -> dict[str, Any]:
    """Compare the files of data sets, or of the parts that were fetched, with what was unpacked."""
    there: dict[str, None] = {}
    for name in names:
        fetched = [part.name for part in find_parts(name) if is_fetched(folder / part.name)]
        if not fetched:
            hint = f"recon datasets fetch {name}"
            raise FormatError("this data set was not fetched", where=folder / name, hint=hint)
        there |= dict.fromkeys(fetched)
    return {"datasets": [verify_part(name, folder) for name in there]}


def _described(parts: Sequence[Part], folder: Path) -> dict[str, Any]:
    entry, sizes = parts[0].dataset, [part.size for part in parts]
    facts = ("name", "about", "page", "licence", "cite", "layout", "use", "unchecked")
    return {
        **{name: getattr(entry, name) for name in facts},
        "bytes": None if None in sizes else sum(size or 0 for size in sizes),
        "parts": len(parts),
        "fetched": sum(is_fetched(folder / part.name) for part in parts),
    }
