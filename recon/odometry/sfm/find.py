"""Structure from motion over all pairs of a source, before the first of them is mapped.

Features of every image, matches between pairs that may see the same, and a model that grows by one
pair after another, adjusted as a whole. The rig is held, so lengths are metres. Pairs that share
nothing are in models of their own.

Ref: Schönberger, Frahm, "Structure-from-motion revisited", CVPR 2016.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from recon.core.errors import RegistrationError, SettingsError
from recon.core.text import counted
from recon.core.work import Stopwatch
from recon.odometry.sfm.colmap import Colmap, load_colmap
from recon.odometry.sfm.found import FoundPoses
from recon.sources.source import StereoSource, check_source
from recon.stereo.rectify.rectifier import RectificationSettings, Rectifier


def check_sfm(source: StereoSource) -> None:
    """Refuse what structure from motion cannot work with, and say which package is missing."""
    check_source(source, stereo=True)
    load_colmap()
    if source.live:
        what = "structure from motion needs all pairs before it begins"
        raise SettingsError(what, where=source.name, hint="record the drive, then recon map it")


@dataclass(frozen=True)
class SfmOptions:
    """How the poses of a source are found."""

    rectification: RectificationSettings
    folder: Path | None = None  # where temporary files may be; None = where the system has them
    threads: int = 1
    limit_mb: float | None = None  # memory
    stopwatch: Stopwatch = field(default_factory=Stopwatch)


def find_poses(source: StereoSource, options: SfmOptions) -> FoundPoses:
    """Find the poses of all pairs of a source, whatever their order.

    Raises:
        RegistrationError: No two pairs can be placed beside each other.
        SettingsError: The source is live.
        MissingDependencyError: The extra ``sfm`` is not installed.
    """
    check_sfm(source)
    stage = options.stopwatch.stage
    with (
        tempfile.TemporaryDirectory(prefix="sfm-", dir=options.folder) as folder,
        _plain_errors(source.name),
    ):
        rectifier = Rectifier(source.calibration, options.rectification)
        work = Colmap(rectifier.camera, Path(folder), options.threads, options.limit_mb)
        with stage("sfm_features"):
            work.add_features(map(rectifier.rectify, source.frames()))
        with stage("sfm_match"):
            work.match(len(source))
        with stage("sfm_map"):
            models = work.map()
    if not models:
        raise RegistrationError(
            "structure from motion found no two pairs that see the same",
            where=source.name,
            got=counted(len(source), "pair"),
            hint="take pairs that overlap by half; recon pair makes a cloud of a single one",
        )
    return FoundPoses(len(source), models)


@contextmanager
def _plain_errors(where: str) -> Iterator[None]:
    """Say in one line what COLMAP, whose errors are those of C++, cannot do."""
    try:
        yield
    except (RuntimeError, ValueError, IndexError) as error:
        what, hint = "structure from motion failed", "try --odometry visual"
        raise RegistrationError(what, where=where, got=error, hint=hint) from error
