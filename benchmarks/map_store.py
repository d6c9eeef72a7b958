"""Storage libraries for a map: the records of a drive, written and read with each of them.

MAP is the file of a map. Its records are written in the order of their numbers, with a commit
after every tenth of them, and read again at random. The libraries:

- ``sqlite``: the store of recon, with arrays as they are, or compressed (``sqlite_zlib``)
- ``npz``, ``npz_zlib``: one file for each record, renamed to its place when it is whole
- ``zarr``: a zarr 3 group for each record, in a folder, with zarr's default compression; needs zarr

Example: python benchmarks/map_store.py outputs/drive/map/map.recon --json
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any, Protocol

import checkout  # noqa: F401 - what is measured
import numpy as np

from recon.map.store.records import Store

COMMITS = 10
READS = 30
Record = tuple[str, int, dict[str, Any]]


def split(tree: Any) -> tuple[str, list[np.ndarray[Any, Any]]]:
    """A tree as JSON, and its arrays."""
    arrays: list[np.ndarray[Any, Any]] = []

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return {"array": len(arrays) - 1}
        if isinstance(value, dict):
            return {name: plain(item) for name, item in value.items()}
        return [plain(item) for item in value] if isinstance(value, list) else value

    return json.dumps(plain(tree)), arrays


def joined(text: str, array: Callable[[int], np.ndarray[Any, Any]]) -> dict[str, Any]:
    """The tree again."""

    def restored(value: Any) -> Any:
        if isinstance(value, dict):
            if value.keys() == {"array"}:
                return array(value["array"])
            return {name: restored(item) for name, item in value.items()}
        return [restored(item) for item in value] if isinstance(value, list) else value

    return dict(restored(json.loads(text)))


class _Backend(Protocol):
    """A library that keeps records."""

    def put(self, kind: str, key: int, tree: dict[str, Any]) -> None: ...

    def commit(self) -> None: ...

    def close(self) -> None: ...

    def get(self, kind: str, key: int) -> dict[str, Any]: ...

    def count(self) -> int: ...


class _Sqlite:
    """The store of recon."""

    def __init__(self, folder: Path, *, compress: bool = False) -> None:
        path, self._compress = folder / "map.recon", compress
        self._store = Store.open(path, cache_bytes=0) if path.exists() else Store.create(path)

    def put(self, kind: str, key: int, tree: dict[str, Any]) -> None:
        self._store.put(kind, key, tree, compress=self._compress)

    def commit(self) -> None:
        self._store.commit()

    def close(self) -> None:
        self._store.close()

    def get(self, kind: str, key: int) -> dict[str, Any]:
        return self._store.read(kind, key)

    def count(self) -> int:
        return len(self._store.keys("rays"))


class _Npz:
    """A file for each record."""

    def __init__(self, folder: Path, *, compress: bool = False) -> None:
        self._folder = folder
        self._save: Callable[..., None] = np.savez_compressed if compress else np.savez

    def put(self, kind: str, key: int, tree: dict[str, Any]) -> None:
        text, arrays = split(tree)
        path = self._folder / f"{kind}_{key:06d}.npz"
        with (self._folder / "new").open("wb") as file:
            self._save(file, text=np.array(text), **{f"a{n}": a for n, a in enumerate(arrays)})
            file.flush()
            os.fsync(file.fileno())
        (self._folder / "new").replace(path)

    def commit(self) -> None:
        """Each record is whole, but no file says which of them belong together."""

    def close(self) -> None: ...

    def get(self, kind: str, key: int) -> dict[str, Any]:
        with np.load(self._folder / f"{kind}_{key:06d}.npz") as file:
            return joined(str(file["text"]), lambda number: file[f"a{number}"])

    def count(self) -> int:
        return len(list(self._folder.glob("rays_*.npz")))


class _Zarr:
    """A group for each record."""

    def __init__(self, folder: Path) -> None:
        zarr = importlib.import_module("zarr")
        self._group = zarr.open_group(folder / "map.zarr", mode="a")

    def put(self, kind: str, key: int, tree: dict[str, Any]) -> None:
        text, arrays = split(tree)
        group = self._group.require_group(kind).create_group(str(key), overwrite=True)
        group.attrs["text"] = text
        for number, array in enumerate(arrays):
            # One chunk for each array: records are read whole.
            group.create_array(
                str(number), data=array, chunks=tuple(max(n, 1) for n in array.shape)
            )

    def commit(self) -> None:
        """Each chunk is whole; a record may be there in part."""

    def close(self) -> None: ...

    def get(self, kind: str, key: int) -> dict[str, Any]:
        group = self._group[f"{kind}/{key}"]
        return joined(group.attrs["text"], lambda number: group[str(number)][...])

    def count(self) -> int:
        return len(list(self._group["rays"].group_keys()))


BACKENDS: dict[str, Callable[[Path], _Backend]] = {
    "sqlite": _Sqlite,
    "sqlite_zlib": lambda folder: _Sqlite(folder, compress=True),
    "npz": _Npz,
    "npz_zlib": lambda folder: _Npz(folder, compress=True),
    "zarr": _Zarr,
}


def measure(
    make: Callable[[Path], _Backend], records: list[Record], folder: Path
) -> dict[str, Any]:
    """Write all records, open, and read some again."""
    backend, commits, start = make(folder), [], time.perf_counter()
    for number, (kind, key, tree) in enumerate(records, start=1):
        backend.put(kind, key, tree)
        if number % max(1, len(records) // COMMITS) == 0:
            begin = time.perf_counter()
            backend.commit()
            commits.append(time.perf_counter() - begin)
    backend.commit()
    backend.close()
    written_s = time.perf_counter() - start
    files = [path for path in folder.rglob("*") if path.is_file()]
    begin = time.perf_counter()
    backend = make(folder)
    backend.count()
    open_s = time.perf_counter() - begin
    figures = {
        "megabytes": sum(path.stat().st_size for path in files) / 1e6,
        "files": len(files),
        "write_all_s": written_s,
        "commit_ms": 1e3 * median(commits),
        "open_ms": 1e3 * open_s,
    }
    for kind in sorted({kind for kind, _, _ in records}):
        keys = [key for known, key, _ in records if known == kind]
        begin = time.perf_counter()
        for key in np.random.default_rng(0).choice(keys, READS).tolist():
            backend.get(kind, key)
        figures[f"read_{kind}_ms"] = 1e3 * (time.perf_counter() - begin) / READS
    backend.close()
    return figures


def records_of(path: Path) -> Iterator[Record]:
    """All records of a map that have one number, in the order of their numbers."""
    with Store.open(path, read_only=True) as store:
        keys = [(kind, key) for kind in store.kinds() for key in store.keys(kind)]
        for kind, key in sorted(keys, key=lambda known: str(known[1]).rjust(9)):
            if isinstance(key, int):
                yield kind, key, store.read(kind, key)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("map", type=Path, help="file of a map")
    parser.add_argument("--only", nargs="+", choices=BACKENDS, default=list(BACKENDS))
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    records = list(records_of(asked.map))
    found: dict[str, Any] = {}
    for name in asked.only:
        folder = Path(tempfile.mkdtemp(dir=asked.map.parent))
        try:
            found[name] = measure(BACKENDS[name], records, folder)
        except ImportError as error:
            found[name] = {"left out": str(error)}
        finally:
            shutil.rmtree(folder)
    if asked.json:
        print(json.dumps(found, indent=2))
        return
    for name, figures in found.items():
        values = (
            f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in figures.items()
        )
        print(f"{name:12}", ", ".join(values))


if __name__ == "__main__":
    main()
