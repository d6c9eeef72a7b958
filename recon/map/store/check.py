"""Whether every record of a map can be read, and what is in it: what `recon map --check` says."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from recon.core.errors import FormatError, ReconError
from recon.core.progress import stage, tracked
from recon.core.summary import Figures, Rows, Summary
from recon.core.text import counted
from recon.io.files import StrPath
from recon.map.store.map_file import MapFile, file_of_map
from recon.map.store.records import FORMAT, Store
from recon.map.store.session import KEYFRAME, SUBMAP, Session
from recon.map.store.trees import LINKS, RAYS

_CALLED: Final = {KEYFRAME: "keyframe"}  # a kind by its name for users
_SHOWN: Final = 2  # sessions in the terminal
_Read = Callable[[], Any]


@dataclass(frozen=True, kw_only=True)
class SessionContent(Figures):
    """What a map has of a drive."""

    number: int
    name: str
    frames: int
    length_m: float  # of its path
    linked: bool
    keyframes: int
    ray_frames: int
    bytes_by_kind: Mapping[str, int]
    versions: Mapping[str, str]  # that mapped it

    def row(self) -> tuple[str, ...]:
        size = f"{self.length_m:.0f} m, {_mb(sum(self.bytes_by_kind.values()))} MB"
        shown = f"{counted(self.frames, 'frame')}, {counted(self.keyframes, 'keyframe')}, {size}"
        return f"session {self.number}", self.name, shown


@dataclass(frozen=True, kw_only=True)
class MapContent(Summary):
    """What is in the file of a map; of a damaged one, its records alone."""

    file: str
    format: int
    newest_format: int = FORMAT  # that this program reads
    records: int
    bytes_by_kind: Mapping[str, int]
    sessions: Sequence[SessionContent]
    links: int
    damaged: Mapping[str, str]  # why, by the name of the record: rays of session 0, number 17

    def rows(self) -> Rows:
        if self.damaged:
            return []
        sizes, more = Counter(self.bytes_by_kind), len(self.sessions) - _SHOWN
        many = counted(len(self.sessions), "session"), counted(self.records, "record")
        by = ", ".join(sorted({one.versions.get("recon", "?") for one in self.sessions}))
        return [
            (f"{', '.join(many)}, {_mb(sum(sizes.values()))} MB, all can be read",),
            ("map", self.file),
            *(one.row() for one in self.sessions[:_SHOWN]),
            *([("", f"and {counted(more, 'session')} more: --json")] if more > 0 else ()),
            ("links", f"{counted(self.links, 'place')} seen by two drives"),
            ("MB", ", ".join(f"{kind} {_mb(n)}" for kind, n in sizes.most_common(4))),
            ("format", f"{self.format}, by recon {by}; this one reads up to {self.newest_format}"),
        ]

    def refuse_damage(self) -> None:
        """Raise `FormatError` for the first record that cannot be read, if there is one."""
        for record, why in self.damaged.items():
            others = len(self.damaged) - 1
            hint = f"{counted(others, 'other record')} cannot be read" if others else None
            raise FormatError(why, where=self.file, got=record, hint=hint)


def check_map_file(path: StrPath) -> MapContent:
    """Read a map, or the one of a finished run, as it was committed last, record by record.

    First the bytes of each against its checksum, and the pages of the file; if these are whole,
    also whether their content is what later commands take. Memory holds one record at a time.

    Raises:
        FormatError: There is no map, or one of a newer format. What is damaged is returned.
    """
    damaged: dict[str, str] = {}

    def tried(record: str, read: _Read) -> Any:
        try:
            return read()
        except ReconError as error:
            got = f": {error.got}" if record == "file" and error.got is not None else ""
            damaged[record] = f"{error.what}{got}"

    file = file_of_map(path)
    with closing(Store.open(file, read_only=True)) as store:
        sizes: dict[str, Counter[str]] = {}  # by session, those of the whole map by ""
        records = store.names()
        for kind, name in tracked(records, "records", "check the records"):
            size = tried(_record(kind, name), partial(store.verify, kind, name)) or 0
            of = "" if kind == LINKS else name.partition(",")[0]
            sizes.setdefault(of, Counter())[_CALLED.get(kind, kind)] += size
        stage("check the file")
        tried("file", store.verify_pages)
        map_: MapFile | None = None if damaged else tried("file", partial(MapFile, store))
        if map_ is not None:
            for record, read in tracked(list(_parts(map_)), "parts", "read the map"):
                tried(record, read)
        whole = None if damaged else map_
        linked = [] if whole is None else whole.linked
        return MapContent(
            file=str(file),
            format=store.format,
            records=len(records),
            bytes_by_kind=sum(sizes.values(), Counter()),
            sessions=[_content(s, s in linked, sizes) for s in (whole.sessions if whole else ())],
            links=len(whole.links) if whole else 0,
            damaged=damaged,
        )


def _parts(map_: MapFile) -> Iterator[tuple[str, _Read]]:
    """Yield what the sessions of a map do not read when it is opened."""
    begun = [one for one in map_.sessions if len(one)]  # others have no axes yet
    yield "file", lambda: (map_.placed, map_.paths)
    yield "file", lambda: [(one.camera, one.T_map_world, one.rig, one.fixes) for one in begun]
    for one in map_.sessions:
        for kind, numbers, read in (
            (SUBMAP, range(len(one.submaps)), one.submaps.__getitem__),
            (KEYFRAME, one.keyframes.frames, one.keyframes.get),
            (RAYS, map_.store.numbers(RAYS, one.number), one.rays),
        ):
            yield from ((_record(kind, f"{one.number},{n}"), partial(read, n)) for n in numbers)


def _record(kind: str, name: str) -> str:
    session, _, number = name.partition(",")
    of = "" if kind == LINKS else f" of session {session}"
    return f"{_CALLED.get(kind, kind)}{of}{f', number {number}' if number else ''}"


def _content(one: Session, linked: bool, sizes: Mapping[str, Mapping[str, int]]) -> SessionContent:
    return SessionContent(
        number=one.number,
        name=one.info.source,
        frames=len(one),
        length_m=one.trajectory.path_length_m if len(one) else 0.0,
        linked=linked,
        keyframes=len(one.keyframes.frames),
        ray_frames=one.ray_frames,
        bytes_by_kind=sizes[str(one.number)],
        versions=one.info.versions,
    )


def _mb(size: int) -> str:
    return f"{size / 1e6:.3g}"
