"""The pipeline behind `recon evaluate middlebury`: scenes in, tables out."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from recon.errors import SettingsError, SourceError
from recon.evaluation.middlebury import scene_weight, weighted_mean
from recon.formats.atomic import write_text
from recon.formats.pfm import write_pfm
from recon.matching import Matcher, check_matcher, name_of
from recon.pipeline.config import ReconConfig, dump_config
from recon.pipeline.machine import peak_memory_mb, use_threads
from recon.pipeline.middlebury_bench import Bench, SceneResult
from recon.pipeline.middlebury_confidence import weighted_confidence
from recon.pipeline.middlebury_scenes import check_folder, find_scenes, read_scored_scene
from recon.pipeline.middlebury_score import MASKS, Figures, weighted_figures
from recon.pipeline.record import fingerprint, write_record
from recon.pipeline.run_directory import RunDirectory
from recon.pipeline.summary import plain

COMMAND: Final = "evaluate-middlebury"

_FOLDER_NAME: Final = re.compile(r"\w[\w.+ ()-]*")
_NAMING: Final = "give each object an attribute `name`"

SceneFigures = dict[str, Figures]
"""Figures of one scene, by matcher."""


class SceneObserver(Protocol):
    """Receives the progress of an evaluation, in the thread that runs it."""

    def on_start(self, name: str, total: int) -> None:
        """An evaluation of ``total`` scenes begins."""
        ...

    def on_scene(self, name: str, figures: Mapping[str, Figures]) -> None:
        """A scene is matched and scored; empty figures = it has no ground truth."""
        ...

    def on_finish(self) -> None:
        """The evaluation has ended, successfully or not."""
        ...


@dataclass(frozen=True)
class MiddleburyOptions:
    """Options of an evaluation that are not part of the configuration.

    Attributes:
        matchers: The matchers, by name or as objects; () = the configured one.
        truth: Folder of scenes that supply ground truth for scenes without their own.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        parallel: Scenes processed at once, sharing the threads. Above 1, timings are those of a
            busy machine.
        auto_range: Whether the disparity range is estimated from each pair.
        observer: Notified of each scene.
        draw: Draws the figures of one result.
        present: Writes the tables.
    """

    matchers: Sequence[str | Matcher] = ()
    truth: Path | None = None
    out: Path | None = None
    threads: int | None = None
    parallel: int = 1
    auto_range: bool = False
    observer: SceneObserver | None = None
    draw: Callable[[SceneResult, RunDirectory], None] | None = None
    present: Callable[[Mapping[str, Any], RunDirectory], None] | None = None


def run_middlebury(folder: Path, config: ReconConfig, options: MiddleburyOptions) -> Figures:
    """Match all scenes of a folder with each matcher, score them, and write tables and figures.

    Returns:
        The content of ``summary.json``.

    Raises:
        SettingsError: A matcher is unknown or named twice.
        SourceError: There is no scene, or none with ground truth; or a folder is missing.
        ReconError: A scene cannot be read or matched, or the folder cannot be written; nothing is
            left behind.
    """
    start = time.perf_counter()
    matchers = options.matchers or (config.matching.matcher,)
    names = _checked(matchers)
    if options.truth is not None:
        check_folder(options.truth)
    paths, threads = find_scenes(folder), use_threads(options.threads)
    with RunDirectory.for_command(COMMAND, options.out) as directory:
        own_threads = max(1, threads // options.parallel)
        bench = Bench(matchers, config, own_threads, auto_range=options.auto_range)
        scenes = dict(_scenes(bench, folder, paths, options, directory))
        skipped = [name for name, figures in scenes.items() if not figures]
        if len(skipped) == len(scenes):
            raise SourceError(
                "no scene has ground truth to compare with",
                where=folder,
                got=", ".join(skipped),
                hint="name a folder of scenes that have one with --truth",
            )
        summary: Figures = {
            "matchers": {name: _of_matcher(scenes, name) for name in names},
            "folder": str(folder),
            "skipped": skipped,
            "warnings": [f"{name}: no truth, skipped" for name in skipped],
            "threads": threads,
            "parallel": options.parallel,
        }
        summary["seconds"] = round(time.perf_counter() - start, 3)
        summary["peak_memory_mb"] = round(peak_memory_mb(), 1)
        summary["out"] = str(directory.folder)
        summary = dict(plain(summary))
        _write(summary, config, options, directory)
        _record(summary, paths, directory)
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


def _scenes(
    bench: Bench,
    folder: Path,
    paths: Mapping[str, Path],
    options: MiddleburyOptions,
    directory: RunDirectory,
) -> Iterator[tuple[str, SceneFigures]]:
    """Figures of each scene, in order; empty for a scene without ground truth."""

    def work(name: str) -> SceneFigures:
        scene = read_scored_scene(name, paths[name], options.truth)
        results = iter(()) if scene is None else bench.results(scene)
        return {one.matcher: _kept(one, options, directory) for one in results}

    observer = options.observer
    if observer is not None:
        observer.on_start(str(folder), len(paths))
    pool = ThreadPoolExecutor(options.parallel)
    try:
        for name, figures in zip(paths, pool.map(work, paths), strict=True):
            if observer is not None:
                observer.on_scene(name, figures)
            yield name, figures
    finally:
        # After an error, scenes that have not started are cancelled.
        pool.shutdown(cancel_futures=True)
        if observer is not None:
            observer.on_finish()


def _kept(result: SceneResult, options: MiddleburyOptions, directory: RunDirectory) -> Figures:
    """Write the disparity map of a result and return its figures, so that the map can be freed."""
    scene = result.scene
    path = directory.path(f"disparity/{result.matcher}/{scene.name}.pfm")
    write_pfm(path, result.disparity.values)
    if options.draw is not None:
        options.draw(result, directory)
    return {
        **result.figures,
        "seconds": round(result.seconds, 4),
        "width_px": scene.camera.width_px,
        "height_px": scene.camera.height_px,
        "full_size_factor": scene.rules.full_size_factor,
        "weight": scene_weight(scene.name),
    }


def _of_matcher(scenes: Mapping[str, SceneFigures], matcher: str) -> Figures:
    """The entry of one matcher in ``summary.json``."""
    own = {name: figures[matcher] for name, figures in scenes.items() if figures}
    masked = {name: {mask: figures[mask] for mask in MASKS} for name, figures in own.items()}
    rated = {name: figures["confidence"] for name, figures in own.items()}
    seconds = weighted_mean({name: figures["seconds"] for name, figures in own.items()})
    weighted = {
        **weighted_figures(masked),
        "confidence": weighted_confidence(rated),
        "seconds": seconds,
    }
    return {"scenes": own, "weighted": weighted}


def _write(
    summary: Figures, config: ReconConfig, options: MiddleburyOptions, directory: RunDirectory
) -> None:
    write_text(directory.path("config.yaml"), dump_config(config))
    if options.present is not None:
        options.present(summary, directory)
    directory.write_json("summary.json", summary)


def _record(summary: Figures, paths: Mapping[str, Path], directory: RunDirectory) -> None:
    """Write ``run.json``, with a hash of all files of all scenes."""
    files = [file for path in paths.values() for file in sorted(path.iterdir()) if file.is_file()]
    shared = ("folder", "threads", "parallel", "seconds", "peak_memory_mb", "warnings")
    record = {key: summary[key] for key in shared}
    write_record(directory, COMMAND, {**record, "inputs": fingerprint(files)})
