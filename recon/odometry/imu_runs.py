"""How the camera moved in some parts of a drive, as features see it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Final

import numpy as np

from recon.core.values import Trajectory
from recon.core.values.arrays import Float64
from recon.core.work import FEW, serial_algebra, side_by_side
from recon.odometry.protocol import OdometryFrame, OdometryResult
from recon.odometry.visual import VisualOdometry
from recon.sources.source import StereoSource
from recon.stereo.frame import FrameReconstructor

_FIRST: Final = 24  # frames from the first on, by which up is found
_PARTS: Final = 4  # more parts, up to the end of the drive
_FRAMES: Final = 12  # frames of each


@dataclass(frozen=True, eq=False)
class ImuSpan:
    """Poses of consecutive frames whose motions are trusted, and how well these are known."""

    path: Trajectory
    sigma_m: Float64  # (N - 1,), of each motion
    sigma_rad: Float64  # (N - 1,)


def seen_runs(source: StereoSource, reconstructor: FrameReconstructor) -> list[ImuSpan]:
    """Return runs from all over a drive, in order."""

    def seen(part: tuple[int, int]) -> list[ImuSpan]:
        pairs = islice(source.frames(part[0]), part[1])
        return list(_runs(OdometryFrame(*reconstructor.match_roughly(pair)) for pair in pairs))

    rest = np.linspace(_FIRST, max(_FIRST, len(source) - _FRAMES), _PARTS).astype(int)
    parts = [(0, _FIRST), *((int(start), _FRAMES) for start in np.unique(rest))]
    with serial_algebra():
        return [run for runs in side_by_side(seen, parts, threads=FEW) for run in runs]


def _runs(frames: Iterable[OdometryFrame]) -> Iterator[ImuSpan]:
    odometry, run = VisualOdometry(), list[tuple[float, OdometryResult]]()
    for frame in frames:
        found = odometry.register(frame)
        if found.health.begins or not found.health.ok:
            yield from _run(run)
            run = []
        if found.health.ok:
            run.append((frame.pair.timestamp_s, found))
    yield from _run(run)


def _run(found: list[tuple[float, OdometryResult]]) -> Iterator[ImuSpan]:
    if len(found) < 2:
        return
    path = Trajectory(
        np.stack([result.T_world_camera for _, result in found]), np.array([t for t, _ in found])
    )
    sigmas = np.array([(r.health.sigma_m, np.deg2rad(r.health.sigma_deg)) for _, r in found[1:]])
    yield ImuSpan(path, *sigmas.T)
