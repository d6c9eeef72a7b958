"""The step before all others: what was recorded of a frame becomes a view with a disparity.

Two images are rectified and matched; a camera with depth brings its disparity along. What comes
after sees the rectified left view, and a disparity with standard deviation, confidence and reasons.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol

from recon.core.values import Disparity, Rectified, RectifiedImage, RectifiedPair
from recon.stereo.match.registry import MatchingSettings, make_matcher
from recon.stereo.match.sad import HalfSizeMatcher
from recon.stereo.rectify.features import (
    INSPECTED,
    check_inspection,
    inspect_features,
    match_features,
)
from recon.stereo.rectify.rectifier import Rectifier
from recon.stereo.support import Support, measure_support

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
