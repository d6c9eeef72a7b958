"""The map: drives in one file that is opened, appended to, committed and closed."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Final

from typing_extensions import Self

from recon.core.errors import FormatError
from recon.core.geometry.se3 import invert
from recon.core.text import counted
from recon.core.values.arrays import Bool, Float64
from recon.io.files import StrPath, reading
from recon.map.store.links import LINKS, Link
from recon.map.store.records import CACHE_BYTES, Store
from recon.map.store.session import SESSION, Session, SessionInfo
from recon.map.store.trust import doubts_of_drives, placed_frames
from recon.run.directory import refuse_links

MAP_FILE: Final = "map/map.recon"
"""Where a finished run keeps its map."""


class MapFile:
    """What is known of one or several drives, on disk; memory holds the poses and a cache.

    Open one with `create`, `open` or `temporary`.

    Attributes:
        store: The records.
        sessions: The drives in it, in the order in which they were begun.

    Raises:
        FormatError: The records are damaged.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        numbers = [key for key in store.keys(SESSION) if isinstance(key, int)]
        self.sessions = [Session(store, number) for number in numbers]

    @classmethod
    def create(cls, path: StrPath, *, cache_bytes: int = CACHE_BYTES) -> Self:
        """Begin an empty map; a file at ``path`` is replaced.

        Raises:
            OutputError: The file cannot be written.
        """
        return cls(Store.create(Path(path), cache_bytes=cache_bytes))

    @classmethod
    def open(cls, path: StrPath, *, read_only: bool = True, cache_bytes: int = CACHE_BYTES) -> Self:
        """Open a map as it was committed last, or the map in the folder of a finished run.

        Raises:
            FormatError: The file is missing, no map, of a newer format, or damaged.
            OutputError: It is to be changed, and another program uses it or it cannot be written.
        """
        path = Path(path)
        file = path / MAP_FILE if path.is_dir() else path
        if path.is_dir() and not file.is_file():
            expected = f"a {MAP_FILE}, as recon map, live and merge keep it"
            raise FormatError("folder has no map", where=path, expected=expected)
        if path.is_dir():
            refuse_links(path)
        store = Store.open(file, read_only=read_only, cache_bytes=cache_bytes)
        try:
            return cls(store)
        except BaseException:
            store.close()
            raise

    @classmethod
    def temporary(cls) -> Self:
        """Begin an empty map that is gone when it is closed."""
        return cls(Store.temporary())

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}({self.store.name!r}, {counted(len(self.sessions), 'session')})"
        )

    def session(self, number: int = 0) -> Session:
        """Return a drive in the map.

        Raises:
            FormatError: There is none of this number.
        """
        for session in self.sessions:
            if session.number == number:
                return session
        known = ", ".join(str(session.number) for session in self.sessions) or "none"
        raise FormatError(
            "the map has no such session", where=self.store.name, got=number, expected=known
        )

    def T_world_session(self, session: Session) -> Float64:
        """Return float64 (4, 4), from the world of a drive to that of the map, its first drive's.

        Drives that are linked share the axes of the map.

        Raises:
            FormatError: The axes are not known.
        """
        return invert(self.first.T_map_world) @ session.T_map_world

    @property
    def links(self) -> list[Link]:
        """The places that two drives saw, those that contradict the others included.

        Raises:
            FormatError: The record of the links is damaged.
        """
        if not self.store.has(LINKS, 0):
            return []
        with reading(self.store.name):
            links = [Link.from_tree(tree) for tree in self.store.get(LINKS, 0)["links"]]
            for link in links:
                (one, other), loop = map(self.session, link.sessions), link.loop
                if not (0 <= loop.first < len(one) and 0 <= loop.last < len(other)):
                    raise FormatError("a link of the map is not between two frames", got=loop)
            return links

    @property
    def linked(self) -> list[Session]:
        """The drives that share the axes of the map; others are in it, but nobody knows where.

        Raises:
            FormatError: The record of the links is damaged.
        """
        if not self.store.has(LINKS, 0):
            return self.sessions[:1]
        with reading(self.store.name):
            numbers = self.store.get(LINKS, 0)["linked"]
            return [session for session in self.sessions if session.number in numbers]

    @property
    def first(self) -> Session:
        """The drive whose world and axes are those of the map.

        Raises:
            FormatError: The map has no drive.
        """
        if not (linked := self.linked):
            raise FormatError("the map has no drive", where=self.store.name)
        return linked[0]

    @property
    def placed(self) -> dict[int, Bool]:
        """Which frames of each linked drive, by its number, have a place in the map; bool (N,).

        Only these are in its products, and to be recognised.

        Raises:
            FormatError: The map is damaged.
        """
        return placed_frames(self.linked, self.links)

    @property
    def doubts(self) -> list[str]:
        """Lines of what is not to be trusted in the linked drives; whoever uses the map says so.

        Raises:
            FormatError: The map is damaged.
        """
        return doubts_of_drives(self.linked, self.placed)

    def set_links(self, links: Sequence[Link], linked: Collection[int]) -> None:
        """Keep the links, and the numbers of the drives that share the axes of the map.

        Raises:
            OutputError: They cannot be written.
        """
        content = {"links": [link.to_tree() for link in links], "linked": sorted(linked)}
        self.store.put(LINKS, 0, content, compress=True)

    def begin(self, info: SessionInfo) -> Session:
        """Add a drive.

        Raises:
            OutputError: It cannot be written.
        """
        number = max((session.number for session in self.sessions), default=-1) + 1
        self.sessions.append(Session.begin(self.store, number, info))
        return self.sessions[-1]

    def commit(self) -> None:
        """Make everything so far permanent: all of it or, after an error, nothing.

        Raises:
            OutputError: The disk is full or cannot be written; the file keeps the last commit.
        """
        for session in self.sessions:
            session.flush()
        self.store.commit()

    def close(self) -> None:
        """Close the file; what was not committed is lost."""
        self.store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
