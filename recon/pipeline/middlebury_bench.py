"""Matching and scoring one scene with several matchers."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from recon.evaluation.middlebury import by_the_rules
from recon.formats.files import naming
from recon.matching import Matcher, make_matcher, rates_matches, searched_ndisp
from recon.pipeline.config import ReconConfig
from recon.pipeline.middlebury_confidence import confidence_figures
from recon.pipeline.middlebury_scenes import ScoredScene
from recon.pipeline.middlebury_score import Figures, dense_map, score_result
from recon.rectification import Rectifier
from recon.structures import Disparity, RectifiedPair
from recon.structures.arrays import Float32

_WARM_UP_ROWS: Final = 64


@dataclass(frozen=True, eq=False)
class SceneResult:
    """Result of one matcher on one scene.

    Attributes:
        scene: The scene.
        matcher: Name of the matcher.
        disparity: Its disparity, at the size of the images.
        figures: As `score_result` gives them; ``ndisp``, the number of disparities searched; and
            ``confidence`` as `confidence_figures` gives it, None for a matcher that does not
            estimate confidence.
        seconds: Time of matching alone.
    """

    scene: ScoredScene
    matcher: str
    disparity: Disparity
    figures: Figures
    seconds: float

    def error_px(self) -> Float32:
        """float32 (H, W), dense absolute error in full-size pixels; NaN = truth unknown."""
        truth, rules = self.scene.truth.values, self.scene.rules
        error = by_the_rules(dense_map(self.disparity.values), truth.shape, rules) - truth
        return np.asarray(np.abs(error) * np.float32(rules.full_size_factor), dtype=np.float32)


class Bench:
    """Matches and scores scenes; each thread has its own matchers, warmed up once.

    The warm-up keeps kernel compilation and network loading out of the timings.

    Args:
        names: The matchers.
        config: Their settings, and the conversion of images to grey.
        threads: Threads of each matcher.
        auto_range: Whether the disparity range is estimated from each pair, as if unknown,
            instead of taken from the scene.
    """

    def __init__(
        self, names: Sequence[str], config: ReconConfig, threads: int, *, auto_range: bool = False
    ) -> None:
        self._names = names
        self._config = config
        self._threads = threads
        self._auto_range = auto_range
        self._own = threading.local()

    def results(self, scene: ScoredScene) -> Iterator[SceneResult]:
        """One result for each matcher, in the order given.

        Raises:
            ReconError: A matcher cannot match the scene; the message names it.
        """
        camera = replace(scene.camera, ndisp=None) if self._auto_range else scene.camera
        pair = Rectifier(camera, self._config.rectification).rectify(scene.pair)
        with naming(scene.name):
            for name, matcher in self._matchers(pair).items():
                start = time.perf_counter()
                disparity = matcher.match(pair)
                seconds = time.perf_counter() - start
                figures = score_result(scene, disparity.values)
                figures["ndisp"] = searched_ndisp(name, self._config.matching, pair)
                rated = confidence_figures(disparity, scene.truth) if rates_matches(name) else None
                figures["confidence"] = rated
                yield SceneResult(scene, name, disparity, figures, seconds)

    def _matchers(self, pair: RectifiedPair) -> dict[str, Matcher]:
        made: dict[str, Matcher] | None = getattr(self._own, "matchers", None)
        if made is None:
            made = {n: make_matcher(n, self._config.matching, self._threads) for n in self._names}
            for matcher in made.values():
                matcher.match(_upper_rows(pair))
            self._own.matchers = made
        return made


def _upper_rows(pair: RectifiedPair) -> RectifiedPair:
    """The top rows of a pair, for a quick warm-up on images of the same kind."""
    rows = min(_WARM_UP_ROWS, pair.camera.height_px)
    return RectifiedPair(
        left=np.ascontiguousarray(pair.left[:rows]),
        right=np.ascontiguousarray(pair.right[:rows]),
        camera=replace(pair.camera, height_px=rows),
    )
