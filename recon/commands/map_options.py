"""What `recon map` is asked for: its command line, and the options that come of it."""

from __future__ import annotations

import errno
import hashlib
import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from typing_extensions import Self

from recon.commands.config import ReconConfig, load_config
from recon.core.errors import (
    ClusterError,
    FormatError,
    MemoryLimitError,
    OutputError,
    ReconError,
    SettingsError,
)
from recon.core.values import Trajectory
from recon.export.make import USUAL
from recon.io.files import StrPath, resolved
from recon.io.trajectory import read_trajectory
from recon.map.drive.workspace import ANEW, resuming, session_info
from recon.map.verbs import Map
from recon.run.batch.cluster import BatchOptions
from recon.run.directory import RECORD, STARTED, RunDirectory, state_folder
from recon.run.machine import versions
from recon.run.memory import memory_overrides
from recon.run.progress import SILENT, Progress
from recon.run.run import Run, fingerprint
from recon.sources.registry import open_source
from recon.sources.source import StereoSource


@dataclass(frozen=True)
class MapOptions:
    """Options of a run that are not part of the configuration.

    Attributes:
        command: Command name, for the record and the default folder.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        known_poses: Poses to use instead of odometry, one per frame.
        prior: Motion of the left camera from another sensor, in the time base of the source.
        prior_origin: Where it is from, for the summary.
        mesh: Whether to reconstruct a surface.
        progress: Shown how far the run is.
        audit: Whether a quick audit of the recording comes first, unless the settings forbid it.
        tell: Given the findings of the audit, before the drive is mapped.
        resume: Resume the unfinished run in ``out``.
        arguments: Command-line arguments, stored so that resuming need not repeat them.
        workers: Where pieces of the drive are mapped side by side; None = it is mapped here, in one
            piece, unless a run that is resumed was begun in pieces.
    """

    command: str = "map"
    out: StrPath | None = None
    threads: int | None = None
    known_poses: Trajectory | None = None
    prior: Trajectory | None = None
    prior_origin: str = ""
    mesh: bool = True
    progress: Progress = SILENT
    audit: bool = True
    tell: Callable[[tuple[str, ...]], None] = lambda findings: None
    resume: bool = False
    arguments: Mapping[str, Any] = field(default_factory=dict)
    workers: BatchOptions | None = None

    @property
    def products(self) -> tuple[str, ...]:
        """What is made of the map."""
        return tuple(name for name in USUAL if self.mesh or name != "mesh")

    def run(self, config: ReconConfig) -> Run:
        """Return the run, which begins when it is entered."""
        return Run(
            self.command,
            self.out,
            config,
            threads=self.threads,
            progress=self.progress,
            resume=self.resume,
        )


@dataclass(frozen=True)
class MapRequest:
    """What is mapped with what: the part of the command line that resuming need not repeat.

    Attributes:
        source: Path of the source.
        kind: Kind of the source; None = inferred from its files.
        poses: File of known poses.
        prior: File of the camera's motion from another sensor, or a topic of the source.
        mesh: Whether to reconstruct a surface.
    """

    source: Path | None = None
    kind: str | None = None
    poses: Path | None = None
    prior: str | None = None
    mesh: bool = True

    def arguments(self) -> dict[str, Any]:
        """Return the request as plain values, with absolute paths."""
        prior = self.prior
        return {
            "source": _absolute(self.source),
            "kind": self.kind,
            "poses": _absolute(self.poses),
            "prior": _absolute(Path(prior)) if prior and Path(prior).is_file() else prior,
            "mesh": self.mesh,
        }

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> Self:
        """Return the request with these `arguments`."""
        source, poses = (arguments.get(name) for name in ("source", "poses"))
        return cls(
            source=None if source is None else Path(source),
            kind=arguments.get("kind"),
            poses=None if poses is None else Path(poses),
            prior=arguments.get("prior"),
            mesh=bool(arguments.get("mesh")),
        )

    def over(self, earlier: Self) -> Self:
        """Return this request, with what it leaves open as in an earlier one."""
        if earlier.mesh and not self.mesh:
            raise SettingsError("the run was started with a mesh", hint="drop --no-mesh")
        return replace(
            earlier,
            source=self.source or earlier.source,
            kind=self.kind or earlier.kind,
            poses=self.poses or earlier.poses,
            prior=self.prior or earlier.prior,
        )

    def open(self, config: ReconConfig) -> tuple[StereoSource, MapOptions]:
        """Open the source, and read the poses and the prior."""
        if self.source is None:
            raise SettingsError("there is no source to map", hint="name SOURCE")
        settings = config.source.model_copy(update={"max_megapixels": config.readable_megapixels})
        source = open_source(self.source, self.kind, settings)
        prior = None if self.prior is None else source.read_prior(self.prior)
        return source, MapOptions(
            known_poses=None if self.poses is None else read_trajectory(self.poses),
            prior=None if prior is None else prior.path,
            prior_origin="" if prior is None else prior.origin,
            mesh=self.mesh,
            arguments=self.arguments(),
        )


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(resolved(path))


_OTHER: Final = {
    "config": "other settings",
    "source": "another source",
    "poses": "other poses",
    "prior": "another prior",
    "versions": "other versions",
}
_HEAD_BYTES: Final = 4096
_MEMORY: Final = "memory"
"""The group of settings that a resumed run may change."""


def identity_of(
    source: StereoSource,
    config: ReconConfig,
    known_poses: Trajectory | None,
    prior: Trajectory | None = None,
) -> dict[str, Any]:
    """Return everything that must be unchanged, as plain values."""
    return {
        "config": config.model_dump(mode="json"),
        "source": {"frames": len(source), **fingerprint(source.files, head_bytes=_HEAD_BYTES)},
        "poses": _digest(known_poses),
        "prior": _digest(prior),
        "versions": versions(),
    }


def read_started(folder: Path) -> dict[str, Any]:
    """Read what an unfinished run was started with: its ``identity`` and ``arguments``."""
    path = state_folder(folder) / STARTED
    try:
        with Map.open(path) as map_:
            return _checked(map_.session().info.start)
    except (ReconError, LookupError, TypeError) as error:
        if path.is_file():
            raise FormatError(
                "the unfinished map cannot be read", where=path, got=error, hint=ANEW
            ) from error
        finished = "it is finished; without --resume it runs again"
        hint = finished if (folder / RECORD).is_file() else "start it without --resume"
        raise OutputError(
            "there is no unfinished run to resume", where=folder, hint=hint
        ) from error


def _checked(started: Any) -> dict[str, Any]:
    """Check that it has the form that `begin_or_resume` writes."""
    parts = (started["identity"], started["identity"]["config"], started["arguments"])
    plain = all(isinstance(part, dict) for part in parts)
    if not plain or not all(isinstance(v, str | bool | None) for v in parts[-1].values()):
        raise TypeError("not what a run is started with")
    return {"identity": parts[0], "arguments": parts[-1]}


def refuse_others(now: Mapping[str, Any], then: Mapping[str, Any], folder: Path) -> None:
    """Refuse to resume with inputs or settings that differ.

    Args:
        now: What a run is to be resumed with; parts of an identity.
        then: The identity that it was started with.
        folder: Folder of the run.
    """
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


def _digest(path: Trajectory | None) -> str | None:
    """Return SHA-256 of the poses and timestamps; None = no trajectory."""
    if path is None:
        return None
    return hashlib.sha256(path.T_world_camera.tobytes() + path.timestamps_s.tobytes()).hexdigest()


def _without_limit(part: Any) -> Any:
    if not isinstance(part, dict):
        return part
    return {name: value for name, value in part.items() if name != _MEMORY}


def _first_difference(now: Any, then: Any, key: str) -> tuple[str, Any, Any]:
    """Return the dotted key and the two values of the first leaf that differs."""
    if isinstance(now, dict) and isinstance(then, dict):
        for name in [*now, *(then.keys() - now.keys())]:
            if now.get(name) != then.get(name):
                return _first_difference(now.get(name), then.get(name), f"{key}.{name}")
    return key, now, then


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
    # What arrives in its own time will not arrive again.
    start = {} if source.live else {"identity": dict(identity), "arguments": dict(arguments)}
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
    if source.live:
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
