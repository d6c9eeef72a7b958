"""What a drive is mapped with: its map, threads and stopwatch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from recon.core.errors import FormatError, ReconError
from recon.io.files import reading
from recon.map.settings import DriveSettings
from recon.map.store.session import Session, SessionInfo
from recon.map.verbs import Map
from recon.run.machine import versions
from recon.run.progress import Stopwatch
from recon.sources.source import StereoSource

ANEW: Final = "start the run anew, without --resume"


@dataclass(frozen=True)
class Workspace:
    """What a drive is mapped with, none of which affects the result."""

    # The map whose last session the drive goes on with, or which it becomes a session of; it must
    # stay open as long as the result is used
    map: Map = field(default_factory=Map.temporary)
    stopwatch: Stopwatch = field(default_factory=Stopwatch)  # times each stage
    threads: int | None = None  # threads of the matcher; None = all cores

    def session(self, source: StereoSource, config: DriveSettings) -> Session:
        """Return the session of a drive: the last one of the map, or a new one."""
        last = self.map.sessions[-1] if self.map.sessions else None
        return self.map.begin(session_info(source, config)) if last is None else last


@contextmanager
def resuming(where: str | Path) -> Iterator[None]:
    """Say in errors about an unfinished map that the run has to start anew."""
    try:
        with reading(where):
            yield
    except ReconError as error:
        raise FormatError(error.what, where=where, got=error.got, hint=ANEW) from error


def session_info(
    source: StereoSource, config: DriveSettings, start: Mapping[str, Any] | None = None
) -> SessionInfo:
    """Return what a session is a drive of.

    Args:
        source: The source.
        config: The settings.
        start: What a run is started with, to resume it.
    """
    return SessionInfo(
        source.name,
        source.description,
        len(source),
        config.model_dump(mode="json"),
        versions(),
        start or {},
    )
