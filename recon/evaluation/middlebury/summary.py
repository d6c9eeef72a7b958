"""Figures of all scenes of an evaluation, by matcher, and their means."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from recon.core.errors import SettingsError, SourceError
from recon.evaluation.middlebury.bench import SceneResult
from recon.evaluation.middlebury.confidence import weighted_confidence
from recon.evaluation.middlebury.results import ResultFolder
from recon.evaluation.middlebury.rules import scene_weight, weighted_mean
from recon.evaluation.middlebury.score import MASKS, Figures, weighted_figures
from recon.run.summary import plain
from recon.stereo.match.foreign import name_of
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import check_matcher

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


def check_names(matchers: Sequence[str | Matcher]) -> list[str]:
    """Return the names of the matchers, which are also those of their folders.

    Raises:
        SettingsError: A matcher is unknown or named twice, or has no name for a folder.
    """
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


def result_figures(result: SceneResult) -> Figures:
    """Return the figures of one result, with its time and what its scene counts for in means."""
    scene, seconds = result.scene, result.seconds
    return {
        **result.figures,
        "seconds": None if seconds is None else round(seconds, 4),
        "width_px": scene.camera.width_px,
        "height_px": scene.camera.height_px,
        "full_size_factor": scene.rules.full_size_factor,
        "weight": scene_weight(scene.name),
    }


def summarise_scenes(
    found: Mapping[str, SceneFigures | None],
    names: Sequence[str],
    results: Sequence[ResultFolder],
    folder: Path,
) -> Figures:
    """Return the content of ``summary.json``: the figures of each matcher, and its means.

    Args:
        found: Figures of each scene; None without ground truth.
        names: Names of the matchers and of the folders of results.
        results: The folders of results.
        folder: The folder of the scenes.

    Raises:
        SourceError: There is no scene with ground truth, or none that all have a result for.
    """
    skipped = [name for name, figures in found.items() if figures is None]
    scenes = {name: figures for name, figures in found.items() if figures is not None}
    common = _common(scenes, names, folder, skipped)
    summary = {
        "matchers": {name: _of_matcher(scenes, name, common) for name in names},
        "folder": str(folder),
        "results": {result.name: str(result.folder) for result in results},
        "mean_over": common,
        "skipped": skipped,
        "warnings": [
            *(f"{name}: no truth, skipped" for name in skipped),
            *_missing(scenes, results, common),
        ],
    }
    return dict(plain(summary))


def _common(
    scenes: Mapping[str, SceneFigures],
    names: Sequence[str],
    folder: Path,
    skipped: Sequence[str],
) -> list[str]:
    """Return the scenes for which all have a result, so that means can be compared."""
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
    """Return a line for each folder of results that lacks scenes."""
    for result in results:
        lacking = [name for name in scenes if name not in result.files]
        if lacking:
            yield (
                f"{result.name}: no result for {', '.join(lacking)}; means are over "
                f"{len(common)} of {len(scenes)} scenes, which all have"
            )


def _of_matcher(scenes: Mapping[str, SceneFigures], matcher: str, common: Sequence[str]) -> Figures:
    """Return the entry of one matcher in ``summary.json``."""
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
