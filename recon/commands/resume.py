"""Resuming an interrupted run, after checking that its inputs and settings are unchanged."""

from __future__ import annotations

import errno
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, load_config
from recon.commands.identity import read_started, refuse_others
from recon.commands.map_options import MapRequest
from recon.core.errors import ClusterError, MemoryLimitError, OutputError
from recon.map.drive.workspace import resuming, session_info
from recon.map.verbs import Map
from recon.run.directory import STARTED, RunDirectory, state_folder
from recon.run.memory import memory_overrides
from recon.run.run import Run
from recon.sources.live import LiveSource
from recon.sources.source import StereoSource

_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def resumed(
    folder: Path,
    request: MapRequest,
    config: Path | None,
    overrides: Sequence[str],
    memory_limit: str | None,
) -> tuple[MapRequest, ReconConfig]:
    """Complete a request by that of an unfinished run, and return its configuration.

    Args:
        folder: Folder of the run.
        request: What is asked for now; what it leaves open is as the run was started with.
        config: YAML file of settings; None = those of the run.
        overrides: ``key=value`` settings; they and the file must not differ from the run's.
        memory_limit: Another memory limit, such as ``2G``; None = that of the run.
    """
    started = read_started(folder)
    request = request.over(MapRequest.of(started["arguments"]))
    settings = ReconConfig.parse(started["identity"]["config"], where=str(folder))
    asked = load_config(config, [*overrides, *memory_overrides(memory_limit)])
    if config is not None or overrides:
        refuse_others({"config": asked.model_dump(mode="json")}, started["identity"], folder)
    if asked.memory.limit_mb is not None:
        settings = settings.model_copy(update={"memory": asked.memory})
    return request, settings


def begin_or_resume(
    run: Run,
    source: StereoSource,
    config: ReconConfig,
    identity: Mapping[str, Any],
    arguments: Mapping[str, Any],
) -> Map:
    """Begin the map of a run; for a resumed one, check that nothing has changed, and open it."""
    named = (arguments.get(name) for name in ("poses", "prior"))
    run.check_targets([*source.files, *(Path(name) for name in named if name is not None)])
    path, memory = run.state(STARTED), config.memory.cache_bytes
    if run.resumes:
        refuse_others(identity, read_started(run.folder)["identity"], run.folder)
        with resuming(path):
            return Map.open(path, read_only=False, cache_bytes=memory)
    map_ = Map.create(path, cache_bytes=memory)
    live = isinstance(source, LiveSource)  # what arrived then will not arrive again
    start = {} if live else {"identity": dict(identity), "arguments": dict(arguments)}
    map_.begin(session_info(source, config, start))
    map_.commit()
    run.begun = run.command != "demo"  # whose street no command line names
    return map_


@contextmanager
def with_resume_hint(run: RunDirectory, source: StereoSource) -> Iterator[None]:
    """Add a hint on how to resume to errors after which the run can be resumed.

    Of a live source, whose drive is over then, it says where the map is that was made so far.
    """
    passing = (OutputError, MemoryLimitError, ClusterError, OSError, MemoryError)
    try:
        yield
    except (*passing, KeyboardInterrupt) as error:
        hint = _way_on(run.folder, source)
        hinted = _with_hint(error, hint) if run.begun else None
        if hinted is None:
            raise
        raise hinted from error


def _way_on(folder: Path, source: StereoSource) -> str:
    """Return how to go on after a run was interrupted."""
    if isinstance(source, LiveSource):
        return f"the map so far is in {state_folder(folder) / STARTED}"
    return f"recon map --resume {shlex.quote(str(folder))} goes on from there"


def _with_hint(error: BaseException, hint: str) -> BaseException | None:
    """Return the error with a hint on how to go on; None if it is raised unchanged."""
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt(hint)
    if isinstance(error, OutputError | ClusterError):
        return error.but(hint=hint)
    if isinstance(error, MemoryLimitError):
        return error.but(hint=f"{hint} with a larger --memory-limit")
    if isinstance(error, MemoryError):
        return MemoryLimitError("out of memory", hint=f"{hint}; give it a --memory-limit")
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        return OutputError("the disk is full", where=error.filename, got=error.strerror, hint=hint)
    return None
