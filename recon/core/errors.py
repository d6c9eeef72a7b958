"""The exceptions of the project: one tree, one clear line each, and the gate of optional packages.

The command line prints ``str(error)`` and exits with 1; the library only raises.
"""

from __future__ import annotations

from importlib import import_module
from os import PathLike
from types import ModuleType
from typing import Any, Final

from typing_extensions import Self

from recon.core.text import visible

_LONGEST: Final = 300  # letters of a value in a message: content from outside may have any length


class ReconError(Exception):
    """An error that a user can act on, in one line: ``where: what (got …, expected …); hint``.

    ``where`` is the file, frame or setting concerned; ``hint`` says what to do about it.
    """

    def __init__(
        self,
        what: str,
        *,
        where: str | PathLike[str] | None = None,
        got: Any = None,
        expected: Any = None,
        hint: str | None = None,
    ) -> None:
        self.what = what
        self.where = where
        self.got = got
        self.expected = expected
        self.hint = hint
        super().__init__(self._line())

    def copy_with(self, **parts: Any) -> Self:
        own = {name: getattr(self, name) for name in ("where", "got", "expected", "hint")}
        return type(self)(self.what, **{**own, **parts})

    def _line(self) -> str:
        found = [
            f"{label} {_clip(str(value))}"
            for label, value in (("got", self.got), ("expected", self.expected))
            if value is not None
        ]
        what = _clip(self.what)
        line = f"{self.where}: {what}" if self.where is not None else what
        line += f" ({', '.join(found)})" if found else ""
        line += f"; {self.hint}" if self.hint else ""
        return " ".join(visible(line).split())


def _clip(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


class SettingsError(ReconError):
    """A setting is unknown or out of range."""


class ShapeError(ReconError):
    """An array has the wrong dtype, shape or values."""


class CalibrationError(ReconError):
    """Cameras that cannot give metric depth."""


class FormatError(ReconError):
    """A file is missing, truncated or not what it claims to be."""


class SourceError(ReconError):
    """A folder or device cannot give stereo pairs."""


class MatchingError(ReconError):
    """A pair cannot be matched."""


class RegistrationError(ReconError):
    """Frames cannot be registered."""


class MappingError(ReconError):
    """A map cannot be built."""


class MeshingError(ReconError):
    """A surface cannot be reconstructed."""


class EvaluationError(ReconError):
    """An estimate cannot be compared with ground truth."""


class DownloadError(ReconError):
    """A data set cannot be fetched."""


class ClusterError(ReconError):
    """Jobs cannot be run on workers."""


class OutputError(ReconError):
    """A result cannot be written."""


class MemoryLimitError(ReconError):
    """A run exceeds its memory limit."""


class MissingDependencyError(ReconError):
    """An optional package is not installed."""


DISTRIBUTION: Final = "recon-stereo"
"""What pip calls this package: ``recon`` is one of biology there, with the same import name."""


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional package, which the extra of that name installs."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"the optional package {module!r} is not installed",
            hint=f"run: pip install '{DISTRIBUTION}[{extra}]'",
        ) from error
