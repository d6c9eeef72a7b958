"""The step before all others: what was recorded of a frame becomes a view with a disparity.

Two images are rectified and matched; a camera with depth brings its disparity along. What comes
after sees the rectified left view, and a disparity with standard deviation, confidence and reasons.

Two signs show that two images belong together, and depend on little else: many features agree, and
more pixels match than in rows that do not belong together. Good pairs have both, unrelated images
none.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final, Literal, Protocol

import numpy as np

from recon.core.errors import MatchingError
from recon.core.text import counted
from recon.core.values import Disparity, Rectified, RectifiedImage, RectifiedPair
from recon.stereo.match.registry import MatchingSettings, make_matcher
from recon.stereo.match.sad import HalfSizeMatcher, estimate_ndisp
from recon.stereo.match.search import SearchSettings
from recon.stereo.rectify.epipolar import count_aligned
from recon.stereo.rectify.features import (
    INSPECTED,
    PairFeatures,
    check_inspection,
    inspect_features,
    match_features,
)
from recon.stereo.rectify.rectifier import Rectifier

_LEAST_ROWS: Final = 64  # lower images are not judged: hardly a feature fits in
_SHIFT_ROWS: Final = 16
_SHIFT_RATIO: Final = 1 / 24
"""Rows by which images are shifted to see what matches by chance: of their height, and at least.

What is left in common there are edges between large areas, as of two roads: farther shifts, where
such areas differ too, would take those for matches."""
_BY_PIXELS: Final = 2.2
"""Times chance from which matches support a pair. Unrelated, mirrored and turned images of ten
cameras have 0.7 to 2.0, if they are not symmetrical; good pairs 2.3 to 40."""
_LEAST_RATIO: Final = 0.02
"""Of the pixels, beyond chance: fewer support nothing, as those that noise has in common."""
_MOSTLY: Final = 0.4
"""Of the pixels, which no unrelated pair matches: along upright edges shifted rows match, too."""
_DOUBTED: Final = 1.5
_LEAST_FEATURES: Final = 12
"""Features from which they support a pair, if most of those matched agree: by chance 10 did."""


@dataclass(frozen=True)
class Support:
    """What supports that two images belong together."""

    measured: float  # mean confidence of a match at half size, over all pixels
    by_chance: float  # the same with rows of the right image that belong elsewhere
    matched: int  # number of matched features
    agreeing: int  # of them, on how rows meet, and at disparities that are searched

    @property
    def times_chance(self) -> float:
        """How many times as much matches as by chance; infinite where nothing does by chance."""
        if self.by_chance > 0.0:
            return self.measured / self.by_chance
        return float("inf") if self.measured > 0.0 else 0.0

    @property
    def by_features(self) -> bool:
        """Whether features support the pair; they match where exposures or rows differ, too."""
        return self.agreeing >= _LEAST_FEATURES and 2 * self.agreeing > self.matched

    @property
    def shown(self) -> bool:
        """Whether anything supports the pair: dense matches do where hardly a corner is."""
        beyond = self.measured - self.by_chance
        clearly = self.times_chance >= _BY_PIXELS and beyond >= _LEAST_RATIO
        return self.by_features or clearly or self.measured >= _MOSTLY

    @property
    def doubtful(self) -> bool:
        """Whether one of the two signs is missing."""
        return not self.by_features or self.times_chance < _DOUBTED

    def check(self, where: str | None, hint: str | None = None) -> None:
        """Raise `MatchingError` where nothing supports the pair."""
        if self.shown:
            return
        advice = (
            "give rectified images of one moment, or raw ones with the calibration of their "
            "cameras, neither mirrored nor upside down, and a range (--ndisp) that reaches the "
            "nearest things"
        )
        what = "nothing shows that left and right belong together"
        raise MatchingError(what, where=where, got=self._found, hint=hint or advice)

    def warnings(self) -> tuple[str, ...]:
        if not self.doubtful:
            return ()
        return (f"little shows that left and right belong together: {self._found}",)

    @property
    def _found(self) -> str:
        features, times = counted(self.matched, "matched feature"), f"{self.times_chance:.1f} times"
        agree = f"{self.agreeing} of {features} agree within the range"
        return f"{agree}, and {times} as many pixels match as by chance"


def measure_support(
    pair: RectifiedPair, features: PairFeatures, searched: SearchSettings, threads: int | None
) -> Support | None:
    """Measure what supports a pair with matched features, over the range that is searched.

    Its own images say what chance gives: with the rows of the right one shifted, nothing belongs
    together, while texture, noise and exposure are the same. None: the images are too small, or
    show nothing.
    """
    height = len(pair.left)
    if height < _LEAST_ROWS:
        return None
    if searched.ndisp is None and pair.camera.ndisp is None:
        ndisp = estimate_ndisp(pair, searched.min_disparity_px)
        pair = replace(pair, camera=replace(pair.camera, ndisp=ndisp))
    matcher = HalfSizeMatcher(searched, threads)
    rows = max(_SHIFT_ROWS, round(height * _SHIFT_RATIO))
    measured, *by_chance = (
        float(matcher.match(replace(pair, right=right)).confidence.mean())
        for right in (pair.right, *(np.roll(pair.right, shift, axis=0) for shift in (-rows, rows)))
    )
    if not measured and not any(by_chance):
        return None
    columns_px = features.left_uv[:, 0] - features.right_uv[:, 0] - searched.min_disparity_px
    within = (columns_px > -1) & (columns_px < searched.ndisp_for(pair.camera) + 1)
    near = features.select(within)
    agreeing = count_aligned(near.left_uv, near.right_uv, pair.camera)
    return Support(measured, max(by_chance), len(features), agreeing)


Effort = Literal["match", "match_roughly", "match_keyframes"]
Inspected = tuple[tuple[str, ...], Support | None]


class Observer(Protocol):
    """Says what one kind of recording (`Recorded`) shows of a frame.

    `rectify` gives its left view with what the disparity is known from, `observe` the disparity;
    `inspect` gives warnings, and what supports that the images of a view belong together.
    """

    def rectify(self, recorded: Any) -> Rectified: ...
    def observe(self, view: Any, effort: Effort) -> Disparity: ...
    def inspect(self, view: Any) -> Inspected: ...


class Matching:
    """Of two images: what looks the same in both is matched."""

    def __init__(
        self, rectifier: Rectifier, settings: MatchingSettings, threads: int | None
    ) -> None:
        self.rectify = rectifier.rectify
        self._searched, self._threads = settings, threads
        names = {"match": settings.matcher, "match_keyframes": settings.keyframe_matcher}
        self.matchers = {
            effort: make_matcher(name, settings, threads)
            for effort, name in names.items()
            if name is not None
        }
        self.matchers["match_roughly"] = HalfSizeMatcher(self._searched, threads=1)

    def observe(self, view: RectifiedPair, effort: Effort) -> Disparity:
        return self.matchers[effort].match(view)

    def inspect(self, view: RectifiedPair) -> Inspected:
        features = match_features(view.left, view.right, INSPECTED)
        found = inspect_features(features, view.camera.doffs_px)
        warnings = check_inspection(found, where=f"frame {view.index}")
        support = measure_support(view, features, self._searched, self._threads)
        return (*warnings, *(() if support is None else support.warnings())), support


class MeasuredDepth:
    """Of a camera with depth: its image is rectified, and its disparity is as it was recorded."""

    def rectify(self, recorded: RectifiedImage) -> RectifiedImage:
        return recorded

    def observe(self, view: RectifiedImage, effort: Effort) -> Disparity:
        return view.disparity

    def inspect(self, view: RectifiedImage) -> Inspected:
        return (), None
