"""Scenes of a folder, matched by matchers or by other programs, and scored."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import FormatError, SettingsError, SourceError
from recon.core.plugins import name_of
from recon.core.summary import Rows, RunSummary, optional
from recon.core.text import counted
from recon.core.values import Disparity, Reason, RectifiedPair
from recon.core.values.arrays import Float32
from recon.evaluation.middlebury.score import (
    MASKS,
    Figures,
    MiddleburyRules,
    ScoredScene,
    confidence_figures,
    scene_weight,
    score_result,
    weighted_confidence,
    weighted_figures,
)
from recon.io.files import naming, read_table, resolved
from recon.io.images.disparity import read_pfm
from recon.io.middlebury import (
    MiddleburyScene,
    find_image,
    find_layout,
    read_middlebury_scene,
    scene_root,
    stand_in_camera,
)
from recon.stereo.frame import StereoSettings
from recon.stereo.match.onnx import NetworkFigures
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import check_matcher, make_matcher, searched_ndisp
from recon.stereo.rectify.rectifier import Rectifier

_WARM_UP_ROWS: Final = 64
_FOLDER_NAME: Final = re.compile(r"\w[\w.+ ()-]*")
_STEP: Final = 16  # of a range that is that of the truth
_DISPARITY: Final = "disp0"


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Result of one matcher, or of another program, on one scene."""

    scene: ScoredScene
    matcher: str  # name of the matcher or of the folder of results
    disparity: Disparity  # in pixels of its own size; with values alone, if it has no more
    figures: Figures  # an entry of ``scenes`` in ``summary.json``


@dataclass(frozen=True, eq=False)
class Bench:
    """Matches and scores scenes; each thread has its own matchers, except given objects."""

    given: Sequence[str | Matcher]
    config: StereoSettings
    threads: int
    auto_range: bool = False  # whether to estimate the disparity range from each pair
    _own: threading.local = field(default_factory=threading.local, init=False)

    def results(self, scene: ScoredScene) -> Iterator[SceneResult]:
        """Yield one result for each matcher, in the order given."""
        camera = replace(scene.camera, ndisp=None) if self.auto_range else scene.camera
        pair = Rectifier(camera, self.config.rectification).rectify(scene.pair)
        with naming(scene.name):
            for given, matcher in zip(self.given, self._matchers(pair), strict=True):
                start = time.perf_counter()
                disparity = matcher.match(pair)
                seconds = time.perf_counter() - start
                sure = disparity.confidence[disparity.valid]
                # Not where the matcher gives all matches the same confidence.
                rates = sure.size and sure.min() < sure.max()
                measured = {
                    "ndisp": searched_ndisp(given, self.config.matching, pair),
                    "confidence": confidence_figures(disparity, scene.truth) if rates else None,
                    "seconds": round(seconds, 4),
                }
                yield _scored(scene, name_of(given), disparity, measured)

    def _matchers(self, pair: RectifiedPair) -> list[Matcher]:
        if not hasattr(self._own, "matchers"):
            made = [make_matcher(n, self.config.matching, self.threads) for n in self.given]
            # Kernels are compiled and networks loaded before anything is timed.
            rows = min(_WARM_UP_ROWS, pair.camera.height_px)
            camera = replace(pair.camera, height_px=rows)
            for matcher in made:
                matcher.match(RectifiedPair(pair.left[:rows], pair.right[:rows], camera))
            self._own.matchers = made
        return list(self._own.matchers)


def read_result(given: ResultFolder, scene: ScoredScene) -> SceneResult | None:
    """Read and score what another program found for a scene; None if there is nothing."""
    file = given.files.get(scene.name)
    if file is None:
        return None
    found = unrated(read_pfm(file))
    with naming(file):
        measured = {"ndisp": None, "confidence": None, "seconds": _seconds_beside(file)}
        return _scored(scene, given.name, found, measured)


def check_names(matchers: Sequence[str | Matcher]) -> list[str]:
    """Return the names of the matchers, which are also those of their folders."""
    for matcher in matchers:
        check_matcher(matcher)
    names = [name_of(matcher) for matcher in matchers]
    if len(set(names)) < len(names):
        named = all(isinstance(one, str) for one in matchers)
        hint = None if named else "give each object an attribute `name`"
        raise SettingsError("a matcher is named twice", got=", ".join(names), hint=hint)
    for name in names:
        if not _FOLDER_NAME.fullmatch(name):
            raise SettingsError("the matcher's name cannot name a folder", got=repr(name))
    return names


def unrated(values: Float32) -> Disparity:
    """Return values (h, w), NaN = none, as a disparity that is measured and sure everywhere."""
    known = np.isfinite(values)
    reason = np.where(known, np.uint8(Reason.VALID), np.uint8(Reason.AMBIGUOUS))
    return Disparity(values, known.astype(np.float32), np.full_like(values, np.nan), reason)


def _scored(scene: ScoredScene, name: str, found: Disparity, measured: Figures) -> SceneResult:
    figures = {
        **score_result(scene, found),
        **measured,
        "width_px": scene.camera.width_px,
        "height_px": scene.camera.height_px,
        "full_size_factor": scene.rules.full_size_factor,
        "weight": scene_weight(scene.name),
    }
    return SceneResult(scene, name, found, figures)


SceneFigures = dict[str, Figures]  # Figures of one scene, by matcher


@dataclass(frozen=True)
class SceneDone:
    """A scene that is scored, a `Step` of progress; without ground truth it has no figures."""

    name: str
    figures: SceneFigures | None
    seconds: float
    ok: bool = True

    @property
    def event(self) -> dict[str, Any]:
        seconds = {matcher: one["seconds"] for matcher, one in (self.figures or {}).items()}
        return {"event": "scene", "name": self.name, "seconds": seconds}

    @property
    def state(self) -> str:
        return self.name if self.figures is not None else f"{self.name}: no truth"


_MOST_ROWS: Final = 3  # matchers that the terminal names, each in a line


def _scores(found: Figures) -> str:
    """Return the errors of a matcher in the terms of the benchmark's table."""
    return f"bad 2.0 {found['bad']['2']:.1f} %, avgerr {found['avgerr']:.2f} px (nonocc, dense)"


@dataclass(frozen=True, kw_only=True)
class MiddleburySummary(RunSummary):
    """Scores of matchers and of other programs on scenes, by the rules of the benchmark.

    Of each of the ``matchers``, ``scenes`` has the figures by scene, and ``weighted`` their mean.
    """

    matchers: Mapping[str, Figures]
    folder: str
    results: Mapping[str, str]  # folders of the results of other programs
    mean_over: Sequence[str]  # scenes that all have a result for
    skipped: Sequence[str]  # scenes without ground truth
    threads: int = 1
    parallel: int = 1  # scenes that were processed at once
    network: NetworkFigures | None = optional()

    def rows(self) -> Rows:
        best = [
            (name, _scores(found["weighted"]["nonocc"]["dense"]))
            for name, found in self.matchers.items()
        ]
        shown, others = best[:_MOST_ROWS], ", ".join(name for name, _ in best[_MOST_ROWS:])
        return [
            (f"{', '.join(self.matchers)} on {counted(len(self.mean_over), 'scene')}",),
            *self.folder_row(),
            *shown,
            *([("and", f"{others} (--verbose has all)")] if others else []),
            *self.cost_row(),
            ("next", self.open_report()),
        ]


def summarise_scenes(
    found: Mapping[str, SceneFigures | None],
    names: Sequence[str],
    results: Sequence[ResultFolder],
    folder: Path,
) -> MiddleburySummary:
    """Return the figures of all scenes; means are over the scenes that all have."""
    skipped = [name for name, figures in found.items() if figures is None]
    scenes = {name: figures for name, figures in found.items() if figures is not None}
    if not scenes:
        what, got = "no scene has ground truth to compare with", ", ".join(skipped)
        hint = "name a folder of scenes that have one with --truth"
        raise SourceError(what, where=folder, got=got, hint=hint)
    common = [name for name, figures in scenes.items() if all(one in figures for one in names)]
    if not common:
        what = "there is no scene that all have a result for"
        raise SourceError(what, where=folder, got=", ".join(names))
    warnings = [f"{name}: no truth, skipped" for name in skipped]
    for result in results:
        lacking = [name for name in scenes if name not in result.files]
        if lacking:
            over = f"{len(common)} of {counted(len(scenes), 'scene')}"
            missing = f"no result for {', '.join(lacking)}"
            warnings.append(f"{result.name}: {missing}; means are over {over}, which all have")
    return MiddleburySummary(
        matchers={name: _of_matcher(scenes, name, common) for name in names},
        folder=str(folder),
        results={result.name: str(result.folder) for result in results},
        mean_over=common,
        skipped=skipped,
        warnings=warnings,
    )


def _of_matcher(scenes: Mapping[str, SceneFigures], matcher: str, common: Sequence[str]) -> Figures:
    own = {name: figures[matcher] for name, figures in scenes.items() if matcher in figures}
    meant = (*MASKS, "seconds")  # seconds are not a number, so null, where one is not known
    figures = weighted_figures({name: {key: own[name][key] for key in meant} for name in common})
    confidence = weighted_confidence({name: own[name]["confidence"] for name in common})
    seconds = figures.pop("seconds")
    return {"scenes": own, "weighted": {**figures, "confidence": confidence, "seconds": seconds}}


@dataclass(frozen=True)
class ResultFolder:
    """The results of one program."""

    name: str  # the last part of the folder's path, with parents if several share it
    folder: Path
    files: Mapping[str, Path]  # the disparity map of each scene that has one


def check_folder(folder: Path) -> None:
    """Check that a path is an existing folder."""
    if not folder.is_dir():
        what = "not a folder" if folder.exists() else "folder does not exist"
        raise SourceError(what, where=folder)


def find_scenes(folder: Path) -> dict[str, Path]:
    """Return folders of all scenes at or below a folder, by scene name."""
    check_folder(folder)
    paths = sorted(_scenes_below(folder))
    if not paths:
        expected = "folders with im0 and im1 and calib.txt, view1 and view5, or im2 and im6"
        raise SourceError("folder contains no Middlebury scene", where=folder, expected=expected)
    roots = [resolved(path) for path in paths]
    short = [path.relative_to(scene_root(path).parent).as_posix() for path in roots]
    if len(set(short)) < len(short):
        short = [path.relative_to(folder).as_posix() for path in paths]
    return dict(zip(short, paths, strict=True))


def _scenes_below(folder: Path) -> Iterator[Path]:
    # Scenes do not nest, so the search stops at each.
    if find_layout(folder) is not None:
        yield folder
        return
    for path in folder.iterdir():
        if path.is_dir() and not path.name.startswith("."):
            yield from _scenes_below(path)


def read_scored_scene(name: str, path: Path, truth: Path | None) -> ScoredScene | None:
    """Read a scene with its ground truth; None if there is none for it.

    A scene without its own gets that of the same name in the folder ``truth``, or of that folder.
    """
    scene = read_middlebury_scene(path)
    judge = scene if scene.truth is not None else _judge(name, truth)
    if judge is None or judge.truth is None:
        return None
    height_px, width_px = scene.pair.left.shape[:2]
    # Sizes may be off by a row or column; real mismatches are rejected by the comparison.
    factor = max(round(4 * judge.truth.values.shape[1] / width_px), 1) / 4
    largest_px = None if scene.ndisp is None else scene.ndisp * factor
    rules = MiddleburyRules(judge.full_size_factor, largest_px, judge.isint)
    camera = scene.camera or stand_in_camera(width_px, height_px)
    searched_px = float(np.nanmax(judge.truth.values, initial=0.0)) / factor
    ndisp = scene.ndisp or camera.ndisp or _STEP * int(searched_px // _STEP + 1)
    camera = replace(camera, ndisp=ndisp)
    return ScoredScene(name, scene.pair, camera, judge.truth, judge.camera, rules)


def _judge(name: str, folder: Path | None) -> MiddleburyScene | None:
    last = name.rpartition("/")[2]
    for path in (folder / name, folder / last, folder) if folder else ():
        if path.name == last and path.is_dir() and find_layout(path) is not None:
            return read_middlebury_scene(path)
    return None


def find_results(
    folders: Sequence[Path], scenes: Mapping[str, Path], taken: Sequence[str]
) -> list[ResultFolder]:
    """Find the results of other programs for scenes, one folder for each program.

    A scene's result is ``Teddy.pfm``, or the only ``disp0*.pfm`` in a folder ``Teddy``, perhaps in
    a folder such as ``trainingQ``. No program gets a name that is ``taken``.
    """
    found = []
    for name, folder in zip(_names(folders, taken), folders, strict=True):
        check_folder(folder)
        files = ((scene, _file_of(folder, scene, path)) for scene, path in scenes.items())
        present = {scene: file for scene, file in files if file is not None}
        if not present:
            first = next(iter(scenes))
            expected = f"{first}.pfm, or {first}/{_DISPARITY}*.pfm, and so on"
            raise SourceError("folder has no result for any scene", where=folder, expected=expected)
        found.append(ResultFolder(name, folder, present))
    return found


def _names(folders: Sequence[Path], taken: Sequence[str]) -> list[str]:
    """Return the shortest ends of the paths that distinguish them."""
    paths = [resolved(folder) for folder in folders]
    if len(set(paths)) < len(paths):
        raise SettingsError("a folder of results is given twice", got=", ".join(map(str, folders)))
    for depth in range(1, max((len(path.parts) for path in paths), default=0)):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len({*names, *taken}) == len(names) + len(taken):
            return names
    return [str(path) for path in paths]


def _file_of(folder: Path, scene: str, path: Path) -> Path | None:
    root = scene_root(path)
    for name in (scene, f"{root.parent.name}/{root.name}", root.name):
        file = folder / f"{name}.pfm"
        if (found := file if file.is_file() else _submitted(folder / name)) is not None:
            return found
    return None


def _submitted(folder: Path) -> Path | None:
    """Return the dense result in the folder of one scene; not its ground truth."""
    truth = {"disp0GT", "disp0"} if find_image(folder, "im0") else {"disp0GT"}
    stems = {file.stem for file in folder.glob(f"{_DISPARITY}*.pfm")}
    found = [f"{stem}.pfm" for stem in sorted(stems - truth - {f"{stem}_s" for stem in stems})]
    if len(found) > 1:
        what, hint = "folder has several results", "keep each method in a folder of its own"
        raise SourceError(f"{what} for one scene", where=folder, got=", ".join(found), hint=hint)
    return folder / found[0] if found else None


def _seconds_beside(file: Path) -> float | None:
    """Return what ``timeX.txt`` beside a result ``disp0X.pfm`` says; None if there is none."""
    beside = file.with_name(f"time{file.stem.removeprefix(_DISPARITY)}.txt")
    if not file.stem.startswith(_DISPARITY) or not beside.is_file():
        return None
    seconds = float(read_table(beside, (1,))[0][0, 0])
    if not 0 <= seconds < float("inf"):
        raise FormatError("not a time in seconds", where=beside, got=f"{seconds:g}")
    return seconds
