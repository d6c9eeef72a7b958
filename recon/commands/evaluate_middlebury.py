"""The pipeline behind `recon evaluate middlebury`: scenes in, tables out."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Final

from recon.commands.config import ReconConfig, dump_config
from recon.core.errors import SettingsError, SourceError
from recon.evaluation.middlebury.bench import Bench, SceneResult
from recon.evaluation.middlebury.confidence import weighted_confidence
from recon.evaluation.middlebury.results import ResultFolder, find_results
from recon.evaluation.middlebury.rules import scene_weight, weighted_mean
from recon.evaluation.middlebury.scenes import check_folder, find_scenes, read_scored_scene
from recon.evaluation.middlebury.score import MASKS, Figures, weighted_figures
from recon.io.atomic import write_text
from recon.io.files import StrPath
from recon.io.images.pfm import write_pfm
from recon.run.directory import RunDirectory
from recon.run.machine import peak_memory_mb, use_threads
from recon.run.progress import SILENT, Progress
from recon.run.record import fingerprint, write_record
from recon.run.summary import plain
from recon.stereo.match import Matcher, check_matcher, name_of

COMMAND: Final = "evaluate-middlebury"

_FOLDER_NAME: Final = re.compile(r"\w[\w.+ ()-]*")
_NAMING: Final = "give each object an attribute `name`"

SceneFigures = dict[str, Figures]
"""Figures of one scene, by matcher."""


@dataclass(frozen=True)
class SceneDone:
    """A scene that is matched and scored: a `Step` of the progress of a run.

    Attributes:
        name: Its name.
        figures: Its figures by matcher; None = it has no ground truth.
        seconds: Time since the previous scene was done.
    """

    name: str
    figures: SceneFigures | None
    seconds: float
    ok: bool = True

    @property
    def event(self) -> dict[str, Any]:
        """The seconds of each matcher."""
        seconds = {matcher: one["seconds"] for matcher, one in (self.figures or {}).items()}
        return {"event": "scene", "name": self.name, "seconds": seconds}

    @property
    def state(self) -> str:
        """The name of the scene."""
        return self.name if self.figures is not None else f"{self.name}: no truth"


@dataclass(frozen=True)
class MiddleburyOptions:
    """Options of an evaluation that are not part of the configuration.

    Attributes:
        matchers: The matchers, by name or as objects; None = the configured one.
        results: Folders with results of other programs, one for each program. They are scored
            beside the matchers, under the names of their folders.
        truth: Folder of scenes that supply ground truth for scenes without their own.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        parallel: Scenes processed at once, sharing the threads. Above 1, timings are those of a
            busy machine.
        auto_range: Whether the disparity range is estimated from each pair.
        progress: Shown each scene.
        draw: Draws the figures of one result.
        present: Writes the tables.
    """

    matchers: Sequence[str | Matcher] | None = None
    results: Sequence[StrPath] = ()
    truth: StrPath | None = None
    out: Path | None = None
    threads: int | None = None
    parallel: int = 1
    auto_range: bool = False
    progress: Progress = SILENT
    draw: Callable[[SceneResult, RunDirectory], None] | None = None
    present: Callable[[Mapping[str, Any], RunDirectory], None] | None = None


def run_middlebury(folder: StrPath, config: ReconConfig, options: MiddleburyOptions) -> Figures:
    """Match all scenes of a folder with each matcher, score them, and write tables and figures.

    Means are over the scenes for which every matcher and every folder of results has a result.

    Returns:
        The content of ``summary.json``.

    Raises:
        SettingsError: A matcher is unknown or named twice.
        SourceError: There is no scene, or none with ground truth; or a folder is missing or holds
            no result.
        ReconError: A scene cannot be read or matched, or the folder cannot be written; nothing is
            left behind.
    """
    start = time.perf_counter()
    given = options.matchers
    matchers = (config.matching.matcher,) if given is None else given
    names = _checked(matchers)
    if options.truth is not None:
        check_folder(Path(options.truth))
    paths, threads = find_scenes(Path(folder)), use_threads(options.threads)
    results = find_results([Path(result) for result in options.results], paths, names)
    names += [result.name for result in results]
    if not names:
        raise SettingsError("nothing to evaluate", hint="name a matcher, or a folder of results")
    with RunDirectory.for_command(COMMAND, options.out) as directory:
        own_threads = max(1, threads // options.parallel)
        bench = Bench(matchers, config, own_threads, auto_range=options.auto_range)
        work = _Work(bench, results, options, directory)
        found = dict(_scenes(work, folder, paths))
        skipped = [name for name, figures in found.items() if figures is None]
        scenes = {name: figures for name, figures in found.items() if figures is not None}
        common = _common(scenes, names, folder, skipped)
        summary: Figures = {
            "matchers": {name: _of_matcher(scenes, name, common) for name in names},
            "folder": str(folder),
            "results": {result.name: str(result.folder) for result in results},
            "mean_over": common,
            "skipped": skipped,
            "warnings": [
                *(f"{name}: no truth, skipped" for name in skipped),
                *_missing(scenes, results, common),
            ],
            "threads": threads,
            "parallel": options.parallel,
        }
        summary["seconds"] = round(time.perf_counter() - start, 3)
        summary["peak_memory_mb"] = round(peak_memory_mb(), 1)
        summary["out"] = str(directory.folder)
        summary = dict(plain(summary))
        _write(summary, config, options, directory)
        _record(summary, paths, results, directory)
    return summary


def _checked(matchers: Sequence[str | Matcher]) -> list[str]:
    """The names of the matchers, which are also those of their folders."""
    for matcher in matchers:
        check_matcher(matcher)
    names = [name_of(matcher) for matcher in matchers]
    if len(set(names)) < len(names):
        hint = None if all(isinstance(one, str) for one in matchers) else _NAMING
        raise SettingsError("a matcher is named twice", got=", ".join(names), hint=hint)
    for name in names:
        if not _FOLDER_NAME.fullmatch(name):
            raise SettingsError("the matcher's name cannot name a folder", got=repr(name))
    return names


@dataclass(frozen=True)
class _Work:
    """What is done with each scene."""

    bench: Bench
    results: Sequence[ResultFolder]
    options: MiddleburyOptions
    directory: RunDirectory

    def figures(self, name: str, path: Path) -> SceneFigures | None:
        """Figures of one scene by matcher; None without ground truth."""
        truth = self.options.truth
        scene = read_scored_scene(name, path, None if truth is None else Path(truth))
        if scene is None:
            return None
        read = (one for result in self.results if (one := result.read(scene)) is not None)
        return {one.matcher: self._kept(one) for one in chain(self.bench.results(scene), read)}

    def _kept(self, result: SceneResult) -> Figures:
        """Write the disparity map of a result and return its figures, so that it can be freed."""
        scene, seconds = result.scene, result.seconds
        if result.file is None:
            path = self.directory.path(f"disparity/{result.matcher}/{scene.name}.pfm")
            write_pfm(path, result.values)
        if self.options.draw is not None:
            self.options.draw(result, self.directory)
        return {
            **result.figures,
            "seconds": None if seconds is None else round(seconds, 4),
            "width_px": scene.camera.width_px,
            "height_px": scene.camera.height_px,
            "full_size_factor": scene.rules.full_size_factor,
            "weight": scene_weight(scene.name),
        }


def _scenes(
    work: _Work, folder: StrPath, paths: Mapping[str, Path]
) -> Iterator[tuple[str, SceneFigures | None]]:
    """Figures of each scene, in order; None for a scene without ground truth."""
    progress, last = work.options.progress, time.perf_counter()
    progress.on_start(str(folder), len(paths), "scenes")
    pool = ThreadPoolExecutor(work.options.parallel)
    try:
        done = pool.map(work.figures, paths.keys(), paths.values())
        for name, figures in zip(paths, done, strict=True):
            now = time.perf_counter()
            progress.on_step(SceneDone(name, figures, now - last))
            last = now
            yield name, figures
    finally:
        # After an error, scenes that have not started are cancelled.
        pool.shutdown(cancel_futures=True)
        progress.on_finish()


def _common(
    scenes: Mapping[str, SceneFigures],
    names: Sequence[str],
    folder: StrPath,
    skipped: Sequence[str],
) -> list[str]:
    """The scenes for which all have a result, so that means can be compared."""
    if not scenes:
        raise SourceError(
            "no scene has ground truth to compare with",
            where=folder,
            got=", ".join(skipped),
            hint="name a folder of scenes that have one with --truth",
        )
    common = [name for name, figures in scenes.items() if all(one in figures for one in names)]
    if not common:
        raise SourceError(
            "there is no scene that all have a result for", where=folder, got=", ".join(names)
        )
    return common


def _missing(
    scenes: Mapping[str, SceneFigures], results: Sequence[ResultFolder], common: Sequence[str]
) -> Iterator[str]:
    """A line for each folder of results that lacks scenes."""
    for result in results:
        lacking = [name for name in scenes if name not in result.files]
        if lacking:
            yield (
                f"{result.name}: no result for {', '.join(lacking)}; means are over "
                f"{len(common)} of {len(scenes)} scenes, which all have"
            )


def _of_matcher(scenes: Mapping[str, SceneFigures], matcher: str, common: Sequence[str]) -> Figures:
    """The entry of one matcher in ``summary.json``."""
    own = {name: figures[matcher] for name, figures in scenes.items() if matcher in figures}
    meant = {name: own[name] for name in common}
    masked = {name: {mask: figures[mask] for mask in MASKS} for name, figures in meant.items()}
    rated = {name: figures["confidence"] for name, figures in meant.items()}
    seconds = {name: figures["seconds"] for name, figures in meant.items()}
    weighted = {
        **weighted_figures(masked),
        "confidence": weighted_confidence(rated),
        "seconds": None if None in seconds.values() else weighted_mean(seconds),
    }
    return {"scenes": own, "weighted": weighted}


def _write(
    summary: Figures, config: ReconConfig, options: MiddleburyOptions, directory: RunDirectory
) -> None:
    write_text(directory.path("config.yaml"), dump_config(config, "evaluate"))
    if options.present is not None:
        options.present(summary, directory)
    directory.write_json("summary.json", summary)


def _record(
    summary: Figures,
    paths: Mapping[str, Path],
    results: Sequence[ResultFolder],
    directory: RunDirectory,
) -> None:
    """Write ``run.json``, with a hash of all files of all scenes and of the results."""
    files = [file for path in paths.values() for file in sorted(path.iterdir()) if file.is_file()]
    files += [file for result in results for file in result.files.values()]
    shared = ("folder", "results", "threads", "parallel", "seconds", "peak_memory_mb", "warnings")
    record = {key: summary[key] for key in shared}
    write_record(directory, COMMAND, {**record, "inputs": fingerprint(files)})
