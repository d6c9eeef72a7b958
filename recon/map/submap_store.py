"""Storage of closed submaps: in memory, or on disk so that memory does not grow with the drive."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from recon.core.errors import FormatError
from recon.io.tree_file import read_tree, write_tree
from recon.map import Submap

_CACHED: Final = 6


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


class SubmapStore:
    """Closed submaps of one drive, in order.

    Args:
        folder: Folder that each is written to, atomically; None = they stay in memory.
        cached: Number of submaps kept in memory after being read.
    """

    def __init__(self, folder: Path | None = None, cached: int = _CACHED) -> None:
        self._folder = folder
        self._limit = cached
        self._entries: list[SubmapEntry] = []
        self._held: OrderedDict[int, Submap] = OrderedDict()

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def entries(self) -> Sequence[SubmapEntry]:
        """One for each submap."""
        return tuple(self._entries)

    def add(self, submap: Submap) -> None:
        """Store the next submap.

        Raises:
            OutputError: It cannot be written.
        """
        if self._folder is None:
            self._held[submap.index] = submap
        else:
            write_tree(self._path(submap.index), submap.to_tree())
        self._entries.append(
            SubmapEntry(
                submap.index,
                submap.first_frame,
                submap.frames,
                len(submap.fused),
                len(submap.occupancy),
            )
        )

    def get(self, index: int) -> Submap:
        """A submap, read from disk if it is not in memory.

        Raises:
            FormatError: Its file is missing or damaged.
        """
        if index not in self._held:
            self._held[index] = self._read(index)
            while len(self._held) > self._limit:
                self._held.popitem(last=False)
        self._held.move_to_end(index)
        return self._held[index]

    def __iter__(self) -> Iterator[Submap]:
        """The submaps in order; those on disk are read one at a time."""
        for index in range(len(self)):
            yield self._held[index] if index in self._held else self._read(index)

    def state(self) -> list[list[int]]:
        """The entries, as plain values."""
        return [[e.index, e.first_frame, e.frames, e.voxels, e.cells] for e in self._entries]

    def restore(self, state: Sequence[Sequence[int]]) -> None:
        """Continue from a `state`; the files of its submaps must be in the folder."""
        self._entries = [SubmapEntry(*entry) for entry in state]
        self._held.clear()

    def _read(self, index: int) -> Submap:
        path = self._path(index)
        tree: dict[str, Any] = read_tree(path)
        try:
            return Submap.from_tree(tree)
        except (KeyError, TypeError) as error:
            raise FormatError("the file holds no submap", where=path) from error

    def _path(self, index: int) -> Path:
        if self._folder is None:
            raise FormatError("the submap was never stored", where=f"submap {index}")
        return self._folder / f"submap_{index:06d}.zip"
