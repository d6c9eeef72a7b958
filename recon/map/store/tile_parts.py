"""Parts of a map on disk, by the square tile of the map that they lie in."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from recon.core.kernels.voxels import distinct_keys, pack_keys, unpack_keys
from recon.core.values.arrays import Bool
from recon.map.rectangle import Rectangle
from recon.map.store.records import Store

_NOTE: Final = "note"
TileKey = tuple[int, int]
"""Column and row of a tile; tile (0, 0) has its lower corner in the origin of the map."""


class TileParts:
    """Numbered parts of several kinds in each tile, in a file; others' files can be looked into.

    Args:
        edge_m: Side of a tile.
        path: The file, which `save` makes readable for others; None = a temporary one.

    Attributes:
        edge_m: Side of a tile.
    """

    def __init__(self, edge_m: float, path: Path | None = None) -> None:
        self.edge_m = edge_m
        self._store = Store.temporary() if path is None else Store.create(path)
        self._homes: dict[tuple[str, TileKey, int], Store] = {}
        self._numbers: dict[str, dict[TileKey, list[int]]] = defaultdict(dict)
        self._keys: dict[TileKey, None] = {}

    @property
    def keys(self) -> list[TileKey]:
        """The tiles in which there is something, in the order in which they were begun."""
        return list(self._keys)

    def bounds(self, key: TileKey) -> Rectangle:
        """Return the bounds of a tile."""
        (x, y), edge_m = key, self.edge_m
        return Rectangle((x * edge_m, y * edge_m), ((x + 1) * edge_m, (y + 1) * edge_m))

    def near(
        self, places_m: NDArray[np.floating[Any]], margin_m: float
    ) -> Iterator[tuple[TileKey, Bool]]:
        """Yield the tiles that have places (N, 2 or 3) in them or their margin, and which ones."""
        home = np.floor(places_m[:, :2] / self.edge_m).astype(np.int64)
        # Packed into one integer, since numpy sorts rows slowly.
        homes = unpack_keys(distinct_keys(pack_keys(np.pad(home, ((0, 0), (0, 1))))))
        reach = math.ceil(margin_m / self.edge_m) or 1
        steps = range(-reach, reach + 1)
        found = {(x + i, y + j) for x, y, _ in homes.tolist() for i, j in product(steps, repeat=2)}
        for key in sorted(found):
            inside = self.bounds(key).wider(margin_m).contains(places_m)
            if inside.any():
                yield key, inside

    def under(self, rectangle: Rectangle) -> list[TileKey]:
        """Return the tiles that a rectangle touches and in which there is something."""
        low = np.floor(np.array(rectangle.low) / self.edge_m).astype(int).tolist()
        high = np.floor(np.array(rectangle.high) / self.edge_m).astype(int).tolist()
        columns, rows = (range(a, b + 1) for a, b in zip(low, high, strict=True))
        return [key for key in product(columns, rows) if key in self._keys]

    def numbers(self, kind: str, key: TileKey) -> Sequence[int]:
        """Return the numbers of the parts of a kind in a tile, in the order they were put."""
        return tuple(self._numbers[kind].get(key, ()))

    def put(
        self, kind: str, key: TileKey, tree: Mapping[str, Any], number: int | None = None
    ) -> None:
        """Keep a part, by default under the next number."""
        numbers = self._numbers[kind].setdefault(key, [])
        numbers.append(len(numbers) if number is None else number)
        self._store.put(kind, (*key, numbers[-1]), tree)
        self._keys[key] = None

    def read(self, kind: str, key: TileKey) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield the parts of a kind in a tile with their numbers; arrays are read-only."""
        # Past the cache: reading a tile again is faster than making it, and it may be large.
        return (
            (n, self._homes.get((kind, key, n), self._store).read(kind, (*key, n)))
            for n in self.numbers(kind, key)
        )

    def drop(self, kind: str, key: TileKey) -> None:
        """Forget the parts of a kind in a tile; they stay in the files of others."""
        for number in self._numbers[kind].pop(key, ()):
            if self._homes.pop((kind, key, number), None) is None:
                self._store.delete(kind, (*key, number))

    def save(self, note: Mapping[str, Any]) -> None:
        """Make the file readable for `adopt`, with a note, and close it."""
        self._store.put(_NOTE, 0, {"keys": self.keys, "note": note})
        self._store.commit()
        self._store.close()

    def adopt(self, path: Path) -> dict[str, Any]:
        """Add the parts in a file that was saved, which is not copied; return its note."""
        store = Store.open(path, read_only=True)
        saved = store.read(_NOTE, 0)
        self._keys.update(dict.fromkeys((x, y) for x, y in saved["keys"]))
        for kind in store.kinds():
            for x, y, number in (key for key in store.keys(kind) if isinstance(key, tuple)):
                self._numbers[kind].setdefault((x, y), []).append(number)
                self._homes[kind, (x, y), number] = store
        return dict(saved["note"])
