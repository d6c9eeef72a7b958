"""`recon evaluate middlebury`: scenes in, the tables of the benchmark out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from recon.commands.config import PAIR_DEFAULTS, ReconConfig, load_config
from recon.core.errors import SettingsError
from recon.core.progress import Progress, series
from recon.core.work import side_by_side
from recon.evaluation.middlebury.bench import (
    Bench,
    MiddleburySummary,
    SceneDone,
    SceneFigures,
    check_folder,
    check_names,
    find_results,
    find_scenes,
    read_result,
    read_scored_scene,
    summarise_scenes,
)
from recon.io.files import StrPath
from recon.io.images.disparity import write_pfm
from recon.report.middlebury_page import draw_result, write_middlebury_page
from recon.run.run import Run
from recon.stereo.match.onnx import describe_network
from recon.stereo.match.protocol import Matcher


def run_middlebury(
    folder: StrPath,
    config: ReconConfig | None = None,
    *,
    matchers: Sequence[str | Matcher] | None = None,
    results: Sequence[StrPath] = (),
    truth: StrPath | None = None,
    out: StrPath | None = None,
    threads: int | None = None,
    parallel: int = 1,
    auto_range: bool = False,
) -> MiddleburySummary:
    """Score matchers on Middlebury scenes: what `recon evaluate middlebury` does.

    Every scene is matched with each matcher, results of other programs are read beside, and all
    are scored by the rules of the benchmark. Disparity maps, figures, tables and a report go to
    the result folder; means are over the scenes that all have a result for.

    Args:
        folder: A scene, or a folder with scenes at any depth.
        config: The configuration; None = the defaults of single pairs.
        matchers: The matchers, by name or as objects; None = the configured one.
        results: Folders with results of other programs, one for each program. They are scored
            beside the matchers, under the names of their folders.
        truth: Folder of scenes that supply ground truth for scenes without their own.
        out: Result folder; None = a new one below ``outputs/``.
        threads: Threads to use; None = all cores. Changes no result.
        parallel: Scenes processed at once, sharing the threads. Above 1, timings are those of a
            busy machine.
        auto_range: Whether the disparity range is estimated from each pair.

    Raises:
        SettingsError: A matcher is unknown or named twice.
        SourceError: There is no scene, or none with ground truth; or a folder is missing or holds
            no result.
        ReconError: A scene cannot be read or matched, or the folder cannot be written; nothing is
            left behind.
    """
    config = config or load_config(defaults=PAIR_DEFAULTS)
    truths = None if truth is None else Path(truth)
    chosen = (config.matching.matcher,) if matchers is None else matchers
    names = check_names(chosen)
    if truths is not None:
        check_folder(truths)
    paths = find_scenes(Path(folder))
    others = find_results([Path(result) for result in results], paths, names)
    names += [other.name for other in others]
    if not names:
        raise SettingsError("nothing to evaluate", hint="name a matcher, or a folder of results")
    with Run("evaluate-middlebury", out, config, threads=threads) as run:
        bench = Bench(chosen, config, max(1, run.threads // parallel), auto_range=auto_range)

        def score(name: str, path: Path) -> SceneFigures | None:
            scene = read_scored_scene(name, path, truths)
            if scene is None:
                return None
            figures = {}
            for one in bench.results(scene):
                stem, found = f"disparity/{one.matcher}/{name}", one.disparity
                write_pfm(run.path(f"{stem}.pfm"), found.only_measured().values)
                if found.inferred.any():
                    write_pfm(run.path(f"{stem}_inferred.pfm"), found.only_inferred().values)
                draw_result(one, run)
                figures[one.matcher] = one.figures
            for other in others:
                if (given := read_result(other, scene)) is not None:
                    draw_result(given, run)
                    figures[other.name] = given.figures
            return figures

        with series(str(folder), len(paths), "scenes") as shown:
            found = dict(_watched(score, paths, parallel, shown))
        summary = summarise_scenes(found, names, others, Path(folder))
        network = describe_network(config.matching.onnx) if "onnx" in chosen else None
        summary = replace(summary, threads=run.threads, parallel=parallel, network=network)
        with run.report(summary) as summary:
            write_middlebury_page(summary.to_json(), run)
        files = [file for path in paths.values() for file in sorted(path.iterdir())]
        files = [file for file in files if file.is_file()]
        files += [file for other in others for file in other.files.values()]
        record = {
            "folder": summary.folder,
            "results": summary.results,
            "threads": run.threads,
            "parallel": parallel,
        }
        return run.finish(summary, source=str(folder), inputs=files, record=record)


def _watched(
    score: Callable[[str, Path], SceneFigures | None],
    paths: Mapping[str, Path],
    parallel: int,
    shown: Progress,
) -> Iterator[tuple[str, SceneFigures | None]]:
    """Yield figures of each scene, in order, some scenes at once."""
    last = time.perf_counter()
    scored = side_by_side(lambda scene: score(*scene), paths.items(), threads=parallel)
    for name, figures in zip(paths, scored, strict=True):
        now = time.perf_counter()
        shown.on_step(SceneDone(name, figures, now - last))
        last = now
        yield name, figures
