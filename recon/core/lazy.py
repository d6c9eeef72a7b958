"""What is loaded when it is first used: heavy libraries, and what draws values."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Final


class Lazy:
    """A module that is imported when something of it is asked for; open3d takes a second."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self._name), name)


def quiet_open3d() -> Any:
    """Keep Open3D's warnings off standard output; errors that matter are checked and raised."""
    utility = Lazy("open3d").utility
    return utility.VerbosityContextManager(utility.VerbosityLevel.Error)


SHOWN_BY: Final[dict[str, Callable[[Any], Any]]] = {}
"""What makes each view of a value: code of layers above, which `recon` names when imported."""


class Shown:
    """A value that a notebook shows as a picture."""

    def plot(self) -> Any:
        """Return a matplotlib figure of it; nothing is shown or written by this."""
        return SHOWN_BY["plot"](self)

    def _repr_html_(self) -> str:
        return str(SHOWN_BY["html"](self))


class Shape(Shown):
    """A value that Open3D has, too."""

    def to_open3d(self) -> Any:
        """Return a copy as Open3D's legacy geometry, with colours and normals if it has them."""
        return SHOWN_BY["to_open3d"](self)
