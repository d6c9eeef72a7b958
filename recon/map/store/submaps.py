"""The submaps of a session, as records of a map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Final

from recon.core.errors import FormatError
from recon.io.files import reading
from recon.map.store.records import Store
from recon.map.store.values import value_in
from recon.map.submaps import Submap

SUBMAP: Final = "submap"
ENTRY: Final = "submap_entry"
_VOXEL_BYTES: Final = 60
_CELL_BYTES: Final = 54
"""Most of one cell: its values, its surface point, and a block of its own."""


@dataclass(frozen=True)
class SubmapEntry:
    """What is known about a closed submap without reading it.

    Attributes:
        index: Index of the submap.
        first_frame: Index of its first frame.
        frames: Number of its frames.
        voxels: Voxels of its part of the fused cloud.
        cells: Cells of its part of the occupancy.
    """

    index: int
    first_frame: int
    frames: int
    voxels: int
    cells: int

    @property
    def nbytes(self) -> int:
        """Most bytes that the arrays of the submap take."""
        return _VOXEL_BYTES * self.voxels + _CELL_BYTES * self.cells

    @property
    def middle(self) -> int:
        """Index of the frame in its middle, whose correction the submap gets."""
        return self.first_frame + self.frames // 2


class Submaps:
    """Closed submaps of one drive, in order.

    Args:
        store: The records of the map.
        session: Number of the session.
    """

    def __init__(self, store: Store, session: int = 0) -> None:
        self._session = session
        self.store = store
        with reading(store.name):
            found = store.numbers(ENTRY, session)
            self._entries = [value_in(SubmapEntry, store.read(ENTRY, (session, n))) for n in found]
            frames = 0
            for index, entry in enumerate(self._entries):
                if (entry.index, entry.first_frame) != (index, frames) or entry.frames < 1:
                    raise FormatError("submaps of the drive are missing", got=f"{entry}")
                frames += entry.frames

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def entries(self) -> Sequence[SubmapEntry]:
        """One for each submap."""
        return tuple(self._entries)

    @property
    def frames(self) -> int:
        """Number of frames in all submaps."""
        return sum(entry.frames for entry in self._entries)

    def add(self, submap: Submap, *, compress: bool = False) -> None:
        """Store the next submap."""
        entry = _entry_of(submap)
        key = (self._session, submap.index)
        self.store.put(SUBMAP, key, submap.to_tree(), compress=compress)
        self.store.put(ENTRY, key, asdict(entry))
        self._entries.append(entry)

    def __getitem__(self, index: int) -> Submap:
        """Return a submap, read from the map: it is large, and used once."""
        with reading(self.store.name):
            most_bytes = self._entries[index].nbytes
            record = self.store.read(SUBMAP, (self._session, index), most_bytes=most_bytes)
            submap = Submap.from_tree(record)
            if _entry_of(submap) != self._entries[index]:
                raise FormatError("a submap of the map is another one", got=f"submap {index}")
            return submap

    def __iter__(self) -> Iterator[Submap]:
        """Return the submaps in order, read one at a time."""
        return map(self.__getitem__, range(len(self)))


def _entry_of(submap: Submap) -> SubmapEntry:
    fused, cells = len(submap.fused), len(submap.occupancy)
    return SubmapEntry(submap.index, submap.first_frame, submap.frames, fused, cells)
