"""`recon diff`: what came and what went between two runs through one place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon.commands.map_options import MapOptions
from recon.core.summary import Rows, RunSummary
from recon.core.text import counted
from recon.core.values.arrays import Float64
from recon.export.changes import Pictures, write_changes
from recon.io.files import StrPath
from recon.map.changes.compare import compare, gather
from recon.map.changes.objects import ChangedObject
from recon.map.map import Map
from recon.map.store.map_file import MAP_FILE
from recon.report.changes_page import write_changes_page, write_objects
from recon.run.finished import refuse_as_target
from recon.run.run import WholeRun


@dataclass(frozen=True, kw_only=True)
class DiffSummary(RunSummary):
    """What `recon diff` found; places are in the map axes of the run before."""

    before: str
    after: str
    changes: Mapping[str, int]  # objects that ``came`` or ``went``
    not_compared_ratio: Mapping[str, float]  # of the surface of either day
    objects: Sequence[ChangedObject]  # the ones with most points first
    T_map_world: Float64  # (4, 4)

    def rows(self) -> Rows:
        ratios = self.not_compared_ratio
        unseen = f"{ratios['before']:.0%} of the first, {ratios['after']:.0%} of the second"
        return [
            (", ".join(f"{counted(n, 'object')} {name}" for name, n in self.changes.items()),),
            *self.folder_row(),
            ("cloud", "changes.ply", "by class: same, came, went, not compared"),
            ("table", "changes.csv", "place, size, volume, first and last seen"),
            ("unseen", f"{unseen} could not be compared"),
            *self.cost_row(),
            ("next", self.open_report()),
        ]


def run_diff(before: StrPath, after: StrPath, options: MapOptions | None = None) -> DiffSummary:
    """Find what came and what went between two finished runs: what `recon diff` does.

    Each may hold several drives; one that both hold counts as one of the first. Neither is changed.

    Args:
        before: Folder of a run, or a map file, whose axes are those of the results.
        after: That of a later one.
        options: Folder and threads; None = the defaults.

    Raises:
        ReconError: A map is missing, damaged, kept no rays, or has other voxels; they share no
            place, or the folder cannot be written; nothing is left behind.
    """
    options = options or MapOptions(command="diff")
    paths = Path(before), Path(after)
    files = [path / MAP_FILE if path.is_dir() else path for path in paths]
    for path in paths:
        refuse_as_target(path, options.out)
    with (
        Map.open(paths[0]) as first,
        Map.open(paths[1]) as second,
        Map.temporary() as map_,
        WholeRun(options.command, options.out, threads=options.threads) as run,
    ):
        run.check_targets(files)
        with run.stage("links"):
            newer = gather(map_, first, second)
        with run.stage("compare"):
            found = compare(map_, newer, run.threads)
        with run.stage("write"):
            write_changes(found, run.path("changes"))
            pictures = Pictures(map_, found)
            objects = pictures.write(run.path)
            write_objects(run.path("changes.csv"), objects)
        days = {"before": found.before, "after": found.after}
        summary = DiffSummary(
            before=str(before),
            after=str(after),
            changes=found.counts,
            not_compared_ratio={name: day.not_compared_ratio for name, day in days.items()},
            objects=objects,
            T_map_world=map_.first.T_map_world,
            warnings=[*map_.doubts, *pictures.missing.values()],
        )
        with run.report(summary) as summary:
            write_changes_page(objects, summary.to_json(), run)
        return run.finish(summary, source=f"{before} and {after}", inputs=files)
