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
from recon.map.store.session import ENTRY, KEYFRAME, SUBMAP, Session
from recon.map.store.trees import FRAMES, LINKS, RAYS

_CALLED: Final = {KEYFRAME: "keyframe", ENTRY: "submap"}  # kinds by their names for users
_COUNTED: Final = {KEYFRAME: "frame", RAYS: "frame", FRAMES: "first frame"}
_SHOWN: Final = 2  # sessions in the terminal


@dataclass(frozen=True)
class Damage(Figures):
    """A record that cannot be read, such as ``rays of session 0, frame 17``."""

    record: str
    why: str


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
    links_refused: int  # those that contradict the others
    damaged: Sequence[Damage]

    def rows(self) -> Rows:
        many = counted(len(self.sessions), "session"), counted(self.records, "record")
        sizes = Counter(self.bytes_by_kind)
        said = f"{_mb(sum(sizes.values()))} MB, all can be read"
        kinds = ", ".join(f"{kind} {_mb(size)}" for kind, size in sizes.most_common(4))
        by = ", ".join(sorted({one.versions.get("recon", "?") for one in self.sessions}))
        more = len(self.sessions) - _SHOWN
        return [
            (f"{', '.join(many)}, {said}",),
            ("map", self.file),
            *(_row(one) for one in self.sessions[:_SHOWN]),
            *([("", f"and {counted(more, 'session')} more: --json")] if more > 0 else ()),
            (
                "links",
                f"{counted(self.links, 'place')} of two drives, {self.links_refused} refused",
            ),
            ("MB by kind", kinds),
            ("format", f"{self.format}, by recon {by}; this one reads up to {self.newest_format}"),
        ]

    def refuse_damage(self) -> None:
        """Raise `FormatError` for the first record that cannot be read, if there is one."""
        if self.damaged:
            first, *others = self.damaged
            more = f"{counted(len(others), 'other record')} cannot be read" if others else None
            raise FormatError(first.why, where=self.file, got=first.record, hint=more)


def check_map_file(path: StrPath) -> MapContent:
    """Read a map, or the one of a finished run, as it was committed last, record by record.

    First the bytes of each against its checksum, and the pages of the file; if these are whole,
    also whether their content is what later commands take. Memory holds one record at a time.

    Raises:
        FormatError: There is no map, or one of a newer format. What is damaged is returned.
    """
    file = file_of_map(path)
    with closing(Store.open(file, read_only=True)) as store:
        damaged: list[Damage] = []
        sizes: Counter[tuple[str, str]] = Counter()  # by session and kind
        records = store.names()
        for kind, name in tracked(records, "records", "check the records"):
            read: Callable[[], Any] = partial(store.verify, kind, name)
            of = "" if kind == LINKS else name.partition(",")[0]
            sizes[of, _CALLED.get(kind, kind)] += _tried(read, kind, name, damaged) or 0
        stage("check the file")
        _tried(store.verify_pages, "", "", damaged)
        sessions: list[SessionContent] = []
        links = []
        if not damaged and (map_ := _tried(partial(MapFile, store), "", "", damaged)) is not None:
            for kind, name, read in tracked(list(_parts(map_)), "parts", "read the map"):
                _tried(read, kind, name, damaged)
            if not damaged:
                linked, links = map_.linked, map_.links
                sessions = [_content(one, one in linked, sizes) for one in map_.sessions]
        kinds: Counter[str] = Counter()
        for (_, kind), size in sizes.items():
            kinds[kind] += size
        return MapContent(
            file=str(file),
            format=store.format,
            records=len(records),
            bytes_by_kind=kinds,
            sessions=sessions,
            links=sum(link.kept for link in links),
            links_refused=sum(not link.kept for link in links),
            damaged=damaged,
        )


def _tried(read: Callable[[], Any], kind: str, name: str, damaged: list[Damage]) -> Any:
    """Return what is read, or None and one more that is damaged."""
    try:
        return read()
    except ReconError as error:
        where = f": {error.got}" if error.got is not None and not kind else ""
        damaged.append(Damage(_record(kind, name), f"{error.what}{where}"))
        return None


def _parts(map_: MapFile) -> Iterator[tuple[str, str, Callable[[], Any]]]:
    """Yield kind, key and reader of what the sessions of a map do not read when it is opened."""
    yield "", "", lambda: (map_.placed, map_.paths)
    for one in map_.sessions:
        own = f"{one.number},"
        yield "", "", lambda one=one: (one.rig, one.fixes)  # type: ignore[misc]
        if len(one):  # else it has no axes yet
            yield "", "", lambda one=one: (one.camera, one.T_map_world)  # type: ignore[misc]
        for n in range(len(one.submaps)):
            yield SUBMAP, f"{own}{n}", partial(one.submaps.__getitem__, n)
        for n in one.keyframes.frames:
            yield KEYFRAME, f"{own}{n}", partial(one.keyframes.get, n)
        for n in map_.store.numbers(RAYS, one.number):
            yield RAYS, f"{own}{n}", partial(one.rays, n)


def _record(kind: str, name: str) -> str:
    if kind in ("", LINKS):
        return kind or "file"
    session, _, number = name.partition(",")
    at = f", {_COUNTED.get(kind, 'number')} {number}" if number else ""
    return f"{_CALLED.get(kind, kind)} of session {session}{at}"


def _content(session: Session, linked: bool, sizes: Counter[tuple[str, str]]) -> SessionContent:
    return SessionContent(
        number=session.number,
        name=session.info.source,
        frames=len(session),
        length_m=session.trajectory.path_length_m if len(session) else 0.0,
        linked=linked,
        keyframes=len(session.keyframes.frames),
        ray_frames=session.ray_frames,
        bytes_by_kind={kind: n for (own, kind), n in sizes.items() if own == str(session.number)},
        versions=session.info.versions,
    )


def _row(one: SessionContent) -> tuple[str, ...]:
    frames = f"{counted(one.frames, 'frame')}, {one.length_m:.0f} m"
    size = f"{counted(one.keyframes, 'keyframe')}, {_mb(sum(one.bytes_by_kind.values()))} MB"
    return f"session {one.number}", one.name, f"{frames}, {size}"


def _mb(size: int) -> str:
    return f"{size / 1e6:.3g}"
