"""Figures of all scenes of an evaluation, by matcher, and their means."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recon.core.errors import SourceError
from recon.core.values.arrays import Float64
from recon.core.words import counted
from recon.evaluation.middlebury.rules import scene_weight, weighted_mean
from recon.evaluation.middlebury.scenes import ResultFolder
from recon.evaluation.middlebury.score import MASKS, Figures, rounded
from recon.run.summary import plain

SceneFigures = dict[str, Figures]
"""Figures of one scene, by matcher."""


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

    Means are over the scenes for which all have a result, so that they can be compared.

    Args:
        found: Figures of each scene; None without ground truth.
        names: Names of the matchers and of the folders of results.
        results: Folders of results of other programs.
        folder: The folder of the scenes.
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
    without = [f"{name}: no truth, skipped" for name in skipped]
    summary = {
        "matchers": {name: _of_matcher(scenes, name, common) for name in names},
        "folder": str(folder),
        "results": {result.name: str(result.folder) for result in results},
        "mean_over": common,
        "skipped": skipped,
        "warnings": [*without, *_missing(scenes, results, common)],
    }
    return dict(plain(summary))


def _missing(
    scenes: Mapping[str, SceneFigures], results: Sequence[ResultFolder], common: Sequence[str]
) -> Iterator[str]:
    """Return a line for each folder of results that lacks scenes."""
    for result in results:
        lacking = [name for name in scenes if name not in result.files]
        if lacking:
            yield (
                f"{result.name}: no result for {', '.join(lacking)}; means are over "
                f"{len(common)} of {counted(len(scenes), 'scene')}, which all have"
            )


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

    A figure that any scene lacks is left out.
    """
    first = next(iter(scenes.values()))
    if isinstance(first, Mapping):
        shared = (key for key in first if all(key in one for one in scenes.values()))
        by_key = {key: {name: one[key] for name, one in scenes.items()} for key in shared}
        return {key: weighted_figures(each) for key, each in by_key.items()}
    if isinstance(first, list):
        return rounded(np.average(list(scenes.values()), axis=0, weights=_weights(scenes)))
    return weighted_mean(scenes)


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
