"""`recon localize`: find each frame of a drive in a map that is there already."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Final

from recon.commands.config import ReconConfig, load_config
from recon.commands.map import as_line, faults_of, look_first, run_map
from recon.commands.map_options import MapOptions
from recon.commands.map_summary import MapSummary
from recon.core.errors import MappingError, SettingsError
from recon.core.progress import Silent, showing, stage
from recon.core.values import Recorded
from recon.export.trajectories import begin_states, export_localized, write_states
from recon.io.fields import write_json
from recon.io.files import StrPath
from recon.io.models.rasters import read_grid
from recon.look.look import look_at
from recon.map.drive.drive import Workspace
from recon.map.drive.scale import measure_scene
from recon.map.drive.sequence import map_sequence
from recon.map.ground.axes import base_axes
from recon.map.localize.sequence import (
    LocalizeResult,
    LocalizeSummary,
    StartPose,
    localize_sequence,
)
from recon.map.map import Map
from recon.map.store.map_file import MAP_FILE
from recon.report.map_page import write_localize_page
from recon.rig.capture import CameraSource
from recon.run.finished import GRID, STATES, figure_of, refuse_as_target
from recon.run.run import SUMMARY
from recon.sources.live import LiveSource
from recon.sources.source import DerivedSource, SourcePart, StereoSource


def run_localize(
    source: StereoSource,
    map_path: StrPath,
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
    *,
    start: StartPose | None = None,
) -> LocalizeResult:
    """Find the frames of a drive in a map, which is not changed: what `recon localize` does.

    Args:
        source: The drive.
        map_path: Folder of the run that made the map, or the map file itself.
        config: The configuration; None = the defaults.
        options: Options of the run; None = the defaults.
        start: Where the drive begins, roughly; None = anywhere in the map.

    Raises:
        ReconError: The map or the source cannot be read, or the folder cannot be written; nothing
            is left behind.
    """
    config, options = config or load_config(), options or MapOptions(command="localize")
    map_path = Path(map_path)
    refuse_as_target(map_path, options.out)
    with (
        Map.open(map_path, cache_bytes=config.memory.cache_bytes) as map_,
        options.run(config.at_scale(map_.first.scale)) as run,
    ):
        folder = map_path if map_path.is_dir() else None
        inputs = [*source.files, map_path if folder is None else folder / MAP_FILE]
        run.check_targets(inputs)
        before = look_first(source, config, options, run, map_.known_rig(source.calibration))
        rig, source = before.rig, before.drive
        height_m = None if folder is None else figure_of(folder, "camera_height_m")
        where = {"map_run": str(map_path), "T_map_world": map_.first.T_map_world.tolist()}
        write_json(run.state(SUMMARY), where)
        note = begin_states(run.state(STATES))
        options.begun(run.folder)
        with options.listening(run) as options:
            workspace = Workspace(map_, run.watch, run.threads, options.listener, height_m)
            drive = localize_sequence(source, workspace, config, start=start, note=note)
        has_grid = folder is not None and (folder / GRID).is_file()
        grid = read_grid(map_path / GRID) if has_grid else None
        seen = [
            *before.findings,
            *rig.warnings(before.findings),
            *drive.warnings(),
            *drive.doubts,
            *source.warnings(),
            *options.listener.warnings(),
        ]
        summary = LocalizeSummary(
            source=source.name,
            map_run=str(map_path),
            T_map_world=map_.first.T_map_world,
            drive=drive.figures(),
            rig=rig.figures(),
            base_frame=None if drive.mount is None else drive.mount.base,
            read=source.figures(),
            warnings=[*before.look.first, *map_.doubts, *seen],
        )
        made = LocalizeResult(source.name, str(map_path), drive, grid, summary)
        with run.stage("write"):
            T_base_camera = base_axes(drive.T_map_world, height_m, drive.mount)
            export_localized(drive, T_base_camera, run.content)
            write_states(run.path(STATES), drive.frames)
        with run.report(summary) as summary:
            write_localize_page(replace(made, summary=summary), run)
        summary = run.finish(summary, source=source.name, inputs=inputs)
    return replace(made, summary=summary)


_SLOWEST: Final = 1e-3
_LOOK_S: Final = 2.0  # that are looked at before the first pose
_MOST: Final = 24  # pairs of them
_FIRST: Final = 3  # pairs that do not count: the first use of a library takes long
_PACE_S: Final = 0.1  # between them, whatever their own times are: there may be a gap


def run_live(
    source: StereoSource,
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
    *,
    rate: float = 1.0,
    map_path: StrPath | None = None,
    start: StartPose | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> MapSummary | LocalizeSummary:
    """Map a drive while its images arrive: what `recon live` does.

    The pose of each frame comes first, from its features alone; matching follows as far as there
    is time. Where even poses take too long, frames are dropped; the summary counts both (``live``).

    Args:
        source: Cameras, or a recording, which is played at its own time stamps.
        config: The configuration; None = the defaults.
        options: Options of the run; None = the defaults.
        rate: How many times as fast as recorded a recording is played.
        map_path: Find the drive in this map instead of making one, as `run_localize` does.
        start: As there.
        stopped: Asked now and then; True ends the drive, whose map is then completed.

    Returns:
        What `run_map` or `run_localize` found.

    Raises:
        ReconError: As for `run_map` and `run_localize`; the rate is not positive, or the odometry
            needs exact disparities.
    """
    if not _SLOWEST <= rate < float("inf"):
        expected = f"{_SLOWEST:g} or more"
        raise SettingsError("not a rate", where="--rate", got=f"{rate:g}", expected=expected)
    config, options = config or load_config(), options or MapOptions(command="live")
    if config.odometry.method == "kiss":
        what = "while images arrive, poses come before the points that kiss-icp needs"
        raise SettingsError(what, where="odometry.method", got="kiss", expected="visual")
    stage("look")
    beginning = _Beginning(source)
    look = look_at(beginning, config)
    if options.audit:
        options.warn(tuple(map(as_line, faults_of(look, config))))
    # What comes is done once and forgotten.
    first = LiveSource(SourcePart(beginning, 0, min(_FIRST, len(beginning))), stopped=stopped)
    stage("warm up")
    with Map.temporary() if map_path is None else Map.open(map_path) as map_, showing(Silent()):
        if map_path is None:
            scene = measure_scene(look.recorded, beginning.calibration, config)
            config = config.at_scale(scene.scale)
            map_sequence(first, config, workspace=Workspace(map_))
        else:
            localize_sequence(first, Workspace(map_), config)
    rate_now = None if source.live else rate
    played = source if isinstance(source, LiveSource) else LiveSource(source, rate_now, stopped)
    options = replace(options, audit=False)
    if map_path is not None:
        return run_localize(played, map_path, config, options, start=start).summary
    try:
        return run_map(played, config, options).summary
    except MappingError as error:
        if not played.warnings():
            raise
        why = "; ".join(played.warnings())
        hint = f"{played.slower}, or take a smaller image or faster matcher"
        raise MappingError(error.what, where=error.where, got=why, hint=hint) from error


class _Beginning(DerivedSource):
    """The first two seconds of a recording; of cameras, which take no pair again, a few pairs."""

    def __init__(self, source: StereoSource) -> None:
        super().__init__(source)
        self._pairs = list[Recorded]()
        begun_s, once = None, source.live or isinstance(source, CameraSource)
        for pair in islice(source.frames(), _FIRST if once else _MOST):
            self._pairs.append(replace(pair, timestamp_s=len(self._pairs) * _PACE_S))
            begun_s = pair.timestamp_s if begun_s is None else begun_s
            if len(self._pairs) >= _FIRST and pair.timestamp_s - begun_s >= _LOOK_S:
                break

    def __len__(self) -> int:
        return len(self._pairs)

    def frames(self, start: int = 0) -> Iterator[Recorded]:
        return iter(self._pairs[start:])
