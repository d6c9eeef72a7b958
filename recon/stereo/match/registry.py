"""The matchers by name: ours, and those that installed packages register."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from functools import cache
from typing import Any, Final

from pydantic import InstanceOf, create_model, field_serializer, model_validator
from pydantic.functional_validators import ModelWrapValidatorHandler
from typing_extensions import Self

from recon.core.plugins import name_of
from recon.core.settings import Settings
from recon.core.values import RectifiedPair
from recon.stereo.match import protocol
from recon.stereo.match.fill import FillingMatcher
from recon.stereo.match.fine import FineMatcher
from recon.stereo.match.light import EveningMatcher
from recon.stereo.match.onnx import OnnxMatcher, OnnxSettings
from recon.stereo.match.opencv import OpencvMatcher, OpencvSettings
from recon.stereo.match.protocol import Matcher
from recon.stereo.match.sad import AutoRangeMatcher, SadMatcher, estimate_ndisp
from recon.stereo.match.search import SearchSettings
from recon.stereo.match.sgm import SgmMatcher

MATCHERS: Final[dict[str, Callable[[Any, int | None], Matcher]]] = {
    "sad": SadMatcher,
    "sgm": SgmMatcher,
    "fine": FineMatcher,
    "opencv-bm": lambda settings, _: OpencvMatcher(settings, settings.opencv, semi_global=False),
    "opencv-sgbm": lambda settings, _: OpencvMatcher(settings, settings.opencv, semi_global=True),
    "onnx": lambda settings, threads: OnnxMatcher(settings.onnx, threads),
}
"""What makes each matcher of its `MatchingSettings` and the number of threads."""
EVENED: Final = frozenset({"sad", "sgm", "fine"})  # OpenCV's are as they are
_NAMES: Final = ("matcher", "keyframe_matcher")  # the settings that name a matcher
_RANGE: Final = frozenset({"ndisp", "min_disparity_px", "fill"})
_WINDOW: Final = _RANGE | {"window_px", "uniqueness_percent"}
_OPENCV: Final = _RANGE | {"window_px", "opencv"}
_TAKEN: Final = {
    "sad": _WINDOW,
    "sgm": _WINDOW,
    "fine": _RANGE | {"uniqueness_percent"},
    "opencv-bm": _OPENCV,
    "opencv-sgbm": _OPENCV,
    "onnx": frozenset({"onnx"}),
}


class MatchingSettings(SearchSettings):
    """Which matcher, what it searches, and what only some of them have."""

    matcher: str | InstanceOf[Matcher] = "sad"
    """Name of the matcher: sad, sgm, fine, opencv-bm, opencv-sgbm, onnx, or one that an installed
    package registers; in Python also a matcher of your own."""
    keyframe_matcher: str | None = None
    """Name of a slower matcher, such as fine, for those views of a recorded drive that show
    something new; the others are matched as ever. The map is denser and more accurate, and takes
    seconds more for each such view."""
    opencv: OpencvSettings = OpencvSettings()
    onnx: OnnxSettings = OnnxSettings()

    @field_serializer("matcher")
    def _written(self, matcher: str | Matcher) -> str:
        return name_of(matcher)

    @model_validator(mode="wrap")
    @classmethod
    def _take_plugins(cls, values: Any, check: ModelWrapValidatorHandler[Self]) -> Self:
        """Add the settings of plug-ins that are named, as groups of their own."""
        if cls is MatchingSettings and isinstance(values, Mapping):
            chosen = [one for key, one in values.items() if key in _NAMES and isinstance(one, str)]
            groups = plugin_groups([*values, *chosen])
            if groups:
                extended: Any = _extended(frozenset(groups.items()))
                return extended.model_validate(values)  # type: ignore[no-any-return]
        return check(values)


def plugin_groups(named: Collection[Any] | None = None) -> dict[str, type[Settings]]:
    """Return the settings that installed matchers bring, by field; ``None`` = of all of them.

    ``named`` are keys and values of settings; nothing is imported for names that are ours.
    """
    if named is not None and {*named} <= {*MATCHERS, *MatchingSettings.model_fields, None}:
        return {}
    groups = {}
    for name in sorted({*protocol.PLUGINS.names()} - {*MATCHERS}):
        if named is None or {name, field_of(name)} & {*named}:
            # A class brings settings as its attribute; it is made with them.
            brought = getattr(protocol.PLUGINS.registered(name), "settings", None)
            if inspect.isclass(brought) and issubclass(brought, Settings):
                groups[field_of(name)] = brought
    return groups


@cache
def _extended(groups: frozenset[tuple[str, type[Settings]]]) -> type[MatchingSettings]:
    """Return `MatchingSettings` with more groups."""
    more: dict[str, Any] = {name: (kind, kind()) for name, kind in sorted(groups, key=str)}
    return create_model(
        "MatchingSettings", __base__=MatchingSettings, __doc__=MatchingSettings.__doc__, **more
    )


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
        group = field_of(name_of(matcher))
        brought = plugin_groups([matcher]).get(group) if isinstance(matcher, str) else None
        own = () if brought is None else (getattr(settings, group, None) or brought(),)
        given = protocol.PLUGINS.load(matcher, *own)
        return AutoRangeMatcher(protocol.CheckedMatcher(given, name_of(matcher)))
    made = MATCHERS[matcher](settings, threads)
    ours = settings.fill == "ours" and field_of(matcher) != "opencv"
    if "fill" in settings_taken(matcher) and (ours or settings.fill is True):
        made = FillingMatcher(made, getattr(made, "reach_px", 0), threads)
    if matcher in EVENED:
        made = EveningMatcher(made)
    # One that searches no range, or whose range is set, needs no guess.
    if settings.ndisp is not None or "ndisp" not in settings_taken(matcher):
        return made
    return AutoRangeMatcher(made, settings.min_disparity_px)


def check_matcher(matcher: str | Matcher) -> None:
    """Check that a matcher exists, without making it."""
    protocol.PLUGINS.check(matcher, MATCHERS)


def settings_taken(matcher: str | Matcher) -> frozenset[str]:
    """Return the fields of `MatchingSettings` that a matcher reads, besides those that name it."""
    name = name_of(matcher)
    if not isinstance(matcher, str) or name not in MATCHERS:
        return frozenset({field_of(name)})
    return _TAKEN[name]


def searched_ndisp(
    matcher: str | Matcher, settings: MatchingSettings, pair: RectifiedPair
) -> int | None:
    """Return how many disparities a matcher searches before rounding; None: no range, not ours."""
    if "ndisp" not in settings_taken(matcher):
        return None
    if settings.ndisp is None and pair.camera.ndisp is None:
        return estimate_ndisp(pair, settings.min_disparity_px)
    return settings.ndisp_for(pair.camera)


def field_of(name: str) -> str:
    """Return the field of `MatchingSettings` with what only one matcher, or one library, has."""
    return name.partition("-")[0] if name in MATCHERS else name.replace("-", "_")
