"""How kernels are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Literal, TypeVar, overload

from numba import config, njit

from recon.kernels.cache import cache_folder, cache_parent

KernelT = TypeVar("KernelT", bound=Callable[..., Any])

_CACHE: Final = str(cache_folder(cache_parent()))


@overload
def kernel(function: KernelT) -> KernelT: ...


@overload
def kernel(
    *, inline: Literal["always", "never"] = ..., error_model: Literal["python", "numpy"] = ...
) -> Callable[[KernelT], KernelT]: ...


def kernel(function: Any = None, **options: str) -> Any:
    """Compile a function to run without the interpreter lock, and cache the machine code.

    Args:
        function: What is compiled.
        **options: ``inline`` and ``error_model`` of `numba.njit`.
    """
    if function is None:
        return lambda function: kernel(function, **options)
    kept = config.CACHE_DIR
    # numba takes the folder while it decorates; functions of other packages keep theirs.
    config.CACHE_DIR = _CACHE
    try:
        return njit(cache=True, nogil=True, **options)(function)
    finally:
        config.CACHE_DIR = kept
