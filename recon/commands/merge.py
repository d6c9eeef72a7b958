"""`recon merge`, `recon map --into` and `--remove`: several drives in one map."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from recon.commands.config import ReconConfig, run_settings
from recon.commands.joined import copied, joined_settings, make_joined
from recon.commands.map import map_drive
from recon.commands.map_options import MapOptions
from recon.core.errors import FormatError, SettingsError
from recon.io.files import resolved
from recon.map.drive.sequence import check_map
from recon.map.map import Map
from recon.map.sessions.copying import copy_sessions
from recon.map.sessions.measured import Survey
from recon.map.store.finished import keep_map
from recon.map.store.map_file import MAP_FILE
from recon.run.finished import command_of_map, refuse_as_target
from recon.run.run import Run
from recon.sources.source import StereoSource


def run_merge(
    runs: Sequence[Path],
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
    survey: Survey | None = None,
) -> dict[str, Any]:
    """Make one map of several runs, or hold runs at measured positions: what `recon merge` does.

    The drives are linked by places that two of them saw, and placed in one pose graph; cloud,
    OctoMap, grid and mesh are made of all that are linked with the first. What a later run saw
    counts more than what an earlier one did.

    Args:
        runs: Folders of finished runs; the world and the axes of the first are those of the map.
        config: Settings of the first run with changes; None = its own.
        options: Folder, threads, mesh and progress of the run; None = the defaults.
        survey: Positions that were measured during drives, whose paths are bent to run through
            them; None = none.

    Returns:
        The figures of ``summary.json``.

    Raises:
        ReconError: A run is missing, unfinished or twice in the list, kept no rays, has voxels of
            another size, or the folder cannot be written; nothing is left behind.
    """
    options = options or MapOptions(command="merge")
    if len(runs) < 2 and survey is None:
        expected = "two runs, or one and --georeference FILE"
        raise SettingsError("there is nothing to merge", got=len(runs), expected=expected)
    _refuse_twice(runs)
    settings = joined_settings(runs[0], config)
    for run in runs:
        command_of_map(run)
        refuse_as_target(run, options.out)

    def fill(run: Run, map_: Map) -> list[int]:
        added = [copied(folder / MAP_FILE, map_, settings) for folder in runs]
        return [number for numbers in added[1:] for number in numbers]

    files = [*(run / MAP_FILE for run in runs), *([] if survey is None else [survey.positions])]
    return make_joined(options, settings, fill, files, survey=survey)


def run_map_into(
    folder: Path,
    source: StereoSource,
    config: ReconConfig | None = None,
    options: MapOptions | None = None,
) -> dict[str, Any]:
    """Map a drive into the map of a finished run: what `recon map SOURCE --into RUN` does.

    The folder is replaced in one step when all is done; until then it keeps the run as it was.
    The settings are those of the run, perhaps with changes; options are as for `run_map`.
    """
    options = options or MapOptions()
    settings = config or run_settings(folder)

    def fill(run: Run, map_: Map) -> list[int]:
        copied(folder / MAP_FILE, map_, settings)
        kept = run.state("kept.recon")
        with Map.create(run.state("drive.recon")) as drive:
            check_map(map_drive(source, settings, options, run, drive), source.name)
            keep_map(drive, kept)
        try:
            return copied(kept, map_, settings)
        except (FormatError, SettingsError) as error:  # not the file, which does not stay
            raise error.but(where=source.name) from error

    files = [folder / MAP_FILE, *source.files]
    return make_joined(options, settings, fill, files, replaced=folder)


def run_remove(
    folder: Path, number: int, config: ReconConfig | None = None, options: MapOptions | None = None
) -> dict[str, Any]:
    """Take a drive out of the map of a run: what `recon map --into RUN --remove SESSION` does.

    Its number is that of ``sessions`` in the summary; the folder is replaced in one step.
    """
    options = options or MapOptions()
    settings = joined_settings(folder, config)

    def fill(run: Run, map_: Map) -> list[int]:
        with closing(Map.open(folder)) as old:
            if len(old.sessions) < 2 and old.session(number):
                raise SettingsError("the map has only this session", where=folder, got=number)
            old.session(number)
            copy_sessions(old, map_, without=[number])
        return []

    return make_joined(options, settings, fill, [folder / MAP_FILE], replaced=folder)


def _refuse_twice(folders: Sequence[Path]) -> None:
    """Refuse a folder that is named twice."""
    seen: set[Path] = set()
    for folder in folders:
        if resolved(folder) in seen:
            raise SettingsError("the same run twice", got=folder, hint="name each run once")
        seen.add(resolved(folder))
