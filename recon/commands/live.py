"""The story of `recon live`: map a drive, or find it in a map, while its images arrive."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, load_config
from recon.commands.localize import run_localize
from recon.commands.map import run_map
from recon.commands.map_options import MapOptions
from recon.core.errors import MappingError, SettingsError
from recon.core.values import StereoPair
from recon.map.drive.sequence import map_sequence
from recon.map.drive.workspace import Workspace
from recon.map.localize.sequence import StartPose, localize_sequence
from recon.map.store.map import Map
from recon.sources.live import LiveSource
from recon.sources.protocol import StereoSource

_COMMIT_S: Final = 3.0
"""Time between two commits of the map, as the drive goes."""

_FIRST: Final = 3
"""Pairs that are worked on before the first one counts: the first use of a library takes long."""


def run_live(
    source: StereoSource,
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
    *,
    rate: float = 1.0,
    map_path: Path | None = None,
    start: StartPose | None = None,
) -> dict[str, Any]:
    """Map a drive while its images arrive at their own time stamps: what `recon live` does.

    Where the machine is too slow, frames are tracked without being matched, and if that does not
    help, dropped; the summary counts both (``live``).

    Args:
        source: The recording that is played.
        config: The configuration; None = the defaults.
        options: Options of the run; None = the defaults.
        rate: How many times as fast as recorded it is played.
        map_path: Find the drive in this map instead of making one: folder of a run, or map file.
        start: Where the drive begins in it, roughly; None = anywhere.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: As for `run_map` and `run_localize`; or the rate is not positive.
    """
    if not 0.0 < rate < float("inf"):
        raise SettingsError("a rate is positive", where="--rate", got=f"{rate:g}")
    config, options = config or load_config(), options or MapOptions(command="live")
    config = _committed_often(config, source, rate)
    _warm_up(_Beginning(source), config, map_path)
    played = LiveSource(source, rate)
    options = replace(options, audit=False, progress=played.timed(options.progress))
    if map_path is not None:
        return run_localize(played, map_path, config, options, start=start).summary
    try:
        return run_map(played, config, options).summary
    except MappingError as error:
        raise _because_it_was_too_fast(error, played) from error


def _because_it_was_too_fast(error: MappingError, played: LiveSource) -> MappingError:
    """Say of a drive that gave no map what was left out of it, if anything was."""
    if not played.warnings():
        return error
    why = "; ".join(played.warnings())
    hint = "play it more slowly, such as --rate 0.5, or take a smaller image or a faster matcher"
    return MappingError(error.what, where=error.where, got=why, hint=hint)


class _Beginning:
    """The first pairs of a source."""

    truth = None

    def __init__(self, source: StereoSource) -> None:
        self._source = source
        self.name, self.description = source.name, source.description
        self.calibration, self.files = source.calibration, source.files

    def __len__(self) -> int:
        return min(_FIRST, len(self._source))

    def __iter__(self) -> Iterator[StereoPair]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[StereoPair]:
        return islice(self._source.frames(start), len(self) - start)


def _warm_up(source: StereoSource, config: ReconConfig, map_path: Path | None) -> None:
    """Do once with the first pairs what comes, and forget it."""
    if map_path is None:
        with Map.temporary() as map_:
            map_sequence(source, config, workspace=Workspace(map_))
    else:
        with Map.open(map_path) as map_:
            localize_sequence(source, Workspace(map_), config)


def _committed_often(config: ReconConfig, source: StereoSource, rate: float) -> ReconConfig:
    """Return the configuration with a commit every few seconds, by the times of the first pairs."""
    times_s = [pair.timestamp_s for pair in _Beginning(source)]
    period_s = (times_s[-1] - times_s[0]) / max(1, len(times_s) - 1) / rate if times_s else 0.0
    every = min(config.checkpoints.every_frames, max(1, round(_COMMIT_S / max(period_s, 1e-3))))
    checkpoints = config.checkpoints.model_copy(update={"every_frames": every})
    return config.model_copy(update={"checkpoints": checkpoints})
