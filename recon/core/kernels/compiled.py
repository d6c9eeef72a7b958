"""How kernels are compiled."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, Final, Literal, TypeVar, overload

import numpy as np
from numba import __version__, config, njit
from numba.core.caching import FunctionCache
from numpy.typing import NDArray

from recon.core.kernels.cache import PACKAGE, announce, cache_folder, cache_parent

KernelT = TypeVar("KernelT", bound=Callable[..., Any])

# As in `recon.core.values.arrays`, which kernels do not know.
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]
UInt16 = NDArray[np.uint16]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


def _usable_cache() -> Path:
    """Return the folder of our cache; where it cannot be written, numba would take another one."""
    try:
        parent = cache_parent()
        parent.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=parent).close()
    except OSError as error:
        what = f"compiled kernels cannot be kept ({error.strerror or error})"
        hint = "set NUMBA_CACHE_DIR to a folder that can be written"
        raise OSError(error.errno, f"{what}; {hint}", error.filename) from error
    return parent


CACHE: Final = _usable_cache()


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one kernel, which one process at a time writes: two would mix up code."""

    def holds(self, sig: Any, target_context: Any) -> bool:
        """Return whether the code for these types is kept, and of this numba and processor."""
        return self._index_key(sig, target_context.codegen()) in self._cache_file._load_index()

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = super().load_overload(sig, target_context)
        if found is None:
            announce(self._py_func.__name__)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        self._impl.locator.ensure_cache_path()
        folder = os.open(self.cache_path, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)
            super().save_overload(sig, data)
        finally:
            os.close(folder)


@overload
def kernel(function: KernelT) -> KernelT: ...


@overload
def kernel(
    *, inline: Literal["always", "never"] = ..., error_model: Literal["python", "numpy"] = ...
) -> Callable[[KernelT], KernelT]: ...


def kernel(function: Any = None, **options: str) -> Any:
    """Compile a function to run without the interpreter lock, and cache the machine code."""
    if function is None:
        return lambda function: kernel(function, **options)
    kept = config.CACHE_DIR
    # numba takes the folder while it decorates; functions of other packages keep theirs.
    config.CACHE_DIR = str(_folder(function.__code__.co_filename))
    try:
        # Nothing calls kernels from C, so nothing is compiled that C could call.
        compiled = njit(nogil=True, no_cfunc_wrapper=True, **options)(function)
        if compiled is not function:  # it is where NUMBA_DISABLE_JIT is set
            _keep(compiled, function)
        return compiled
    finally:
        config.CACHE_DIR = kept


@cache
def _folder(file: str) -> Path:
    """Return the folder for a file of kernels; those of others, as in tests, have one for all."""
    source = Path(file)
    inside = source.is_relative_to(PACKAGE)
    return cache_folder(CACHE, source if inside else Path(__file__))


def _keep(compiled: Any, function: Callable[..., Any]) -> None:
    """Give a compiled function our cache, as `enable_caching` does its own."""
    before, own = getattr(compiled, "_cache", None), _KernelCache(function)
    used = all(hasattr(before, name) for name in ("load_overload", "save_overload"))
    if not (used and own.cache_path.startswith(config.CACHE_DIR)):
        # Code of earlier sources would run, or two processes would mix up what they write.
        raise ImportError(f"numba {__version__} keeps machine code in another way", name="numba")
    compiled._cache = own
