"""What a run is asked for, and how one that was interrupted goes on.

An unfinished map keeps what its run was asked for (``arguments``) and what must be unchanged for
the same result (``identity``): settings, source, poses, prior and versions.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from typing_extensions import Self

from recon.commands.config import Changes, ReconConfig, load_config
from recon.core.dates import Date
from recon.core.errors import FormatError, OutputError, ReconError, SettingsError
from recon.core.geometry.se3 import make_transform
from recon.core.machine import versions
from recon.core.values import Trajectory
from recon.export.make import PRODUCTS, USUAL
from recon.export.mcap import write_layout
from recon.export.robot import RobotTopics
from recon.io.files import StrPath, resolved
from recon.io.ros.bag import write_bag
from recon.io.ros.messages import MessageWriter
from recon.io.trajectory import read_trajectory
from recon.map.drive.drive import ANEW, resuming, session_info
from recon.map.listener import NOBODY, DriveListener
from recon.map.map import Map
from recon.map.sessions.keep import Keep
from recon.map.store.session import IMAGES
from recon.run.batch.cluster import BatchOptions
from recon.run.directory import RECORD, STARTED, state_folder
from recon.run.run import Run
from recon.sources.registry import open_source
from recon.sources.source import StereoSource, mark_of
from recon.stereo.rectify.rectifier import turns_of

_OTHER: Final = {
    "config": "other settings", "source": "another source", "poses": "other poses",
    "prior": "another prior", "versions": "other versions",
}  # fmt: skip


@dataclass(frozen=True)
class MapOptions:
    """What a run is asked for besides its settings.

    Attributes:
        command: Command name, for the record and the default folder.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        known_poses: Poses to use instead of odometry, one per frame.
        prior: Motion of the left camera from another sensor, in the time base of the source.
        prior_origin: Where it is from, for the summary.
        mesh: Whether to reconstruct a surface.
        audit: Whether a quick audit of the recording comes first, unless the settings forbid it.
        warn: Given the findings of the audit, before the drive is mapped.
        begun: Given the folder of the run, once its map or what it has located can be read.
        resume: Resume the unfinished run in ``out``.
        workers: Where pieces of the drive are mapped side by side; None = in one piece, here,
            unless a run that is resumed was begun in pieces.
        source, kind: What `open` opens; kind None = inferred from its files.
        poses_file: File of the known poses, which `open` reads.
        prior_from: File of the prior, or a topic of the source; likewise.
        listener: Is told of the drive while it goes on, unless topics are written.
        writers: Where topics of a robot are written while it goes on, see `RobotTopics`.
        namespace: What the names of its topics and frames begin with.
        stamp_ns: Makes their stamps of the times of frames; None = they are seconds since 1970.
        keep: What a map keeps of its drives, into which another is mapped; None = the default.
        changes: Whether what came and went with the newest of several drives is reported.
        date: Day of the drive, where the user gives it; None = by its stamps or files.
        bag: Whether they are written into a bag in the folder of the run, too.
    """

    command: str = "map"
    out: StrPath | None = None
    threads: int | None = None
    known_poses: Trajectory | None = None
    prior: Trajectory | None = None
    prior_origin: str = ""
    mesh: bool = True
    audit: bool = True
    warn: Callable[[tuple[str, ...]], None] = lambda findings: None
    begun: Callable[[Path], None] = lambda folder: None
    resume: bool = False
    workers: BatchOptions | None = None
    source: StrPath | None = None
    kind: str | None = None
    poses_file: StrPath | None = None
    prior_from: str | None = None
    listener: DriveListener = NOBODY
    writers: Sequence[MessageWriter] = ()
    namespace: str = ""
    stamp_ns: Callable[[float], int] | None = None
    bag: bool = False
    keep: Keep | None = None
    changes: bool = False
    date: Date | None = None

    @property
    def products(self) -> tuple[str, ...]:
        return tuple(name for name in USUAL if self.mesh or name != "mesh")

    @property
    def arguments(self) -> dict[str, Any]:
        """What resuming need not repeat, as plain values; empty where no file is mapped."""
        if self.source is None:
            return {}
        prior = self.prior_from
        return {
            "source": _absolute(self.source),
            "kind": self.kind,
            "poses": _absolute(self.poses_file),
            "prior": _absolute(prior) if prior and Path(prior).is_file() else prior,
            "mesh": self.mesh,
        }

    def images_of(self, source: StereoSource) -> dict[str, Any]:
        """Return where the images of a drive are, for its map; empty where no file is mapped."""
        if source.live or self.source is None:
            return {}
        found = {"source": _absolute(self.source), "kind": self.kind}
        return {IMAGES: {**found, "mark": mark_of(source)}}

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> Self:
        """Return options with the `arguments` of a run."""
        return cls(
            source=arguments.get("source"),
            kind=arguments.get("kind"),
            poses_file=arguments.get("poses"),
            prior_from=arguments.get("prior"),
            mesh=bool(arguments.get("mesh")),
        )

    def open(self, config: ReconConfig) -> tuple[StereoSource, Self]:
        """Open the source; return it, and the options with the poses and the prior read."""
        if self.source is None:
            raise SettingsError("there is no source to map", hint="name SOURCE")
        settings = config.source.model_copy(update={"max_megapixels": config.readable_megapixels})
        source = open_source(self.source, self.kind, settings)
        prior = None if self.prior_from is None else source.read_prior(self.prior_from)
        poses = None if self.poses_file is None else read_trajectory(self.poses_file)
        if poses is not None and settings.poses_of == "raw":
            R_rectified_raw = turns_of(source.calibration, config.rectification).R_left
            T_raw_rectified = make_transform(R_rectified_raw.T, np.zeros(3))
            poses = replace(poses, T_world_camera=poses.T_world_camera @ T_raw_rectified)
        return source, replace(
            self,
            known_poses=poses,
            prior=None if prior is None else prior.path,
            prior_origin="" if prior is None else prior.origin,
        )

    def resumed(
        self, folder: Path, file: Path | None, changes: Changes, *, preset: str | None = None
    ) -> tuple[Self, ReconConfig]:
        """Complete the options by those of the unfinished run in a folder; and its settings.

        Those in ``file`` and ``changes`` must be those of the run, all but the memory limit.
        """
        started = _read_started(folder)
        earlier = self.of(started["arguments"])
        if earlier.mesh and not self.mesh:
            raise SettingsError("the run was started with a mesh", hint="drop --no-mesh")
        settings = load_config(file, changes, started["identity"]["config"], preset=preset)
        now = {"config": settings.model_dump(mode="json")}
        _refuse_others(now, started["identity"], folder)
        given = {
            name: getattr(self, name) or getattr(earlier, name)
            for name in ("source", "kind", "poses_file", "prior_from")
        }
        return replace(self, out=folder, resume=True, mesh=earlier.mesh, **given), settings

    def run(self, config: ReconConfig) -> Run:
        """Return the run, which begins when it is entered."""
        return Run(self.command, self.out, config, threads=self.threads, resume=self.resume)

    @contextmanager
    def listening(self, run: Run) -> Iterator[Self]:
        """Return the options with the listener that writes topics, if they are written."""
        with ExitStack() as stack:
            writers = [*self.writers]
            if self.bag:
                folder = run.path(PRODUCTS["mcap"].name)
                writers.append(stack.enter_context(write_bag(folder, as_it_goes=True)))
                write_layout(folder, self.namespace and f"{self.namespace}/", live=True)
            if not writers:
                yield self
            else:
                yield replace(
                    self, listener=RobotTopics(writers, self.namespace, stamp_ns=self.stamp_ns)
                )

    def begin(self, run: Run, source: StereoSource, config: ReconConfig) -> Map:
        """Begin the map of a run; of one that is resumed, open it if nothing has changed."""
        named = (name for name in (self.poses_file, self.prior_from) if name is not None)
        run.check_targets([*source.files, *map(Path, named)])
        path, memory = run.state(STARTED), config.memory.cache_bytes
        images = self.images_of(source)
        identity = {
            "config": config.model_dump(mode="json"),
            "source": images[IMAGES]["mark"] if images else mark_of(source),
            "poses": _digest(self.known_poses),
            "prior": _digest(self.prior),
            "versions": versions(),
        }
        if run.resumes:
            _refuse_others(identity, _read_started(run.folder)["identity"], run.folder)
            with resuming(path):
                return Map.open(path, read_only=False, cache_bytes=memory)
        map_ = Map.create(path, cache_bytes=memory)
        # What arrives in its own time will not arrive again.
        start = {"identity": identity, "arguments": self.arguments, **images}
        map_.begin(session_info(source, config, {} if source.live else start, self.date))
        map_.commit()
        run.begun = run.command != "demo"  # whose street no command line names
        return map_


def _read_started(folder: Path) -> dict[str, Any]:
    """Read what an unfinished run was started with: its ``identity`` and ``arguments``."""
    path = state_folder(folder) / STARTED
    try:
        with Map.open(path) as map_:
            start = map_.session().info.start
            started = _checked(start) if start else {}
    except (ReconError, LookupError, TypeError) as error:
        if path.is_file():
            what = "the unfinished map cannot be read"
            raise FormatError(what, where=path, got=error, hint=ANEW) from error
        finished = "it is finished; without --resume it runs again"
        hint = finished if (folder / RECORD).is_file() else "start it without --resume"
        what = "there is no unfinished run to resume"
        raise OutputError(what, where=folder, hint=hint) from error
    if not started:
        what, hint = "a drive that arrived live cannot be resumed", f"its map so far is {path}"
        raise OutputError(what, where=folder, hint=hint)
    # As in this version: settings that are new have their defaults.
    config = ReconConfig.parse(started["identity"]["config"], where=str(folder))
    started["identity"]["config"] = config.model_dump(mode="json")
    return started


def _checked(started: Any) -> dict[str, Any]:
    parts = (started["identity"], started["identity"]["config"], started["arguments"])
    plain = all(isinstance(part, dict) for part in parts)
    if not plain or not all(isinstance(v, str | bool | None) for v in parts[-1].values()):
        raise TypeError("not what a run is started with")
    return {"identity": parts[0], "arguments": parts[-1]}


def _refuse_others(now: Mapping[str, Any], then: Mapping[str, Any], folder: Path) -> None:
    """Refuse to resume where a part of an identity differs from the one it was started with."""
    plain = json.loads(json.dumps(now))  # as stored: tuples equal lists
    found = next(_differences(plain, {part: then.get(part) for part in now}), None)
    if found is not None:
        key, got, expected = found
        what = f"the run was started with {_OTHER[key.partition('.')[0]]}"
        hint = "resume with what it was started with, or start anew without --resume"
        got = f"{key} = {got}"
        raise SettingsError(what, where=folder, got=got, expected=expected, hint=hint)


def _differences(now: Any, then: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield dotted keys and values of what differs, but for the memory, which may change."""
    if isinstance(now, dict) and isinstance(then, dict):
        for name in [*now, *(then.keys() - now.keys())]:
            inside = f"{key}.{name}" if key else name
            yield from _differences(now.get(name), then.get(name), inside)
    elif now != then and not key.startswith("config.memory"):
        yield key, now, then


def _absolute(path: StrPath | None) -> str | None:
    return None if path is None else str(resolved(path))


def _digest(path: Trajectory | None) -> str | None:
    if path is None:
        return None
    return hashlib.sha256(path.T_world_camera.tobytes() + path.timestamps_s.tobytes()).hexdigest()
