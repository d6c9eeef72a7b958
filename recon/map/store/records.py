"""Records of a map in one SQLite file: trees of arrays, committed whole or not at all."""

from __future__ import annotations

import sqlite3
import sys
import weakref
import zlib
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from io import BytesIO
from pathlib import Path
from threading import Lock, RLock
from typing import Any, Final, TypeVar

import numpy as np
from typing_extensions import Self

from recon.core.errors import FormatError, OutputError
from recon.io.atomic import check_targets
from recon.io.files import reading, refuse_special
from recon.map.store.trees import Bytes, from_bytes, to_bytes

Key = int | tuple[int, ...]
CACHE_BYTES: Final = 100_000_000
FORMAT: Final = 2
"""Number of the format, which grows with every change that older versions cannot read."""
_OURS: Final = 0x7265636E  # "recn"
_TABLE: Final = """CREATE TABLE record (
    kind TEXT NOT NULL, key TEXT NOT NULL, tree TEXT NOT NULL, checksum INTEGER NOT NULL,
    content BLOB NOT NULL, PRIMARY KEY (kind, key)
)"""
_PAGE_BYTES: Final = 1 << 14
_PIECE_BYTES: Final = 1 << 18
_SMALL_BYTES: Final = 1 << 24
_MOST_GROWTH: Final = 16
"""What was measured becomes two to three times smaller; small records may shrink further."""
_LONGEST: Final = 120  # characters of what SQLite says of a damaged file
_ROOM: Final = "check that the folder is writable and the disk is not full"


@contextmanager
def writing(path: Path | None) -> Iterator[None]:
    """Turn errors of the database into ours."""
    where = "temporary map" if path is None else path
    try:
        yield
    except sqlite3.Error as error:
        text = str(error)
        if "locked" in text:
            what, hint = "another process uses the map", "wait for it, or write to another one"
        elif "readonly" in text:
            what = "the map can only be read"
            hint = "make the file writable, and open it with read_only=False"
        elif "full" in text:
            what, hint = "the disk is full", "make room on it"
        else:
            what, hint = "cannot write the map", _ROOM
        raise OutputError(what, where=where, got=text, hint=hint) from error
    except OSError as error:
        raise OutputError(
            "cannot write the map", where=where, got=error.strerror, hint=_ROOM
        ) from error


def _files_of(path: Path) -> list[Path]:
    """Return a database, and what SQLite keeps beside it."""
    return [path.with_name(path.name + end) for end in ("", "-wal", "-shm", "-journal")]


def connect(path: Path | None, *, read_only: bool = False) -> sqlite3.Connection:
    """Return a connection without transactions of its own; the lock of the store guards it."""
    name: str | Path = "" if path is None else path
    if path is not None and read_only:
        name = f"{path.absolute().as_uri()}?mode=ro"
    return sqlite3.connect(
        name, timeout=0, isolation_level=None, check_same_thread=False, uri=read_only
    )


@contextmanager
def _closed_on_error(database: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Close a connection where the block that sets it up fails."""
    try:
        yield database
    except BaseException:
        database.close()
        raise


def _make_tables(database: sqlite3.Connection) -> None:
    # Most records are larger than any page: fewer pages are written faster.
    database.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
    database.execute("BEGIN")
    database.execute(f"PRAGMA application_id = {_OURS}")
    database.execute(f"PRAGMA user_version = {FORMAT}")
    database.execute(_TABLE)
    database.execute("COMMIT")


def _begin_to_write(database: sqlite3.Connection) -> None:
    """Begin a transaction that keeps other writers out."""
    # Readers go on at the last commit while the next one is written.
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    database.execute("BEGIN IMMEDIATE")


def check_format(database: sqlite3.Connection, path: Path) -> None:
    """Refuse files of other programs, of other versions, and with tables of another make."""
    try:
        (ours,) = database.execute("PRAGMA application_id").fetchone()
        (number,) = database.execute("PRAGMA user_version").fetchone()
        tables = {sql for (sql,) in database.execute("SELECT sql FROM sqlite_master") if sql}
    except sqlite3.DatabaseError as error:
        if "lock" in str(error):
            raise FormatError("another process is opening the map", where=path) from error
        raise FormatError("not a map of recon, or damaged", where=path, got=str(error)) from error
    if ours == _OURS and number != FORMAT:
        what, hint = "a newer version of recon", "update recon"
        if number < FORMAT:
            what, hint = "a version of recon before 1.0", "map the drive again"
        how = {"got": f"format {number}", "expected": f"format {FORMAT}", "hint": hint}
        raise FormatError(f"the map was written by {what}", where=path, **how)
    if ours != _OURS or tables != {_TABLE}:
        raise FormatError("not a map of recon", where=path)


class _Content:
    """The bytes of a record, read piece by piece, with ``checksum`` so far and bytes ``left``.

    Read as one value, they would exist three times: in the database, as bytes, and as arrays.
    """

    def __init__(self, database: sqlite3.Connection, row: int, size: int, checksum: int) -> None:
        self.checksum, self.left = checksum, size
        if sys.version_info >= (3, 11):
            self._file = database.blobopen("record", "content", row, readonly=True)
        else:
            query = "SELECT content FROM record WHERE rowid = ?"
            self._file = BytesIO(database.execute(query, (row,)).fetchone()[0])

    def read(self, size: int) -> bytearray:
        if not 0 <= size <= self.left:
            raise FormatError("a record of the map is truncated")
        self.left -= size
        found = bytearray(size)
        for begin in range(0, size, _PIECE_BYTES):
            piece = self._file.read(min(_PIECE_BYTES, size - begin))
            found[begin : begin + len(piece)] = piece
            self.checksum = zlib.crc32(piece, self.checksum)
        return found

    def close(self) -> None:
        """Read the rest, so that the checksum is that of all bytes."""
        while self.left:
            self.read(min(_PIECE_BYTES, self.left))
        self._file.close()

    def check(self, checksum: int, of: str) -> None:
        """Refuse content whose bytes, all read, have another checksum."""
        if self.checksum != checksum:
            raise FormatError("a record of the map is damaged", got=of)


class Store:
    """Records under a kind and a key, in one SQLite file.

    What is put or deleted is on disk, and visible to other programs, when it is committed. A
    program that is killed, or meets a full disk, leaves the last commit. One program writes at a
    time; others may read meanwhile, and see what was committed when they opened it. Threads share a
    store. ``path`` None = a temporary file; ``cache`` keeps what was read last, and whatever else
    is derived from the records.
    """

    def __init__(self, database: sqlite3.Connection, path: Path | None, cache_bytes: int) -> None:
        self._database = database
        self._lock = RLock()
        self.path = path
        self.cache = Cache(cache_bytes)
        weakref.finalize(self, database.close)  # where a reader does not close it

    @classmethod
    def create(cls, path: Path, *, cache_bytes: int = CACHE_BYTES) -> Self:
        """Begin a store; a file at ``path`` is replaced."""
        check_targets([path])
        with writing(path):
            for file in _files_of(path):
                file.unlink(missing_ok=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            with _closed_on_error(connect(path)) as database:
                _make_tables(database)
                _begin_to_write(database)
        return cls(database, path, cache_bytes)

    @classmethod
    def open(cls, path: Path, *, read_only: bool = False, cache_bytes: int = CACHE_BYTES) -> Self:
        with reading(path):
            with path.open("rb"):  # a missing file, a folder, no permission
                pass
            for file in _files_of(path):
                refuse_special(file)
            database = connect(path, read_only=read_only)
        with _closed_on_error(database):
            with reading(path):
                check_format(database, path)
                if read_only:  # what was committed last, whatever is committed later
                    database.execute("BEGIN")
                    database.execute("SELECT count(*) FROM record LIMIT 1")
            if not read_only:
                with writing(path):
                    _begin_to_write(database)
        return cls(database, path, cache_bytes)

    @classmethod
    def temporary(cls, *, cache_bytes: int = CACHE_BYTES) -> Self:
        """Begin a store in a temporary file, which is gone when the store is closed."""
        with writing(None), _closed_on_error(connect(None)) as database:
            database.execute("PRAGMA journal_mode = OFF")
            _make_tables(database)
            database.execute("BEGIN")
        return cls(database, None, cache_bytes)

    @property
    def name(self) -> str:
        return "temporary map" if self.path is None else str(self.path)

    def put(self, kind: str, key: Key, tree: Mapping[str, Any], *, compress: bool = False) -> None:
        """Store a record, in place of an earlier one of that kind and key.

        ``tree``: mappings and lists of arrays, numbers (also NaN), texts and None; tuples are read
        back as lists.
        """
        text, content = to_bytes(tree, compress=compress)
        self._insert(kind, _name(key), text, content)

    def get(self, kind: str, key: Key) -> dict[str, Any]:
        """Return a record, not to be changed, without large compressed arrays: see `read`."""
        return self.cache.get((kind, key), lambda: self.read(kind, key))

    def find(self, kind: str, key: Key, **otherwise: Any) -> dict[str, Any]:
        """Return a record as `get` does, or something else where there is none."""
        return self.get(kind, key) if self.has(kind, key) else otherwise

    def read(self, kind: str, key: Key, *, most_bytes: int = 0) -> dict[str, Any]:
        """Return a record read from the file, past the cache; for those that are read once.

        ``most_bytes`` is what its compressed arrays can take together, as far as the rest of the
        map says: a small file can claim very large ones.
        """
        name = _name(key)
        with self._lock, reading(self.name):
            text, content, checksum = self._row(kind, name)
            try:
                most = min(most_bytes, max(_SMALL_BYTES, _MOST_GROWTH * content.left))
                return from_bytes(text, content.read, most)
            except (KeyboardInterrupt, MemoryError):
                checksum = content.checksum  # what is cut short may be whole
                raise
            finally:
                content.close()
                content.check(checksum, f"{kind} {name}")

    def delete(self, kind: str, key: Key | None = None) -> None:
        """Delete a record, or all of a kind; it need not exist."""
        with self._lock, writing(self.path):
            for each in self.keys(kind) if key is None else [key]:
                where = (kind, _name(each))
                self._database.execute("DELETE FROM record WHERE kind = ? AND key = ?", where)
                self.cache.drop((kind, each))

    def keys(self, kind: str) -> list[Key]:
        with self._lock, reading(self.name):
            rows = self._database.execute("SELECT key FROM record WHERE kind = ?", (kind,))
            found = [_key(name) for (name,) in rows]
        return sorted(found, key=lambda key: key if isinstance(key, tuple) else (key,))

    def numbers(self, kind: str, session: int) -> list[int]:
        """Return the second numbers of the keys of a kind that begin with that of a session."""
        keys = (key for key in self.keys(kind) if isinstance(key, tuple))
        return [key[1] for key in keys if key[0] == session]

    def names(self) -> list[tuple[str, str]]:
        """Return kind and name of every record, as they are written, damaged ones included."""
        with self._lock, reading(self.name):
            return self._database.execute("SELECT kind, key FROM record").fetchall()

    def verify(self, kind: str, name: str) -> int:
        """Read a record of `names` piece by piece against its checksum; returns its bytes."""
        with self._lock, reading(self.name):
            text, content, checksum = self._row(kind, name)
            size = len(text) + content.left
            content.close()
            content.check(checksum, f"{kind} {name}")
            _key(name)
            return size

    def verify_pages(self) -> None:
        """Refuse a file whose pages do not fit together, whatever the records say."""
        with self._lock, reading(self.name):
            (found,) = self._database.execute("PRAGMA integrity_check(1)").fetchone()
            if found != "ok":
                raise FormatError("the file of the map is damaged", got=str(found)[:_LONGEST])

    @property
    def format(self) -> int:
        """Number of the format that the file was written in."""
        return int(self._database.execute("PRAGMA user_version").fetchone()[0])

    def kinds(self) -> list[str]:
        with self._lock, reading(self.name):
            rows = self._database.execute("SELECT DISTINCT kind FROM record ORDER BY kind")
            return [str(kind) for (kind,) in rows]

    def has(self, kind: str, key: Key) -> bool:
        query = "SELECT 1 FROM record WHERE kind = ? AND key = ?"
        with self._lock, reading(self.name):
            return self._database.execute(query, (kind, _name(key))).fetchone() is not None

    def alike(self, kind: str, one: Key, other: Key) -> bool:
        """Return whether two records of a kind are there and equal to the last bit."""
        query = (
            "SELECT one.tree = other.tree AND one.content = other.content"
            " FROM record AS one, record AS other"
            " WHERE one.kind = ? AND one.key = ? AND other.kind = one.kind AND other.key = ?"
        )
        with self._lock, reading(self.name):
            found = self._database.execute(query, (kind, _name(one), _name(other))).fetchone()
        return found is not None and bool(found[0])

    def copy(self, kind: str, other: Store, keys: Mapping[Key, Key] | None = None) -> None:
        """Copy records, packed, to another store; ``keys`` (None = all) with their keys there."""
        for key, new in ({k: k for k in self.keys(kind)} if keys is None else keys).items():
            with self._lock, reading(self.name):
                text, content, checksum = self._row(kind, _name(key))
                whole = content.read(content.left)
                content.close()
                content.check(checksum, f"{kind} {_name(key)}")
            other._insert(kind, _name(new), text, [whole])

    def commit(self) -> None:
        """Make everything so far permanent, all of it or, after an error, nothing."""
        with self._lock, writing(self.path):
            self._database.execute("COMMIT")
            self._database.execute("BEGIN IMMEDIATE")

    def compact(self) -> None:
        """Commit, and give the room of deleted records back to the disk."""
        with self._lock, writing(self.path):
            self._database.execute("COMMIT")
            self._database.execute("VACUUM")
            self._database.execute("BEGIN IMMEDIATE")

    @property
    def nbytes(self) -> int:
        """Bytes of the file, with all that is not committed yet."""
        query = "SELECT page_count * page_size FROM pragma_page_count(), pragma_page_size()"
        with self._lock, reading(self.name):
            return int(self._database.execute(query).fetchone()[0])

    def close(self) -> None:
        """Close the file; what was not committed is lost."""
        with self._lock, suppress(sqlite3.Error):
            self.cache.clear()
            if self._database.in_transaction:
                self._database.execute("ROLLBACK")
            # One file, which can be read where nothing can be written; not while others read it.
            with suppress(sqlite3.Error):
                self._database.execute("PRAGMA journal_mode = DELETE")
            self._database.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _insert(self, kind: str, name: str, text: str, content: Sequence[Bytes]) -> None:
        head = (kind, name, text, _checksum(kind, name, text, *content))
        insert = "INSERT OR REPLACE INTO record VALUES (?, ?, ?, ?, {})"
        with self._lock, writing(self.path):
            if sys.version_info >= (3, 11):
                # Bound to a statement, bytes are copied twice, which for a submap is more memory
                # than the submap itself: room is made for them, and written piece by piece.
                size = sum(map(len, content))
                values = (*head, size)
                row = self._database.execute(insert.format("zeroblob(?)"), values).lastrowid
                if size:
                    with self._database.blobopen("record", "content", row) as blob:
                        for piece in content:
                            blob.write(piece)
            else:
                self._database.execute(insert.format("?"), (*head, b"".join(content)))
            self.cache.drop((kind, _key(name)))

    def _row(self, kind: str, name: str) -> tuple[str, _Content, int]:
        query = "SELECT rowid, length(content), tree, checksum FROM record"
        query += " WHERE kind = ? AND key = ?"
        found = self._database.execute(query, (kind, name)).fetchone()
        if found is None:
            raise FormatError("the map lacks a record", got=f"{kind} {name}")
        row, size, text, checksum = found
        content = _Content(self._database, row, size, _checksum(kind, name, text))
        return text, content, checksum


def _name(key: Key) -> str:
    return ",".join(map(str, key)) if isinstance(key, tuple) else str(key)


def _key(name: str) -> Key:
    numbers = tuple(map(int, name.split(",")))
    key = numbers if len(numbers) > 1 else numbers[0]
    if _name(key) != name:  # as 00 and 1_0, which are other names of a number
        raise FormatError("a record of the map has no valid key", got=name)
    return key


def _checksum(kind: str, name: str, text: str, *content: Bytes) -> int:
    checksum = zlib.crc32(f"{kind} {name} {text}".encode())
    for piece in content:
        checksum = zlib.crc32(piece, checksum)
    return checksum


Value = TypeVar("Value")
_PLAIN_BYTES: Final = 64  # about what a number or a short text takes


class Cache:
    """Keeps the values used last, up to a number of bytes (0 = nothing). Threads may share it."""

    def __init__(self, limit_bytes: int) -> None:
        self._limit = limit_bytes
        self._held: OrderedDict[Hashable, tuple[Any, int]] = OrderedDict()
        self.nbytes = 0
        self._lock = Lock()

    def get(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """Return the value of a key, made now unless it is kept; two threads may both make it."""
        with self._lock:
            if key in self._held:
                self._held.move_to_end(key)
                found: Value = self._held[key][0]
                return found
        value = make()
        size = size_of(value)
        if size > self._limit:  # would drive out everything else, and then itself
            return value
        with self._lock:
            self.nbytes += size - self._held.pop(key, (None, 0))[1]
            self._held[key] = value, size
            while self.nbytes > self._limit:
                self.nbytes -= self._held.popitem(last=False)[1][1]
        return value

    def drop(self, key: Hashable) -> None:
        with self._lock:
            self.nbytes -= self._held.pop(key, (None, 0))[1]

    def clear(self) -> None:
        with self._lock:
            self._held.clear()
            self.nbytes = 0


def size_of(value: object) -> int:
    """Return bytes of the arrays in a value: in mappings, sequences and dataclasses."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, Mapping):
        return _PLAIN_BYTES + sum(map(size_of, value.values()))
    if isinstance(value, list | tuple):
        return _PLAIN_BYTES + sum(map(size_of, value))
    if is_dataclass(value):
        return _PLAIN_BYTES + sum(size_of(getattr(value, f.name)) for f in fields(value))
    return _PLAIN_BYTES
