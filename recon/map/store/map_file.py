"""The map on disk: drives in one file, which frames have a place in it, and what can be seen."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Final, overload

import numpy as np
from typing_extensions import Self

from recon.core.errors import FormatError, MappingError
from recon.core.geometry.se3 import invert
from recon.core.text import counted
from recon.core.values import RectifiedCamera, Rig, Trajectory
from recon.core.values.arrays import Bool, Float64, Int64
from recon.io.files import StrPath, reading, refuse_links
from recon.look.rig import KnownRig
from recon.map.store.records import CACHE_BYTES, Store
from recon.map.store.session import SESSION, Session, SessionInfo
from recon.map.store.trees import FORGOTTEN, LINKS, Forgotten, Link, value_in
from recon.odometry.health import doubt_about, name_frames, segment_numbers
from recon.places.detector import KnownPlaces, KnownView

MAP_FILE: Final = "map/map.recon"  # where a finished run keeps its map


def file_of_map(path: StrPath) -> Path:
    """Return the file of a map, which may be named by the folder of its run."""
    file = Path(path)
    if not file.is_dir():
        return file
    if not (file / MAP_FILE).is_file():
        expected = f"a {MAP_FILE}, as recon map, live and merge keep it"
        raise FormatError("folder has no map", where=path, expected=expected)
    refuse_links(file)
    return file / MAP_FILE


class MapFile:
    """What is known of one or several drives, on disk; memory holds the poses and a cache.

    Open one with `create`, `open` or `temporary`. Whatever reads raises `FormatError` where the map
    is damaged, whatever writes `OutputError` where the file cannot be written.

    Attributes:
        store: The records.
        sessions: The drives in it, in the order in which they were begun.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        numbers = [key for key in store.keys(SESSION) if isinstance(key, int)]
        self.sessions = [Session(store, number) for number in numbers]

    @classmethod
    def create(cls, path: StrPath, *, cache_bytes: int = CACHE_BYTES) -> Self:
        """Begin an empty map; a file at ``path`` is replaced."""
        return cls(Store.create(Path(path), cache_bytes=cache_bytes))

    @classmethod
    def open(cls, path: StrPath, *, read_only: bool = True, cache_bytes: int = CACHE_BYTES) -> Self:
        """Open a map as it was committed last, or the map in the folder of a finished run.

        Raises:
            FormatError: The file is missing, no map, of a newer format, or damaged.
            OutputError: It is to be changed, and another program uses it or it cannot be written.
        """
        store = Store.open(file_of_map(path), read_only=read_only, cache_bytes=cache_bytes)
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
        sessions = counted(len(self.sessions), "session")
        return f"{type(self).__name__}({self.store.name!r}, {sessions})"

    def session(self, number: int = 0) -> Session:
        """Return a drive in the map; `FormatError` if there is none of this number."""
        for session in self.sessions:
            if session.number == number:
                return session
        known = ", ".join(str(session.number) for session in self.sessions) or "none"
        raise FormatError(
            "the map has no such session", where=self.store.name, got=number, expected=known
        )

    def known_rig(self, given: Rig) -> KnownRig | None:
        """Return what the last drive of a rig with this calibration showed of it, if any did."""
        found = (session.rig for session in reversed(self.sessions))
        return next((rig for rig in found if rig is not None and rig.is_of(given)), None)

    def T_world_session(self, session: Session) -> Float64:
        """Return float64 (4, 4), from the world of a linked drive to that of the map."""
        return invert(self.first.T_map_world) @ session.T_map_world

    @property
    def links(self) -> list[Link]:
        """The places that two drives saw, those that contradict the others included."""
        with reading(self.store.name):
            trees = self.store.find(LINKS, 0, links=())["links"]
            links = [Link.from_tree(tree) for tree in trees]
            for link in links:
                (one, other), loop = map(self.session, link.sessions), link.loop
                if not (0 <= loop.first < len(one) and 0 <= loop.last < len(other)):
                    raise FormatError("a link of the map is not between two frames", got=loop)
            return links

    @property
    def linked(self) -> list[Session]:
        """The drives that share the axes of the map; others are in it, but nobody knows where."""
        if not self.store.has(LINKS, 0):
            return self.sessions[:1]
        with reading(self.store.name):
            numbers = self.store.get(LINKS, 0)["linked"]
            return [session for session in self.sessions if session.number in numbers]

    @property
    def first(self) -> Session:
        """The drive whose world and axes are those of the map; `FormatError` if it has no drive."""
        if not (linked := self.linked):
            raise FormatError("the map has no drive", where=self.store.name)
        return linked[0]

    @property
    def paths(self) -> dict[int, Trajectory]:
        """The path of each linked drive by its number, in the world of the map."""
        return {
            session.number: replace(
                path, T_world_camera=self.T_world_session(session) @ path.T_world_camera
            )
            for session, path in ((session, session.trajectory) for session in self.linked)
        }

    @property
    def placed(self) -> dict[int, Bool]:
        """Which frames of each linked drive, by its number, have a place in the map; bool (N,).

        Those whose pose is to be trusted, of segments that loops, links or measured positions hold
        to the longest one of the first drive. Behind a lost pose odometry guesses, and a guess does
        not enter the map. Only these frames are in products, and to be recognised.
        """
        if not (sessions := self.linked):
            return {}
        of = {session.number: segment_numbers(session.health) for session in sessions}
        constraints, first = [*_constraints(sessions, self.links, of)], sessions[0].number
        held = {(first, int(np.bincount(of[first] + 1, minlength=2)[1:].argmax()))}
        while (
            more := {
                b
                for constraint in constraints
                for a, b in (constraint, constraint[::-1])
                if a in held
            }
            - held
        ):
            held |= more
        return {
            number: (segment >= 0) & np.isin(segment, [s for drive, s in held if drive == number])
            for number, segment in of.items()
        }

    def joined(self, session: Session) -> Bool:
        """Which frames of a linked drive are part of its path in the map; bool (N,).

        Frames without a trusted pose go with those before them. All, if no pose is trusted.
        """
        segment, placed = segment_numbers(session.health), self.placed[session.number]
        last = np.maximum.accumulate(np.where(segment >= 0, np.arange(len(segment)), -1))
        first = int(np.argmax(segment >= 0))
        return np.asarray(
            np.isin(segment[np.maximum(last, first)], segment[placed]) | ~placed.any()
        )

    @property
    def doubts(self) -> list[str]:
        """Lines of what is not to be trusted in the linked drives; whoever uses the map says so."""
        lines, placed, many = [], self.placed, len(self.linked) > 1
        for session in self.linked:
            of = f"session {session.number} ({session.info.source}): " if many else ""
            lines += [of + line for line in doubt_about(session.health)]
            apart = np.flatnonzero(session.trusted & ~placed[session.number]).tolist()
            if apart:
                lie = "lies" if len(apart) == 1 else "lie"
                why = f"{lie} beyond a break, and no loop closure connects them"
                left_out = "not in cloud, grid, OctoMap and mesh, nor to be recognised"
                lines.append(f"{of}{name_frames(apart)} {why}: {left_out}")
        return lines

    def set_links(self, links: Sequence[Link], linked: Collection[int]) -> None:
        """Keep the links, and the numbers of the drives that share the axes of the map."""
        content = {"links": [link.to_tree() for link in links], "linked": sorted(linked)}
        self.store.put(LINKS, 0, content, compress=True)

    @property
    def forgotten(self) -> list[Forgotten]:
        """The drives that left the map, by number."""
        with reading(self.store.name):
            drives = self.store.find(FORGOTTEN, 0, drives=())["drives"]
            return [value_in(Forgotten, tree) for tree in drives]

    def set_forgotten(self, forgotten: Collection[Forgotten]) -> None:
        """Keep which drives left the map."""
        drives = [asdict(one) for one in sorted(forgotten, key=lambda one: one.number)]
        self.store.put(FORGOTTEN, 0, {"drives": drives})

    @property
    def mb_per_km(self) -> float | None:
        """Size of the file by the length of the paths of all drives; None if nothing moved."""
        length_m = sum(
            session.trajectory.path_length_m for session in self.sessions if len(session)
        )
        return 1e-3 * self.store.nbytes / length_m if length_m else None

    @property
    def next_number(self) -> int:
        """The number of the next drive: none that another one has, or had."""
        had = [one.number for one in self.forgotten]
        return max([-1, *had, *(session.number for session in self.sessions)]) + 1

    def begin(self, info: SessionInfo) -> Session:
        number = self.next_number
        self.sessions.append(Session.begin(self.store, number, info))
        return self.sessions[-1]

    def commit(self) -> None:
        """Make everything so far permanent: all of it or, after an error, nothing."""
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


_Segment = tuple[int, int]
"""Number of a drive, and of a segment of it."""
_SURVEY: Final[_Segment] = (-1, -1)
_FEWEST_FIXES: Final = 2  # measured positions that say where a segment is, and which way it goes


def _constraints(
    sessions: Sequence[Session], links: Sequence[Link], of: Mapping[int, Int64]
) -> Iterator[tuple[_Segment, _Segment]]:
    """Yield pairs of segments that loops, links and measured positions hold together."""

    def segment(number: int, frame: int) -> _Segment:
        return number, int(of[number][frame])

    for session in sessions:
        number = session.number
        for loop in session.loops.get("closed", ()):
            yield segment(number, loop["first"]), segment(number, loop["last"])
        measured, counts = np.unique(of[number][session.fixes.frames], return_counts=True)
        for one in measured[(measured >= 0) & (counts >= _FEWEST_FIXES)].tolist():
            yield (number, one), _SURVEY
    for link in links:
        if link.kept and set(link.sessions) <= set(of):
            one, other = link.sessions
            yield segment(one, link.loop.first), segment(other, link.loop.last)


def known_places(map_: MapFile) -> KnownPlaces:
    """Return all places of a map, to recognise them."""
    views = MapViews(map_)
    if not views:
        raise MappingError(
            "the map has no keyframes to be recognised by",
            where=map_.store.name,
            hint="map the drive again with this version",
        )
    return KnownPlaces(views, map_.first.scale)


class MapViews(Sequence[KnownView]):
    """What a map can recognise, with the ``keys`` (drive, frame); each is read when asked for.

    ``sessions`` are the numbers of the drives to take; None = those that share the axes of the map,
    as far as they have a place in it.
    """

    def __init__(self, map_: MapFile, sessions: Collection[int] | None = None) -> None:
        self._map = map_
        self.keys: list[tuple[int, int]] = []
        self._poses: dict[int, Float64] = {}
        self._cameras: dict[int, RectifiedCamera] = {}
        taken = map_.linked if sessions is None else map(map_.session, sorted(sessions))
        placed = map_.placed if sessions is None else None
        for session in taken:
            frames = session.keyframes.frames
            if placed is not None:
                frames = [frame for frame in frames if placed[session.number][frame]]
            if frames:
                T_world_session = map_.T_world_session(session)
                self._poses[session.number] = T_world_session @ session.trajectory.T_world_camera
                self._cameras[session.number] = session.camera
                self.keys.extend((session.number, frame) for frame in frames)

    def __len__(self) -> int:
        return len(self.keys)

    @overload
    def __getitem__(self, number: int) -> KnownView: ...
    @overload
    def __getitem__(self, number: slice) -> list[KnownView]: ...
    def __getitem__(self, number: int | slice) -> KnownView | list[KnownView]:
        if isinstance(number, slice):
            return [self[n] for n in range(*number.indices(len(self)))]
        session, frame = self.keys[number]
        stored = self._map.session(session).keyframes.get(frame)
        pose = self._poses[session][frame]
        return KnownView(stored.keyframe, self._cameras[session], pose, session)
