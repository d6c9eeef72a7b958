"""What `recon map` is asked for: its command line, and the options that come of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from typing_extensions import Self

from recon.commands.config import ReconConfig
from recon.core.errors import SettingsError
from recon.core.values import Trajectory
from recon.export.make import USUAL
from recon.io.files import StrPath, resolved
from recon.io.trajectory import read_trajectory
from recon.run.batch.cluster import BatchOptions
from recon.run.progress import SILENT, Progress
from recon.run.run import Run
from recon.sources.prior import read_prior
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
        prior = None if self.prior is None else read_prior(source, self.prior)
        return source, MapOptions(
            known_poses=None if self.poses is None else read_trajectory(self.poses),
            prior=None if prior is None else prior.path,
            prior_origin="" if prior is None else prior.origin,
            mesh=self.mesh,
            arguments=self.arguments(),
        )


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(resolved(path))
