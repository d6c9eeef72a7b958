"""The matchers by name: ours, and those that installed packages register."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from pydantic import InstanceOf, field_serializer

from recon.core.plugins import name_of
from recon.core.settings import Settings
from recon.core.values import RectifiedPair
from recon.stereo.match import protocol
from recon.stereo.match.fill import FillingMatcher
from recon.stereo.match.fine import FineMatcher, FineSettings
from recon.stereo.match.onnx import OnnxMatcher, OnnxSettings
from recon.stereo.match.opencv import OpencvMatcher, OpencvSettings
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import AutoRangeMatcher, SadMatcher, SadSettings, estimate_ndisp
from recon.stereo.match.search import FillableSettings, SearchSettings
from recon.stereo.match.sgm import SgmMatcher, SgmSettings

MATCHERS: Final[dict[str, Callable[[Any, int | None], Matcher]]] = {
    "sad": SadMatcher,
    "sgm": SgmMatcher,
    "fine": FineMatcher,
    "opencv-bm": lambda settings, _: OpencvMatcher(settings, semi_global=False),
    "opencv-sgbm": lambda settings, _: OpencvMatcher(settings, semi_global=True),
    "onnx": OnnxMatcher,
}


class MatchingSettings(Settings):
    """Which matcher, and the settings of each."""

    matcher: str | InstanceOf[Matcher] = "sad"
    """Name of the matcher: sad, sgm, fine, opencv-bm, opencv-sgbm, onnx, or one that an installed
    package registers; in Python also a matcher of your own."""
    keyframe_matcher: str | None = None
    """Name of a slower matcher, such as fine, for those views of a recorded drive that show
    something new; the others are matched as ever. The map is denser and more accurate, and takes
    seconds more for each such view."""
    sad: SadSettings = SadSettings()
    sgm: SgmSettings = SgmSettings()
    fine: FineSettings = FineSettings()
    opencv: OpencvSettings = OpencvSettings()
    onnx: OnnxSettings = OnnxSettings()

    @field_serializer("matcher")
    def _written(self, matcher: str | Matcher) -> str:
        return name_of(matcher)


def make_matcher(
    matcher: str | Matcher, settings: MatchingSettings | None = None, threads: int | None = None
) -> Matcher:
    """Make the matcher of a name, ours or one that an installed package registers.

    An object with the methods of `Matcher` is taken too; what a matcher that is not ours returns is
    checked. ``settings`` are those of all matchers; threads (None = all cores) are for ours.
    """
    settings = settings or MatchingSettings()
    if not isinstance(matcher, str) or matcher not in MATCHERS:
        check_matcher(matcher)
        given = protocol.PLUGINS.load(matcher)
        return AutoRangeMatcher(protocol.CheckedMatcher(given, name_of(matcher)))
    own = getattr(settings, field_of(matcher))
    made = MATCHERS[matcher](own, threads)
    if isinstance(own, FillableSettings) and own.fill:
        made = FillingMatcher(made, own.reach_px, threads)
    # A matcher without the setting searches no range; one that is set needs no guess.
    if getattr(own, "ndisp", 0) is not None:
        return made
    return AutoRangeMatcher(made, own.min_disparity_px)


def check_matcher(matcher: str | Matcher) -> None:
    """Check that a matcher exists, without making it."""
    protocol.PLUGINS.check(matcher, MATCHERS)


def settings_of(matcher: str | Matcher, settings: MatchingSettings) -> Settings | None:
    """Return the settings of one matcher; None of a matcher that is not ours."""
    if not isinstance(matcher, str) or matcher not in MATCHERS:
        return None
    own: Settings = getattr(settings, field_of(matcher))
    return own


def searched(settings: MatchingSettings) -> SearchSettings:
    """Return the range of the chosen matcher; that of `sad` where it searches none."""
    own = settings_of(settings.matcher, settings)
    return own if isinstance(own, SearchSettings) else settings.sad


def searched_ndisp(
    matcher: str | Matcher, settings: MatchingSettings, pair: RectifiedPair
) -> int | None:
    """Return how many disparities a matcher searches before rounding; None: no range, not ours."""
    own = settings_of(matcher, settings)
    if not isinstance(own, SearchSettings):
        return None
    if own.ndisp is None and pair.camera.ndisp is None:
        return estimate_ndisp(pair, own.min_disparity_px)
    return own.ndisp_for(pair.camera)


def field_of(name: str) -> str:
    """Return the field of `MatchingSettings` that a matcher's settings have."""
    return name.partition("-")[0]
