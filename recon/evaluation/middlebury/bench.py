"""One scene matched by several matchers, or matched by other programs, and scored."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from recon.core.errors import SettingsError
from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32
from recon.evaluation.middlebury.rules import scene_weight
from recon.evaluation.middlebury.scenes import ResultFolder, ScoredScene, read_seconds
from recon.evaluation.middlebury.score import Figures, confidence_figures, score_result
from recon.io.files import naming
from recon.io.images.pfm import read_pfm
from recon.stereo.frame import StereoSettings
from recon.stereo.match.protocol import Matcher, name_of
from recon.stereo.match.registry import check_matcher, make_matcher, searched_ndisp
from recon.stereo.rectify.rectifier import Rectifier

_WARM_UP_ROWS: Final = 64
_FOLDER_NAME: Final = re.compile(r"\w[\w.+ ()-]*")


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Result of one matcher, or of another program, on one scene.

    Attributes:
        scene: The scene.
        matcher: Name of the matcher or of the folder of results.
        values: float32 (h, w), its disparity in pixels of its own size; NaN = none.
        figures: An entry of ``scenes`` in ``summary.json``.
    """

    scene: ScoredScene
    matcher: str
    values: Float32
    figures: Figures


class Bench:
    """Matches and scores scenes; each thread has its own matchers, warmed up once.

    The warm-up keeps kernel compilation and network loading out of the timings. A matcher given as
    an object is shared by the threads.

    Args:
        matchers: The matchers, by name or as objects.
        config: Their settings, and the conversion of images to grey.
        threads: Threads of each matcher.
        auto_range: Whether the disparity range is estimated from each pair, as if unknown.
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
                rated = confidence_figures(disparity, scene.truth) if _rates(disparity) else None
                ndisp = searched_ndisp(given, self._config.matching, pair)
                figures = _figures(scene, disparity.values, ndisp, rated, round(seconds, 4))
                yield SceneResult(scene, name_of(given), disparity.values, figures)

    def _matchers(self, pair: RectifiedPair) -> list[Matcher]:
        made: list[Matcher] | None = getattr(self._own, "matchers", None)
        if made is None:
            made = [make_matcher(n, self._config.matching, self._threads) for n in self._given]
            for matcher in made:
                matcher.match(_upper_rows(pair))
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


def _rates(disparity: Disparity) -> bool:
    """Return whether the matcher gives each match a confidence of its own."""
    sure = disparity.confidence[disparity.valid]
    return bool(sure.size) and bool(sure.min() < sure.max())


def _upper_rows(pair: RectifiedPair) -> RectifiedPair:
    """Return the top rows of a pair, for a quick warm-up on images of the same kind."""
    rows = min(_WARM_UP_ROWS, pair.camera.height_px)
    camera = replace(pair.camera, height_px=rows)
    return RectifiedPair(left=pair.left[:rows], right=pair.right[:rows], camera=camera)
