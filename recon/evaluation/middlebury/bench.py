"""Matching and scoring one scene with several matchers."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from recon.core.values import Disparity, RectifiedPair
from recon.core.values.arrays import Float32
from recon.evaluation.middlebury.confidence import confidence_figures
from recon.evaluation.middlebury.rules import values_compared
from recon.evaluation.middlebury.scenes import ScoredScene
from recon.evaluation.middlebury.score import Figures, dense_map, score_result
from recon.io.files import naming
from recon.stereo.match.foreign import name_of
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.registry import make_matcher, searched_ndisp
from recon.stereo.rectify.rectifier import Rectifier
from recon.stereo.settings import StereoSettings

_WARM_UP_ROWS: Final = 64


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Result of one matcher, or of another program, on one scene.

    Attributes:
        scene: The scene.
        matcher: Name of the matcher or of the folder of results.
        values: float32 (h, w), its disparity in pixels of its own size; NaN = none.
        figures: As `score_result` gives them; ``ndisp``, the number of disparities searched, None
            of a matcher that is not ours; and ``confidence`` as `confidence_figures` gives it,
            None of a matcher with the same confidence everywhere.
        seconds: Time of matching alone; None = not known.
        file: The file that the result was read from; None = it was made here.
    """

    scene: ScoredScene
    matcher: str
    values: Float32
    figures: Figures
    seconds: float | None
    file: Path | None = None

    def error_px(self) -> Float32:
        """Return float32 (H, W), dense absolute error in full-size pixels; NaN = truth unknown."""
        truth, rules = self.scene.truth.values, self.scene.rules
        error = values_compared(dense_map(self.values), truth.shape, rules) - truth
        return np.asarray(np.abs(error) * np.float32(rules.full_size_factor), dtype=np.float32)


class Bench:
    """Matches and scores scenes; each thread has its own matchers, warmed up once.

    The warm-up keeps kernel compilation and network loading out of the timings. A matcher given as
    an object is shared by the threads.

    Args:
        matchers: The matchers, by name or as objects.
        config: Their settings, and the conversion of images to grey.
        threads: Threads of each matcher.
        auto_range: Whether the disparity range is estimated from each pair, as if unknown,
            instead of taken from the scene.
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
        """Yield one result for each matcher, in the order given.

        Raises:
            ReconError: A matcher cannot match the scene; the message names it.
        """
        camera = replace(scene.camera, ndisp=None) if self._auto_range else scene.camera
        pair = Rectifier(camera, self._config.rectification).rectify(scene.pair)
        with naming(scene.name):
            for given, matcher in zip(self._given, self._matchers(pair), strict=True):
                start = time.perf_counter()
                disparity = matcher.match(pair)
                seconds = time.perf_counter() - start
                figures = score_result(scene, disparity.values)
                figures["ndisp"] = searched_ndisp(given, self._config.matching, pair)
                rated = confidence_figures(disparity, scene.truth) if _rates(disparity) else None
                figures["confidence"] = rated
                yield SceneResult(scene, name_of(given), disparity.values, figures, seconds)

    def _matchers(self, pair: RectifiedPair) -> list[Matcher]:
        made: list[Matcher] | None = getattr(self._own, "matchers", None)
        if made is None:
            made = [make_matcher(n, self._config.matching, self._threads) for n in self._given]
            for matcher in made:
                matcher.match(_upper_rows(pair))
            self._own.matchers = made
        return made


def _rates(disparity: Disparity) -> bool:
    """Return whether the matcher gives each match a confidence of its own."""
    sure = disparity.confidence[disparity.valid]
    return bool(sure.size) and bool(sure.min() < sure.max())


def _upper_rows(pair: RectifiedPair) -> RectifiedPair:
    """Return the top rows of a pair, for a quick warm-up on images of the same kind."""
    rows = min(_WARM_UP_ROWS, pair.camera.height_px)
    return RectifiedPair(
        left=np.ascontiguousarray(pair.left[:rows]),
        right=np.ascontiguousarray(pair.right[:rows]),
        camera=replace(pair.camera, height_px=rows),
    )
