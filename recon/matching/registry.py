"""The matchers by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, Literal

from pydantic import Field

from recon.errors import SettingsError
from recon.matching.onnx import OnnxMatcher, OnnxSettings
from recon.matching.opencv import (
    OpencvBmMatcher,
    OpencvBmSettings,
    OpencvSgbmMatcher,
    OpencvSgbmSettings,
)
from recon.matching.protocol import Matcher
from recon.matching.range import AutoRangeMatcher, estimate_ndisp
from recon.matching.sad import SadMatcher, SadSettings
from recon.matching.search import SearchSettings
from recon.matching.sgm import SgmMatcher, SgmSettings
from recon.matching.unrated import UnratedSettings
from recon.settings import Settings
from recon.structures import RectifiedPair

MATCHERS: Final[dict[str, Callable[[Any, int | None], Matcher]]] = {
    "sad": SadMatcher,
    "sgm": SgmMatcher,
    "opencv-bm": OpencvBmMatcher,
    "opencv-sgbm": OpencvSgbmMatcher,
    "onnx": OnnxMatcher,
}


class MatchingSettings(Settings):
    """Which matcher, and the settings of each."""

    matcher: str = Field(
        default="sad", description="Name of the matcher: sad, sgm, opencv-bm, opencv-sgbm or onnx."
    )
    range: Literal["auto", "usual"] = Field(
        default="auto",
        description="How far to search where neither the matcher's `ndisp` nor the calibration "
        "says it: as far as each pair needs, but at least the usual tenth of the image width; or "
        "just that tenth.",
    )
    sad: SadSettings = Field(default_factory=SadSettings, description="Of the matcher `sad`.")
    sgm: SgmSettings = Field(default_factory=SgmSettings, description="Of the matcher `sgm`.")
    opencv_bm: OpencvBmSettings = Field(
        default_factory=OpencvBmSettings, description="Of the matcher `opencv-bm`."
    )
    opencv_sgbm: OpencvSgbmSettings = Field(
        default_factory=OpencvSgbmSettings, description="Of the matcher `opencv-sgbm`."
    )
    onnx: OnnxSettings = Field(default_factory=OnnxSettings, description="Of the matcher `onnx`.")


def make_matcher(
    name: str, settings: MatchingSettings | None = None, threads: int | None = None
) -> Matcher:
    """Make the matcher of a name.

    Args:
        name: A key of `MATCHERS`.
        settings: The settings of all matchers; it takes its own part.
        threads: Threads that it may use; all cores by default.

    Raises:
        SettingsError: There is no such matcher.
    """
    if name not in MATCHERS:
        choices = ", ".join(sorted(MATCHERS))
        raise SettingsError("unknown matcher", got=repr(name), expected=f"one of: {choices}")
    settings = settings or MatchingSettings()
    own = getattr(settings, field_of(name))
    matcher = MATCHERS[name](own, threads)
    # A matcher without the setting searches no range; one that is set needs no guess.
    if settings.range == "usual" or getattr(own, "ndisp", 0) is not None:
        return matcher
    return AutoRangeMatcher(matcher, own.min_disparity_px)


def rates_matches(name: str) -> bool:
    """Whether the matcher of a name tells how sure it is of each match.

    Args:
        name: A key of `MATCHERS`.
    """
    settings = MatchingSettings.model_fields[field_of(name)].annotation
    return not (isinstance(settings, type) and issubclass(settings, UnratedSettings))


def searched_ndisp(name: str, settings: MatchingSettings, pair: RectifiedPair) -> int | None:
    """How many disparities the matcher of a name searches in a pair, before it rounds them.

    Args:
        name: A key of `MATCHERS`.
        settings: The settings of all matchers.
        pair: The pair.

    Returns:
        Their number, or None of a matcher that searches no range.
    """
    own = getattr(settings, field_of(name))
    if not isinstance(own, SearchSettings):
        return None
    if settings.range == "auto" and own.ndisp is None and pair.camera.ndisp is None:
        return estimate_ndisp(pair, own.min_disparity_px)
    return own.ndisp_for(pair.camera)


def field_of(name: str) -> str:
    """The field of `MatchingSettings` that a matcher's settings have."""
    return name.replace("-", "_")
