"""Names that go: an old function or keyword works for one more version and names its successor."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

from typing_extensions import ParamSpec

P = ParamSpec("P")
R = TypeVar("R")


def deprecated(
    *, since: str, use: str, keyword: str | None = None
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Mark a function, or one of its keyword arguments, as replaced by another.

    The call works as before. Each place that calls raises one `DeprecationWarning`, which Python
    shows in scripts, notebooks and tests; the docstring says the same.

    Args:
        since: The version that replaced it, such as ``"1.1"``.
        use: What to use instead. Of a keyword, the new keyword: it is passed what the old one got.
        keyword: The old keyword argument; None = the whole function is replaced.
    """

    def mark(function: Callable[P, R]) -> Callable[P, R]:
        name = function.__name__
        if keyword is None:
            message = f"{name} is deprecated since recon {since}: use {use}"
        else:
            message = f"{name}({keyword}=…) is deprecated since recon {since}: use {use}=…"

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            if keyword is None:
                warnings.warn(message, DeprecationWarning, stacklevel=2)
            elif keyword in kwargs:
                if use in kwargs:
                    raise TypeError(f"{name}() got both {keyword} and {use}: give {use} alone")
                warnings.warn(message, DeprecationWarning, stacklevel=2)
                kwargs[use] = kwargs.pop(keyword)
            return function(*args, **kwargs)

        call.__doc__ = f"{function.__doc__ or ''}\n\nDeprecated: {message}.\n".lstrip("\n")
        return call

    return mark
