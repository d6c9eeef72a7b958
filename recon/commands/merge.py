"""`recon merge`, `recon map --into` and `--remove`: several drives in one map.

Each fills a new map with drives; then these are linked and placed, and the products are made.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.commands.config import REMADE, ReconConfig, check_changes, run_settings
from recon.commands.map import look_first, map_drive
from recon.commands.map_options import MapOptions
from recon.commands.map_summary import JoinedDrive, JoinedSummary, LinkFigures, UsualProducts
from recon.core.errors import FormatError, ReconError, SettingsError
from recon.export.make import make
from recon.export.product import ExportContext
from recon.export.trajectories import export_sessions
from recon.io.files import resolved
from recon.look.rig import RefinedRig
from recon.map.changes.compare import compare
from recon.map.drive.drive import session_info
from recon.map.drive.sequence import check_map
from recon.map.map import Map
from recon.map.sessions.copying import check_session, copy_sessions, keep_map, read_all
from recon.map.sessions.joining import doubts_of_lengths, join_new
from recon.map.sessions.keep import DRIVES, Keep
from recon.map.sessions.measured import Survey, doubts_of_positions, hold, misfit_rms_m
from recon.map.sessions.placed import place_map, settings_of
from recon.map.sessions.tending import forgotten_of, tend
from recon.map.store.map_file import MAP_FILE
from recon.map.store.session import Session
from recon.report.map_page import write_joined_page
from recon.run.finished import command_of_map, refuse_as_target
from recon.run.run import Run, WholeRun
from recon.sources.source import StereoSource

_CHANGEABLE: Final = (*REMADE, "mesh", "memory")
"""Sections of the configuration that may differ from those of the first run."""
Fill = Callable[[Run, Map], Sequence[int]]
"""Puts drives into the empty map of a run; gives the numbers of those that are new in it."""


def run_merge(
    runs: Sequence[Path],
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
    survey: Survey | None = None,
) -> JoinedSummary:
    """Make one map of several runs, or hold runs at measured positions: what `recon merge` does.

    The drives are linked by places that two of them saw, and placed in one pose graph; cloud,
    OctoMap, grid and mesh are made of all that are linked with the first. What a later run saw
    counts more than what an earlier one did.

    Args:
        runs: Folders of finished runs; the world and the axes of the first are those of the map.
        config: Settings of the first run with changes; None = its own.
        options: Folder, threads and mesh of the run; None = the defaults.
        survey: Positions that were measured during drives, whose paths are optimised to run through
            them; None = none.

    Raises:
        ReconError: A run is missing, unfinished or twice in the list, kept no rays, has voxels of
            another size, or the folder cannot be written; nothing is left behind.
    """
    options = options or MapOptions(command="merge")
    if len(runs) < 2 and survey is None:
        expected = "two runs, or one and --georeference FILE"
        raise SettingsError("there is nothing to merge", got=len(runs), expected=expected)
    for number, run in enumerate(runs):
        if resolved(run) in map(resolved, runs[:number]):
            raise SettingsError("the same run twice", got=run, hint="name each run once")
    settings = _settings(runs[0], config)
    for run in runs:
        command_of_map(run)
        refuse_as_target(run, options.out)

    def fill(run: Run, map_: Map) -> list[int]:
        added = [_copied(folder / MAP_FILE, map_, settings) for folder in runs]
        return [number for numbers in added[1:] for number in numbers]

    files = [*(run / MAP_FILE for run in runs), *([] if survey is None else [survey.positions])]
    return _make_joined(options, settings, fill, files, survey=survey)


def run_map_into(
    folder: Path, source: StereoSource, config: ReconConfig | None, options: MapOptions
) -> JoinedSummary:
    """Map a drive into the map of a finished run: what `recon map SOURCE --into RUN` does.

    What of older drives newer ones saw again is forgotten, as far as ``options.keep`` says; None =
    as `DRIVES` does, ``Keep()`` keeps all.

    The folder is replaced in one step when all is done; until then it keeps the run as it was.
    The settings are those of the run, perhaps with changes; options are as for `run_map`.
    """
    settings = config or run_settings(folder)

    def fill(run: Run, map_: Map) -> list[int]:
        _copied(folder / MAP_FILE, map_, settings)
        kept = run.state("kept.recon")
        known = map_.known_rig(source.calibration)
        seen = look_first(source, settings, options, run, known)
        rig, drive_settings = seen.rig, seen.shifted(settings)
        with Map.create(run.state("drive.recon")) as drive:
            images = options.images_of(seen.look.source)
            drive.begin(session_info(seen.look.source, drive_settings, images, options.date))
            mapped = map_drive(seen.drive, drive_settings, options, run, drive)
            check_map(mapped, source.name, seen.look.first)
            if settings.rig.refine:
                mapped.session.set_rig(rig)
            keep_map(drive, kept)
        try:
            return _copied(kept, map_, settings)
        except (FormatError, SettingsError) as error:  # not the file, which does not stay
            raise error.copy_with(where=source.name) from error

    files = [folder / MAP_FILE, *source.files]
    options = replace(options, keep=options.keep or Keep(DRIVES))
    return _make_joined(options, settings, fill, files, replaced=folder)


def run_remove(
    folder: Path, number: int | None, config: ReconConfig | None, options: MapOptions
) -> JoinedSummary:
    """Take a drive out of the map of a run: what `recon map --into RUN --remove SESSION` does.

    Its number is that of ``sessions`` in the summary (None = none is taken out); then the map
    keeps what ``options.keep`` says (None = all). The folder is replaced in one step.
    """
    settings = _settings(folder, config)

    def fill(run: Run, map_: Map) -> list[int]:
        with Map.open(folder) as old:
            without = [] if number is None else [old.session(number)]
            if without and len(old.sessions) < 2:
                raise SettingsError("the map has only this session", where=folder, got=number)
            copy_sessions(old, map_, without=[session.number for session in without])
            map_.set_forgotten([*map_.forgotten, *(forgotten_of(session) for session in without)])
        return []

    return _make_joined(options, settings, fill, [folder / MAP_FILE], replaced=folder)


def _make_joined(
    options: MapOptions,
    settings: ReconConfig,
    fill: Fill,
    inputs: Sequence[Path],
    replaced: Path | None = None,
    survey: Survey | None = None,
) -> JoinedSummary:
    """Fill the map of a run, which may replace another, link and place its drives, and report."""
    out = replaced or options.out
    with (
        WholeRun(options.command, out, settings, threads=options.threads) as run,
        Map.create(run.path(MAP_FILE), cache_bytes=settings.memory.cache_bytes) as map_,
        _damage_named(map_, inputs),
    ):
        new = fill(run, map_)
        left_out = [] if survey is None else hold(map_, survey)
        with run.stage("links"):
            join_new(map_, new)
        with run.stage("forget"):
            tended = "" if options.keep is None else tend(map_, settings, options.keep)
        map_.commit()
        if tended:
            map_.store.compact()
        with run.stage("map"):
            placed = place_map(map_, settings, run.threads)
        context = ExportContext(map_, placed, settings.mesh, threads=run.threads)
        made = make(context, run.content, options.products, run.watch)
        with run.stage("changes"):
            several = options.changes and len(map_.linked) > 1
            changed = compare(map_, [map_.linked[-1].number], run.threads) if several else None
        summary = replace(
            _figures(map_, UsualProducts.of(made), tended),
            changes=None if changed is None else changed.counts,
            warnings=[*left_out, *_warnings(map_), *_of_rigs(map_, new), *made.warnings],
        )
        export_sessions(map_, run.content)
        with run.report(summary) as summary:
            write_joined_page(map_, made, summary.to_json(), run, changed)
        map_.close()
        names, axes = ", ".join(drive.name for drive in summary.sessions), summary.T_map_world
        record = {"T_map_world": axes.tolist()}
        return run.finish(summary, source=names, inputs=inputs, record=record)


def _figures(map_: Map, made: UsualProducts, tended: str) -> JoinedSummary:
    kept = [link for link in map_.links if link.kept]
    pairs = Counter("-".join(map(str, link.sessions)) for link in kept)
    return JoinedSummary(
        frames=sum(map(len, map_.linked)),
        path_length_m=sum(path.path_length_m for path in map_.paths.values()),
        sessions=joined_drives(map_),
        forgotten=map_.forgotten,
        map_mb_per_km=map_.mb_per_km,
        tended=tended,
        links=LinkFigures(len(kept), len(map_.links) - len(kept), pairs),
        positions_misfit_rms_m=misfit_rms_m(map_),
        made=made,
        T_map_world=map_.first.T_map_world,
    )


def joined_drives(map_: Map) -> list[JoinedDrive]:
    """Return what there is of each drive that has frames."""
    placed = map_.placed
    return [
        JoinedDrive(
            number=session.number,
            name=session.info.source,
            frames=len(session),
            length_m=session.trajectory.path_length_m,
            linked=session.number in placed,
            frames_not_trusted=int((~session.trusted).sum()),
            frames_placed=int(placed.get(session.number, np.zeros(0)).sum()),
            positions=len(session.fixes),
            rig=None if (rig := _rig_of(session)) is None else rig.figures(),
            date=session.date.text,
            date_from=session.date.known_from,
            rays_kept=1.0 if (left := session.thinned) is None else left.rays_ratio,
            keyframes_kept=1.0 if left is None else left.keyframes_ratio,
        )
        for session in map_.sessions
        if len(session)
    ]


def _rig_of(session: Session) -> RefinedRig | None:
    """Return what a drive showed of its rig, if anything."""
    rig = session.rig
    return None if rig is None else rig.described(settings_of(session).rectification)


def _of_rigs(map_: Map, numbers: Sequence[int]) -> list[str]:
    """Return what the user should know of the rigs of some drives."""
    rigs = [(number, _rig_of(map_.session(number))) for number in numbers]
    return [
        f"session {number}: {line}"
        for number, rig in rigs
        if rig is not None
        for line in rig.warnings()
    ]


def _warnings(map_: Map) -> list[str]:
    """Return what the user should know: drives apart; doubtful poses, lengths, and positions."""
    linked = map_.linked
    apart = [session for session in map_.sessions if session not in linked]
    names = ", ".join(f"{session.number} ({session.info.source})" for session in apart)
    what = "shares no verified place" if len(apart) == 1 else "share no verified place"
    text = f"session {names} {what} with session {linked[0].number}: kept in the map, but not in "
    return [
        *map_.doubts,
        *([text + "cloud, grid, OctoMap and mesh"] if apart else ()),
        *doubts_of_lengths(map_),
        *doubts_of_positions(map_),
    ]


@contextmanager
def _damage_named(map_: Map, inputs: Sequence[Path]) -> Iterator[None]:
    """Name the map that a damaged record came from, not the new one, which does not stay."""
    try:
        yield
    except ReconError as error:
        if str(error.where) == map_.store.name:
            for file in inputs:
                if file.match(MAP_FILE):
                    with Map.open(file) as read:
                        read_all(read)
        raise


def _copied(file: Path, map_: Map, settings: ReconConfig) -> list[int]:
    """Copy the drives of a finished map into another; their numbers."""
    with Map.open(file) as other:
        for session in other.sessions:
            check_session(session, settings)
        return copy_sessions(other, map_)


def _settings(folder: Path, config: ReconConfig | None) -> ReconConfig:
    """Return the settings of a finished run, or those with changes where they have an effect."""
    command_of_map(folder)
    ran = run_settings(folder)
    if config is not None:
        check_changes(ran, config, _CHANGEABLE)
    return config or ran
