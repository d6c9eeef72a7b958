"""What is not to be trusted in the map that a result was made from."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from recon.map.store.map_file import MAP_FILE
from recon.map.verbs import Map
from recon.run.finished import FinishedRun


def doubts_of(run: FinishedRun) -> list[str]:
    """Return lines of what is not to be trusted in the map of a run, or that it was made from."""
    if not (run.folder / MAP_FILE).is_file():
        return list(run.doubts)
    return doubts_of_file(run.folder / MAP_FILE)


def doubts_of_file(file: Path) -> list[str]:
    """Return lines of what is not to be trusted in the map of the run that a file belongs to."""
    folder = next((one for one in file.absolute().parents[:3] if (one / MAP_FILE).is_file()), None)
    if folder is None:
        return []
    with closing(Map.open(folder)) as map_:
        return map_.doubts
