"""Scenes matched by several matchers, or by other programs, scored, and the figures of all."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from recon.core.errors import SettingsError, SourceError
from recon.core.text import counted
from recon.core.values import RectifiedPair
from recon.core.values.arrays import Float32, Float64
from recon.evaluation.middlebury.scenes import ResultFolder, read_seconds
from recon.evaluation.middlebury.score import (
    MASKS,
    Figures,
    ScoredScene,
    confidence_figures,
    rounded,
    scene_weight,
    score_result,
)
from recon.io.files import naming
from recon.io.images.disparity import read_pfm
from recon.run.run import plain
from recon.stereo.frame import StereoSettings
from recon.stereo.match.protocol import Matcher, name_of
from recon.stereo.match.registry import check_matcher, make_matcher, searched_ndisp
from recon.stereo.rectify.rectifier import Rectifier

_WARM_UP_ROWS: Final = 64
_FOLDER_NAME: Final = re.compile(r"\w[\w.+ ()-]*")


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Result of one matcher, or of another program, on one scene."""

    scene: ScoredScene  # the scene
    matcher: str  # name of the matcher or of the folder of results
    values: Float32  # (h, w), its disparity in pixels of its own size; NaN = none
    figures: Figures  # an entry of ``scenes`` in ``summary.json``


class Bench:
    """Matches and scores scenes; each thread has its own matchers, warmed up once.

    The warm-up keeps kernel compilation and network loading out of the timings. A matcher given as
    an object is shared by the threads. ``auto_range``: estimate the disparity range from each pair.
    """

    def __init__(
        self,
        matchers: Sequence[str | Matcher],
        config: StereoSettings,
        threads: int,
        *,
        auto_range: bool = False,
    ) -> None:
        self._given = matchers
        self._config = config
        self._threads = threads
        self._auto_range = auto_range
        self._own = threading.local()

    def results(self, scene: ScoredScene) -> Iterator[SceneResult]:
        """Yield one result for each matcher, in the order given."""
        camera = replace(scene.camera, ndisp=None) if self._auto_range else scene.camera
        pair = Rectifier(camera, self._config.rectification).rectify(scene.pair)
        with naming(scene.name):
            for given, matcher in zip(self._given, self._matchers(pair), strict=True):
                start = time.perf_counter()
                disparity = matcher.match(pair)
                seconds = time.perf_counter() - start
                sure = disparity.confidence[disparity.valid]
                # Not where the matcher gives all matches the same confidence.
                rates = sure.size and sure.min() < sure.max()
                rated = confidence_figures(disparity, scene.truth) if rates else None
                ndisp = searched_ndisp(given, self._config.matching, pair)
                figures = _figures(scene, disparity.values, ndisp, rated, round(seconds, 4))
                yield SceneResult(scene, name_of(given), disparity.values, figures)

    def _matchers(self, pair: RectifiedPair) -> list[Matcher]:
        made: list[Matcher] | None = getattr(self._own, "matchers", None)
        if made is None:
            made = [make_matcher(n, self._config.matching, self._threads) for n in self._given]
            rows = min(_WARM_UP_ROWS, pair.camera.height_px)
            camera = replace(pair.camera, height_px=rows)
            for matcher in made:
                matcher.match(RectifiedPair(pair.left[:rows], pair.right[:rows], camera))
            self._own.matchers = made
        return made


def read_result(given: ResultFolder, scene: ScoredScene) -> SceneResult | None:
    """Read and score what another program found for a scene; None if there is nothing."""
    file = given.files.get(scene.name)
    if file is None:
        return None
    values = read_pfm(file)
    with naming(file):
        figures = _figures(scene, values, None, None, read_seconds(file))
    return SceneResult(scene, given.name, values, figures)


def check_names(matchers: Sequence[str | Matcher]) -> list[str]:
    """Return the names of the matchers, which are also those of their folders."""
    for matcher in matchers:
        check_matcher(matcher)
    names = [name_of(matcher) for matcher in matchers]
    if len(set(names)) < len(names):
        objects = any(not isinstance(one, str) for one in matchers)
        hint = "give each object an attribute `name`" if objects else None
        raise SettingsError("a matcher is named twice", got=", ".join(names), hint=hint)
    for name in names:
        if not _FOLDER_NAME.fullmatch(name):
            raise SettingsError("the matcher's name cannot name a folder", got=repr(name))
    return names


def _figures(
    scene: ScoredScene,
    values: Float32,
    ndisp: int | None,
    confidence: Figures | None,
    seconds: float | None,
) -> Figures:
    return {
        **score_result(scene, values),
        "ndisp": ndisp,
        "confidence": confidence,
        "seconds": seconds,
        "width_px": scene.camera.width_px,
        "height_px": scene.camera.height_px,
        "full_size_factor": scene.rules.full_size_factor,
        "weight": scene_weight(scene.name),
    }


SceneFigures = dict[str, Figures]  # Figures of one scene, by matcher


@dataclass(frozen=True)
class SceneDone:
    """A scene that is matched and scored: a `Step` of the progress of a run.

    Without ground truth it has no figures; ``seconds`` are since the scene before.
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


def summarise_scenes(
    found: Mapping[str, SceneFigures | None],
    names: Sequence[str],
    results: Sequence[ResultFolder],
    folder: Path,
) -> Figures:
    """Return the content of ``summary.json``: the figures of each matcher, and its means.

    Means are over the scenes for which all ``names`` (matchers and folders of results) have a
    result, so that they can be compared. A scene without ground truth has no figures.
    """
    skipped = [name for name, figures in found.items() if figures is None]
    scenes = {name: figures for name, figures in found.items() if figures is not None}
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
    warnings = [f"{name}: no truth, skipped" for name in skipped]
    for result in results:
        lacking = [name for name in scenes if name not in result.files]
        if lacking:
            over = f"{len(common)} of {counted(len(scenes), 'scene')}"
            missing = f"no result for {', '.join(lacking)}"
            warnings.append(f"{result.name}: {missing}; means are over {over}, which all have")
    summary = {
        "matchers": {name: _of_matcher(scenes, name, common) for name in names},
        "folder": str(folder),
        "results": {result.name: str(result.folder) for result in results},
        "mean_over": common,
        "skipped": skipped,
        "warnings": warnings,
    }
    return dict(plain(summary))


def _of_matcher(scenes: Mapping[str, SceneFigures], matcher: str, common: Sequence[str]) -> Figures:
    """Return the entry of one matcher in ``summary.json``."""
    own = {name: figures[matcher] for name, figures in scenes.items() if matcher in figures}
    counted = {name: own[name] for name in common}
    masks = {name: {mask: one[mask] for mask in MASKS} for name, one in counted.items()}
    seconds = {name: one["seconds"] for name, one in counted.items()}
    confidence = {name: one["confidence"] for name, one in counted.items()}
    weighted = {
        **weighted_figures(masks),
        "confidence": weighted_confidence(confidence),
        "seconds": None if None in seconds.values() else weighted_figures(seconds),
    }
    return {"scenes": own, "weighted": weighted}


def weighted_figures(scenes: Mapping[str, Any]) -> Any:
    """Return the mean of nested figures and curves over scenes, with the benchmark's weights.

    A figure that any scene lacks is left out; one that is NaN in any is NaN.
    """
    first = next(iter(scenes.values()))
    if isinstance(first, Mapping):
        shared = (key for key in first if all(key in one for one in scenes.values()))
        by_key = {key: {name: one[key] for name, one in scenes.items()} for key in shared}
        return {key: weighted_figures(each) for key, each in by_key.items()}
    if isinstance(first, list):
        return rounded(np.average(list(scenes.values()), axis=0, weights=_weights(scenes)))
    values = np.array(list(scenes.values()), dtype=np.float64)
    return float(np.average(values, weights=_weights(scenes)))


def weighted_confidence(scenes: Mapping[str, Figures | None]) -> Figures | None:
    """Return the mean over the scenes that have figures, with the benchmark's weights."""
    found = {name: one for name, one in scenes.items() if one is not None}
    if not found:
        return None
    bins = {name: one["reliability"] for name, one in found.items()}
    rest = {name: {**one, "reliability": {}} for name, one in found.items()}
    return {**weighted_figures(rest), "reliability": _pooled(bins)}


def _pooled(scenes: Mapping[str, Figures]) -> Figures:
    """Pool the bins of confidence with the share of each scene scaled to its weight."""
    weights, bins = _weights(scenes), scenes.values()
    share = np.array([one["share"] for one in bins]) * (weights / weights.sum())[:, None]
    total = share.sum(axis=0)
    pooled: Figures = {}
    for name in ("confidence", "right"):
        values = np.array([one[name] for one in bins], dtype=np.float64)
        with np.errstate(invalid="ignore"):
            pooled[name] = rounded(np.sum(share * np.nan_to_num(values), axis=0) / total)
    return {**pooled, "share": rounded(total)}


def _weights(scenes: Iterable[str]) -> Float64:
    return np.array([scene_weight(name) for name in scenes])
