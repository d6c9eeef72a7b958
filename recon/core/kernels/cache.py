"""Where the machine code of kernels is kept: in a folder of its own for each state of the sources.

numba by itself keeps machine code beside the source, and checks only the file of the outermost
function. After an update a kernel would go on running old code that it calls in another file, or
fail because a type in its signature is gone.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

_PACKAGE: Final = Path(__file__).parents[2]
_PREFIX: Final = "kernels-"
_LISTENERS: Final[list[Callable[[str], None]]] = []


@contextmanager
def when_compiling(notify: Callable[[str], None]) -> Iterator[None]:
    """Call ``notify`` with the name of each kernel that is about to be compiled, in any thread."""
    _LISTENERS.append(notify)
    try:
        yield
    finally:
        _LISTENERS.remove(notify)


def announce(kernel: str) -> None:
    """Notify all listeners that a kernel is not in the cache and is about to be compiled."""
    for notify in tuple(_LISTENERS):
        notify(kernel)


def cache_parent() -> Path:
    """The folder that holds the cache: ``NUMBA_CACHE_DIR``, else beside the sources, else in home.

    Beside the sources it is where Python keeps its own compiled files; where that cannot be
    written, as in a system-wide installation, it is the user's cache folder.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given)
    here = Path(__file__).parent
    beside = here / "__pycache__"
    if os.access(beside if beside.is_dir() else here, os.W_OK):
        return beside
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "recon"


def cache_folder(parent: Path, package: Path = _PACKAGE) -> Path:
    """The folder for the sources as they are; if it is new, those of earlier states are removed.

    Args:
        parent: Holds the cache.
        package: The kernels are in the folders ``kernels`` below it, and in folders of these.

    Returns:
        The folder, which numba makes when it first writes to it.
    """
    digest = hashlib.sha256()
    for path in sorted(path for path in package.rglob("*.py") if "kernels" in path.parts):
        digest.update(path.read_bytes())
    folder = parent / f"{_PREFIX}{digest.hexdigest()[:16]}"
    if not folder.is_dir():
        # Another process may make the folder at this moment.
        for earlier in set(parent.glob(f"{_PREFIX}*")) - {folder}:
            shutil.rmtree(earlier, ignore_errors=True)
    return folder
