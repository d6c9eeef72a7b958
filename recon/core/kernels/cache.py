"""Where the machine code of kernels is kept: for each of their files a folder for its state.

numba alone keeps it beside the source and checks only the file of the outermost function: after
an update a kernel would go on running old code that it calls in another file. So the state of a
file is that of all that it imports, too; an update compiles what it changed, and no more.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Final

from recon.core.progress import LOGGER

PACKAGE: Final = Path(__file__).parents[2]
_PREFIX: Final = "kernels-"
# Modules of the package are imported by their whole names.
_IMPORT: Final = re.compile(rb"^ *from (recon[.\w]*) import (\([^)]*\)|.*)$", re.MULTILINE)
_LISTENERS: Final[list[Callable[[str], None]]] = []


@contextmanager
def when_compiling(notify: Callable[[str], None]) -> Iterator[None]:
    """Call ``notify`` with the name of each kernel that is compiled, in any thread."""
    _LISTENERS.append(notify)
    try:
        yield
    finally:
        _LISTENERS.remove(notify)


def announce(kernel: str) -> None:
    """Notify all listeners that a kernel is compiled; the first time, log it."""
    note_compiling()
    for notify in tuple(_LISTENERS):
        notify(kernel)


@cache
def note_compiling() -> None:
    """Log, once, that kernels are compiled: whoever waits is to know why."""
    why = "compiling kernels, once after an installation: those that this command needs …"
    LOGGER.warning(why, extra={"passing": True})


def cache_parent() -> Path:
    """The folder of the cache: ``NUMBA_CACHE_DIR``, else beside the sources, else in home.

    A user without a home, as in a container, gets a folder for temporary files.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given)
    here = Path(__file__).parent
    beside = here / "__pycache__"
    if os.access(beside if beside.is_dir() else here, os.W_OK):
        return beside
    # Unlike those of Path, these functions take no home and one of somebody else for what they are.
    users = Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))  # noqa: PTH111
    nearest = next(path for path in (users, *users.parents) if os.path.exists(path))  # noqa: PTH110
    if users.is_absolute() and os.access(nearest, os.W_OK):
        return users / "recon"
    # A folder that is this user's alone: machine code of others must not run.
    user = os.getuid()  # elsewhere than on POSIX there is always a home
    folder = Path(tempfile.gettempdir()) / f"recon-{user}"
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    state = folder.lstat()
    if stat.S_ISDIR(state.st_mode) and state.st_uid == user and not state.st_mode & 0o022:
        return folder
    return Path(tempfile.mkdtemp(prefix="recon-"))


def cache_folder(parent: Path, source: Path, package: Path = PACKAGE) -> Path:
    """Return the folder for a file of kernels and its imports as they are; others are removed."""
    digest = hashlib.sha256()
    for path in with_imports(source, package):
        digest.update(_read(path))
    name = ".".join(source.relative_to(package).with_suffix("").parts)
    folder = parent / f"{_PREFIX}{name}-{digest.hexdigest()[:16]}"
    if not folder.is_dir():
        # Another process may make the folder at this moment.
        for earlier in set(parent.glob(f"{_PREFIX}{name}-*")) - {folder}:
            shutil.rmtree(earlier, ignore_errors=True)
    return folder


def with_imports(source: Path, package: Path) -> list[Path]:
    """Return a file and those of the package that it imports, and they in turn, in order."""
    found, waiting = set[Path](), [source]
    while waiting:
        if (path := waiting.pop()) not in found:
            found.add(path)
            waiting += _imported(path, package)
    return sorted(found)


_read: Final = cache(Path.read_bytes)


@cache
def _imported(path: Path, package: Path) -> list[Path]:
    """Return the files of the package that one imports: modules, or the names of one."""
    found = list[Path]()
    for module, names in _IMPORT.findall(_read(path)):
        place = package.parent.joinpath(*module.decode().split("."))
        beside = (place / f"{name.decode()}.py" for name in re.findall(rb"\w+", names))
        files = (place.with_suffix(".py"), place / "__init__.py", *beside)
        found += filter(Path.is_file, files)
    return found
