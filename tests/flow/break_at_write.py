"""`recon` in a process that ends, is interrupted, or meets a full disk, at its n-th write.

``python break_at_write.py (kill|interrupt|terminate|full|count) N ARGUMENTS…``: a write is what
makes a file appear whole under its name, or a commit of the map. ``kill`` ends the process by
SIGKILL before it (even N) or after it (odd N), ``interrupt`` does what Ctrl-C does, ``terminate``
what a batch system does, ``full`` lets the disk be full from there on, ``count`` writes how many
writes there were to ``$COUNT``. A live drive leaves no frame out here and is committed after each,
so that its writes, too, are the same every time.
"""

import errno
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from recon.cli import main
from recon.core.errors import OutputError
from recon.map.drive import drive
from recon.map.store.records import Store
from tests.scenery.patience import be_patient

MODE, LAST = sys.argv[1], int(sys.argv[2])
SIGNALS = {"interrupt": signal.SIGINT, "terminate": signal.SIGTERM}
signal.signal(signal.SIGINT, signal.default_int_handler)  # perhaps ignored, in the background
_replace, _fsync, _commit = Path.replace, os.fsync, Store.commit
_writes = 0


@contextmanager
def write() -> Iterator[None]:
    global _writes  # noqa: PLW0603
    _writes += 1
    broken = MODE == "kill" and _writes == LAST
    if broken and LAST % 2 == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    if MODE in SIGNALS and _writes == LAST:
        os.kill(os.getpid(), SIGNALS[MODE])
    yield
    if broken:
        os.kill(os.getpid(), signal.SIGKILL)


def replace(self: Path, target: Path) -> Path:
    with write():
        return _replace(self, target)


def commit(self: Store) -> None:
    with write():
        if MODE == "full" and _writes >= LAST:
            raise OutputError("the disk is full", got=os.strerror(errno.ENOSPC))
        _commit(self)


def fsync(handle: int) -> None:
    if MODE == "full" and _writes >= LAST:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    _fsync(handle)


Path.replace, os.fsync = replace, fsync  # type: ignore[method-assign,assignment]
Store.commit = commit  # type: ignore[method-assign]
be_patient(pytest.MonkeyPatch())
drive._COMMIT_S = 0.0  # type: ignore[misc]
sys.argv = ["recon", *sys.argv[3:]]
try:
    main()
finally:
    if MODE == "count":
        Path(os.environ["COUNT"]).write_text(str(_writes))
