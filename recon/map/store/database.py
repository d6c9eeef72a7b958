"""The SQLite file of a store: its tables, its transactions, and the bytes of a record."""

from __future__ import annotations

import sqlite3
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Final

from recon.core.errors import FormatError

MORE_ATTRIBUTES: Final = 2
"""Number of the format of a map whose points carry more than those of format 1 could."""
FORMAT: Final = MORE_ATTRIBUTES
"""The newest number; it grows with every change that older versions cannot read. A map has the
least number of all that read it, beginning with 1."""
_OURS: Final = 0x7265636E  # "recn"
_TABLE: Final = """CREATE TABLE record (
    kind TEXT NOT NULL, key TEXT NOT NULL, tree TEXT NOT NULL, checksum INTEGER NOT NULL,
    content BLOB NOT NULL, PRIMARY KEY (kind, key)
)"""
_PAGE_BYTES: Final = 1 << 14
_PIECE_BYTES: Final = 1 << 18


def connect(path: Path | None, *, read_only: bool = False) -> sqlite3.Connection:
    """Return a connection without transactions of its own; the lock of the store guards it."""
    name: str | Path = "" if path is None else path
    if path is not None and read_only:
        name = f"{path.absolute().as_uri()}?mode=ro"
    return sqlite3.connect(
        name, timeout=0, isolation_level=None, check_same_thread=False, uri=read_only
    )


@contextmanager
def closed_on_error(database: sqlite3.Connection) -> Iterator[sqlite3.Connection]:
    """Close a connection where the block that sets it up fails."""
    try:
        yield database
    except BaseException:
        database.close()
        raise


def make_tables(database: sqlite3.Connection) -> None:
    """Make an empty file a store."""
    # Most records are larger than any page: fewer pages are written faster.
    database.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
    database.execute("BEGIN")
    database.execute(f"PRAGMA application_id = {_OURS}")
    database.execute("PRAGMA user_version = 1")
    database.execute(_TABLE)
    database.execute("COMMIT")


def format_of(database: sqlite3.Connection) -> int:
    """Return the number of the format of a store."""
    return int(database.execute("PRAGMA user_version").fetchone()[0])


class Content:
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
        """Return the next bytes, exactly as many."""
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


def begin_to_write(database: sqlite3.Connection) -> None:
    """Begin a transaction that keeps other writers out."""
    # Readers go on at the last commit while the next one is written.
    database.execute("PRAGMA journal_mode = WAL")
    database.execute("PRAGMA synchronous = FULL")
    database.execute("BEGIN IMMEDIATE")


def begin_to_read(database: sqlite3.Connection) -> None:
    """Begin a transaction that sees the last commit, whatever is committed later."""
    database.execute("BEGIN")
    database.execute("SELECT count(*) FROM record LIMIT 1")


def check_format(database: sqlite3.Connection, path: Path) -> None:
    """Refuse files of other programs, of newer versions, and with tables of another make."""
    try:
        (ours,) = database.execute("PRAGMA application_id").fetchone()
        number = format_of(database)
        tables = {sql for (sql,) in database.execute("SELECT sql FROM sqlite_master") if sql}
    except sqlite3.DatabaseError as error:
        if "lock" in str(error):
            raise FormatError("another program is opening the map", where=path) from error
        raise FormatError("not a map of recon, or damaged", where=path, got=str(error)) from error
    if ours == _OURS and number > FORMAT:
        raise FormatError(
            "the map was written by a newer version of recon",
            where=path,
            got=f"format {number}",
            expected=f"at most {FORMAT}",
            hint="update recon",
        )
    if ours != _OURS or tables != {_TABLE}:
        raise FormatError("not a map of recon", where=path)
