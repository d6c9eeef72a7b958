"""Resuming an interrupted run, after checking that its inputs and settings are unchanged."""

from __future__ import annotations

import errno
import hashlib
import json
import shlex
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, load_config
from recon.commands.map_options import MapRequest
from recon.core.errors import (
    FormatError,
    MemoryLimitError,
    OutputError,
    ReconError,
    SettingsError,
)
from recon.core.values import Trajectory
from recon.map.drive.workspace import ANEW, resuming, session_info
from recon.map.store.map import Map
from recon.run.directory import RECORD, STARTED, RunDirectory, state_folder
from recon.run.machine import versions
from recon.run.memory import memory_overrides
from recon.run.record import fingerprint
from recon.sources.protocol import StereoSource

_OTHER: Final = {
    "config": "other settings",
    "source": "another source",
    "poses": "other poses",
    "prior": "another prior",
    "versions": "other versions",
}
_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_HEAD_BYTES: Final = 4096
_MEMORY: Final = "memory"
_NOTHING: Final = "there is no unfinished run to resume"
_START_ANEW: Final = "start it without --resume"


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

    Raises:
        SettingsError: A setting is invalid, or contradicts the run.
        OutputError: There is no run to resume.
    """
    started = read_started(folder)
    request = request.over(MapRequest.of(started["arguments"]))
    settings = ReconConfig.parse(started["identity"]["config"], where=str(folder))
    asked = load_config(config, [*overrides, *memory_overrides(memory_limit)])
    if config is not None or overrides:
        _refuse_others({"config": asked.model_dump(mode="json")}, started["identity"], folder)
    if asked.memory.limit_mb is not None:
        settings = settings.model_copy(update={_MEMORY: asked.memory})
    return request, settings


def identity_of(
    source: StereoSource,
    config: ReconConfig,
    known_poses: Trajectory | None,
    prior: Trajectory | None = None,
) -> dict[str, Any]:
    """Everything that must be unchanged for a resumed run to give the same result."""
    return {
        "config": config.model_dump(mode="json"),
        "source": {"frames": len(source), **fingerprint(source.files, head_bytes=_HEAD_BYTES)},
        "poses": _digest(known_poses),
        "prior": _digest(prior),
        "versions": versions(),
    }


def _digest(path: Trajectory | None) -> str | None:
    """SHA-256 of the poses and timestamps; None = no trajectory."""
    if path is None:
        return None
    return hashlib.sha256(path.T_world_camera.tobytes() + path.timestamps_s.tobytes()).hexdigest()


def begin_or_resume(
    directory: RunDirectory,
    source: StereoSource,
    config: ReconConfig,
    identity: Mapping[str, Any],
    arguments: Mapping[str, Any],
) -> Map:
    """Begin the map of a run; for a resumed one, check that nothing has changed, and open it.

    Raises:
        SettingsError: The run was started with other inputs or settings.
        FormatError: The map is damaged.
        OutputError: The map cannot be written, or there is no run to resume.
    """
    path, memory = directory.state(STARTED), config.memory.cache_bytes
    if directory.resumes:
        _refuse_others(identity, read_started(directory.folder)["identity"], directory.folder)
        with resuming(path):
            return Map.open(path, read_only=False, cache_bytes=memory)
    map_ = Map.create(path, cache_bytes=memory)
    start = {"identity": dict(identity), "arguments": dict(arguments)}
    map_.begin(session_info(source, config, start))
    map_.commit()
    return map_


@contextmanager
def tell_how_to_resume(directory: RunDirectory) -> Iterator[None]:
    """Add a hint on how to resume to errors after which the run can be resumed.

    Raises:
        OutputError: The disk is full, or the folder can no longer be written.
        MemoryLimitError: Memory is exhausted.
    """
    try:
        yield
    except (OutputError, MemoryLimitError, OSError, MemoryError, KeyboardInterrupt) as error:
        told = _with_hint(error, directory.folder) if directory.resumable else None
        if told is None:
            raise
        raise told from error


def _with_hint(error: BaseException, folder: Path) -> BaseException | None:
    """The error with a hint on how to resume; None if it is raised unchanged."""
    hint = f"recon map --resume {shlex.quote(str(folder))} goes on from there"
    if isinstance(error, KeyboardInterrupt):
        return KeyboardInterrupt(hint)
    if isinstance(error, OutputError):
        return OutputError(error.what, where=error.where, got=error.got, hint=hint)
    if isinstance(error, MemoryLimitError):
        more = f"{hint} with a larger --memory-limit"
        return MemoryLimitError(
            error.what, where=error.where, got=error.got, expected=error.expected, hint=more
        )
    if isinstance(error, MemoryError):
        return MemoryLimitError("out of memory", hint=f"{hint}; give it a --memory-limit")
    if isinstance(error, OSError) and error.errno in _NO_ROOM:
        return OutputError("the disk is full", where=error.filename, got=error.strerror, hint=hint)
    return None


def read_started(folder: Path) -> dict[str, Any]:
    """Read what an unfinished run was started with.

    Raises:
        OutputError: The folder holds no unfinished run.
    """
    path = state_folder(folder) / STARTED
    try:
        with Map.open(path) as map_:
            return _checked(map_.session().info.start)
    except (ReconError, LookupError, TypeError) as error:
        if path.is_file():
            raise FormatError(
                "the unfinished map cannot be read", where=path, got=error, hint=ANEW
            ) from error
        finished = (folder / RECORD).is_file()
        hint = "it is finished; without --resume it runs again" if finished else _START_ANEW
        raise OutputError(_NOTHING, where=folder, hint=hint) from error


def _checked(started: Any) -> dict[str, Any]:
    """What a run was started with, if it has the form that `begin_or_resume` writes.

    Raises:
        TypeError: A part has another type; a `LookupError` if it is missing.
    """
    parts = (started["identity"], started["identity"]["config"], started["arguments"])
    plain = all(isinstance(part, dict) for part in parts)
    if not plain or not all(isinstance(v, str | bool | None) for v in parts[-1].values()):
        raise TypeError("not what a run is started with")
    return {"identity": parts[0], "arguments": parts[-1]}


def _refuse_others(now: Mapping[str, Any], then: Mapping[str, Any], folder: Path) -> None:
    """Refuse to resume with inputs or settings that differ."""
    # Through JSON, like the stored values, so that tuples equal lists.
    for part, value in json.loads(json.dumps(dict(now))).items():
        after, before = _without_limit(value), _without_limit(then.get(part))
        if after == before:
            continue
        key, got, expected = _first_difference(after, before, part)
        raise SettingsError(
            f"the run was started with {_OTHER[part]}",
            where=folder,
            got=f"{key} = {got}",
            expected=expected,
            hint="resume with what it was started with, or start anew without --resume",
        )


def _without_limit(part: Any) -> Any:
    """A part of an identity without the memory limit, which a resumed run may change."""
    if not isinstance(part, dict):
        return part
    return {name: value for name, value in part.items() if name != _MEMORY}


def _first_difference(now: Any, then: Any, key: str) -> tuple[str, Any, Any]:
    """Dotted key and the two values of the first leaf that differs."""
    if isinstance(now, dict) and isinstance(then, dict):
        for name in [*now, *(then.keys() - now.keys())]:
            if now.get(name) != then.get(name):
                return _first_difference(now.get(name), then.get(name), f"{key}.{name}")
    return key, now, then
