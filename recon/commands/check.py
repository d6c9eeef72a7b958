"""`recon map --check`: whether every record of a map can be read, and what is in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from recon.commands.map_summary import JoinedDrive
from recon.commands.merge import joined_drives
from recon.core.errors import FormatError, ReconError
from recon.core.progress import stage, tracked
from recon.core.summary import Rows, Summary
from recon.core.text import counted
from recon.io.files import StrPath
from recon.map.map import Map
from recon.map.sessions.copying import read_all
from recon.map.store.map_file import file_of_map
from recon.map.store.records import FORMAT, Store
from recon.map.store.session import KEYFRAME
from recon.map.store.trees import LINKS

_CALLED: Final = {KEYFRAME: "keyframe"}  # a kind by its name for users
_FILE: Final = "file"  # in place of a record
_SHOWN: Final = 2  # sessions in the terminal


@dataclass(frozen=True, kw_only=True)
class MapContent(Summary):
    """What is in the file of a map; of a damaged one, its records alone."""

    file: str
    format: int
    newest_format: int = FORMAT  # that this program reads
    records: Mapping[str, Mapping[str, int]]  # number by session and kind; "" = of no session
    bytes: Mapping[str, Mapping[str, int]]
    sessions: Sequence[JoinedDrive]
    versions: Mapping[str, Mapping[str, str]]  # that mapped each session
    links: int
    damaged: Mapping[str, str]  # why, by the name of the record: rays of session 0, number 17

    def rows(self) -> Rows:
        if self.damaged:
            return []
        sizes, more = sum(map(Counter, self.bytes.values()), Counter()), len(self.sessions) - _SHOWN
        records = sum(sum(each.values()) for each in self.records.values())
        many = counted(len(self.sessions), "session"), counted(records, "record")
        by = ", ".join(sorted({one.get("recon", "?") for one in self.versions.values()}))
        return [
            (f"{', '.join(many)}, {_mb(sum(sizes.values()))} MB, all can be read",),
            ("map", self.file),
            *map(self._row, self.sessions[:_SHOWN]),
            *([("", f"and {counted(more, 'session')} more: --json")] if more > 0 else ()),
            ("links", f"{counted(self.links, 'place')} seen by two drives"),
            ("MB", ", ".join(f"{kind} {_mb(n)}" for kind, n in sizes.most_common(4))),
            ("format", f"{self.format}, by recon {by}; this one reads up to {self.newest_format}"),
        ]

    def _row(self, one: JoinedDrive) -> tuple[str, ...]:
        number = f"{one.number}"
        keyframes = counted(self.records[number].get("keyframe", 0), "keyframe")
        size = f"{one.length_m:.0f} m, {_mb(sum(self.bytes[number].values()))} MB"
        return f"session {number}", one.name, f"{counted(one.frames, 'frame')}, {keyframes}, {size}"

    def refuse_damage(self) -> None:
        """Raise `FormatError` for the first record that cannot be read, if there is one."""
        for record, why in self.damaged.items():
            others = len(self.damaged) - 1
            hint = f"{counted(others, 'other record')} cannot be read" if others else None
            raise FormatError(why, where=self.file, got=record, hint=hint)


def check_map(path: StrPath) -> MapContent:
    """Read a map, or the one of a finished run, as it was committed last, record by record.

    First the bytes of each against its checksum, and the pages of the file; if these are whole,
    also whether their content is what later commands take. Memory holds one record at a time.

    Raises:
        FormatError: There is no map, or one of a newer format. What is damaged is returned.
    """
    file, damaged = file_of_map(path), dict[str, str]()
    numbers: dict[str, Counter[str]] = {}
    sizes: dict[str, Counter[str]] = {}
    with Store.open(file, read_only=True) as store:
        for kind, name in tracked(store.names(), "records", "check the records"):
            session, _, number = ("", "", "") if kind == LINKS else name.partition(",")
            called = _CALLED.get(kind, kind)
            at = f", number {number}" if number else ""
            with _noting(damaged, f"{called} of session {session}{at}" if session else called):
                numbers.setdefault(session, Counter())[called] += 1
                sizes.setdefault(session, Counter())[called] += store.verify(kind, name)
        stage("check the file")
        with _noting(damaged, _FILE):
            store.verify_pages()
        drives: list[JoinedDrive] = []
        if not damaged:
            stage("read what the records hold")
            with _noting(damaged, _FILE):
                map_ = Map(store)
                read_all(map_)
                drives = joined_drives(map_)
        return MapContent(
            file=str(file),
            format=store.format,
            records=numbers,
            bytes=sizes,
            sessions=drives,
            versions={} if damaged else {f"{s.number}": s.info.versions for s in map_.sessions},
            links=0 if damaged else len(map_.links),
            damaged=damaged,
        )


@contextmanager
def _noting(damaged: dict[str, str], record: str) -> Iterator[None]:
    try:
        yield
    except ReconError as error:
        damaged[record] = f"{error.what}{f': {error.got}' if record == _FILE else ''}"


def _mb(size: int) -> str:
    return f"{size / 1e6:.3g}"
